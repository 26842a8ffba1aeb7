"""Identity of a frame: detector, camera, exposure, and unique names within a file."""

import re
from dataclasses import replace

from wpdc_gwcs.detector import UNNAMED
from wpdc_gwcs.io.dates import EXPOSURE_KEYS, header_start
from wpdc_gwcs.io.exposures import camera_key, exposure_key, has_identifier
from wpdc_gwcs.io.headers import header_text, positive_number

__all__ = [
    "NOT_NAMES",
    "detector_name",
    "detector_names",
    "distinct",
    "exposure_keys",
    "file_name",
    "header_facts",
    "of_one_exposure",
    "on_its_own",
]

_DETECTOR_KEYS = (
    "DETECTOR",
    "DETNAME",
    "CCDNAME",
    "CHIPNAME",
    "EXTNAME",
    "CHIPID",
    "CCDNUM",
    "CCDCHIP",
    "CCDID",
    "IMAGEID",
)
_FACTS = {"filter": ("FILTER", "FILTER1", "BAND"), "object": ("OBJECT",), "date": ("DATE-OBS",)}
# Camera of frames that are tied to others but do not name it.
_CAMERA = "camera"
#: Generic names of extensions.
NOT_NAMES = ("PRIMARY", "COMPRESSED_IMAGE", "")


def exposure_keys(headers, exposure_keyword, where, chosen=()):
    """Find camera and exposure; a frame without a camera is on its own.

    Parameters
    ----------
    headers : list of `~astropy.io.fits.Header`
        Header of the frame first, then that of its file.
    exposure_keyword : str or None
        Keyword that identifies the exposure; `None` for the usual ones.
    where : str
        Name of the frame in messages.
    chosen : list of str, optional
        Words for the plane of a cube.

    Returns
    -------
    dict
        ``camera`` and ``exposure`` of a `~wpdc_gwcs.frame.Frame`.
    """
    exposure = exposure_key(headers, keyword=exposure_keyword, name=where)
    if exposure is not None and chosen:
        # Planes of a cube are from one detector, and so from different exposures.
        exposure = "_".join([exposure, *chosen])
    camera = camera_key(headers)
    if camera is None and exposure_keyword is not None:
        camera = _CAMERA
    return {"camera": camera, "exposure": None if camera is None else exposure}


def on_its_own(frame):
    """Return a frame that is not tied to others.

    Parameters
    ----------
    frame : Frame
        Any frame.

    Returns
    -------
    Frame
        The frame without camera and exposure.
    """
    return replace(frame, camera=None, exposure=None)


def of_one_exposure(frames, parts, path):
    """Tie the frames of a file, unless identifiers say that they are different exposures.

    Their times may differ: each detector may have its own.

    Parameters
    ----------
    frames : list of Frame
        Frames of one file.
    parts : list of dict
        Their ``headers``.
    path : path-like
        The file.

    Returns
    -------
    list of Frame
        With camera and exposure.
    """
    frames = [replace(f, camera=f.camera or _CAMERA) for f in frames]
    if len({f.exposure for f in frames}) == 1 and frames[0].exposure is not None:
        return frames
    if all(has_identifier(p["headers"]) for p in parts):
        return frames
    return [replace(f, exposure=str(path)) for f in frames]


def detector_name(headers):
    """Find the name of a frame's detector.

    Parameters
    ----------
    headers : list of `~astropy.io.fits.Header`
        Header of the frame first, then that of its file.

    Returns
    -------
    str
        Name of the detector, or `wpdc_gwcs.detector.UNNAMED`.
    """
    return next(iter(detector_names(headers).values()), UNNAMED)


def detector_names(headers):
    """List all names that headers have for a detector.

    Parameters
    ----------
    headers : list of `~astropy.io.fits.Header`
        Header of the frame first, then that of its file.

    Returns
    -------
    dict
        Name by keyword, best first.  The name of an extension, ``EXTNAME``, may be of anything.
    """
    # The primary header describes the whole camera; the header of the frame takes precedence.
    found = {}
    for header in headers:
        for key in _DETECTOR_KEYS:
            text = header_text(header, key)
            if text.upper() not in (*NOT_NAMES, "LDAC_OBJECTS", "LDAC_IMHEAD"):
                found.setdefault(key, text)
    return found


def header_facts(headers):
    """Find what the header tells about an exposure.

    Parameters
    ----------
    headers : list of `~astropy.io.fits.Header`
        Header of the frame first, then that of its file.

    Returns
    -------
    dict
        ``filter``, ``object``, ``date``, ``exptime`` in s, ``start`` as MJD: those that are known.
    """
    facts = {}
    for fact, keys in _FACTS.items():
        text = next((t for h in headers for k in keys if (t := header_text(h, k))), "")
        if text:
            facts[fact] = text
    numbers = {
        "exptime": positive_number(headers, EXPOSURE_KEYS),
        "start": header_start(headers),
    }
    return facts | {fact: n for fact, n in numbers.items() if n is not None}


def distinct(frames, parts):
    """Make the names of frames and detectors of a file unique.

    Parameters
    ----------
    frames : list of Frame
        Frames of one file.
    parts : list of dict
        Their ``index`` and ``label`` in it.

    Returns
    -------
    list of Frame
        The frames, with numbers appended to names that were the same.
    """
    if len(frames) < 2:
        return frames
    if len({f.name for f in frames}) < len(frames):
        frames = [
            replace(f, name=f"{f.name}_{p['index']}") for f, p in zip(frames, parts, strict=True)
        ]
    if len({f.detector for f in frames}) < len(frames):
        frames = [
            replace(f, detector=f"{f.detector}_{p['label']}")
            for f, p in zip(frames, parts, strict=True)
        ]
    if len({f.detector for f in frames}) < len(frames):
        frames = [
            replace(f, detector=f"{f.detector}_{p['index']}")
            for f, p in zip(frames, parts, strict=True)
        ]
    return frames


def file_name(text):
    """Make a text usable in a file name.

    Parameters
    ----------
    text : str
        Any text.

    Returns
    -------
    str
        The text, with underscores for characters that file systems may reject.
    """
    return re.sub(r"[^A-Za-z0-9.+-]+", "_", text).strip("_") or "image"
