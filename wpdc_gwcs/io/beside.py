"""Lists of files: frames, and the masks and weights that belong to them.

::

    x.fits x.weight.fits x_mask.fits y.fits --tell_frames--> x.fits (weight, mask), y.fits
"""

import logging

from wpdc_gwcs.exceptions import FrameError
from wpdc_gwcs.io.companions import SCIENCE_WORDS, WCS_KEYS, map_role, words_of
from wpdc_gwcs.io.files import file_kind, open_fits, split_extension, stem_of
from wpdc_gwcs.io.frames import read_frames
from wpdc_gwcs.io.headers import header_text
from wpdc_gwcs.io.images import image_shape

__all__ = ["read_files", "tell_frames"]

log = logging.getLogger(__name__)

# Words that together describe a file: bad_pixel_mask.
_MOST_WORDS = 3
# Keywords that differ between exposures.
_TIMES = ("DATE-OBS", "MJD-OBS", "EXPNUM", "OBSID", "DATE-BEG", "TIME-OBS", "UTSTART")


def read_files(paths, *, progress=None, **options):
    """Read the frames of several files, some of which may be masks or weights of others.

    Parameters
    ----------
    paths : iterable of path-like
        As for `wpdc_gwcs.io.read_frames`.
    progress : callable, optional
        Called as ``progress("read", done, total)`` after each file.
    **options
        As for `wpdc_gwcs.io.read_frames`; an explicit mask or weight map takes precedence.

    Returns
    -------
    list of `~wpdc_gwcs.frame.Frame`
        In the order of the files.

    Raises
    ------
    FrameError
        As `wpdc_gwcs.io.read_frames` does.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> import numpy as np
    >>> from astropy.io import fits
    >>> from wpdc_gwcs import simulate
    >>> from wpdc_gwcs.io import read_files
    >>> exposure = simulate(1, image_shape=(128, 128), density=60, seed=1).exposures[0]
    >>> image = exposure.render()
    >>> image[40:50] = 0.0
    >>> folder = Path(tempfile.mkdtemp())
    >>> fits.writeto(folder / "a.fits", image, exposure.header)
    >>> fits.writeto(folder / "a.mask.fits", (image == 0).astype(np.int16))
    >>> (frame,) = read_files([folder / "a.fits", folder / "a.mask.fits"])
    >>> frame.name, int(frame.load_mask().sum())
    ('a', 1280)
    """
    frames, told = [], tell_frames(paths)
    for done, (path, maps) in enumerate(told, start=1):
        frames += read_frames(path, beside=maps, **options)
        if progress is not None:
            progress("read", done, len(told))
    return frames


def tell_frames(paths):
    """Separate files of frames from masks and weights of others.

    Parameters
    ----------
    paths : iterable of path-like
        Files.

    Returns
    -------
    list of (path, list)
        Path of each frame, and the list of its masks and weights.

    Notes
    -----
    A file belongs to another one if its name has an additional word for this (``x.weight.fits``,
    ``x_bad_pixel_mask.fits``), or such a word in place of one for images (``x_image.fits``,
    ``x_invvar.fits``), if its images have the same shapes, and if WCS and time do not contradict.
    A file without such a frame counts as a frame itself.
    """
    paths = list(paths)
    names = {}
    for path in paths:
        if split_extension(path)[1] is None:
            names.setdefault(tuple(words_of(stem_of(path))), path)
    maps, owners = {}, {}
    for path in paths:
        if split_extension(path)[1] is not None:
            continue
        owner = next((o for o in _owners(path, names) if _belong(o, path)), None)
        if owner is not None and str(owner) not in owners:
            maps.setdefault(str(owner), []).append(path)
            owners[str(path)] = owner
            log.info("%s: goes with %s, and is no frame", path, owner)
    return [(path, maps.get(str(path), [])) for path in paths if str(path) not in owners]


def _owners(path, names):
    """Files of the list with the same name, except for the words for masks and weights."""
    words = words_of(stem_of(path))
    for first in range(len(words)):
        for last in range(first + 1, min(first + _MOST_WORDS, len(words)) + 1):
            if map_role(words[first:last]) is None:
                continue
            for science in ((), *((word,) for word in sorted(SCIENCE_WORDS))):
                owner = names.get((*words[:first], *science, *words[last:]))
                if owner is not None and str(owner) != str(path):
                    yield owner


def _belong(owner, path):
    """Whether the images of a file can be those of a mask or a weight of another file."""
    try:
        if {file_kind(p, error=FrameError) for p in (owner, path)} != {"fits"}:
            return False
        sides = [_images(p) for p in (owner, path)]
    except FrameError:
        # Errors are reported when the file is read.
        return False
    if not all(sides) or len(sides[0]) != len(sides[1]):
        return False
    for one, other in zip(*sides, strict=True):
        if image_shape(one) != image_shape(other):
            return False
        if "CRVAL1" in other and any(one.get(k) != other.get(k) for k in WCS_KEYS):
            return False
        for key in _TIMES:
            texts = {header_text(h, key) for h in (one, other)} - {""}
            if len(texts) > 1:
                return False
    return True


def _images(path):
    """Headers of the images of a file, merged with its primary header."""
    with open_fits(path, error=FrameError) as hdus:
        result = []
        for hdu in hdus:
            if hdu.is_image and image_shape(hdu.header) is not None:
                header = hdu.header.copy()
                for key in _TIMES:
                    if key not in header and key in hdus[0].header:
                        header[key] = hdus[0].header[key]
                result.append(header)
        return result
