"""Assignment of calibrations to images: whether they belong together, and to which extension."""

import re
import warnings

import numpy as np
from astropy.coordinates import SkyCoord

from wpdc_gwcs.columns import listed
from wpdc_gwcs.detector import UNNAMED
from wpdc_gwcs.exceptions import InputError, WPDCWarning
from wpdc_gwcs.io.dates import EXPOSURE_KEYS, header_epoch
from wpdc_gwcs.io.embed import image_numbers
from wpdc_gwcs.io.files import open_fits, split_extension, stem_of
from wpdc_gwcs.io.frames import read_frames
from wpdc_gwcs.io.headers import extension_names, find_extension, header_text, positive_number
from wpdc_gwcs.io.identity import detector_names, file_name

__all__ = ["assign_extensions", "frames_of_image", "require_same_exposure"]

# The header of an extension may point this far from its calibration, in diagonals of the detector:
# more than any match allows, less than the distance of another exposure.
_MAX_OFFSET = 1.0
# Epochs of an exposure agree to this, in years (3 s): another exposure takes longer than that.
_SAME_EPOCH = 1e-7
# A copy may have the start or the end of the exposure as its date, instead of the middle.  The
# middle of another exposure is at least a whole exposure time away.
_SHARE_OF_EXPOSURE = 0.5
_SECONDS_PER_YEAR = 365.25 * 86400
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


def assign_extensions(image, frames, calibrations, *, any_exposure=False):
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
    any_exposure : bool, optional
        Whether calibrations of other times and fields are accepted.

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
        if number is None:
            number = by_detector.get(solution.detector)
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
        if not any_exposure:
            frame, place = frames[number], f"{image}[{number}]"
            _require_same_epoch(place, frame.epoch, frame.meta.get("exptime"), name, one)
            if one is not solution:
                _require_same_field(place, frame, name, one)
        found[number] = name
    return {number: found[number] for number in sorted(found)}


def require_same_exposure(image, name, calibration):
    """Refuse a calibration that is not of the exposure and the detector of an image.

    Parameters
    ----------
    image : str
        FITS image, or ``path[EXT]``; what its headers do not tell is not compared.
    name : path-like
        Name of the calibration for messages.
    calibration : `~wpdc_gwcs.Calibration` or `~wpdc_gwcs.DistortionSolution`
        The calibration.  A solution is of no exposure.

    Raises
    ------
    InputError
        If the epochs or the detectors differ, or the image cannot be read.
    """
    path, extension = split_extension(image)
    numbers = image_numbers(path)
    with open_fits(path, lazy=True) as hdus:
        number = numbers[0] if extension is None else find_extension(hdus, extension, path)
        headers = {k: hdus[k].header.copy() for k in {0, number, *numbers}}
    own = [headers[number], headers[0]]
    with warnings.catch_warnings():
        # They were given when the frame was calibrated.
        warnings.simplefilter("ignore", WPDCWarning)
        epoch = header_epoch(own)
    _require_same_epoch(image, epoch, positive_number(own, EXPOSURE_KEYS), name, calibration)
    stem, label = stem_of(path), file_name(header_text(headers[number], "EXTNAME") or str(number))
    if getattr(calibration, "frame", None) not in (stem, f"{stem}_{label}"):
        _require_same_detector(image, headers, number, name, calibration)


def _require_same_detector(image, headers, number, name, calibration):
    """Compare the detector of a calibration with the names in the headers of an image."""
    detector = getattr(calibration, "solution", calibration).detector
    known = {k: detector_names([header]) for k, header in headers.items()}
    here = [*known[number].values(), *known[0].values()]
    # A number is added to names that several detectors of a file have.
    if detector == UNNAMED or any(f"{detector}_".startswith(f"{one}_") for one in here):
        return
    # The name of an extension may be of anything, unless another one has that of the detector.  The
    # header of the file may be about the whole camera.
    named = [name for key, name in known[number].items() if key != "EXTNAME"]
    elsewhere = [k for k in known if detector in known[k].values()]
    if named or elsewhere:
        raise InputError(
            f"{image}: is of detector {(named or here or [UNNAMED])[0]}, {name} of {detector}: "
            "not the same detector"
        )


def _require_same_epoch(place, epoch, exposure, name, calibration):
    epochs = calibration.provenance.get("epochs") if hasattr(calibration, "frame") else None
    if epoch is None or not epochs:
        return
    margin = _SAME_EPOCH + _SHARE_OF_EXPOSURE * (exposure or 0.0) / _SECONDS_PER_YEAR
    if not min(epochs) - margin <= epoch <= max(epochs) + margin:
        raise InputError(
            f"{place}: is of epoch {epoch:.7f}, {name} of {max(epochs):.7f}: not the same exposure"
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
