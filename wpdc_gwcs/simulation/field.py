"""Exposures of a simulated camera on star fields, anywhere on the sky."""

from dataclasses import dataclass
from inspect import signature

import astropy.units as u
import numpy as np
from astropy.coordinates import SkyCoord
from astropy.table import QTable, vstack
from scipy.spatial import cKDTree

from wpdc_gwcs.frozen import freeze_attributes
from wpdc_gwcs.simulation.camera import SimulatedCamera, require, value_of
from wpdc_gwcs.simulation.chromatism import Chromatism
from wpdc_gwcs.simulation.exposure import SimulatedExposure
from wpdc_gwcs.simulation.measurement import Measurement
from wpdc_gwcs.simulation.pointing import Pointing, aim
from wpdc_gwcs.simulation.presets import USUAL, make_camera
from wpdc_gwcs.simulation.stars import (
    CATALOG_EPOCH,
    KingCluster,
    make_reference,
    make_stars,
    offset_positions,
)
from wpdc_gwcs.sky import directions

__all__ = ["Simulation", "simulate"]


@dataclass(frozen=True, eq=False)
class Simulation:
    """Exposures of a camera on one or more fields, made by `simulate`.

    Parameters
    ----------
    reference : `astropy.table.QTable`
        Reference catalog with Gaia's column names: ``source_id``, ``ra``, ``dec``, ``ra_error``,
        ``dec_error``, ``pmra``, ``pmdec``, ``ref_epoch``, ``phot_g_mean_mag``, perhaps ``bp_rp``.
    exposures : tuple of SimulatedExposure
        The exposures of each detector, field after field.
    camera : SimulatedCamera
        The camera.
    settings : dict
        The options of `simulate`.

    Examples
    --------
    >>> from wpdc_gwcs import simulate
    >>> sky = simulate(2, image_shape=(128, 128), density=60, seed=1)
    >>> [exposure.name for exposure in sky.exposures]
    ['sim-01', 'sim-02']
    >>> sky.camera.name, sky.settings["density"]
    ('sim', 60)
    >>> sky.reference["ref_epoch"].unit
    Unit("yr")
    """

    reference: QTable
    exposures: tuple[SimulatedExposure, ...]
    camera: SimulatedCamera
    settings: dict

    def __post_init__(self):
        freeze_attributes(self, "settings")

    @property
    def distortion(self):
        """The distortion of the first detector."""
        return self.camera.detectors[0].distortion


@dataclass(frozen=True, eq=False)
class StarField:
    """The stars of a field.

    Parameters
    ----------
    stars : `~astropy.table.Table`
        Columns ``ra``, ``dec``, ``pmra``, ``pmdec``, ``magnitude``, ``reference_index`` and perhaps
        ``color``, at the epoch of the catalog.
    vectors : (3, N) ndarray
        Unit vectors toward them.
    """

    stars: object
    vectors: np.ndarray


def simulate(
    n_exposures=5,
    *,
    camera="generic",
    detectors=None,
    seed=1,
    center=None,
    roll=0.0 * u.deg,
    density=None,
    slope=0.25,
    reference_limit=None,
    catalog_errors=None,
    cluster=None,
    galaxies=0.0,
    colors=None,
    refraction=0.0 * u.mas,
    lateral_color=0.0 * u.mas,
    proper_motion=None,
    epoch=None,
    dither=None,
    pointing_error=2 * u.arcsec,
    roll_error=0.01 * u.deg,
    scale_error=0.0,
    spurious=None,
    lost=0.05,
    resolution=None,
    noise=True,
    **camera_options,
):
    """Simulate dithered exposures of a camera whose distortion is known.

    Parameters
    ----------
    n_exposures : int, optional
        Number of exposures of each field.
    camera : str or SimulatedCamera, optional
        Name of a built-in camera ("generic", "csst-msc" or "bass-90prime", see `make_camera`), or a
        camera.
    detectors : sequence of str, optional
        Names of the detectors to simulate; all by default.
    seed : int, optional
        The same seed gives the same simulation.
    center : `~astropy.coordinates.SkyCoord`, optional
        Pointing of the middle of the chosen detectors, one position per field; by default one field
        at RA 120 deg, Dec +30 deg.
    roll : `~astropy.units.Quantity`, optional
        Position angle of the camera's y axis, north through east: one for all exposures, or one for
        each exposure of a field.
    density : float or sequence of float, optional
        Stars per square arcmin down to the faintest magnitude: one for all fields, or one for each.
    slope : float, optional
        Slope of the luminosity function, d log10 N / d mag.
    reference_limit : float, optional
        Faintest magnitude of the reference catalog; all stars by default.
    catalog_errors : bool, optional
        Whether the catalog has Gaia's errors; otherwise its positions and motions are exact, and it
        has no error columns.
    cluster : KingCluster, optional
        A star cluster at the center of each field, in addition to the field stars.
    galaxies : float, optional
        Galaxies per square arcmin, which are in no catalog.
    colors : (float, float), optional
        Mean and scatter of the stars' colors; without them the catalog has none.
    refraction : `~astropy.units.Quantity`, optional
        Shift of stars toward the zenith per magnitude of color; the direction of the zenith is
        random for each exposure.
    lateral_color : `~astropy.units.Quantity`, optional
        Shift of stars away from the pointing of the camera per magnitude of color, at the farthest
        corner of its detectors.  The true WCS is that of the mean color.
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
        Spurious sources, and undetected stars, as fractions of the stars on the detector.
    resolution : float, optional
        Source lists have only the brighter one of two sources closer than this, in FWHM.
    noise : bool, optional
        Scatter positions in the source lists and in the reference by their errors.
    **camera_options
        Options of a built-in camera: ``image_shape``, ``distortion``, ``waves``,
        ``pixel_scale``, ``magnitudes``, ``fwhm`` and all other options of `make_camera`;
        ``detector``: name of the only detector of the generic camera.

    Returns
    -------
    Simulation
        Reference catalog and exposures.

    Raises
    ------
    ValueError
        If an option is out of range, or the distortion too large to be invertible.
    TypeError
        If an angle has no unit, or an option is unknown.

    Notes
    -----
    The defaults of options (`None`) depend on the camera: for "generic", 20 stars per square
    arcmin, epoch 2016, a dither of 30 arcsec, no motions, 10 % of spurious sources, Gaia's errors,
    and lists without blends.

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

    Two of the 18 detectors of a mosaic, a tenth of their size, next to the south pole:

    >>> from astropy.coordinates import SkyCoord
    >>> pole = SkyCoord(10, -89.9, unit="deg")
    >>> simulation = simulate(1, camera="csst-msc", detectors=["g-1", "y-4"], center=pole,
    ...                       image_shape=(920, 920), distortion=20, density=100)
    >>> [exposure.name for exposure in simulation.exposures]
    ['csst-msc-01-g-1', 'csst-msc-01-y-4']
    """
    settings = {k: v for k, v in locals().items() if k not in ("center", "camera")}
    require("n_exposures", n_exposures, n_exposures >= 1, "at least 1")
    require("seed", seed, isinstance(seed, (int, np.integer)) and seed >= 0, "0 or more")
    # One random stream for each part, so that more exposures do not change the first ones.
    streams = np.random.SeedSequence(int(seed)).spawn(2 + n_exposures)
    usual = {**_USUAL, **USUAL.get(getattr(camera, "name", camera), {})}
    given = {name: settings[name] for name in usual if settings[name] is not None}
    usual |= given
    camera = _the_camera(camera, detectors, streams[0], camera_options)
    for name in ("spurious", "resolution", "galaxies"):
        value = {**usual, "galaxies": galaxies}[name]
        require(name, value, 0 <= value < np.inf, "not negative")
    require("lost", lost, 0 <= lost <= 1, "between 0 and 1")
    require("slope", slope, 0 < slope < np.inf, "positive")
    if not (cluster is None or isinstance(cluster, KingCluster)):
        raise TypeError(f"cluster must be a KingCluster or None, not {cluster!r}")
    centers = _centers(center)
    densities = _each("density", usual["density"], len(centers), "field")
    require("density", usual["density"], (densities >= 0).all(), "not negative")
    epochs = _each("epoch", usual["epoch"], n_exposures, "exposure")
    rolls = _each("roll", value_of("roll", roll, u.deg), n_exposures, "exposure")
    dither = float(value_of("dither", usual["dither"], u.deg))
    require("dither", usual["dither"], dither >= 0, "not negative")
    scatter = (
        float(value_of("pointing_error", pointing_error, u.deg)),
        float(value_of("roll_error", roll_error, u.deg)),
        scale_error,
    )
    drawing = {
        "magnitudes": camera.magnitudes,
        "slope": slope,
        "cluster": cluster,
        "proper_motion": float(value_of("proper_motion", usual["proper_motion"], u.mas / u.yr)),
        "colors": colors,
    }
    chromatic = _chromatic(camera, colors, refraction, lateral_color)
    measurement = Measurement(
        spurious=usual["spurious"],
        lost=lost,
        noise=noise,
        galaxies=galaxies,
        slope=slope,
        resolution=usual["resolution"],
    )

    catalogs, exposures, n_before = [], [], 0
    for number, where in enumerate(centers):
        if number:
            streams = np.random.SeedSequence([int(seed), number]).spawn(2 + n_exposures)
        pointings = [
            _point(camera, where, rolls[k], dither if n_exposures > 1 else 0.0, scatter, stream)
            for k, stream in enumerate(streams[2:])
        ]
        rng = np.random.default_rng(streams[1])
        extra = np.random.default_rng(streams[1].spawn(1)[0])
        reach = _reach(camera, dither, scatter[0])
        middle = _middle(camera)
        away = max(np.hypot(*np.subtract(d.center, middle)) for d in camera.detectors)
        stars = make_stars(
            rng,
            extra,
            where,
            reach + away * camera.arcsec / 3600,
            density=densities[number],
            **drawing,
        )
        stars = stars[_near_detectors(stars, camera, pointings, reach + dither)]
        in_catalog = stars["magnitude"] <= (np.inf if reference_limit is None else reference_limit)
        index = n_before + np.cumsum(in_catalog) - 1
        stars["reference_index"] = np.where(in_catalog, index, -1)
        n_before += int(in_catalog.sum())
        catalogs.append(
            make_reference(rng, stars[in_catalog], noise=noise, errors=usual["catalog_errors"])
        )
        vectors, *_ = directions(stars["ra"].data, stars["dec"].data)
        field = StarField(stars, vectors)
        for k, (nominal, true, generator, image_seed) in enumerate(pointings):
            chromatism = chromatic and Chromatism.of(
                **chromatic,
                center=(true.ra, true.dec),
                rng=np.random.default_rng(streams[2 + k].spawn(1)[0]),
            )
            label = f"{k + 1:02d}" if len(centers) == 1 else f"f{number + 1:02d}-{k + 1:02d}"
            exposures += [
                SimulatedExposure.of(
                    camera,
                    d,
                    label=label,
                    epoch=float(epochs[k]),
                    pointing=(nominal, true),
                    field=field,
                    measurement=measurement,
                    streams=(generator.jumped(j), image_seed),
                    place=j,
                    chromatism=chromatism,
                )
                for j, d in enumerate(camera.detectors)
            ]
    reference = catalogs[0] if len(catalogs) == 1 else vstack(catalogs)
    reference.add_column(
        np.arange(len(reference), dtype=np.int64) + 4_000_000_000, name="source_id", index=0
    )
    return Simulation(reference, tuple(exposures), camera, settings)


# Defaults for any camera without its own entry.
_USUAL = {
    "density": 20.0,
    "epoch": CATALOG_EPOCH,
    "proper_motion": 0.0 * u.mas / u.yr,
    "dither": 30 * u.arcsec,
    "spurious": 0.1,
    "resolution": 0.0,
    "catalog_errors": True,
}


def _the_camera(camera, detectors, seed, options):
    if isinstance(camera, SimulatedCamera):
        if options:
            raise TypeError(
                f"a Camera has its options already and takes no {', '.join(options)}: "
                "dataclasses.replace makes another"
            )
    else:
        unknown = set(options) - _CAMERA_OPTIONS
        if unknown:
            raise TypeError(f"simulate has no option {', '.join(sorted(unknown))}")
        options = {("name" if k == "detector" else k): v for k, v in options.items()}
        camera = make_camera(camera, seed=seed, **options)
    return camera if detectors is None else camera.only(detectors)


_CAMERA_OPTIONS = {"detector", "image_shape", "distortion", "waves"} | (
    set(signature(SimulatedCamera).parameters) - {"name", "detectors", "shared_tangent"}
)


def _centers(center):
    """Right ascension and declination of each field, deg."""
    if center is None:
        return [(120.0, 30.0)]
    if not isinstance(center, SkyCoord):
        raise TypeError(f"center must be a SkyCoord, not {center!r}")
    center = center.icrs.reshape(-1)
    require("center", center, len(center) > 0, "at least one position")
    return list(zip(center.ra.deg.tolist(), center.dec.deg.tolist(), strict=True))


def _each(name, values, n, what):
    values = np.asarray(values, float)
    if values.shape not in ((), (1,), (n,)) or not np.isfinite(values).all():
        raise ValueError(
            f"{name} must be one number, or one for each {what} ({n}), not {values.tolist()}"
        )
    return np.broadcast_to(values, (n,))


def _chromatic(camera, colors, refraction, lateral_color):
    """Sizes of the shifts by color in rad per magnitude; `None` for none."""
    sizes = {
        name: float(value_of(name, value, u.rad))
        for name, value in (("refraction", refraction), ("lateral_color", lateral_color))
    }
    if not any(sizes.values()):
        return None
    require("colors", colors, colors is not None, "given where places depend on color")
    rim = max(np.hypot(*d.center) + np.hypot(*d.image_shape) / 2 for d in camera.detectors)
    return {
        "color": colors[0],
        "refraction": sizes["refraction"],
        "lateral": sizes["lateral_color"],
        "rim": np.deg2rad(rim * camera.arcsec / 3600),
    }


def _middle(camera):
    """Middle of the detectors in the focal plane, px."""
    places = np.array([d.center for d in camera.detectors])
    return (places.min(axis=0) + places.max(axis=0)) / 2


def _reach(camera, dither, pointing_error):
    """Distance from the nominal center of a detector up to which stars are needed, deg."""
    size = max(np.hypot(*d.image_shape) for d in camera.detectors)
    distortion = max(d.distortion.greatest() for d in camera.detectors)
    reach = size / 2 * camera.arcsec / 3600 * 1.02 + dither + 4 * pointing_error
    return reach + (distortion + 20) * camera.arcsec / 3600


def _point(camera, center, roll, dither, scatter, stream):
    """Draw the nominal and true pointing of an exposure, and its random streams."""
    seed, image_seed = stream.spawn(2)
    rng = np.random.default_rng(seed)
    along = rng.uniform(-dither, dither, 2) if dither else np.zeros(2)
    pointing_error, roll_error, scale_error = scatter
    nominal = aim(*offset_positions(*center, *along), roll, camera.arcsec, _middle(camera))
    off = rng.normal(size=2) * pointing_error
    scale = camera.arcsec * (1 + rng.normal() * scale_error)
    turned = roll + rng.normal() * roll_error
    ra, dec = offset_positions(nominal.ra, nominal.dec, *off)
    true = Pointing(float(ra), float(dec), float(turned), scale)
    return nominal, true, rng.bit_generator, image_seed


def _near_detectors(stars, camera, pointings, reach):
    """Mark the stars on or near a detector in any exposure."""
    if len(camera.detectors) == 1:
        return slice(None)
    centers = []
    for nominal, *_ in pointings:
        for d in camera.detectors:
            wcs = nominal.linear_wcs(d, d.center, shared_tangent=camera.shared_tangent)
            centers.append(wcs.wcs_pix2world([d.distortion.center], 0)[0])
    tree = cKDTree(directions(*np.transpose(centers))[0].T)
    vectors, *_ = directions(stars["ra"].data, stars["dec"].data)
    return np.isfinite(tree.query(vectors.T, distance_upper_bound=np.deg2rad(reach))[0])
