"""Built-in cameras: a generic detector, the CSST Main Survey Camera, 90Prime."""

from dataclasses import replace

import astropy.units as u
import numpy as np

from wpdc_gwcs.simulation.camera import SimulatedCamera, SimulatedDetector, require
from wpdc_gwcs.simulation.distortion import Distortion

__all__ = ["CAMERAS", "USUAL", "make_camera"]

# Ratio of the quintic to the cubic radial distortion at the edge of the focal plane.
_QUINTIC = 0.15

# Distance from the axis, in half-widths, where the terms of a detector are as large as those of a
# single detector.
_TERMS_AT = 4.0

# Rows of five, from the bottom up, and the four columns of the Main Survey Camera that have
# imaging detectors, from left to right.  Its other 12 detectors are for spectra.
_CSST = (
    ("y-1", "i-1", "g-1", "r-1", None),
    ("z-1", "NUV-1", "NUV-2", "u-1", "y-2"),
    ("y-3", "u-2", "NUV-3", "NUV-4", "z-2"),
    (None, "r-2", "g-2", "i-2", "y-4"),
)
# Pitch of its detectors in their widths and heights: 534 and 898 px lie between them.
_CSST_PITCH = (9750 / 9216, 10130 / 9232)
# Magnitudes by which the bands differ in depth from g: with a slope of 0.25, NUV sees a ninth of
# the stars that g sees, y a third.
_CSST_DEPTH = {"NUV": -3.8, "u": -2.0, "g": 0.0, "r": 0.0, "i": -0.3, "z": -0.8, "y": -2.0}

# Chips of 90Prime: position in the focal plane and directions of their axes, each read out from its
# outer corner; distance of their centers from the reference point in widths and heights.
_BASS = {"CCD1": (-1, -1), "CCD2": (-1, 1), "CCD3": (1, -1), "CCD4": (1, 1)}
_BASS_PITCH = (0.55, 0.59)

# Defaults of the cameras, and of simulations with them.
_CAMERA = {
    "generic": {"image_shape": (2048, 2048), "distortion": 40.0, "pixel_scale": 0.3 * u.arcsec},
    "csst-msc": {
        "image_shape": (9232, 9216),
        "distortion": 200.0,
        "waves": 0.002,
        "pixel_scale": 0.074 * u.arcsec,
        "magnitudes": (17.0, 24.5),
        "limit_snr": 13.0,
        "fwhm": 2.0,
        "centroid_floor": 0.02,
        "gain": 1.1,
        "background": 60.0,
        "exposure_time": 150.0,
    },
    "bass-90prime": {
        "image_shape": (4096, 4032),
        "distortion": 40.0,
        "waves": 0.01,
        "pixel_scale": 0.454 * u.arcsec,
        "magnitudes": (15.0, 20.5),
        "limit_snr": 80.0,
        "fwhm": 3.3,
        "centroid_floor": 0.01,
        "read_noise": 8.0,
        "background": 600.0,
        "saturation": 60000.0,
    },
}
USUAL = {
    "generic": {},
    "csst-msc": {"density": 46.0, "spurious": 0.05, "resolution": 1.0, "catalog_errors": False},
    "bass-90prime": {
        "density": 3.0,
        "epoch": 2017.33,
        "proper_motion": 6 * u.mas / u.yr,
        "dither": 120 * u.arcsec,
        "resolution": 1.0,
    },
}
CAMERAS = tuple(_CAMERA)


def make_camera(preset="generic", *, seed=1, name=None, **options):
    """Make one of the built-in cameras, or a variant of it.

    Parameters
    ----------
    preset : {"generic", "csst-msc", "bass-90prime"}, optional
        A single detector; the 18 imaging detectors of the CSST Main Survey Camera, each with the
        tangent point at its center; or four chips around a common tangent point.
    seed : int or `numpy.random.SeedSequence`, optional
        Seed of the distortion.
    name : str, optional
        Name of the only detector of the generic camera, "sim" by default.
    **options
        ``image_shape`` : (int, int), shape of each detector ``(ny, nx)``, with which the layout
        scales; ``distortion`` : float, largest displacement by the smooth distortion, over all
        detectors, in px; ``waves`` : float, scatter of the amplitudes of fine waves, in px; and the
        parameters of `SimulatedCamera` except its detectors.

    Returns
    -------
    SimulatedCamera
        The camera.

    Raises
    ------
    ValueError
        If there is no such preset, or a value is invalid.
    TypeError
        If an option is unknown.

    Notes
    -----
    A detector of a mosaic has the cubic and quintic radial distortion of the common optics, without
    the part that is constant or linear over the detector, which is in its header; its own terms up
    to degree 6; and six waves of 0.2 to 0.65 of its longer side.

    Examples
    --------
    >>> from wpdc_gwcs.simulation import make_camera
    >>> camera = make_camera("csst-msc", seed=3)
    >>> [d.name for d in camera.detectors][:4], camera.pixel_scale
    (['y-1', 'i-1', 'g-1', 'r-1'], <Quantity 0.074 arcsec>)
    >>> round(max(d.distortion.greatest() for d in camera.detectors))
    200
    """
    require("camera", preset, preset in _CAMERA, f"one of {', '.join(CAMERAS)}")
    options = {"waves": 0.0, **_CAMERA[preset], **options}
    shape, distortion, waves = (options.pop(k) for k in ("image_shape", "distortion", "waves"))
    shape = tuple(int(n) for n in shape)
    if len(shape) != 2 or min(shape) < 16:
        raise ValueError(f"image_shape must be at least 16 px in both directions, not {shape}")
    for key, value in (("distortion", distortion), ("waves", waves)):
        require(key, value, 0 <= value < np.inf, "not negative")
    if not isinstance(seed, np.random.SeedSequence):
        seed = np.random.SeedSequence(seed)
    if preset == "generic":
        one = Distortion.random(
            shape, amplitude=distortion, waves=waves, rng=np.random.default_rng(seed)
        )
        name = "sim" if name is None else name
        return SimulatedCamera(name, (SimulatedDetector(name, one),), **options)
    require("detector", name, name is None, "left out for a camera of several detectors")
    places = _csst_places(shape) if preset == "csst-msc" else _bass_places(shape)
    detectors = _with_optics(places, shape, distortion, waves, seed)
    return SimulatedCamera(preset, detectors, shared_tangent=preset == "bass-90prime", **options)


def _csst_places(shape):
    """Center, axes, band and depth by name."""
    pitch = np.multiply(_CSST_PITCH, shape[::-1])
    found = {}
    for column, names in enumerate(_CSST):
        for row, name in enumerate(names):
            if name is not None:
                band = name.split("-")[0]
                center = pitch * (column - 1.5, row - 2)
                found[name] = {
                    "center": tuple(map(float, center)), "band": band, "depth": _CSST_DEPTH[band]
                }  # fmt: skip
    return found


def _bass_places(shape):
    away = np.multiply(_BASS_PITCH, shape[::-1])
    return {
        name: {"center": tuple(map(float, away * side)), "axes": tuple(-s for s in side)}
        for name, side in _BASS.items()
    }


def _with_optics(places, shape, distortion, waves, seed):
    half = max(shape) / 2
    streams = [np.random.default_rng(s) for s in seed.spawn(1 + len(places))]
    # The axis is slightly off the pointing of the camera.
    axis = streams[0].normal(0, 0.2, 2) * half
    rim = max(np.hypot(*np.subtract(p["center"], axis)) for p in places.values()) / half + np.sqrt(
        2
    )
    quintic = _QUINTIC * streams[0].choice([-1, 1]) / rim**2
    drawn = []
    for place, rng in zip(places.values(), streams[1:], strict=True):
        x, y = np.subtract(axis, place["center"]) * place.get("axes", (1, 1)) / half
        one = Distortion.off_axis(shape, complex(x, y), quintic=quintic, rng=rng)
        # The terms of a detector grow toward the edge, like the common ones.
        own = (max(np.hypot(x, y), 1.0) / _TERMS_AT) ** 1.5
        drawn.append(replace(one, terms={key: own * c for key, c in one.terms.items()}))
    gain = distortion / max(one.greatest() for one in drawn)
    detectors = []
    for (name, place), one, rng in zip(places.items(), drawn, streams[1:], strict=True):
        own = one.scaled(gain).with_waves(waves, rng=rng)
        if not own.invertible():
            raise ValueError(
                f"a distortion of {distortion:g} px (waves {waves:g} px) is not invertible on a "
                f"detector of {shape[1]} x {shape[0]} px"
            )
        # Detectors are mounted to within a few pixels.
        offset = tuple(map(float, rng.normal(0, 3e-4, 2) * shape[::-1]))
        detectors.append(SimulatedDetector(name, own, offset=offset, **place))
    return tuple(detectors)
