"""A frame: one exposure of one detector, as input of a calibration."""

import math
import re
from collections.abc import Callable
from dataclasses import dataclass, field

from wpdc_gwcs.frozen import freeze_attributes

__all__ = ["Frame"]

# Characters that file names or tables cannot contain: slash, control characters, invalid UTF-8.
_UNFIT = re.compile(r"[/\x00-\x1f\x7f-\x9f\u2028\u2029\ud800-\udfff]")


@dataclass(frozen=True, repr=False)
class Frame:
    """One exposure of one detector: image or source list, with WCS and epoch of its header.

    Parameters
    ----------
    name : str
        Stem of the files written for this frame.
    detector : str
        Name of the detector; frames of one detector share one distortion solution.
    image_shape : (int, int)
        Shape of the detector, ``(ny, nx)`` in pixels.
    wcs : object
        Starting WCS with the shared low-level interface (``pixel_to_world_values``, zero based),
        for example `astropy.wcs.WCS`; world axes are ICRS, RA first.
    epoch : float, optional
        Mid-exposure epoch in Julian years; `None` if the header has no date.
    source : str
        Origin of the frame for messages: path and extension.
    load_image : callable, optional
        Returns the image as a float array ``[y, x]``; called once, when needed.
    load_sources : callable, optional
        Returns the source table (``x``, ``y`` zero based, optional ``x_err``, ``y_err``, ``flux``,
        ``snr``, ``roundness``, ``flags``).  Exactly one of this and ``load_image`` is given.
    gain, saturation : float, optional
        Electrons per count and saturation level in counts, from the header.
    read_noise : float, optional
        Read noise in electrons, from the header: the minimum noise of a pixel.
    exposure : str, optional
        Identifies the exposure among those of its camera: frames with the same camera and exposure
        were taken at the same time by the detectors of a mosaic.  `None`: a frame on its own.
    camera : str, optional
        Name of the camera, whose detectors share a focal plane; `None`: the detector is on its own.
    meta : dict
        Other facts of the header worth keeping (filter, exposure time, ...).
    load_mask, load_weight : callable, optional
        Return the mask of the image (true for pixels that must not be used) and its weights
        (inverse variances of the sky in any unit).
    inputs : tuple of str, optional
        Files besides that of ``source`` that the loaders read.
    fresh_image : bool, optional
        Whether the image from ``load_image`` may be overwritten, to save memory.

    Raises
    ------
    ValueError
        If there is not exactly one loader, or the name, epoch, shape or a key is invalid.

    Examples
    --------
    >>> import numpy as np
    >>> from astropy.wcs import WCS
    >>> from wpdc_gwcs.frame import Frame
    >>> frame = Frame("a", "NE", (20, 30), WCS(naxis=2), load_image=lambda: np.zeros((20, 30)))
    >>> frame.load_image().shape
    (20, 30)
    """

    name: str
    detector: str
    image_shape: tuple[int, int]
    wcs: object
    epoch: float | None = None
    source: str = ""
    load_image: Callable | None = None
    load_sources: Callable | None = None
    gain: float | None = None
    saturation: float | None = None
    read_noise: float | None = None
    exposure: str | None = None
    camera: str | None = None
    meta: dict = field(default_factory=dict)
    load_mask: Callable | None = None
    load_weight: Callable | None = None
    inputs: tuple[str, ...] = ()
    fresh_image: bool = False

    def __post_init__(self):
        if (self.load_image is None) == (self.load_sources is None):
            raise ValueError("a Frame needs exactly one of load_image and load_sources")
        if not self.name or _UNFIT.search(self.name):
            raise ValueError(f"name must be fit for a file name, got {self.name!r}")
        if self.epoch is not None and not math.isfinite(self.epoch):
            raise ValueError(f"epoch must be a finite Julian year or None, got {self.epoch}")
        for label in ("exposure", "camera"):
            value = getattr(self, label)
            if not (value is None or (isinstance(value, str) and value)):
                raise ValueError(f"{label} must be a text that is not empty or None, got {value!r}")
        try:
            shape = tuple(int(n) for n in self.image_shape)
            valid = len(shape) == 2 and min(shape) >= 1 and shape == tuple(self.image_shape)
        except (TypeError, ValueError):
            valid = False
        if not valid:
            raise ValueError(
                f"image_shape must be (ny, nx), positive integers, got {self.image_shape!r}"
            )
        object.__setattr__(self, "image_shape", shape)
        freeze_attributes(self, "meta")

    def __repr__(self):
        ny, nx = self.image_shape
        kind = "source list" if self.load_image is None else "image"
        return f"<Frame {self.name}: {kind} of {nx} x {ny} px, detector {self.detector}>"
