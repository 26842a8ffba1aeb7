"""A distortion of one detector in closed form, with its exact inverse."""

from dataclasses import dataclass

import numpy as np

__all__ = ["Distortion"]


@dataclass(frozen=True, eq=False)
class Distortion:
    r"""Smooth, exactly invertible distortion of one detector, in the complex plane.

    Parameters
    ----------
    image_shape : (int, int)
        Shape of the detector ``(ny, nx)``.
    axis : complex
        Where the optical axis is, in half-widths of the detector from its center.
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
        D(z) = (z - a)(k_3 |z - a|^2 + k_5 |z - a|^4) + \sum_{m+n=2}^{6} c_{mn} z^m \bar z^n
               - T_1(z) + \sum_j A_j \sin(\mathrm{Re}\,\bar\kappa_j z + \phi_j)

    where :math:`T_1` takes the constant and the linear part of the radial term at the center away:
    they belong to the linear WCS.  The inverse is Newton's iteration with the Wirtinger derivatives
    :math:`D_z, D_{\bar z}`.
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
            Source of the numbers.

        Returns
        -------
        Distortion
            The distortion.

        Raises
        ------
        ValueError
            If the distortion asked for would fold the detector over itself.
        """
        rng = np.random.default_rng(rng)
        half = max(image_shape) / 2
        axis = rng.uniform(1.5, 3.5) * np.exp(2j * np.pi * rng.uniform())
        radial = (1.0, rng.uniform(-0.02, 0.02))
        terms = {
            (m, order - m): 4.0 * 0.4**order * complex(*rng.normal(size=2))
            for order in range(2, 7)
            for m in range(order + 1)
        }
        smooth = cls(image_shape, axis, radial, terms)
        y, x = np.mgrid[0 : image_shape[0] : 65j, 0 : image_shape[1] : 65j] - 0.5
        size = np.abs(smooth._displace(smooth._normalise(x, y))[0]).max() * half
        k = amplitude / size
        fine = []
        for _ in range(6 if waves else 0):
            length = rng.uniform(*wavelength) * 2  # in half-widths
            fine.append(
                (
                    2 * np.pi / length * np.exp(1j * np.pi * rng.uniform()),
                    rng.uniform(0, 2 * np.pi),
                    complex(*rng.normal(size=2)) * waves / half,
                )
            )
        distortion = cls(
            image_shape,
            axis,
            (k * radial[0], k * radial[1]),
            {key: k * c for key, c in terms.items()},
            tuple(fine),
        )
        _, dz, dzbar = distortion._displace(distortion._normalise(x, y))
        if (np.abs(1 + dz) - np.abs(dzbar)).min() < 0.2:
            raise ValueError(
                f"a distortion of {amplitude:g} px (waves {waves:g} px) is not invertible "
                f"on a detector of {image_shape[1]} x {image_shape[0]} px"
            )
        return distortion

    @property
    def center(self):
        """Center of the detector ``(x, y)``, zero based: the point that the distortion leaves."""
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

    def _radial(self, z):
        k3, k5 = self.radial
        s = z - self.axis
        r2 = (s * s.conjugate()).real
        return (
            s * r2 * (k3 + k5 * r2),
            r2 * (2 * k3 + 3 * k5 * r2),
            s * s * (k3 + 2 * k5 * r2),
        )

    def _displace(self, z):
        """D, its derivative by z and its derivative by conj(z)."""
        d, dz, dzbar = self._radial(z)
        d0, dz0, dzbar0 = self._radial(0j)
        c = np.conj(z)
        d = d - d0 - dz0 * z - dzbar0 * c
        dz = dz - dz0
        dzbar = dzbar - dzbar0
        for (m, n), a in self.terms.items():
            d = d + a * z**m * c**n
            if m:
                dz = dz + a * m * z ** (m - 1) * c**n
            if n:
                dzbar = dzbar + a * n * z**m * c ** (n - 1)
        for kappa, phase, a in self.waves:
            angle = (np.conj(kappa) * z).real + phase
            d = d + a * np.sin(angle)
            slope = a * np.cos(angle) / 2
            dz = dz + slope * np.conj(kappa)
            dzbar = dzbar + slope * kappa
        return d, dz, dzbar

    def undistort(self, x, y):
        """Detector pixels to undistorted pixels.

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
        return self._pixels(z + self._displace(z)[0])

    def distort(self, x, y):
        """Undistorted pixels to detector pixels, the inverse of `undistort`.

        Parameters
        ----------
        x, y : array_like
            Undistorted pixel coordinates, zero based.

        Returns
        -------
        x, y : ndarray
            Detector pixel coordinates, zero based; NaN where there is no answer near the detector.
        """
        target = self._normalise(x, y)
        z = target.copy()
        reach = 3 + np.abs(target)
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            for _ in range(50):
                d, dz, dzbar = self._displace(z)
                miss = target - z - d
                jacobian = np.abs(1 + dz) ** 2 - np.abs(dzbar) ** 2
                step = (np.conj(1 + dz) * miss - dzbar * np.conj(miss)) / jacobian
                z = np.where(np.abs(z) < reach, z + step, np.nan)
                if not np.nanmax(np.abs(step), initial=0) > 1e-14:
                    break
            good = np.abs(target - z - self._displace(z)[0]) < 1e-11
        return self._pixels(np.where(good, z, complex(np.nan, np.nan)))
