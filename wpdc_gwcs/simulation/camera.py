"""Simulated cameras: their detectors in the focal plane, optics and noise."""

from dataclasses import dataclass, field, replace

import astropy.units as u
import numpy as np
from scipy.special import ndtr

from wpdc_gwcs.simulation.distortion import Distortion
from wpdc_gwcs.simulation.light import PSF, SIGMA_PER_FWHM, find_zero_point

__all__ = ["SimulatedCamera", "SimulatedDetector"]


@dataclass(frozen=True, eq=False)
class SimulatedDetector:
    """One detector of a simulated camera.

    Parameters
    ----------
    name : str
        Name of the detector.
    distortion : Distortion
        Distortion of the detector, in its own pixels.
    center : (float, float), optional
        Center according to headers, in px of the focal plane from the pointing of the camera;
        without rotation, x points west and y north.
    offset : (float, float), optional
        Offset of the true center from there, px.
    axes : (int, int), optional
        Directions of the pixel axes along those of the focal plane, 1 or -1 each.
    band : str, optional
        Filter of the detector.
    depth : float, optional
        Magnitudes by which the detector is deeper than the camera's ``magnitudes``; negative if it
        is shallower.

    Examples
    --------
    >>> import astropy.units as u
    >>> from wpdc_gwcs.simulation import Distortion, SimulatedCamera, SimulatedDetector
    >>> distortion = Distortion.random((500, 1000), amplitude=5.0, rng=1)
    >>> detectors = (
    ...     SimulatedDetector("left", distortion, center=(-520.0, 0.0)),
    ...     SimulatedDetector("right", distortion.scaled(-1.0), center=(520.0, 0.0)),
    ... )
    >>> camera = SimulatedCamera("two", detectors, 0.3 * u.arcsec)
    >>> [(detector.name, detector.image_shape) for detector in camera.detectors]
    [('left', (500, 1000)), ('right', (500, 1000))]
    """

    name: str
    distortion: Distortion
    center: tuple[float, float] = (0.0, 0.0)
    offset: tuple[float, float] = (0.0, 0.0)
    axes: tuple[int, int] = (1, 1)
    band: str = "g"
    depth: float = 0.0

    @property
    def image_shape(self):
        """Shape of the detector ``(ny, nx)``."""
        return self.distortion.image_shape


@dataclass(frozen=True, eq=False)
class SimulatedCamera:
    """A simulated camera: detectors, light and noise.

    Parameters
    ----------
    name : str
        Name of the camera.
    detectors : tuple of SimulatedDetector
        Its detectors.
    pixel_scale : `~astropy.units.Quantity`
        Pixel scale.
    shared_tangent : bool, optional
        Whether the headers of all detectors share a tangent point, the pointing of the camera, with
        CRPIX outside the detectors; otherwise each has its own at its center.
    magnitudes : (float, float), optional
        Magnitudes of the brightest and of the faintest star.
    limit_snr : float, optional
        Signal-to-noise ratio of the faintest star.  It sets the zero point.
    fwhm : float, optional
        Width of the PSF, in px.
    psf_variation : float, optional
        Relative change of the PSF's width and shape over a detector.
    centroid_floor : float, optional
        Centroid error of the brightest stars, in px.
    gain : float, optional
        Electrons per count.
    read_noise, background : float, optional
        Read noise and background level, in electrons.
    saturation : float, optional
        Saturation level in electrons; saturated stars are missing from the source lists.
    exposure_time : float, optional
        Exposure time in seconds, for the header.

    Raises
    ------
    ValueError
        If a value is invalid, or two detectors have the same name.
    TypeError
        If the pixel scale has no unit of an angle.

    See Also
    --------
    make_camera : Make one of the built-in cameras.

    Examples
    --------
    >>> from wpdc_gwcs.simulation import make_camera
    >>> camera = make_camera("csst-msc", seed=3)
    >>> len(camera.detectors), len(camera.only(["g-1", "g-2"]).detectors)
    (18, 2)
    >>> g1 = camera.only(["g-1"]).detectors[0]
    >>> round(float(camera.flux(20.0, g1) / camera.flux(21.0, g1)), 3)  # one magnitude
    2.512
    """

    name: str
    detectors: tuple[SimulatedDetector, ...]
    pixel_scale: u.Quantity
    shared_tangent: bool = False
    magnitudes: tuple[float, float] = (15.0, 21.0)
    limit_snr: float = 10.0
    fwhm: float = 2.5
    psf_variation: float = 0.05
    centroid_floor: float = 0.005
    gain: float = 1.5
    read_noise: float = 5.0
    background: float = 200.0
    saturation: float = 90000.0
    exposure_time: float = 100.0
    arcsec: float = field(init=False, repr=False)

    def __post_init__(self):
        names = [d.name for d in self.detectors]
        if not names or len(set(names)) < len(names):
            raise ValueError(f"detectors must have different names, not {', '.join(names)}")
        for d in self.detectors:
            if min(d.image_shape) < 16:
                raise ValueError(f"image_shape must be at least 16 px, not {d.image_shape}")
        bright, faint = self.magnitudes
        if not bright < faint:
            raise ValueError(
                f"magnitudes must be a brighter and a fainter one, not {self.magnitudes}"
            )
        for name in ("centroid_floor", "read_noise"):
            require(name, getattr(self, name), getattr(self, name) >= 0, "not negative")
        for name in ("fwhm", "gain", "background", "saturation", "limit_snr", "exposure_time"):
            require(name, getattr(self, name), getattr(self, name) > 0, "positive")
        arcsec = value_of("pixel_scale", self.pixel_scale, u.arcsec)
        require("pixel_scale", self.pixel_scale, arcsec > 0, "positive")
        object.__setattr__(self, "arcsec", arcsec)

    @property
    def zero_point(self):
        """Magnitude of one electron."""
        return find_zero_point(
            self.magnitudes[1], self.limit_snr, self.fwhm, self.background, self.read_noise
        )

    def only(self, names):
        """Return the camera with some of its detectors.

        Parameters
        ----------
        names : sequence of str
            Names of detectors.

        Returns
        -------
        SimulatedCamera
            Camera with these alone, in its own order.

        Raises
        ------
        ValueError
            If there is no detector with a name.
        """
        known = [d.name for d in self.detectors]
        for name in names:
            require("detectors", name, name in known, f"among {', '.join(known)}")
        return replace(self, detectors=tuple(d for d in self.detectors if d.name in names))

    def flux(self, magnitude, detector):
        """Return the flux of stars in electrons.

        Parameters
        ----------
        magnitude : array_like
            Magnitudes of the stars.
        detector : SimulatedDetector
            Detector that observes them.

        Returns
        -------
        ndarray
            Electrons.
        """
        return 10 ** (-0.4 * (np.asarray(magnitude) - self.zero_point - detector.depth))

    def psf_widths(self, x, y, image_shape):
        """Return the Gaussian widths of the PSF's core.

        Parameters
        ----------
        x, y : array_like
            Positions on a detector, px.
        image_shape : (int, int)
            Shape of the detector ``(ny, nx)``.

        Returns
        -------
        sx, sy : ndarray
            Widths along x and y, px.
        """
        ny, nx = image_shape
        a, b = 2 * np.asarray(x) / nx - 1, 2 * np.asarray(y) / ny - 1
        s = self.fwhm * SIGMA_PER_FWHM * (1 + self.psf_variation * (a * a + b * b) / 2)
        shape = self.psf_variation * (a - b) / 2
        return s * (1 + shape), s * (1 - shape)

    def psf_stamp(self):
        """Return the mean pixelated PSF of a star at the center of a pixel.

        Returns
        -------
        x, y : (N,) ndarray
            Pixels relative to the star.
        profile : (N,) ndarray
            Fraction of the light of the star in each pixel.
        slope : (N,) ndarray
            Derivative of the profile with respect to the x of the star, per px.
        """
        half = int(np.ceil(6 * self.fwhm))
        edges = np.arange(-half, half + 2) - 0.5
        profile = slope = 0.0
        for share, width in PSF:
            s = width * self.fwhm * SIGMA_PER_FWHM
            across = np.diff(ndtr(edges / s))
            density = np.exp(-0.5 * (edges / s) ** 2) / (s * np.sqrt(2 * np.pi))
            profile = profile + share * np.outer(across, across)
            slope = slope - share * np.outer(across, np.diff(density))
        y, x = np.mgrid[-half : half + 1, -half : half + 1]
        return x.ravel(), y.ravel(), profile.ravel(), slope.ravel()

    def snr(self, flux):
        """Return the signal-to-noise ratio of stars under the PSF's noise-equivalent area.

        Parameters
        ----------
        flux : array_like
            Electrons.

        Returns
        -------
        ndarray
            Ratios.
        """
        area = 4 * np.pi * (self.fwhm * SIGMA_PER_FWHM) ** 2
        return flux / np.sqrt(flux + area * (self.background + self.read_noise**2))

    def peak(self, flux):
        """Return the approximate number of electrons in the brightest pixel of stars.

        Parameters
        ----------
        flux : array_like
            Electrons.

        Returns
        -------
        ndarray
            Electrons.
        """
        return flux * 0.85 / max(2 * np.pi * (self.fwhm * SIGMA_PER_FWHM) ** 2, 1.0)


def require(name, value, good, rule):
    """Raise an error if a value breaks a rule.

    Parameters
    ----------
    name : str
        Name of the value for the user.
    value : object
        The value.
    good : bool
        Whether it is allowed.
    rule : str
        What it must be, for the message.
    """
    if not good:
        raise ValueError(f"{name} must be {rule}, not {value}")


def value_of(name, quantity, unit):
    """Return an angle or a motion as a number.

    Parameters
    ----------
    name : str
        Name of the value for the user.
    quantity : `~astropy.units.Quantity`
        The value.
    unit : `~astropy.units.Unit`
        Unit of the number.

    Returns
    -------
    float or ndarray
        The number.
    """
    try:
        number = u.Quantity(quantity, subok=False).to_value(unit)
    except (u.UnitConversionError, TypeError) as error:
        raise TypeError(f"{name} must be a Quantity in {unit}, not {quantity!r}") from error
    require(name, quantity, np.all(np.isfinite(number)), "finite")
    return number
