"""Errors and warnings of wpdc_gwcs.

Every error that a caller may want to catch derives from `WPDCError`.  There are two kinds: input
that cannot be used at all (`InputError`; exit status 2 on the command line), and a frame that was
read but could not be solved (`FrameFailure`; exit status 1, the other frames are not affected).
"""

from astropy.utils.exceptions import AstropyUserWarning

__all__ = [
    "CatalogError",
    "CentroidWarning",
    "ClusterError",
    "DetectionError",
    "DuplicateFrameError",
    "FileFormatError",
    "FitError",
    "FrameError",
    "FrameFailure",
    "InputError",
    "InternalError",
    "MatchError",
    "WPDCError",
    "WPDCWarning",
    "without_frames",
]


class WPDCError(Exception):
    """Base class of every error raised on purpose by wpdc_gwcs."""


class InputError(WPDCError):
    """Input that cannot be used: the message names the file, the rule and the value."""


class FrameError(InputError):
    """A frame (image, source list or its header) that cannot be read or has no usable WCS."""


class DuplicateFrameError(FrameError, ValueError):
    """Two frames with the same name, whose files would be the same."""


class CatalogError(InputError):
    """A reference catalog that cannot be read or lacks what is needed."""


class FileFormatError(InputError):
    """A solution, calibration or header file that is damaged, inconsistent or of a newer format."""


class ClusterError(InputError):
    """A cluster that has no scheduler or no worker."""


class FrameFailure(WPDCError):
    """A readable frame that could not be solved."""


class DetectionError(FrameFailure):
    """No usable stars were found on the image."""


class MatchError(FrameFailure):
    """The sources could not be matched to the reference catalog with sufficient evidence.

    Parameters
    ----------
    message : str
        What is wrong.
    found : dict, optional
        For a match that is further from the header than is allowed: ``shift`` (px), ``rotation``
        (deg) and ``scale`` (factor) relative to the header.
    """

    def __init__(self, message="", *, found=None):
        super().__init__(message)
        self.found = found


class FitError(FrameFailure):
    """Pairs that do not determine a fit.

    Parameters
    ----------
    message : str
        What is wrong.
    reasons : dict, optional
        Reason for each frame by name, if several failed together.
    """

    def __init__(self, message="", *, reasons=None):
        super().__init__(message)
        self.reasons = reasons or {}


class InternalError(FrameFailure):
    """An unexpected error: a bug of the program, or a process that died.

    Parameters
    ----------
    message : str
        What is wrong, in one line.
    details : str, optional
        Where it happened, for bug reports.
    """

    def __init__(self, message="", details=""):
        super().__init__(message, details)
        self.details = details

    def __str__(self):
        return self.args[0]


class WPDCWarning(AstropyUserWarning):
    """Base class of the warnings of wpdc_gwcs."""


class CentroidWarning(WPDCWarning):
    """Centroids are of lower quality than asked for: windowed, for example, not PSF-fitted."""


def without_frames(error):
    """Remove the tracebacks from an error that is kept.

    Parameters
    ----------
    error : Exception
        The error.  Its tracebacks, and those of its causes, keep every array of the functions that
        it came through alive: for an image, a hundred times what the frame needs.

    Returns
    -------
    Exception
        The same error.
    """
    error.__traceback__ = error.__context__ = error.__cause__ = None
    return error
