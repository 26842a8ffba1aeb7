"""Spectra of the fields of exposures, by evidence.

::

    residuals, noise --products--> normal matrix of the waves
                     --largest evidence--> amplitude s, outer scale L, stretch, bend
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import lapack
from scipy.optimize import minimize

from wpdc_gwcs.solve.basis import BEND_DEGREES, Basis, inner_products
from wpdc_gwcs.solve.normal import posterior_factor

__all__ = ["Products", "Spectrum", "learn_spectra", "pooled_spectrum", "products"]

# Sum over the waves of a kind of field: a potential's gradient, or each axis by itself.
KINDS = ("curl-free", "axes")

# Scatter of the spectra of exposures about the pooled one (natural logarithms), from ground-based
# frames.
_LOG_AMPLITUDE_SCATTER = 1.0
_LOG_SCALE_SCATTER = 0.7
_LOG_STRETCH_SCATTER = 0.5

# Numbers of exposures, and of frames of each, from which the pooled spectrum is learned.
_EXPOSURES_POOLED, _FRAMES_POOLED = 8, 2

# Gain in log evidence that fields must bring to all exposures together, and what more must add: a
# stretch (two numbers) to one that is well above it, the bend of one exposure where others bend.
_LEAST_GAIN = 5.0
_MORE_GAIN = 3.0
_GAIN_FOR_STRETCH = 30.0

# The same of polynomials beside the waves of all exposures: much, for turbulence bends a detector
# as well, and where exposures really bend, some of them bring 50 nats and more.  Their first guess
# in units of the amplitude, and how much smaller a degree is than the one before.
_BEND_GAIN, _FIRST_BEND, _BEND_DECAY = 10.0, 0.3, 1.8


@dataclass(frozen=True)
class Spectrum:
    """Power spectrum of a field: von Karman, stretched along a direction, plus polynomials.

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
    bend : float
        Standard deviation of the coefficients of degree 2 along each axis, px; 0 for none.
    """

    amplitude: float
    scale: float
    stretch: float = 1.0
    angle: float = 0.0
    kind: str = "curl-free"
    bend: float = 0.0

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
            Variances for ``basis.shapes(..., kind)``.
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
        bends = [
            self.bend**2 * _BEND_DECAY ** (-2.0 * (n - BEND_DEGREES[0]))
            for n in BEND_DEGREES for _ in range(n + 1)
        ] if basis.bends else []  # fmt: skip
        return np.concatenate([power, bends, bends, [constant, constant]])

    def unresolved(self, basis):
        """Return the variance along each axis below the shortest wave of a basis, px^2.

        Parameters
        ----------
        basis : Basis
            Waves.

        Returns
        -------
        float
            Variance that remains as noise.
        """
        highest = np.max(np.sum(basis.wave**2, axis=0)) * (self.scale / (2 * np.pi)) ** 2
        return self.amplitude**2 * (1 + highest) ** (-5 / 6)


@dataclass(frozen=True, eq=False)
class Products:
    """Weighted products of the waves of a patch, sufficient for the evidence.

    Parameters
    ----------
    basis : Basis
        Waves.
    blocks : dict
        For each kind of field, sets of coefficients that are independent of each other: their
        numbers, normal matrix and right-hand side.
    n_stars : int
        Number of stars.
    """

    basis: Basis
    blocks: dict
    n_stars: int

    def log_evidence(self, spectrum):
        """Return the log evidence of a spectrum relative to no field.

        Parameters
        ----------
        spectrum : Spectrum
            Spectrum.

        Returns
        -------
        float
            Log evidence, nats.
        """
        scale, total = np.sqrt(spectrum.prior(self.basis)), 0.0
        for mine, matrix, right in self.blocks[spectrum.kind]:
            root = scale[mine]
            factor, info = posterior_factor(matrix, root)
            if info != 0:
                return -np.inf
            half, _ = lapack.dtrtrs(factor, right * root, lower=1)
            total += 0.5 * half @ half - np.sum(np.log(np.diagonal(factor)))
        return float(total)


def products(basis, focal, residual, weight, *, nuisance=None, kinds=KINDS):
    """Multiply the waves of a patch with the residuals of its stars.

    Parameters
    ----------
    basis : Basis
        Waves.
    focal, residual, weight : (2, N) ndarray
        Positions, residuals (px) and inverse variances of the stars.
    nuisance : (2, N, K) ndarray, optional
        Columns that are fitted freely with the field: the attitude of a single detector.
    kinds : tuple of str, optional
        Kinds of field.

    Returns
    -------
    Products
        Products for `learn_spectra`.
    """
    root = np.sqrt(weight)
    target, together = root * residual, False
    if nuisance is not None:
        free = nuisance * root[:, :, None]
        columns = free.reshape(-1, free.shape[2])
        normal, free_right = columns.T @ columns, columns.T @ target.ravel()
        together = bool(np.any(free != 0, axis=1).all(axis=0).any())
    blocks = {}
    for kind in kinds:
        parts = basis.along(focal, kind)
        # If nothing shifts stars along both axes, the axes are independent.
        groups = [(0,), (1,)] if kind == "axes" and not together else [(0, 1)]
        blocks[kind] = []
        for axes in groups:
            numbers = np.unique(np.concatenate([parts[a][0] for a in axes]))
            mine = [(np.searchsorted(numbers, parts[a][0]), parts[a][1] * root[a]) for a in axes]
            matrix, right = inner_products(mine), np.zeros(len(numbers))
            for a, (k, rows) in zip(axes, mine):
                right[k] += rows @ target[a]
            if nuisance is not None:
                cross = np.zeros((len(normal), len(numbers)))
                for a, (k, rows) in zip(axes, mine):
                    cross[:, k] += (rows @ free[a]).T
                both = np.column_stack([cross, free_right])
                solved = np.linalg.lstsq(normal, both, rcond=1e-12)[0]
                matrix = matrix - cross.T @ solved[:, :-1]
                right = right - cross.T @ solved[:, -1]
            blocks[kind].append((numbers, matrix, right))
    return Products(basis, blocks, focal.shape[1])


def learn_spectra(frames, make, *, start, scales, force=False):
    """Find the spectrum of each exposure by evidence, with a pooled spectrum as prior.

    Parameters
    ----------
    frames : dict
        Frames of each exposure.
    make : callable
        ``make(frame, kinds)`` returns the `Products` of a frame.
    start : float
        First guess of the amplitude, px.
    scales : (float, float)
        Smallest and largest outer scale, px.
    force : bool, optional
        Whether to return a spectrum for every exposure, regardless of evidence.

    Returns
    -------
    dict
        `Spectrum` of each exposure; `None` for all without evidence for fields.

    Notes
    -----
    This is the maximum a posteriori: the logarithms of amplitude and scale of an exposure scatter
    by 1 and 0.7 about the pooled ones.  If there is evidence that all exposures share a field, it
    belongs to the detector.
    """
    if not frames:
        return {}
    # A few frames suffice for the pooled spectrum.
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
        # With few stars, an exposure gets the pooled spectrum; with evidence against a field, a
        # small amplitude.
        found[e], _ = _maximize(group, spectrum.kind, start, scales, about=spectrum)
    return found


def _is_common(patches, spectrum):
    """Return whether all exposures of a detector have the same field, which is then static."""
    each = common = 0.0
    for basis in {id(p.basis): p.basis for p in patches}.values():
        mine = [p for p in patches if p.basis is basis]
        if len(mine) > 1:
            blocks = [
                (of_all[0][0], *(sum(one[part] for one in of_all) for part in (1, 2)))
                for of_all in zip(*(p.blocks[spectrum.kind] for p in mine), strict=True)
            ]
            together = Products(basis, {spectrum.kind: blocks}, sum(p.n_stars for p in mine))
            each += sum(p.log_evidence(spectrum) for p in mine)
            common += together.log_evidence(spectrum)
    return common > each


def pooled_spectrum(patches, *, start, scales):
    """Find the common spectrum of several patches.

    Parameters
    ----------
    patches : list of Products
        Products of each patch, for all kinds of field.
    start : float
        First guess of the amplitude, px.
    scales : (float, float)
        Smallest and largest outer scale, px.

    Returns
    -------
    Spectrum or None
        `None` without evidence for a field.
    """
    straight = [_maximize(patches, kind, start, scales) for kind in KINDS]
    spectrum, gain = max(straight, key=_gain)
    if gain < _LEAST_GAIN:
        return None
    if patches[0].basis.bends:
        bent = max((_bent(patches, each, scales) for each, _ in straight), key=_gain)
        spectrum, _ = max((spectrum, gain + _BEND_GAIN), bent, key=_gain)
    return spectrum


def _maximize(group, kind, start, scales, about=None):
    """Spectrum with the largest evidence (and prior about another one), and its gain in nats."""
    low, high = np.log(scales)

    def spectrum_of(p):
        stretch, angle = (1.0, 0.0) if len(p) < 4 else (np.exp(np.hypot(p[2], p[3])),
                                                        0.5 * np.arctan2(p[3], p[2]))  # fmt: skip
        scale = np.exp(np.clip(p[1], low, high))
        return Spectrum(float(np.exp(p[0])), float(scale), float(stretch), float(angle), kind)

    def penalty(p):
        total = _penalty(p, scales, about)
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
        if -four.fun > gain + _MORE_GAIN:
            p, gain = four.x, -four.fun
    found = spectrum_of(p)
    if about is not None and about.bend:
        return max((found, gain + _MORE_GAIN), _bent(group, found, scales, about), key=_gain)
    return found, gain


def _gain(found):
    return found[1]


def _penalty(p, scales, about):
    """Minus the log prior of amplitude and scale: within limits, and about the pooled ones."""
    low, high = np.log(scales)
    total = max(low - p[1], p[1] - high, 0.0) ** 2
    if about is not None:
        total += 0.5 * ((p[0] - np.log(about.amplitude)) / _LOG_AMPLITUDE_SCATTER) ** 2
        total += 0.5 * ((p[1] - np.log(about.scale)) / _LOG_SCALE_SCATTER) ** 2
    return total


def _bent(group, straight, scales, about=None):
    """Spectrum with polynomials of the largest evidence, and its gain in nats."""
    low, high = np.log(scales)
    first = about.bend if about is not None else _FIRST_BEND * straight.amplitude

    def spectrum_of(p):
        amplitude, scale, bend = np.exp([p[0], np.clip(p[1], low, high), p[2]])
        return replace(straight, amplitude=float(amplitude), scale=float(scale), bend=float(bend))

    def cost(p):
        if np.any(p[[0, 2]] < -25) or np.any(p[[0, 2]] > 10):
            return 1e12
        total = _penalty(p, scales, about)
        if about is not None:
            total += 0.5 * ((p[2] - np.log(about.bend)) / _LOG_AMPLITUDE_SCATTER) ** 2
        spectrum = spectrum_of(p)
        return total - sum(g.log_evidence(spectrum) for g in group)

    p = np.log([straight.amplitude, straight.scale, first])
    steps = np.vstack([np.zeros(3), np.diag([0.3, 0.3, 0.7])])
    options = {"xatol": 0.03, "fatol": 0.1, "maxfev": 120, "initial_simplex": p + steps}
    found = minimize(cost, p, method="Nelder-Mead", options=options)
    return spectrum_of(found.x), -found.fun
