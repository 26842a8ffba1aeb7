"""One simulated exposure: what was measured, and the truth about it."""

import copy
from dataclasses import dataclass, field
from functools import cached_property

import astropy.units as u
import numpy as np
from astropy.io import fits
from astropy.table import Table
from astropy.time import Time
from astropy.wcs import WCS

from wpdc_gwcs.detector import on_detector
from wpdc_gwcs.frame import Frame
from wpdc_gwcs.simulation.camera import SimulatedCamera, SimulatedDetector
from wpdc_gwcs.simulation.chromatism import Chromatism
from wpdc_gwcs.simulation.light import DISC, PSF, add_gaussians
from wpdc_gwcs.simulation.measurement import Measurement
from wpdc_gwcs.simulation.stars import CATALOG_EPOCH
from wpdc_gwcs.simulation.truth import FrameTruth
from wpdc_gwcs.sky import angles, directions

__all__ = ["SimulatedExposure"]

_MAS = np.deg2rad(1 / 3.6e6)  # rad
# Margin for stars just outside the detector, whose light falls on it, px.
_MARGIN = 20


@dataclass(frozen=True, eq=False)
class SimulatedExposure(FrameTruth):
    """One exposure of one detector with its truth, made by `simulate`.

    Parameters
    ----------
    name : str
        Name of the exposure.
    detector : str
        Name of the detector.
    epoch : float
        Epoch of mid-exposure, Julian years.
    exposure : str or None
        What the exposures of all detectors of a mosaic have in common; `None` of a single detector.
    distortion : Distortion
        The distortion of the detector.
    linear_wcs : `astropy.wcs.WCS`
        The true WCS of undistorted pixels.
    header : `astropy.io.fits.Header`
        The header a camera would write: nominal TAN WCS (wrong by pointing, roll, scale and all
        of the distortion), ``DATE-OBS``, ``GAIN``, ``SATURATE``, ...

    Examples
    --------
    >>> from wpdc_gwcs import simulate
    >>> exposure = simulate(1, image_shape=(128, 128), density=60, seed=1).exposures[0]
    >>> exposure.render().shape, exposure.header["OBJECT"]
    ((128, 128), 'sim-01')
    >>> len(exposure.stars) >= len(exposure.sources) > 0
    True
    """

    header: fits.Header
    _camera: SimulatedCamera = field(repr=False)
    _detector: SimulatedDetector = field(repr=False)
    _field: object = field(repr=False)
    _measurement: Measurement = field(repr=False)
    _streams: tuple = field(repr=False)
    _chromatism: Chromatism | None = field(repr=False)

    @classmethod
    def of(
        cls,
        camera,
        detector,
        *,
        label,
        epoch,
        pointing,
        field,
        measurement,
        streams,
        place,
        chromatism=None,
    ):
        """Make the exposure of a detector.

        Parameters
        ----------
        camera : SimulatedCamera
            The camera.
        detector : SimulatedDetector
            The detector.
        label : str
            Label of the exposure, unique for the camera.
        epoch : float
            Epoch of mid-exposure, Julian years.
        pointing : (Pointing, Pointing)
            Pointing of the header, and true pointing.
        field : StarField
            The stars.
        measurement : Measurement
            Properties of source lists.
        streams : (`numpy.random.PCG64`, `numpy.random.SeedSequence`)
            Random streams of the source list and of the image.
        place : int
            Number of the detector in the camera.
        chromatism : Chromatism, optional
            Shifts of stars by color.

        Returns
        -------
        SimulatedExposure
            The exposure.
        """
        nominal, true = (
            p.linear_wcs(detector, where, shared_tangent=camera.shared_tangent)
            for p, where in zip(
                pointing, (detector.center, np.add(detector.center, detector.offset)), strict=True
            )
        )
        mosaic = camera.name != detector.name
        name = f"{camera.name}-{label}-{detector.name}" if mosaic else f"{detector.name}-{label}"
        exposure = label if mosaic else None
        header = _make_header(nominal, camera, detector, epoch, name, exposure)
        bits, seed = streams
        return cls(
            name,
            detector.name,
            epoch,
            exposure,
            detector.distortion,
            true,
            header,
            _camera=camera,
            _detector=detector,
            _field=field,
            _measurement=measurement,
            _streams=(bits, seed, place),
            _chromatism=chromatism,
            color=None if chromatism is None else chromatism.color,
        )

    @property
    def wcs(self):
        """Starting WCS: the nominal one, from the header."""
        return WCS(self.header)

    @cached_property
    def stars(self):
        """Every star on the detector or just outside it, without noise.

        Columns ``x``, ``y``, ``ra``, ``dec`` (at the epoch of the exposure), ``magnitude``,
        ``reference_index`` (row of the reference, -1 if it is not in it), perhaps ``color``.
        """
        return self._stars()

    @cached_property
    def sources(self):
        """Source list as it would be measured.

        Columns ``x``, ``y`` (zero based), ``x_err``, ``y_err`` in px, ``flux`` in counts, ``snr``,
        ``roundness``, and the truth ``reference_index`` (row of the reference, -1 for a spurious
        source, a galaxy or a star that is not in it).
        """
        return self._measure(self.stars)[0]

    def observe(self):
        """Return the source list and the truth of its stars.

        Returns
        -------
        sources : `astropy.table.Table`
            As `sources`.
        truth : `astropy.table.Table`
            The stars on the detector, with the columns of `stars` and ``source_index``, the row in
            the source list (-1 if a star was not detected).

        Notes
        -----
        Nothing is cached, to save memory with many exposures.
        """
        stars = self._stars()
        sources, source_index = self._measure(stars)
        stars["source_index"] = source_index
        ny, nx = self.image_shape
        return sources, stars[on_detector(stars["x"].data, stars["y"].data, (ny, nx))]

    def _stars(self):
        ny, nx = self.image_shape
        middle = directions(*self.sky((nx - 1) / 2, (ny - 1) / 2))[0]
        corners = directions(*self.sky([0, nx, 0, nx], [0, 0, ny, ny]))[0]
        # The farthest corner, a margin for the distortion, and an arcminute for proper motion.
        radius = np.linalg.norm(corners - middle[:, None], axis=0).max() * 1.1 + 3e-4
        chosen = np.flatnonzero(middle @ self._field.vectors > 1 - radius**2 / 2)
        stars = self._field.stars[chosen]
        p, e, n = directions(stars["ra"].data, stars["dec"].data)
        years = self.epoch - CATALOG_EPOCH
        ra, dec = angles(p + years * _MAS * (e * stars["pmra"].data + n * stars["pmdec"].data))
        seen = ra, dec
        if self._chromatism is not None:
            seen = self._chromatism.move(ra, dec, stars["color"].data)
        x, y = self.pixel(*seen)
        with np.errstate(invalid="ignore"):
            near = (x > -_MARGIN) & (x < nx - 1 + _MARGIN) & (y > -_MARGIN) & (y < ny - 1 + _MARGIN)
        columns = {"x": x[near], "y": y[near], "ra": ra[near], "dec": dec[near]}
        for name in ("magnitude", "color", "reference_index"):
            if name in stars.colnames:
                columns[name] = stars[name].data[near]
        return Table(columns)

    def _measure(self, stars):
        bits, seed, place = self._streams
        rng = np.random.Generator(copy.deepcopy(bits))
        extra = np.random.default_rng([*seed.generate_state(4).tolist(), place])
        return self._measurement.measure(rng, extra, stars, self._camera, self._detector)

    def frame(self, *, image=False):
        """Return the exposure as input of `~wpdc_gwcs.calibrate`.

        Parameters
        ----------
        image : bool, optional
            Give the rendered image instead of the source list.

        Returns
        -------
        Frame
            The frame, without the truth.
        """
        data = {"load_image": self.render} if image else {"load_sources": self._measured}
        return Frame(
            name=self.name,
            detector=self.detector,
            image_shape=self.image_shape,
            wcs=self.wcs,
            epoch=self.epoch,
            source=self.name,
            gain=self._camera.gain,
            saturation=self.header["SATURATE"],
            exposure=self.exposure,
            camera=None if self.exposure is None else self.header["INSTRUME"].replace("-", ""),
            **data,
        )

    def _measured(self):
        columns = [c for c in self.sources.colnames if c != "reference_index"]
        return self.sources[columns]

    def render(self, *, noise=True, galaxies=None, cosmic_rays=0):
        """Render the image of the exposure.

        Parameters
        ----------
        noise : bool, optional
            Add photon and read noise.
        galaxies : float, optional
            Galaxies per square arcmin; those of the simulation by default.
        cosmic_rays : int, optional
            Number of cosmic rays.

        Returns
        -------
        (ny, nx) ndarray of float32
            The image in counts; the same call gives the same image.

        Notes
        -----
        Stars are a core and wings, both Gaussian, integrated over the pixels exactly (differences
        of the error function); the widths vary over the detector.  Pixels end at the saturation
        level.
        """
        camera = self._camera
        ny, nx = self.image_shape
        _, seed, place = self._streams
        rng = np.random.Generator(np.random.PCG64(seed).jumped(place))
        galaxies = self._measurement.galaxies if galaxies is None else galaxies
        # The background increases slightly toward one side, as in practice.
        image = np.empty((ny, nx))
        image[:] = camera.background * (1 + 0.05 * (np.arange(nx) / nx - 0.5))
        x, y = self.stars["x"].data, self.stars["y"].data
        flux = camera.flux(self.stars["magnitude"].data, self._detector)
        sx, sy = camera.psf_widths(x, y, self.image_shape)
        for share, width in PSF:
            add_gaussians(image, x, y, share * flux, width * sx, width * sy)
        count = rng.poisson(galaxies * nx * ny * (camera.arcsec / 60) ** 2)
        if count:
            x, y = rng.uniform(0, nx, count), rng.uniform(0, ny, count)
            faint = self.stars["magnitude"].data.max(initial=camera.magnitudes[0])
            flux = camera.flux(faint - rng.exponential(1.0, count), self._detector)
            size = camera.fwhm * rng.uniform(0.4, 1.6, count)
            axis = np.exp(rng.normal(0, 0.25, count))
            sx, sy = camera.psf_widths(x, y, self.image_shape)
            for share, width in DISC:
                add_gaussians(
                    image,
                    x,
                    y,
                    share * flux,
                    np.hypot(sx, width * size * axis),
                    np.hypot(sy, width * size / axis),
                )
        if noise:
            image = rng.poisson(image) + rng.normal(0, camera.read_noise, (ny, nx))
        for _ in range(cosmic_rays):
            t = np.arange(0, rng.exponential(4) + 1, 0.5)
            angle = rng.uniform(0, 2 * np.pi)
            x = (rng.uniform(0, nx) + t * np.cos(angle)).astype(int)
            y = (rng.uniform(0, ny) + t * np.sin(angle)).astype(int)
            on = (x >= 0) & (x < nx) & (y >= 0) & (y < ny)
            image[y[on], x[on]] += rng.uniform(300, 6000)
        return (np.minimum(image, camera.saturation) / camera.gain).astype(np.float32)


def _make_header(wcs, camera, detector, epoch, name, exposure):
    header = fits.Header()
    header["NAXIS"] = 2
    header["NAXIS1"], header["NAXIS2"] = detector.image_shape[1], detector.image_shape[0]
    header["OBJECT"] = name
    if exposure is not None:
        header["INSTRUME"] = camera.name.upper()
        header["EXPID"] = (exposure, "what the detectors have in common")
    header["DETECTOR"] = detector.name
    header["FILTER"] = detector.band
    header["EXPTIME"] = (camera.exposure_time, "[s]")
    start = Time(epoch, format="jyear", scale="utc") - camera.exposure_time / 2 * u.s
    header["DATE-OBS"] = (start.isot, "start of the exposure, UTC")
    header["MJD-OBS"] = (start.mjd, "[d] start of the exposure")
    header["GAIN"] = (camera.gain, "[e-/count]")
    header["RDNOISE"] = (camera.read_noise, "[e-]")
    # Slightly below the true saturation level, as in headers of cameras.
    header["SATURATE"] = (round(0.95 * camera.saturation / camera.gain, 3), "[count]")
    header["RADESYS"] = "ICRS"
    for i in (0, 1):
        header[f"CTYPE{i + 1}"] = wcs.wcs.ctype[i]
        header[f"CUNIT{i + 1}"] = "deg"
        header[f"CRPIX{i + 1}"] = wcs.wcs.crpix[i]
        header[f"CRVAL{i + 1}"] = wcs.wcs.crval[i]
        for j in (0, 1):
            header[f"CD{i + 1}_{j + 1}"] = wcs.wcs.cd[i, j]
    return header
