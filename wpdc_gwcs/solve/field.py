"""The field of an exposure: a smooth random displacement of the focal plane.

The atmosphere shifts the stars of one exposure by a few hundredths of a pixel, alike over minutes
of arc.  That is a Gaussian process with the spectrum of von Karman, written as a sum of sine waves
on a patch a little larger than the detector: the waves are the columns of a linear model, the
spectrum is the prior of their coefficients, and so the field is one more term with a prior.

::

    residuals, noise --spectrum by evidence--> amplitude s, outer scale L, stretch
                     --posterior--> coefficients and covariance --Field--> displacement, variance
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_solve, lapack
from scipy.optimize import minimize

__all__ = [
    "Basis",
    "Field",
    "Products",
    "Spectrum",
    "fit_field",
    "learn_spectra",
    "patch",
    "pooled_spectrum",
]

# The patch is this much larger than the part of the focal plane where stars are used: the waves
# vanish at its rim.
_PATCH = 1.2

# Sum over the waves of a kind of field: a potential's gradient, or each axis by itself.
KINDS = ("curl-free", "axes")

# Prior of the spectrum of one exposure about the pooled one (natural logarithms), measured on
# ground-based frames.
_LOG_AMPLITUDE_SCATTER = 1.0
_LOG_SCALE_SCATTER = 0.7
_LOG_STRETCH_SCATTER = 0.5

# Exposures, and frames of each, that the pooled spectrum is learnt from.
_EXPOSURES_POOLED, _FRAMES_POOLED = 8, 2

# Gain in log evidence that fields must bring to all exposures together, and what a stretch (two
# numbers more) must add to one that is well above it.
_LEAST_GAIN = 5.0
_STRETCH_GAIN = 3.0
_GAIN_FOR_STRETCH = 30.0


@dataclass(frozen=True, eq=False)
class Basis:
    """Sine waves on a rectangle of the focal plane.

    Parameters
    ----------
    center, half : (2,) ndarray
        Middle and half sides of the rectangle, px.
    orders : (2, M) ndarray of int
        Half waves along each axis, in the order of growing wave number.
    """

    center: np.ndarray
    half: np.ndarray
    orders: np.ndarray

    @property
    def wave(self):
        """Wave vectors ``(2, M)``, rad / px."""
        return 0.5 * np.pi * self.orders / self.half[:, None]

    def design(self, focal, kind="curl-free"):
        """Displacements of unit coefficients: ``(2, N, M + 2)`` or ``(2, N, 2 M + 2)``.

        Parameters
        ----------
        focal : (2, N) ndarray
            Focal plane, px.
        kind : {'curl-free', 'axes'}, optional
            Gradient of a potential, or each axis by itself.

        Returns
        -------
        ndarray
            The last two columns are a constant along each axis.
        """
        return np.moveaxis(self.shapes(focal, kind), 0, -1)

    def shapes(self, focal, kind="curl-free"):
        """Return `design` with the coefficients first, as it lies in memory: ``(K, 2, N)``.

        Parameters
        ----------
        focal : (2, N) ndarray
            Focal plane, px.
        kind : {'curl-free', 'axes'}, optional
            Gradient of a potential, or each axis by itself.

        Returns
        -------
        ndarray
            The last two are a constant along each axis.
        """
        phases = [
            np.outer(
                np.arange(self.orders[a].max() + 1),
                (focal[a] - self.center[a] + self.half[a]) * (0.5 * np.pi / self.half[a]),
            )
            for a in range(2)
        ]
        m = self.orders.shape[1]
        norm = 1.0 / np.sqrt(np.prod(self.half))
        size = m if kind == "curl-free" else 2 * m
        out = np.zeros((size + 2, 2, focal.shape[1]))
        sines = [np.sin(phase) for phase in phases]
        if kind == "curl-free":
            wave = self.wave * norm
            for a in range(2):
                along = np.cos(phases[a])[self.orders[a]]
                along *= wave[a][:, None]
                np.multiply(along, sines[1 - a][self.orders[1 - a]], out=out[:m, a])
        else:
            first = sines[0][self.orders[0]]
            first *= norm
            np.multiply(first, sines[1][self.orders[1]], out=out[:m, 0])
            out[m : 2 * m, 1] = out[:m, 0]
        out[size, 0] = out[size + 1, 1] = 1.0
        return out


def patch(low, high, n_waves):
    """Waves for the part of the focal plane between two corners.

    Parameters
    ----------
    low, high : (2,) array_like
        Corners, px.
    n_waves : int
        Waves to keep, the longest ones.

    Returns
    -------
    Basis
        On a rectangle that is a fifth larger.
    """
    low, high = np.asarray(low, float), np.asarray(high, float)
    half = 0.5 * _PATCH * (high - low)
    # Enough orders along each axis that the shortest side does not run out of them.
    reach = 2 * np.sqrt(n_waves / np.pi / np.prod(half)) * half * 1.3 + 2
    j, k = (a.ravel() for a in np.meshgrid(*(np.arange(1, int(r) + 2) for r in reach)))
    order = np.argsort((j / half[0]) ** 2 + (k / half[1]) ** 2, kind="stable")[:n_waves]
    return Basis(0.5 * (low + high), half, np.array([j[order], k[order]]))


@dataclass(frozen=True)
class Spectrum:
    """Power of a field: von Karman's, stretched along one direction.

    Parameters
    ----------
    amplitude : float
        Standard deviation along each axis, px.
    scale : float
        Outer scale, px.
    stretch, angle : float
        Ratio of the scales along and across a direction, and that direction in rad.
    kind : {'curl-free', 'axes'}
        Whether the displacements are the gradient of a potential.
    """

    amplitude: float
    scale: float
    stretch: float = 1.0
    angle: float = 0.0
    kind: str = "curl-free"

    def _reduced(self, wave):
        """Square of the wave number over that of the outer scale, ``k^2 / k0^2``."""
        c, s = np.cos(self.angle), np.sin(self.angle)
        along, across = c * wave[0] + s * wave[1], c * wave[1] - s * wave[0]
        square = along**2 * self.stretch + across**2 / self.stretch
        return square * (self.scale / (2 * np.pi)) ** 2

    def prior(self, basis):
        """Variance of each coefficient of a basis, the two constants last.

        Parameters
        ----------
        basis : Basis
            Waves.

        Returns
        -------
        ndarray
            For the columns of ``basis.design(..., kind)``.
        """
        wave = basis.wave
        k0 = 2 * np.pi / self.scale
        # Both axes together; the integral of the spectrum over the plane is 2 amplitude^2.
        power = self.amplitude**2 * (20 * np.pi / 3) / k0**2
        power = power * (1 + self._reduced(wave)) ** (-11 / 6)
        if self.kind == "curl-free":
            power = power / np.sum(wave**2, axis=0)
        else:
            power = np.tile(0.5 * power, 2)
        lowest = (0.25 * self.scale / basis.half.max()) ** 2
        constant = self.amplitude**2 * (1 - (1 + lowest) ** (-5 / 6))
        return np.concatenate([power, [constant, constant]])

    def unresolved(self, basis):
        """Variance along each axis that the waves of a basis are too long for, px^2.

        Parameters
        ----------
        basis : Basis
            Waves.

        Returns
        -------
        float
            What remains as noise.
        """
        highest = np.max(np.sum(basis.wave**2, axis=0)) * (self.scale / (2 * np.pi)) ** 2
        return self.amplitude**2 * (1 + highest) ** (-5 / 6)


@dataclass(frozen=True, eq=False)
class Products:
    """Weighted products of the waves of one patch: all that evidence needs of the stars.

    Parameters
    ----------
    basis : Basis
        Waves.
    matrix, right : dict
        For each kind of field, normal matrix and right-hand side.
    n_stars : int
        Stars behind them.
    """

    basis: Basis
    matrix: dict
    right: dict
    n_stars: int

    def log_evidence(self, spectrum):
        """Logarithm of the evidence of a spectrum over that of no field.

        Parameters
        ----------
        spectrum : Spectrum
            Spectrum.

        Returns
        -------
        float
            In nats.
        """
        root = np.sqrt(spectrum.prior(self.basis))
        inner = self.matrix[spectrum.kind] * root[:, None] * root
        inner[np.diag_indices_from(inner)] += 1.0
        factor, info = lapack.dpotrf(inner, lower=1, overwrite_a=1)
        if info != 0:
            return -np.inf
        half, _ = lapack.dtrtrs(factor, self.right[spectrum.kind] * root, lower=1)
        return float(0.5 * half @ half - np.sum(np.log(np.diagonal(factor))))


def products(basis, focal, residual, weight, *, nuisance=None, kinds=KINDS):
    """Multiply the waves of a patch with the residuals of its stars.

    Parameters
    ----------
    basis : Basis
        Waves.
    focal, residual, weight : (2, N) ndarray
        Places, residuals (px) and inverse variances of the stars.
    nuisance : (2, N, K) ndarray, optional
        Columns fitted freely beside the field: the attitude of a single detector.
    kinds : tuple of str, optional
        Kinds of field.

    Returns
    -------
    Products
        For `learn_spectra`.
    """
    matrix, right = {}, {}
    w = weight.ravel()
    r = residual.ravel()
    for kind in kinds:
        shapes = basis.shapes(focal, kind)
        shapes = shapes.reshape(len(shapes), -1) * np.sqrt(w)
        g, h = shapes @ shapes.T, shapes @ (np.sqrt(w) * r)
        if nuisance is not None:
            free = nuisance.reshape(-1, nuisance.shape[2])
            cross = (shapes @ (free * np.sqrt(w)[:, None])).T
            normal = (free * w[:, None]).T @ free
            solved = np.linalg.lstsq(
                normal, np.column_stack([cross, (free * w[:, None]).T @ r]), rcond=1e-12
            )[0]
            g = g - cross.T @ solved[:, :-1]
            h = h - cross.T @ solved[:, -1]
        matrix[kind], right[kind] = g, h
    return Products(basis, matrix, right, focal.shape[1])


def learn_spectra(frames, make, *, start, scales, force=False):
    """Find the spectrum of each exposure by evidence, about one that all exposures share.

    Parameters
    ----------
    frames : dict
        Exposure to its frames.
    make : callable
        ``make(frame, kinds)`` returns the `Products` of a frame.
    start : float
        First guess of the amplitude, px.
    scales : (float, float)
        Least and largest outer scale, px.
    force : bool, optional
        Return a spectrum for every exposure, whatever the evidence.

    Returns
    -------
    dict
        Exposure to `Spectrum`, `None` for all where the stars do not speak for fields.

    Notes
    -----
    Maximum a posteriori: the logarithms of amplitude and scale of an exposure scatter by 1 and 0.7
    about the pooled ones.  A field that all exposures have in common, by evidence, is none of
    theirs.
    """
    if not frames:
        return {}
    # A few frames tell what all have in common.
    step = -(-len(frames) // _EXPOSURES_POOLED)
    some = [f for e in sorted(frames)[::step] for f in frames[e][:_FRAMES_POOLED]]
    patches = [make(f, KINDS) for f in some]
    spectrum = pooled_spectrum(patches, start=start, scales=scales)
    if spectrum is not None and _is_common(patches, spectrum):
        spectrum = None
    if spectrum is None and not force:
        return dict.fromkeys(frames)
    if spectrum is None:
        spectrum = Spectrum(1e-3 * start, float(np.sqrt(np.prod(scales))))
    found = {}
    for e, members in frames.items():
        group = [make(f, (spectrum.kind,)) for f in members]
        # Where its own stars say little, an exposure is like the others; where they speak against
        # a field, the amplitude is small.
        found[e], _ = _maximize(group, spectrum.kind, start, scales, about=spectrum)
    return found


def _is_common(patches, spectrum):
    """Tell whether all exposures of a detector have the same field: then it is the detector's."""
    each = common = 0.0
    for basis in {id(p.basis): p.basis for p in patches}.values():
        mine = [p for p in patches if p.basis is basis]
        if len(mine) > 1:
            matrix, right = (
                {spectrum.kind: sum(getattr(p, part)[spectrum.kind] for p in mine)}
                for part in ("matrix", "right")
            )
            together = Products(basis, matrix, right, sum(p.n_stars for p in mine))
            each += sum(p.log_evidence(spectrum) for p in mine)
            common += together.log_evidence(spectrum)
    return common > each


def pooled_spectrum(patches, *, start, scales):
    """Find the spectrum that several patches have in common.

    Parameters
    ----------
    patches : list of Products
        Stars of each, with all kinds of field.
    start : float
        First guess of the amplitude, px.
    scales : (float, float)
        Least and largest outer scale, px.

    Returns
    -------
    Spectrum or None
        `None` where the stars do not speak for a field.
    """
    spectrum, gain = max(
        (_maximize(patches, kind, start, scales) for kind in KINDS), key=lambda found: found[1]
    )
    return spectrum if gain >= _LEAST_GAIN else None


def _maximize(group, kind, start, scales, about=None):
    """Spectrum of the largest evidence (with the prior about another), and its gain in nats."""
    low, high = np.log(scales)

    def spectrum_of(p):
        stretch, angle = (1.0, 0.0) if len(p) < 4 else (np.exp(np.hypot(p[2], p[3])),
                                                        0.5 * np.arctan2(p[3], p[2]))  # fmt: skip
        scale = np.exp(np.clip(p[1], low, high))
        return Spectrum(float(np.exp(p[0])), float(scale), float(stretch), float(angle), kind)

    def penalty(p):
        beyond = max(low - p[1], p[1] - high, 0.0)
        total = beyond**2
        if about is not None:
            total += 0.5 * ((p[0] - np.log(about.amplitude)) / _LOG_AMPLITUDE_SCATTER) ** 2
            total += 0.5 * ((p[1] - np.log(about.scale)) / _LOG_SCALE_SCATTER) ** 2
        if len(p) == 4:
            total += 0.5 * (p[2] ** 2 + p[3] ** 2) / _LOG_STRETCH_SCATTER**2
        return total

    def cost(p):
        if not -25 < p[0] < 10:
            return 1e12
        spectrum = spectrum_of(p)
        return penalty(p) - sum(g.log_evidence(spectrum) for g in group)

    if about is not None:
        p = np.log([about.amplitude, about.scale])
    else:
        trials = [
            (np.log(start * a), np.clip(0.5 * (low + high) + b, low, high))
            for a in (0.2, 1.0, 5.0)
            for b in (-1.0, 0.0, 1.0)
        ]
        p = np.array(min(trials, key=cost))
    found = minimize(cost, p, method="Nelder-Mead",
                     options={"xatol": 0.02, "fatol": 0.05, "maxfev": 80,
                              "initial_simplex": p + [[0, 0], [0.4, 0], [0, 0.4]]})  # fmt: skip
    p, gain = found.x, -found.fun
    if gain > _GAIN_FOR_STRETCH and kind == "curl-free":
        p4 = np.array([*p, 0.0, 0.0])
        steps = np.vstack([np.zeros(4), np.diag([0.2, 0.2, 0.5, 0.5])])
        four = minimize(cost, p4, method="Nelder-Mead",
                        options={"xatol": 0.03, "fatol": 0.1, "maxfev": 120,
                                 "initial_simplex": p4 + steps})  # fmt: skip
        if -four.fun > gain + _STRETCH_GAIN:
            p, gain = four.x, -four.fun
    return spectrum_of(p), gain


@dataclass(frozen=True, eq=False)
class Field:
    """Posterior of the field over one patch.

    Parameters
    ----------
    basis : Basis
        Waves.
    spectrum : Spectrum
        Prior.
    coefficients : (M,) ndarray
        Of the columns of the design.
    root : (M, M) ndarray
        Lower factor of the posterior precision in units of the prior.
    freedom : float
        Effective number of parameters for each star behind the field.
    """

    basis: Basis
    spectrum: Spectrum
    coefficients: np.ndarray
    root: np.ndarray
    freedom: float

    def __call__(self, focal):
        """Displacement ``(2, N)`` at focal plane positions, px.

        Parameters
        ----------
        focal : (2, N) ndarray
            Focal plane, px.

        Returns
        -------
        ndarray
            Px of the focal plane.
        """
        shapes = self.basis.shapes(focal, self.spectrum.kind)
        return (self.coefficients @ shapes.reshape(len(shapes), -1)).reshape(2, -1)

    def conditioned(self, focal, rows, focal_stars, star_rows, weight):
        """Rows of other terms less what the field follows, and the field's own covariance.

        Parameters
        ----------
        focal : (2, N) ndarray
            Places of the rows, px.
        rows : (2, N, P) ndarray
            Columns of the other terms there.
        focal_stars : (2, S) ndarray
            Places of the stars behind the field, px.
        star_rows : (2, S, P) ndarray
            Columns of the other terms there.
        weight : (2, S) ndarray
            Inverse variances of the stars.

        Returns
        -------
        rows : (2, N, P) ndarray
            The field takes a part of what any other term does at the stars.
        covariance : (2, 2, N) ndarray
            Of the field, the other terms fixed, with what the waves are too long for.
        """
        weight = 1.0 / (1.0 / weight + self.spectrum.unresolved(self.basis))
        waves = self._scaled(focal_stars)
        flat = star_rows.reshape(waves.shape[1], -1)
        right = waves @ (flat * weight.reshape(-1, 1))
        here = self._scaled(focal)
        solved = cho_solve((self.root, True), right, check_finite=False)
        return rows - (here.T @ solved).reshape(rows.shape), self._covariance(here)

    def covariance(self, focal):
        """Posterior covariance, with what the waves are too long for.

        Parameters
        ----------
        focal : (2, N) ndarray
            Focal plane, px.

        Returns
        -------
        (2, 2, N) ndarray
            Px^2 of the focal plane.
        """
        return self._covariance(self._scaled(focal))

    @property
    def wave(self):
        """Wave vectors ``(2, M)``, rad / px."""
        return self.basis.wave

    def _scaled(self, focal):
        """Shapes in units of their prior, both axes side by side, ``(M, 2 N)``."""
        shapes = self.basis.shapes(focal, self.spectrum.kind)
        root = np.sqrt(self.spectrum.prior(self.basis))
        return shapes.reshape(len(shapes), -1) * root[:, None]

    def _covariance(self, scaled):
        """Covariance at places with these shapes, in units of the prior."""
        half = lapack.dtrtrs(self.root, scaled, lower=1)[0]
        half = half.reshape(len(half), 2, -1)
        covariance = np.einsum("man,mbn->abn", half, half)
        covariance[[0, 1], [0, 1]] += self.spectrum.unresolved(self.basis)
        return covariance


def fit_field(basis, spectrum, focal, residual, variance):
    """Posterior of a field with a known spectrum.

    Parameters
    ----------
    basis : Basis
        Waves.
    spectrum : Spectrum
        Prior.
    focal, residual, variance : (2, N) ndarray
        Places, residuals and their variances without the field, px.

    Returns
    -------
    Field
        Mean and covariance.
    """
    weight = 1.0 / (variance + spectrum.unresolved(basis))
    root = np.sqrt(spectrum.prior(basis))
    shapes = basis.shapes(focal, spectrum.kind)
    shapes = shapes.reshape(len(shapes), -1)
    shapes *= root[:, None]
    shapes *= np.sqrt(weight.ravel())
    inner = shapes @ shapes.T
    inner[np.diag_indices_from(inner)] += 1.0
    lower, _ = lapack.dpotrf(inner, lower=1, clean=1)
    right = shapes @ (np.sqrt(weight) * residual).ravel()
    coefficients = root * lapack.dpotrs(lower, right, lower=1)[0]
    inverse, _ = lapack.dtrtri(lower, lower=1)
    freedom = (len(root) - np.sum(inverse**2)) / max(focal.shape[1], 1)
    # A camera has a thousand of these, and no error is known to seven digits.
    return Field(basis, spectrum, coefficients, lower.astype(np.float32), float(freedom))
