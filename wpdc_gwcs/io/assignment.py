"""Which extension of an image a calibration belongs to."""

import re
import warnings

import numpy as np
from astropy.coordinates import SkyCoord

from wpdc_gwcs.columns import listed
from wpdc_gwcs.exceptions import InputError, WPDCWarning
from wpdc_gwcs.io.embed import image_numbers
from wpdc_gwcs.io.files import open_fits
from wpdc_gwcs.io.frames import read_frames
from wpdc_gwcs.io.headers import extension_names

__all__ = ["assign_extensions", "frames_of_image"]

# The header of an extension may point this far from its calibration, in diagonals of the detector:
# more than any match allows, less than the distance of another exposure.
_MAX_OFFSET = 1.0
# Epochs of an exposure agree to this, in years (3 s): another exposure takes longer than that.
_SAME_EPOCH = 1e-7
_NUMBER = re.compile(r"\[(\d+)\]$")


def frames_of_image(image):
    """Read the frames of an image by the numbers of their extensions.

    Parameters
    ----------
    image : path-like
        FITS image with one or several extensions.

    Returns
    -------
    dict
        Number of the extension to its `~wpdc_gwcs.frame.Frame`, named as in a calibration.

    Raises
    ------
    FrameError
        If the file cannot be read, or an image has no WCS.
    InputError
        If it is not clear which of several images is the frame.
    """
    with warnings.catch_warnings():
        # They are about the use of a header for a match.
        warnings.simplefilter("ignore", WPDCWarning)
        frames = read_frames(image)
    if len(frames) > 1:
        return {int(_NUMBER.search(frame.source)[1]): frame for frame in frames}
    numbers = image_numbers(image)
    if len(numbers) > 1:
        with open_fits(image, lazy=True) as hdus:
            names = extension_names(hdus)
        raise InputError(
            f"{image}: has {len(numbers)} images of two axes, of which one is a frame; choose it "
            f"with path[EXT], EXT one of {names}"
        )
    return dict(zip(numbers, frames, strict=True))


def assign_extensions(image, frames, calibrations):
    """Find the calibration of each extension, by the name of its frame or else of its detector.

    Parameters
    ----------
    image : path-like
        The image, for messages.
    frames : dict
        Its frames by the numbers of their extensions.
    calibrations : dict
        Name for messages to `~wpdc_gwcs.Calibration` or `~wpdc_gwcs.DistortionSolution`.  A renamed
        image is recognized by its detectors.

    Returns
    -------
    dict
        Number of the extension to the name of its calibration, in the order of the extensions.

    Raises
    ------
    InputError
        If a calibration belongs to no extension, or two belong to the same one, or the extension is
        of another time or field.
    """
    by_frame = {frame.name: number for number, frame in frames.items()}
    by_detector = {frame.detector: number for number, frame in frames.items()}
    found = {}
    for name, one in calibrations.items():
        solution = getattr(one, "solution", one)
        number = by_frame.get(getattr(one, "frame", None))
        if number is None and (number := by_detector.get(solution.detector)) is not None:
            _require_same_epoch(f"{image}[{number}]", frames[number], name, one)
        if number is None:
            raise InputError(
                f"{name}: is of frame {getattr(one, 'frame', None)} and detector "
                f"{solution.detector}; {image} has frames "
                f"{listed(list(by_frame), kind='frames')} and detectors "
                f"{listed(list(by_detector), kind='detectors')}"
            )
        if number in found:
            raise InputError(
                f"{found[number]} and {name} both belong to {image}[{number}]; give one"
            )
        if one is not solution:
            _require_same_field(f"{image}[{number}]", frames[number], name, one)
        found[number] = name
    return {number: found[number] for number in sorted(found)}


def _require_same_epoch(place, frame, name, calibration):
    epochs = calibration.provenance.get("epochs") if hasattr(calibration, "frame") else None
    if frame.epoch is None or not epochs:
        return
    if not min(epochs) - _SAME_EPOCH <= frame.epoch <= max(epochs) + _SAME_EPOCH:
        raise InputError(
            f"{place}: is of epoch {frame.epoch:.7f}, {name} of {max(epochs):.7f}: not the same "
            "exposure"
        )


def _require_same_field(place, frame, name, calibration):
    ny, nx = frame.image_shape
    center = (nx - 1) / 2, (ny - 1) / 2
    header = SkyCoord(*frame.wcs.pixel_to_world_values(*center), unit="deg")
    offset = header.separation(SkyCoord(*calibration.pixel_to_sky(*center), unit="deg")).deg
    side = np.sqrt(abs(np.linalg.det(calibration.cd)))
    if not offset < _MAX_OFFSET * np.hypot(nx, ny) * side:
        raise InputError(
            f"{place}: its header points {offset:.3g} deg away from {name}: not the same exposure"
        )
