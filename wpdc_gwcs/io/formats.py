"""Reading and writing of calibrations and solutions in all formats."""

import warnings
from pathlib import Path

from astropy.io import fits
from astropy.table import Table

from wpdc_gwcs.camera import Camera
from wpdc_gwcs.exceptions import FileFormatError, WPDCWarning
from wpdc_gwcs.export import FORMS
from wpdc_gwcs.io.celestial import parse_wcs
from wpdc_gwcs.io.files import check_output, check_suffix, file_kind, split_extension
from wpdc_gwcs.io.headers import header_text, is_ours, read_headers
from wpdc_gwcs.io.tan import parse_tan

__all__ = ["FORMATS", "read", "read_wcs", "write"]

#: Formats of `write`.
FORMATS = ("asdf", *FORMS, "stock")
_SUFFIXES = {".asdf": "asdf", ".fits": "fits", ".fit": "fits", ".head": "head", ".ecsv": "ecsv"}


def read(path):
    """Read a calibration, a distortion solution or a camera.

    Parameters
    ----------
    path : path-like
        ASDF file of this package; FITS file (or ``path[EXT]``), ``.head`` or other text file with a
        TPV, TAN + PV or TAN header, with the look-up table of this package if there is one.

    Returns
    -------
    obj : `~wpdc_gwcs.Calibration`, `~wpdc_gwcs.DistortionSolution` or `~wpdc_gwcs.Camera`
        Object with a fast, exactly invertible ``wcs``.  A camera includes the solutions of its
        detectors, whose files must be at the paths that it names.

    Raises
    ------
    FileFormatError
        If the file is missing, empty, damaged, of a newer format version, or of another kind.

    See Also
    --------
    read_wcs : Read the WCS of any file that has one.

    Examples
    --------
    >>> import tempfile
    >>> import numpy as np
    >>> import wpdc_gwcs
    >>> from wpdc_gwcs import DistortionSolution, PVPolynomial
    >>> cd, crpix, crval = np.diag([-8e-5, 8e-5]), np.array([511.5, 511.5]), np.array([10.0, 45.0])
    >>> solution = DistortionSolution("d1", (1024, 1024), crpix, cd, crval, PVPolynomial(pv1_7=4.0))
    >>> path = f"{tempfile.mkdtemp()}/d1.solution.asdf"
    >>> wpdc_gwcs.write(solution, path)
    >>> again = wpdc_gwcs.read(path)
    >>> again.detector, again.wcs(10.0, 20.0) == solution.wcs(10.0, 20.0)
    ('d1', True)
    """
    plain, extension = split_extension(path)
    if file_kind(plain) == "asdf":
        from wpdc_gwcs.io.asdf import read_asdf

        if extension is not None:
            raise FileFormatError(f"{path}: only FITS and text files have extensions")
        return read_asdf(plain)
    from wpdc_gwcs.io.fits import read_fits

    return read_fits(path)


def read_wcs(source):
    r"""Read the WCS of a file or header of any kind.

    Parameters
    ----------
    source : path-like or `~astropy.io.fits.Header`
        FITS file or ``path[EXT]``, ``.head`` or other text header, ASDF file with a ``wcs``; or a
        header.

    Returns
    -------
    wcs : `~gwcs.wcs.WCS` or `~astropy.wcs.WCS`
        For TAN, TPV and TAN + PV an exact gwcs with the numbers of the header (no change of
        celestial frame) and the look-up table of this package where there is one; for ASDF the
        stored one; for SIP and the rest an `astropy.wcs.WCS` in ICRS.

    Raises
    ------
    FileFormatError
        If there is no usable celestial WCS.

    Examples
    --------
    >>> from astropy.io import fits
    >>> from wpdc_gwcs.io import read_wcs
    >>> cards = ["CTYPE1  = 'RA---TAN'", "CTYPE2  = 'DEC--TAN'", "CRVAL1  = 10.0", "CRVAL2  = 0.0",
    ...          "CRPIX1  = 1.0", "CRPIX2  = 1.0", "CD1_1   = -1e-4", "CD2_2   = 1e-4"]
    >>> header = fits.Header.fromstring("\n".join(cards), sep="\n")
    >>> ra, dec = read_wcs(header)(0.0, 100.0)
    >>> round(float(ra), 6), round(float(dec), 6)
    (10.0, 0.01)
    """
    if isinstance(source, fits.Header):
        return _wcs_of(source, "header", None)
    plain, _ = split_extension(source)
    if file_kind(plain) == "asdf":
        from wpdc_gwcs.io.asdf import read_asdf_wcs

        return read_asdf_wcs(plain)
    headers = read_headers(source)
    if len(headers) > 1:
        raise FileFormatError(f"{source}: has {len(headers)} WCS headers; choose one with path[N]")
    if is_ours(headers[0]) and header_text(headers[0], "CTYPE1") == "RA---TPV":
        return read(source).wcs
    return _wcs_of(headers[0], str(source), plain)


def _wcs_of(header, name, path):
    tan = parse_tan(header, name=name)
    if tan is not None:
        from wpdc_gwcs.wcs import build_wcs

        return build_wcs(
            crpix=tan.crpix, cd=tan.cd, crval=tan.crval, pv=tan.pv, image_shape=tan.image_shape
        )
    if path is not None and file_kind(path) == "fits":
        from wpdc_gwcs.io.files import open_fits

        # Warnings are suppressed while a file is open: ours are repeated afterwards.
        with open_fits(path) as hdus, warnings.catch_warnings(record=True) as seen:
            warnings.simplefilter("always")
            wcs = parse_wcs(header, hdus=hdus, name=name)
        for warning in seen:
            if issubclass(warning.category, WPDCWarning):
                warnings.warn(warning.message)
        return wcs
    return parse_wcs(header, name=name)


def write(obj, path, *, format=None, degree=None, overwrite=False):
    """Write a calibration, a solution or a table, atomically.

    Parameters
    ----------
    obj : Calibration, DistortionSolution, Camera or `~astropy.table.Table`
        Object to write.  In FITS formats, a solution has its nominal pointing.  A camera can only
        be written as ``asdf``.
    path : path-like
        File to write.
    format : {"asdf", "fits", "cpdis", "tpv", "head", "sip", "tab", "stock"}, optional
        By default from the suffix: ``.asdf``, ``.fits``, ``.head``; ``.ecsv`` for tables.
    degree : int, optional
        Degree of the polynomials of the FITS formats.  Default: that of the solution for ``fits``
        and ``cpdis``; for the others, the lowest that is accurate to 1e-3 px (``tpv``, ``head``) or
        1e-4 px (``sip``), or nearly as accurate as any.
    overwrite : bool, optional
        Whether an existing file may be replaced.

    Returns
    -------
    deviation : float or None
        Largest deviation from the exact WCS over the detector, px; `None` for the exact formats,
        ``asdf`` and ``fits`` without ``degree``.

    Raises
    ------
    OutputExistsError
        If the file exists and may not be replaced.
    InputError
        If the file cannot be written, or its suffix belongs to another format.
    ValueError
        If the format is unknown, or has no polynomials of this degree.

    Examples
    --------
    >>> import tempfile
    >>> import numpy as np
    >>> import wpdc_gwcs
    >>> from wpdc_gwcs import DistortionSolution, PVPolynomial
    >>> cd, crpix, crval = np.diag([-8e-5, 8e-5]), np.array([511.5, 511.5]), np.array([10.0, 45.0])
    >>> solution = DistortionSolution("d1", (1024, 1024), crpix, cd, crval, PVPolynomial(pv1_7=4.0))
    >>> wpdc_gwcs.write(solution, f"{tempfile.mkdtemp()}/d1.head") < 1e-6  # greatest deviation, px
    True
    """
    path = Path(path)
    if format is None:
        format = _SUFFIXES.get(path.suffix.lower())
    if isinstance(obj, Table):
        from wpdc_gwcs.io.tables import write_table

        if format not in ("ecsv", None):
            raise ValueError(f"a table is written as 'ecsv', got the format {format!r}")
        return write_table(obj, path, overwrite=overwrite)
    if format not in FORMATS:
        raise ValueError(f"format must be one of {', '.join(FORMATS)}, got {format!r} for {path}")
    if isinstance(obj, Camera) and format != "asdf":
        raise ValueError(f"a camera is written as 'asdf', got the format {format!r} for {path}")
    # Check before the work, not after.
    check_suffix(path, format)
    check_output(path, overwrite=overwrite)
    if format in FORMS:
        from wpdc_gwcs.io.fits import write_form

        made = write_form(obj, path, form=format, degree=degree, overwrite=overwrite)
        return made.deviation
    if degree is not None:
        raise ValueError(f"degree must be None for {format!r}, got {degree}")
    # asdf and gwcs take half a second to import: only when needed.
    from wpdc_gwcs.io import asdf

    writer = {"asdf": asdf.write_asdf, "stock": asdf.write_stock}[format]
    return writer(obj, path, overwrite=overwrite)
