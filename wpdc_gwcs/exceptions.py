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
    """Base class of every error raised on purpose by wpdc_gwcs.

    Examples
    --------
    >>> import wpdc_gwcs
    >>> from wpdc_gwcs.exceptions import WPDCError
    >>> try:
    ...     wpdc_gwcs.read("missing.wcs.asdf")
    ... except WPDCError as error:
    ...     print(error)
    missing.wcs.asdf: must be a readable file: No such file or directory
    """


class InputError(WPDCError):
    """Input that cannot be used: the message names the file, the rule and the value.

    Examples
    --------
    >>> import wpdc_gwcs
    >>> from wpdc_gwcs.exceptions import CatalogError, FrameError, InputError
    >>> issubclass(CatalogError, InputError), issubclass(FrameError, InputError)
    (True, True)
    >>> wpdc_gwcs.read_catalog("missing.fits")
    Traceback (most recent call last):
        ...
    wpdc_gwcs.exceptions.CatalogError: missing.fits: catalog must be an existing file, ...
    """


class FrameError(InputError):
    """A frame (image, source list or its header) that cannot be read or has no usable WCS.

    Examples
    --------
    >>> import tempfile
    >>> from astropy.io import fits
    >>> from wpdc_gwcs import read_frames
    >>> path = f"{tempfile.mkdtemp()}/empty.fits"
    >>> fits.PrimaryHDU().writeto(path)
    >>> read_frames(path)
    Traceback (most recent call last):
        ...
    wpdc_gwcs.exceptions.FrameError: ...empty.fits: must have an image, FITS_LDAC sources ...
    """


class DuplicateFrameError(FrameError, ValueError):
    """Two frames with the same name, whose files would be the same.

    Examples
    --------
    >>> from wpdc_gwcs import calibrate, simulate
    >>> sky = simulate(1, image_shape=(128, 128), density=60, seed=1)
    >>> frame = sky.exposures[0].frame()
    >>> calibrate([frame, frame], sky.reference)
    Traceback (most recent call last):
        ...
    wpdc_gwcs.exceptions.DuplicateFrameError: frame names must be unique: sim-01 and ...
    """


class CatalogError(InputError):
    """A reference catalog that cannot be read or lacks what is needed.

    Examples
    --------
    >>> from astropy.table import Table
    >>> from wpdc_gwcs import read_catalog
    >>> read_catalog(Table({"x": [1.0], "y": [2.0]}))
    Traceback (most recent call last):
        ...
    wpdc_gwcs.exceptions.CatalogError: catalog: catalog must have columns 'ra' and 'dec' ...
    """


class FileFormatError(InputError):
    """A solution, calibration or header file that is damaged, inconsistent or of a newer format.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> from wpdc_gwcs import read
    >>> path = Path(tempfile.mkdtemp()) / "a.wcs.asdf"
    >>> size = path.write_text("not ASDF")
    >>> read(path)
    Traceback (most recent call last):
        ...
    wpdc_gwcs.exceptions.FileFormatError: ...a.wcs.asdf: must hold a header with CTYPE1, ...
    """


class ClusterError(InputError):
    """A cluster that has no scheduler or no worker.

    Examples
    --------
    >>> from wpdc_gwcs.calibration import cluster_executor
    >>> with cluster_executor("tcp://127.0.0.1:9", timeout=0.1):
    ...     pass
    Traceback (most recent call last):
        ...
    wpdc_gwcs.exceptions.ClusterError: ...
    """


class FrameFailure(WPDCError):
    """A readable frame that could not be solved.

    Examples
    --------
    >>> from wpdc_gwcs import calibrate, simulate
    >>> from wpdc_gwcs.exceptions import FrameFailure
    >>> sky = simulate(1, image_shape=(256, 256), density=60, seed=1)
    >>> run = calibrate([sky.exposures[0].frame()], sky.reference[:2])
    >>> failure = run.failures["sim-01"]
    >>> type(failure).__name__, isinstance(failure, FrameFailure)
    ('MatchError', True)
    """


class DetectionError(FrameFailure):
    """No usable stars were found on the image.

    Examples
    --------
    >>> import numpy as np
    >>> from wpdc_gwcs import detect_sources
    >>> noise = np.random.default_rng(1).normal(100, 5, (200, 200))
    >>> detect_sources(noise, threshold=10.0)
    Traceback (most recent call last):
        ...
    wpdc_gwcs.exceptions.DetectionError: no source above 10 sigma on the image
    """


class MatchError(FrameFailure):
    """The sources could not be matched to the reference catalog with sufficient evidence.

    Parameters
    ----------
    message : str
        What is wrong.
    found : dict, optional
        For a match that is farther from the header than allowed: ``n_pairs``; ``shift`` of the
        center (px), ``rotation`` (deg), ``scale`` (factor) and ``parity`` (1, or -1 if mirrored)
        relative to the header.

    Examples
    --------
    >>> import numpy as np
    >>> from wpdc_gwcs.matching import match_planes
    >>> x, y, xr, yr = np.random.default_rng(1).uniform(0, 1000, (4, 100))
    >>> match_planes(x, y, xr, yr, image_shape=(1000, 1000))
    Traceback (most recent call last):
        ...
    wpdc_gwcs.exceptions.MatchError: no match with sufficient evidence (100 sources, 100 ...
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

    Examples
    --------
    >>> import numpy as np
    >>> from wpdc_gwcs.fitting import solve_linear
    >>> solve_linear(np.ones((5, 2)), np.arange(5.0))
    Traceback (most recent call last):
        ...
    wpdc_gwcs.exceptions.FitError: the 5 stars determine only 1 of 2 coefficients: they ...
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

    Examples
    --------
    >>> from wpdc_gwcs.exceptions import InternalError
    >>> error = InternalError("a process died", "worker 3, frame night-07")
    >>> print(error)
    a process died
    >>> error.details
    'worker 3, frame night-07'
    """

    def __init__(self, message="", details=""):
        super().__init__(message, details)
        self.details = details

    def __str__(self):
        return self.args[0]


class WPDCWarning(AstropyUserWarning):
    """Base class of the warnings of wpdc_gwcs.

    Examples
    --------
    >>> import warnings
    >>> import numpy as np
    >>> from wpdc_gwcs import build_epsf, detect_sources
    >>> from wpdc_gwcs.detection import subtract_background
    >>> from wpdc_gwcs.exceptions import WPDCWarning
    >>> y, x = np.mgrid[:200, :200]
    >>> image = 2000 * np.exp(-((x - 80.3) ** 2 + (y - 120.6) ** 2) / 4)
    >>> background = subtract_background(image + np.random.default_rng(1).normal(100, 5, x.shape))
    >>> with warnings.catch_warnings(record=True) as caught:
    ...     warnings.simplefilter("always", WPDCWarning)
    ...     epsf = build_epsf(background, detect_sources(background))
    >>> print(epsf, caught[0].category.__name__)
    None CentroidWarning
    """


class CentroidWarning(WPDCWarning):
    """Centroids are of lower quality than asked for: windowed, for example, not PSF-fitted.

    Examples
    --------
    >>> import warnings
    >>> import numpy as np
    >>> from wpdc_gwcs import detect_sources
    >>> from wpdc_gwcs.centroids import measure_psf
    >>> from wpdc_gwcs.detection import subtract_background
    >>> y, x = np.mgrid[:200, :200]
    >>> image = 2000 * np.exp(-((x - 80.3) ** 2 + (y - 120.6) ** 2) / 4)
    >>> background = subtract_background(image + np.random.default_rng(1).normal(100, 5, x.shape))
    >>> with warnings.catch_warnings(record=True) as caught:
    ...     warnings.simplefilter("always")
    ...     psf = measure_psf(background, detect_sources(background), name="night-07")
    >>> print(str(caught[0].message).partition(";")[0])
    night-07: no effective PSF: 1 bright, clean, isolated star, 8 needed
    """


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

    Examples
    --------
    >>> from wpdc_gwcs.exceptions import MatchError, without_frames
    >>> try:
    ...     raise MatchError("too few stars")
    ... except MatchError as error:
    ...     kept = without_frames(error)
    >>> print(kept, kept.__traceback__)
    too few stars None
    """
    error.__traceback__ = error.__context__ = error.__cause__ = None
    return error
