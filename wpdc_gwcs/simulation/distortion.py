"""A distortion of one detector in closed form, with its exact inverse."""

from dataclasses import dataclass, replace
from functools import cached_property
from math import comb

import numpy as np

__all__ = ["Distortion"]

# Points per block: their powers stay in the cache.
_BLOCK = 4096
# Newton's method ends below this step, in half-widths of the detector.
_LAST_STEP = 1e-9
# Tolerance for a map to be a polynomial, px.
_SAME_PX = 1e-6


@dataclass(frozen=True, eq=False)
class Distortion:
    r"""Smooth, exactly invertible distortion of one detector, in the complex plane.

    Parameters
    ----------
    image_shape : (int, int)
        Shape of the detector ``(ny, nx)``.
    axis : complex
        Position of the optical axis, in half-widths of the detector from its center.
    radial : (float, float)
        Cubic and quintic coefficients of the radial distortion about that axis.
    terms : dict
        ``{(m, n): coefficient}``, complex, of the polynomial terms :math:`z^m \bar z^n`.
    waves : sequence of (complex, float, complex)
        Wave vector (radians per half-width), phase and complex amplitude of each fine wave.

    Notes
    -----
    With :math:`z = (x - x_0 + i (y - y_0)) / h` and :math:`a` the axis, a detector pixel moves by

    .. math::
        D(z) = R(z) - T_1(z) + \sum_{m+n=2}^{6} c_{mn} z^m \bar z^n
               + \sum_j A_j \sin(\mathrm{Re}\,\bar\kappa_j z + \phi_j)

    with the radial term :math:`R(z) = (z - a)(k_3 |z - a|^2 + k_5 |z - a|^4)`, whose constant and
    linear part at the center, :math:`T_1`, is in the linear WCS.  The inverse is Newton's iteration
    with the Wirtinger derivatives :math:`D_z, D_{\bar z}`.

    Examples
    --------
    >>> from wpdc_gwcs.simulation import Distortion
    >>> distortion = Distortion.random((1000, 1000), amplitude=40.0, rng=1)
    >>> round(distortion.greatest(), 3), round(distortion.scaled(0.1).greatest(), 3)
    (40.0, 4.0)
    >>> u, v = distortion.undistort(10.0, 20.0)
    >>> x, y = distortion.distort(u, v)
    >>> round(float(x), 6), round(float(y), 6)
    (10.0, 20.0)
    """

    image_shape: tuple[int, int]
    axis: complex
    radial: tuple[float, float]
    terms: dict
    waves: tuple = ()

    @classmethod
    def random(cls, image_shape, *, amplitude=40.0, waves=0.0, wavelength=(0.2, 0.65), rng=None):
        """Draw a distortion.

        Parameters
        ----------
        image_shape : (int, int)
            Shape of the detector ``(ny, nx)``.
        amplitude : float, optional
            Greatest displacement on the detector by the smooth part, in pixels.
        waves : float, optional
            Scatter of the amplitude per axis of six fine waves, in pixels.
        wavelength : (float, float), optional
            Range of their wavelengths, in units of the longer side.
        rng : `numpy.random.Generator`, optional
            Random number generator.

        Returns
        -------
        Distortion
            The distortion.

        Raises
        ------
        ValueError
            If the distortion would fold the detector over itself.
        """
        rng = np.random.default_rng(rng)
        axis = rng.uniform(1.5, 3.5) * np.exp(2j * np.pi * rng.uniform())
        smooth = cls.off_axis(image_shape, axis, quintic=rng.uniform(-0.02, 0.02), rng=rng)
        smooth = smooth.scaled(amplitude / smooth.greatest())
        distortion = smooth.with_waves(waves, wavelength=wavelength, rng=rng)
        if not distortion.invertible():
            raise ValueError(
                f"a distortion of {amplitude:g} px (waves {waves:g} px) is not invertible "
                f"on a detector of {image_shape[1]} x {image_shape[0]} px"
            )
        return distortion

    @classmethod
    def off_axis(cls, image_shape, axis, *, quintic=0.0, rng=None):
        """Draw the distortion of a detector at a given distance from the optical axis.

        Parameters
        ----------
        image_shape : (int, int)
            Shape of the detector ``(ny, nx)``.
        axis : complex
            Where the optical axis is, in half-widths of the detector from its center.
        quintic : float, optional
            Quintic coefficient of the radial distortion; the cubic one is 1.
        rng : `numpy.random.Generator`, optional
            Random number generator for the polynomial terms, which decrease by 0.4 per order.

        Returns
        -------
        Distortion
            A distortion of arbitrary size; use `scaled`.
        """
        rng = np.random.default_rng(rng)
        terms = {
            (m, order - m): 4.0 * 0.4**order * complex(*rng.normal(size=2))
            for order in range(2, 7)
            for m in range(order + 1)
        }
        return cls(image_shape, axis, (1.0, quintic), terms)

    @classmethod
    def from_map(cls, image_shape, undistort, *, degree):
        """Return the distortion of a polynomial map of pixels.

        Parameters
        ----------
        image_shape : (int, int)
            Shape of the detector ``(ny, nx)``.
        undistort : callable
            Detector pixels to undistorted ones, ``undistort(x, y) -> (x, y)``; zero based.
        degree : int
            Total degree of the polynomial.

        Returns
        -------
        Distortion
            The same map to 1e-6 px, including its constant and linear part.

        Raises
        ------
        ValueError
            If the map is not a polynomial of this degree.
        """
        empty = cls(tuple(image_shape), 0j, (0.0, 0.0), {})
        # Its values at more points than coefficients determine a polynomial.
        node = np.cos(np.pi * np.arange(degree + 3) / (degree + 2))
        z = (node + 1j * node[:, None]).ravel()
        moved = empty._normalise(*undistort(*empty._pixels(z))) - z
        powers = [(m, order - m) for order in range(degree + 1) for m in range(order + 1)]
        design = np.stack([z**m * np.conj(z) ** n for m, n in powers], axis=1)
        terms = np.linalg.lstsq(design, moved, rcond=None)[0]
        worst = np.abs(design @ terms - moved).max() * max(image_shape) / 2
        if not worst < _SAME_PX:
            raise ValueError(
                f"undistort must be a polynomial of degree {degree}, is {worst:.3g} px off one"
            )
        return replace(empty, terms=dict(zip(powers, terms.tolist(), strict=True)))

    def scaled(self, factor):
        """Return the distortion scaled by a factor.

        Parameters
        ----------
        factor : float
            Factor on all displacements.

        Returns
        -------
        Distortion
            The distortion.
        """
        return replace(
            self,
            radial=tuple(factor * k for k in self.radial),
            terms={key: factor * c for key, c in self.terms.items()},
            waves=tuple((kappa, phase, factor * a) for kappa, phase, a in self.waves),
        )

    def with_waves(self, amplitude, *, wavelength=(0.2, 0.65), rng=None):
        """Add six fine waves.

        Parameters
        ----------
        amplitude : float
            Scatter of their amplitudes per axis, in pixels; 0 adds none.
        wavelength : (float, float), optional
            Range of their wavelengths, in units of the longer side.
        rng : `numpy.random.Generator`, optional
            Random number generator.

        Returns
        -------
        Distortion
            The distortion.
        """
        rng = np.random.default_rng(rng)
        half = max(self.image_shape) / 2
        fine = []
        for _ in range(6 if amplitude else 0):
            length = rng.uniform(*wavelength) * 2  # in half-widths
            fine.append(
                (
                    2 * np.pi / length * np.exp(1j * np.pi * rng.uniform()),
                    rng.uniform(0, 2 * np.pi),
                    complex(*rng.normal(size=2)) * amplitude / half,
                )
            )
        return replace(self, waves=self.waves + tuple(fine))

    def greatest(self):
        """Return the largest displacement on the detector.

        Returns
        -------
        float
            In pixels, on a grid of 65 x 65 points from edge to edge.
        """
        return float(np.abs(self._on_grid()[0]).max() * max(self.image_shape) / 2)

    def invertible(self):
        """Return whether the map is one to one on the detector.

        Returns
        -------
        bool
            True if the Jacobian determinant stays well above zero on the detector.
        """
        _, dz, dzbar = self._on_grid()
        return bool((np.abs(1 + dz) - np.abs(dzbar)).min() >= 0.2)

    def _on_grid(self):
        ny, nx = self.image_shape
        y, x = np.mgrid[0:ny:65j, 0:nx:65j] - 0.5
        return self._displace(self._normalise(x, y))

    @property
    def center(self):
        """Center of the detector ``(x, y)``, zero based, which the distortion leaves in place."""
        ny, nx = self.image_shape
        return (nx - 1) / 2, (ny - 1) / 2

    def _normalise(self, x, y):
        x0, y0 = self.center
        z = (np.asarray(x, float) - x0) + 1j * (np.asarray(y, float) - y0)
        return z / (max(self.image_shape) / 2)

    def _pixels(self, z):
        x0, y0 = self.center
        half = max(self.image_shape) / 2
        return z.real * half + x0, z.imag * half + y0

    @cached_property
    def coefficients(self):
        """The radial and the polynomial terms together, ``c[m, n]`` of z^m conj(z)^n."""
        order = max([5, *(m + n for m, n in self.terms)])
        c = np.zeros((order + 1, order + 1), complex)
        # (z - a)^(j + 1) conj(z - a)^j, j = 1 and 2, multiplied out.
        for k, j in zip(self.radial, (1, 2)):
            own = [comb(j + 1, m) * (-self.axis) ** (j + 1 - m) for m in range(j + 2)]
            other = [comb(j, n) * (-np.conj(self.axis)) ** (j - n) for n in range(j + 1)]
            c[: j + 2, : j + 1] += k * np.outer(own, other)
        c[0, 0] = c[1, 0] = c[0, 1] = 0
        for (m, n), value in self.terms.items():
            c[m, n] += value
        return c

    def _displace(self, z):
        """D, its derivative by z and its derivative by conj(z)."""
        c = self.coefficients
        size = len(c)
        conj = np.conj(z)
        # Horner's rule in conj(z) over polynomials in z, each with its derivative.
        d, dz, dzbar = np.zeros_like(z), np.zeros_like(z), np.zeros_like(z)
        for n in range(size - 1, -1, -1):
            row, slope = np.full_like(z, c[size - 1 - n, n]), np.zeros_like(z)
            for m in range(size - 2 - n, -1, -1):
                slope = slope * z + row
                row = row * z + c[m, n]
            dzbar = dzbar * conj + d
            d = d * conj + row
            dz = dz * conj + slope
        for kappa, phase, a in self.waves:
            angle = (np.conj(kappa) * z).real + phase
            d = d + a * np.sin(angle)
            slope = a * np.cos(angle) / 2
            dz = dz + slope * np.conj(kappa)
            dzbar = dzbar + slope * kappa
        return d, dz, dzbar

    def undistort(self, x, y):
        """Map detector pixels to undistorted pixels.

        Parameters
        ----------
        x, y : array_like
            Detector pixel coordinates, zero based.

        Returns
        -------
        x, y : ndarray
            Undistorted pixel coordinates, zero based.
        """
        z = self._normalise(x, y)
        return self._pixels(_in_blocks(lambda part: part + self._displace(part)[0], z))

    def distort(self, x, y):
        """Map undistorted pixels to detector pixels, the inverse of `undistort`.

        Parameters
        ----------
        x, y : array_like
            Undistorted pixel coordinates, zero based.

        Returns
        -------
        x, y : ndarray
            Detector pixel coordinates, zero based; NaN if there is no solution near the detector.
        """
        return self._pixels(_in_blocks(self._solve, self._normalise(x, y)))

    def _solve(self, target):
        """Invert z + D(z) by Newton's method; NaN if there is no solution near the detector."""
        reach = 3 + np.abs(target)
        z = target
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            for _ in range(50):
                d, dz, dzbar = self._displace(z)
                miss = target - z - d
                jacobian = np.abs(1 + dz) ** 2 - np.abs(dzbar) ** 2
                step = (np.conj(1 + dz) * miss - dzbar * np.conj(miss)) / jacobian
                z = np.where(np.abs(z) < reach, z + step, np.nan)
                # Convergence is quadratic: after such a small step, the error is negligible.
                if not np.nanmax(np.abs(step), initial=0) > _LAST_STEP:
                    break
            good = np.abs(step) <= _LAST_STEP
        return np.where(good, z, complex(np.nan, np.nan))


def _in_blocks(function, z):
    """Evaluate a function of complex points, a block of them at a time."""
    flat = np.ravel(z)
    result = np.empty_like(flat)
    for start in range(0, flat.size, _BLOCK):
        result[start : start + _BLOCK] = function(flat[start : start + _BLOCK])
    return result.reshape(np.shape(z))
