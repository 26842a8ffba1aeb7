"""Star fields, and the exposures of one detector on them."""

from dataclasses import dataclass

import astropy.units as u
import numpy as np
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.table import QTable, Table
from astropy.time import Time
from astropy.wcs import WCS

from wpdc_gwcs.detector import on_detector
from wpdc_gwcs.frozen import freeze_attributes
from wpdc_gwcs.simulation._camera import SIGMA_PER_FWHM, Camera, find_zero_point
from wpdc_gwcs.simulation.distortion import Distortion
from wpdc_gwcs.simulation.exposure import SimulatedExposure

__all__ = ["Simulation", "simulate"]

_MAS = np.deg2rad(1 / 3.6e6)  # rad


@dataclass(frozen=True, eq=False)
class Simulation:
    """Exposures of one detector on one field, made by `simulate`.

    Parameters
    ----------
    reference : `astropy.table.QTable`
        Reference catalog with Gaia's column names: ``source_id``, ``ra``, ``dec``, ``ra_error``,
        ``dec_error``, ``pmra``, ``pmdec``, ``ref_epoch``, ``phot_g_mean_mag``.
    exposures : tuple of SimulatedExposure
        The exposures.
    distortion : Distortion
        The distortion of the detector.
    settings : dict
        The options it was made with.
    """

    reference: QTable
    exposures: tuple[SimulatedExposure, ...]
    distortion: Distortion
    settings: dict

    def __post_init__(self):
        freeze_attributes(self, "settings")


def simulate(
    n_exposures=5,
    *,
    seed=1,
    detector="sim",
    image_shape=(2048, 2048),
    pixel_scale=0.3 * u.arcsec,
    center=None,
    roll=0.0 * u.deg,
    distortion=40.0,
    waves=0.0,
    density=20.0,
    magnitudes=(15.0, 21.0),
    slope=0.25,
    reference_limit=None,
    cluster=0.0,
    cluster_radius=45 * u.arcsec,
    proper_motion=0.0 * u.mas / u.yr,
    epoch=2016.0,
    dither=30 * u.arcsec,
    pointing_error=2 * u.arcsec,
    roll_error=0.01 * u.deg,
    scale_error=0.0,
    spurious=0.1,
    lost=0.05,
    noise=True,
    centroid_floor=0.005,
    fwhm=2.5,
    psf_variation=0.05,
    gain=1.5,
    read_noise=5.0,
    background=200.0,
    saturation=90000.0,
    limit_snr=10.0,
    exposure_time=100.0,
):
    """Simulate dithered exposures of one detector with a known distortion.

    Parameters
    ----------
    n_exposures : int, optional
        Number of exposures.
    seed : int, optional
        The same seed gives the same simulation.
    detector : str, optional
        Name of the detector.
    image_shape : (int, int), optional
        Shape of the detector ``(ny, nx)``.
    pixel_scale : `~astropy.units.Quantity`, optional
        Angle of a pixel.
    center : `~astropy.coordinates.SkyCoord`, optional
        Center of the field; RA 120 deg, Dec +30 deg by default.
    roll : `~astropy.units.Quantity`, optional
        Position angle of the detector's y axis, north through east.
    distortion : float, optional
        Greatest displacement by the smooth distortion, in px.
    waves : float, optional
        Scatter of the amplitudes of fine waves in the distortion, in px.
    density : float, optional
        Stars per square arcmin.
    magnitudes : (float, float), optional
        Magnitudes of the brightest and of the faintest star.
    slope : float, optional
        Slope of the luminosity function, d log10 N / d mag.
    reference_limit : float, optional
        Faintest magnitude of the reference catalog; all stars by default.
    cluster : float, optional
        Share of the stars that are members of a star cluster at the center.
    cluster_radius : `~astropy.units.Quantity`, optional
        Core radius of the cluster.
    proper_motion : `~astropy.units.Quantity`, optional
        Scatter of the proper motions per axis.
    epoch : float or (n_exposures,) array_like, optional
        Epoch of the exposures, Julian years; the reference is at 2016.0.
    dither : `~astropy.units.Quantity`, optional
        Exposures point within this angle of the center, per axis.
    pointing_error, roll_error : `~astropy.units.Quantity`, optional
        Scatter of the true pointing (per axis) and roll about the header's.
    scale_error : float, optional
        Scatter of the true pixel scale about the header's, relative.
    spurious, lost : float, optional
        Spurious sources, and stars that are not detected, as shares of the stars on the detector.
    noise : bool, optional
        Scatter positions in the source lists and in the reference by their errors.
    centroid_floor : float, optional
        Centroid error of the brightest stars, in px.
    fwhm : float, optional
        Width of the PSF, in px.
    psf_variation : float, optional
        Relative change of the PSF's width and shape over the detector.
    gain : float, optional
        Electrons per count.
    read_noise, background : float, optional
        Read noise and background level, in electrons.
    saturation : float, optional
        Saturation level in electrons; saturated stars are missing from the source lists.
    limit_snr : float, optional
        Signal-to-noise ratio of the faintest star.  It sets the zero point.
    exposure_time : float, optional
        Exposure time in seconds, for the header.

    Returns
    -------
    Simulation
        Reference catalog and exposures.

    Raises
    ------
    ValueError
        If an option is out of range, or the distortion too large to be invertible.

    Examples
    --------
    >>> from wpdc_gwcs import simulate
    >>> simulation = simulate(2, distortion=20, density=5, seed=3)
    >>> exposure = simulation.exposures[0]
    >>> ra, dec = exposure.sky(100.0, 200.0)
    >>> x, y = exposure.pixel(ra, dec)
    >>> print(f"{x:.6f} {y:.6f}")
    100.000000 200.000000
    >>> exposure.sources.colnames[:4]
    ['x', 'y', 'x_err', 'y_err']
    """
    settings = {k: v for k, v in locals().items() if k != "center"}
    ny, nx = image_shape = tuple(int(n) for n in image_shape)
    _require("n_exposures", n_exposures, n_exposures >= 1, "at least 1")
    _require("image_shape", image_shape, min(image_shape) >= 16, "at least 16 px on each side")
    _require("magnitudes", magnitudes, magnitudes[0] < magnitudes[1], "(brightest, faintest)")
    _require("lost", lost, 0 <= lost <= 1, "between 0 and 1")
    _require("cluster", cluster, 0 <= cluster <= 1, "between 0 and 1")
    for name in ("distortion", "waves", "density", "spurious", "centroid_floor", "read_noise"):
        _require(name, settings[name], settings[name] >= 0, "not negative")
    for name in ("slope", "fwhm", "gain", "background", "saturation", "limit_snr"):
        _require(name, settings[name], settings[name] > 0, "positive")
    scale = _value("pixel_scale", pixel_scale, u.arcsec)
    _require("pixel_scale", pixel_scale, scale > 0, "positive")
    dither = _value("dither", dither, u.deg)
    pointing_error = _value("pointing_error", pointing_error, u.deg)
    roll, roll_error = _value("roll", roll, u.deg), _value("roll_error", roll_error, u.deg)
    epochs = np.broadcast_to(np.asarray(epoch, float), (n_exposures,))
    center = SkyCoord(120 * u.deg, 30 * u.deg) if center is None else center.icrs

    camera = Camera(
        image_shape=image_shape,
        pixel_scale=scale,
        fwhm=fwhm,
        psf_variation=psf_variation,
        gain=gain,
        read_noise=read_noise,
        background=background,
        saturation=saturation,
        zero_point=find_zero_point(magnitudes[1], limit_snr, fwhm, background, read_noise),
        exposure_time=exposure_time,
    )
    # One stream of numbers for each part: more exposures leave the first ones as they are.
    streams = np.random.SeedSequence(seed).spawn(2 + n_exposures)
    optics = Distortion.random(
        image_shape, amplitude=distortion, waves=waves, rng=np.random.default_rng(streams[0])
    )
    rng = np.random.default_rng(streams[1])
    reach = np.hypot(nx, ny) / 2 * scale / 3600 * 1.02 + dither + 4 * pointing_error
    reach += (distortion + 20) * scale / 3600
    sky = _make_field(
        rng,
        center,
        reach,
        density=density,
        magnitudes=magnitudes,
        slope=slope,
        cluster=cluster,
        cluster_radius=_value("cluster_radius", cluster_radius, u.deg),
        proper_motion=_value("proper_motion", proper_motion, u.mas / u.yr),
    )
    kept = sky["magnitude"] <= (np.inf if reference_limit is None else reference_limit)
    sky["reference_index"] = np.where(kept, np.cumsum(kept) - 1, -1)
    reference = _make_reference(rng, sky[kept], noise=noise)

    exposures = []
    for k in range(n_exposures):
        stream, image_seed = streams[2 + k].spawn(2)
        rng = np.random.default_rng(stream)
        along = rng.uniform(-dither, dither, 2) if n_exposures > 1 else np.zeros(2)
        pointing = _offset(center.ra.deg, center.dec.deg, *along)
        true = _offset(*pointing, *(rng.normal(size=2) * pointing_error))
        nominal_wcs = _linear_wcs(optics, scale, pointing, roll)
        true_wcs = _linear_wcs(
            optics,
            scale * (1 + rng.normal() * scale_error),
            true,
            roll + rng.normal() * roll_error,
        )
        name = f"{detector}-{k + 1:02d}"
        stars = _stars_on_detector(sky, epochs[k], optics, true_wcs)
        exposures.append(
            SimulatedExposure(
                name=name,
                detector=detector,
                epoch=float(epochs[k]),
                header=_make_header(nominal_wcs, camera, epochs[k], detector, name),
                sources=_measure(
                    rng,
                    stars,
                    camera,
                    spurious=spurious,
                    lost=lost,
                    noise=noise,
                    floor=centroid_floor,
                    slope=slope,
                ),
                stars=stars,
                distortion=optics,
                linear_wcs=true_wcs,
                _camera=camera,
                _seed=image_seed,
            )
        )
    return Simulation(reference, tuple(exposures), optics, settings)


def _require(name, value, good, rule):
    if not good:
        raise ValueError(f"{name} must be {rule}, not {value}")


def _value(name, quantity, unit):
    try:
        return u.Quantity(quantity, subok=False).to_value(unit)
    except u.UnitConversionError as error:
        raise TypeError(f"{name} must be a Quantity in {unit}, not {quantity!r}") from error


def _basis(ra, dec):
    """Find the unit vectors towards a position, east and north of it; degrees in."""
    ra, dec = np.deg2rad(ra), np.deg2rad(dec)
    zero = np.zeros_like(ra)
    return (
        np.array([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)]),
        np.array([-np.sin(ra), np.cos(ra), zero]),
        np.array([-np.sin(dec) * np.cos(ra), -np.sin(dec) * np.sin(ra), np.cos(dec)]),
    )


def _offset(ra, dec, east, north):
    """Positions at tangent-plane offsets, all in degrees."""
    p, e, n = _basis(np.asarray(ra, float), np.asarray(dec, float))
    east, north = np.deg2rad(east), np.deg2rad(north)
    shape = (3,) + (1,) * (np.ndim(east) - np.ndim(ra))
    v = p.reshape(p.shape + shape[1:]) + e.reshape(e.shape + shape[1:]) * east
    v = v + n.reshape(n.shape + shape[1:]) * north
    return (
        np.rad2deg(np.arctan2(v[1], v[0])) % 360,
        np.rad2deg(np.arctan2(v[2], np.hypot(v[0], v[1]))),
    )


def _make_field(
    rng, center, reach, *, density, magnitudes, slope, cluster, cluster_radius, proper_motion
):
    n = rng.poisson(density * (2 * reach * 60) ** 2)
    east, north = rng.uniform(-reach, reach, (2, n))
    members = int(round(cluster * n))
    # Plummer's surface density, cut at 99 % of its mass.
    q = rng.uniform(0, 0.99, members)
    r, angle = cluster_radius * np.sqrt(q / (1 - q)), rng.uniform(0, 2 * np.pi, members)
    east[:members], north[:members] = r * np.cos(angle), r * np.sin(angle)
    bright, faint = 10 ** (slope * np.asarray(magnitudes, float))
    ra, dec = _offset(center.ra.deg, center.dec.deg, east, north)
    order = rng.permutation(n)
    return Table(
        {
            "ra": ra[order],
            "dec": dec[order],
            "pmra": rng.normal(0, proper_motion, n),
            "pmdec": rng.normal(0, proper_motion, n),
            "magnitude": np.log10(rng.uniform(bright, faint, n)) / slope,
        }
    )


def _make_reference(rng, sky, *, noise):
    n = len(sky)
    # Gaia's errors: flat for bright stars, then falling with the flux.
    error = 0.02 * 10 ** (0.2 * np.clip(sky["magnitude"].data - 14.5, 0, None))
    pm_error = 1.1 * error
    shift = rng.normal(size=(4, n)) * [[noise]]
    ra, dec = _offset(sky["ra"].data, sky["dec"].data, *(shift[:2] * error / 3.6e6))
    return QTable(
        {
            "source_id": np.arange(n, dtype=np.int64) + 4_000_000_000,
            "ra": ra * u.deg,
            "dec": dec * u.deg,
            "ra_error": error * u.mas,
            "dec_error": error * u.mas,
            "pmra": sky["pmra"].data * u.mas / u.yr,
            "pmdec": sky["pmdec"].data * u.mas / u.yr,
            "pmra_error": pm_error * u.mas / u.yr,
            "pmdec_error": pm_error * u.mas / u.yr,
            "ref_epoch": np.full(n, 2016.0) * u.yr,
            "phot_g_mean_mag": sky["magnitude"].data * u.mag,
        }
    )


def _linear_wcs(optics, scale, crval, roll):
    wcs = WCS(naxis=2)
    wcs.wcs.ctype = ["RA---TAN", "DEC--TAN"]
    wcs.wcs.cunit = ["deg", "deg"]
    wcs.wcs.crpix = np.add(optics.center, 1)
    wcs.wcs.crval = crval
    c, s = np.cos(np.deg2rad(roll)), np.sin(np.deg2rad(roll))
    wcs.wcs.cd = scale / 3600 * np.array([[-c, s], [s, c]])
    wcs.wcs.radesys = "ICRS"
    wcs.array_shape = optics.image_shape
    wcs.wcs.set()
    return wcs


def _stars_on_detector(sky, epoch, optics, wcs):
    years = epoch - 2016.0
    p, e, n = _basis(sky["ra"].data, sky["dec"].data)
    v = p + years * _MAS * (e * sky["pmra"].data + n * sky["pmdec"].data)
    ra = np.rad2deg(np.arctan2(v[1], v[0])) % 360
    dec = np.rad2deg(np.arctan2(v[2], np.hypot(v[0], v[1])))
    x, y = optics.distort(*wcs.wcs_world2pix(ra, dec, 0))
    ny, nx = optics.image_shape
    margin = 20  # px: stars just off the detector shine onto it
    with np.errstate(invalid="ignore"):
        near = (x > -margin) & (x < nx - 1 + margin) & (y > -margin) & (y < ny - 1 + margin)
    return Table(
        {
            "x": x[near],
            "y": y[near],
            "ra": ra[near],
            "dec": dec[near],
            "magnitude": sky["magnitude"].data[near],
            "reference_index": sky["reference_index"].data[near],
        }
    )


def _measure(rng, stars, camera, *, spurious, lost, noise, floor, slope):
    ny, nx = camera.image_shape
    x, y, magnitude = stars["x"].data, stars["y"].data, stars["magnitude"].data
    seen = on_detector(x, y, (ny, nx))
    seen &= rng.uniform(size=len(stars)) >= lost
    seen &= camera.peak(camera.flux(magnitude)) < camera.saturation
    x, y, magnitude = x[seen], y[seen], magnitude[seen]
    index = stars["reference_index"].data[seen]
    n = len(x)
    m = rng.poisson(spurious * n)
    faint = magnitude.max(initial=0.0)
    flux = camera.flux(np.append(magnitude, faint - rng.exponential(1 / (slope * 3), m)))
    snr = camera.snr(flux)
    # The photon limit of a Gaussian image, and what no image gets under.
    sigma = np.hypot(floor, camera.fwhm * SIGMA_PER_FWHM / snr)
    error = rng.normal(size=(2, n + m)) * sigma * noise
    error[:, n:] = 0.0
    order = rng.permutation(n + m)
    return Table(
        {
            "x": (np.append(x, rng.uniform(-0.5, nx - 0.5, m)) + error[0])[order],
            "y": (np.append(y, rng.uniform(-0.5, ny - 0.5, m)) + error[1])[order],
            "x_err": sigma[order],
            "y_err": sigma[order],
            "flux": flux[order] / camera.gain,
            "snr": snr[order],
            "roundness": rng.normal(0, np.append(np.full(n, 0.05), np.full(m, 0.12)))[order],
            "reference_index": np.append(index, np.full(m, -1))[order],
        }
    )


def _make_header(wcs, camera, epoch, detector, name):
    header = fits.Header()
    header["NAXIS"] = 2
    header["NAXIS1"], header["NAXIS2"] = camera.image_shape[1], camera.image_shape[0]
    header["OBJECT"] = name
    header["DETECTOR"] = detector
    header["FILTER"] = "g"
    header["EXPTIME"] = (camera.exposure_time, "[s]")
    start = Time(epoch, format="jyear", scale="utc") - camera.exposure_time / 2 * u.s
    header["DATE-OBS"] = (start.isot, "start of the exposure, UTC")
    header["MJD-OBS"] = (start.mjd, "[d] start of the exposure")
    header["GAIN"] = (camera.gain, "[e-/count]")
    header["RDNOISE"] = (camera.read_noise, "[e-]")
    # A little lower than where pixels end, as cameras give it.
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
