"""FITS headers: cards, values, shapes; for the WCS see `tan` and `celestial`."""

import math
import re
import warnings

import numpy as np
from astropy.io import fits

from wpdc_gwcs.exceptions import FileFormatError
from wpdc_gwcs.io.files import READ_ERRORS, file_kind, first_line, open_fits, split_extension

__all__ = [
    "WRITTEN_BY_US",
    "clean_header",
    "extension_names",
    "find_extension",
    "header_number",
    "header_of",
    "header_shape",
    "header_text",
    "header_value",
    "history_of_wcs",
    "is_ours",
    "ldac_header",
    "positive_number",
    "read_headers",
]

#: Beginning of the HISTORY card of a WCS that this package wrote.
WRITTEN_BY_US = "WCS by wpdc_gwcs"
_CARD_START = re.compile(r"[A-Z0-9_-]{1,8} *= *\S")


def clean_header(text):
    r"""Build a header from text, whatever its line ends, padding and encoding accidents.

    Parameters
    ----------
    text : bytes
        Cards of 80 bytes with or without line ends, NULs for blanks and latin-1 in comments
        allowed.

    Returns
    -------
    headers : list of `~astropy.io.fits.Header`
        One for each ``END`` card (or for the end of the text); without COMMENT and HISTORY.

    Examples
    --------
    >>> from wpdc_gwcs.io.headers import clean_header
    >>> clean_header("CRVAL1  = 1.5 / é\nEND\n".encode("latin-1"))[0]["CRVAL1"]
    1.5
    """
    text = text.replace(b"\0", b" ").decode("latin-1")
    text = re.sub(r"[^\x20-\x7e\r\n]", "?", text)
    lines = text.splitlines()
    if any(len(line) > 240 for line in lines):
        lines = [line[i : i + 80] for line in lines for i in range(0, len(line), 80)]
    headers, cards = [], []
    for line in [*lines, "END"]:
        if line.rstrip() == "END":
            if cards:
                headers.append(fits.Header(cards))
            cards = []
        elif _CARD_START.match(line):
            cards.append(fits.Card.fromstring(line[:80].ljust(80)))
    return headers


def read_headers(path):
    """Read every header with a WCS from a file.

    Parameters
    ----------
    path : path-like
        FITS file, ``path[EXT]``, SCAMP ``.head`` file, or any text file of header cards.

    Returns
    -------
    headers : list of `~astropy.io.fits.Header`
        Headers with a ``CTYPE1``, in the order of the file; independent copies.  A FITS_LDAC list
        has that of its image.

    Raises
    ------
    FileFormatError
        If the file is missing, empty, damaged or has no such header.
    """
    path, extension = split_extension(path)
    if file_kind(path) == "fits":
        with open_fits(path) as hdus:
            chosen = range(len(hdus))
            if extension is not None:
                chosen = [find_extension(hdus, extension, path)]
            headers = [header_of(hdus, k, path) for k in chosen]
    else:
        # Files with 80-byte cards without line ends are read the same way.
        headers = clean_header(path.read_bytes())
        if extension is not None:
            if not isinstance(extension, int) or not 0 <= extension < len(headers):
                raise FileFormatError(
                    f"{path}: header number must be below {len(headers)}, got {extension!r}"
                )
            headers = [headers[extension]]
    headers = [header for header in headers if "CTYPE1" in header]
    if not headers:
        raise FileFormatError(f"{path}: must hold a header with CTYPE1, CRVAL1, ...; found none")
    return headers


def header_of(hdus, index, name):
    """Return a copy of the header of an HDU, or of its image if it is a FITS_LDAC list.

    Parameters
    ----------
    hdus : `~astropy.io.fits.HDUList`
        The open file.
    index : int
        Number of the HDU.
    name : path-like
        Name for messages.

    Returns
    -------
    header : `~astropy.io.fits.Header`
        The header.

    Raises
    ------
    FileFormatError
        If the header in a list is damaged.
    """
    if hdus[index].name == "LDAC_OBJECTS" and index and hdus[index - 1].name == "LDAC_IMHEAD":
        return ldac_header(hdus, index, name)
    return hdus[index].header.copy()


def ldac_header(hdus, index, name, *, error=FileFormatError):
    """Return the image header that a FITS_LDAC file carries as a table of one string.

    Parameters
    ----------
    hdus : `~astropy.io.fits.HDUList`
        The open file.
    index : int
        Number of the ``LDAC_OBJECTS``.
    name : path-like
        Name for messages.
    error : type, optional
        Subclass of `~wpdc_gwcs.exceptions.InputError` that is raised.

    Returns
    -------
    header : `~astropy.io.fits.Header`
        Header of the image from which the list was made.

    Raises
    ------
    InputError
        If there is no such header, or it is damaged.
    """
    if index == 0 or hdus[index - 1].name != "LDAC_IMHEAD":
        raise error(f"{name}: LDAC_OBJECTS must follow LDAC_IMHEAD")
    try:
        text = np.asarray(hdus[index - 1].data).tobytes()
    except READ_ERRORS as problem:
        raise error(f"{name}: damaged LDAC_IMHEAD: {first_line(problem)}") from problem
    # Cards of 80 bytes without line ends.
    headers = clean_header(b"\n".join(text[i : i + 80] for i in range(0, len(text), 80)))
    if not headers:
        raise error(f"{name}: LDAC_IMHEAD must hold a header, is empty")
    return headers[0]


def find_extension(hdus, extension, path, *, error=FileFormatError):
    """Find an extension by number, name, or ``NAME,VERSION``.

    Parameters
    ----------
    hdus : `~astropy.io.fits.HDUList`
        The open file.
    extension : int or str
        Text in the brackets.
    path : path-like
        Path for messages.
    error : type, optional
        Subclass of `~wpdc_gwcs.exceptions.InputError` that is raised.

    Returns
    -------
    index : int
        Number of the extension.

    Raises
    ------
    InputError
        If there is no such extension.
    """
    key = extension
    if isinstance(key, str) and "," in key:
        name, version = key.rsplit(",", 1)
        if version.strip().isdigit():
            key = name.strip(), int(version)
    try:
        index = hdus.index_of(key)
        hdus[index]
    except (KeyError, IndexError):
        raise error(
            f"{path}: extension must be one of {extension_names(hdus)}, got {extension!r}"
        ) from None
    return index


def extension_names(hdus):
    """List the extensions of a file for a message.

    Parameters
    ----------
    hdus : `~astropy.io.fits.HDUList`
        The open file.

    Returns
    -------
    text : str
        Numbers and names.
    """
    return ", ".join(f"{i} {hdu.name}".strip() for i, hdu in enumerate(hdus))


def header_text(header, key):
    """Return a keyword as stripped text, an empty one if it is absent, blank or broken.

    Parameters
    ----------
    header : `~astropy.io.fits.Header`
        The header.
    key : str
        Keyword.

    Returns
    -------
    text : str
        Its value.
    """
    value = header_value(header, key)
    return "" if value is None else str(value).strip()


def header_value(header, key):
    """Return the value of a keyword.

    Parameters
    ----------
    header : `~astropy.io.fits.Header`
        The header.
    key : str
        Keyword.

    Returns
    -------
    value : object
        `None` if it is absent, undefined or cannot be parsed.
    """
    if key not in header:
        return None
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            value = header[key]
    except (fits.VerifyError, ValueError):
        return None
    return None if isinstance(value, fits.card.Undefined) else value


def header_number(
    header, key, *, name="header", required=True, default=None, error=FileFormatError
):
    """Return a keyword as a finite number.

    Parameters
    ----------
    header : `~astropy.io.fits.Header`
        The header.
    key : str
        Keyword.
    name : str, optional
        Name of the header in messages.
    required : bool, optional
        Whether the card must be there.
    default : float, optional
        Value for an absent card that is not required.
    error : type, optional
        Subclass of `~wpdc_gwcs.exceptions.InputError` that is raised.

    Returns
    -------
    number : float
        Its value.

    Raises
    ------
    InputError
        If the card is missing or not a finite number.
    """
    if key not in header:
        if required:
            raise error(f"{name}: card {key} is missing")
        return default
    value = header_value(header, key)
    if isinstance(value, bool | str | complex) or value is None or not math.isfinite(value):
        shown = "what cannot be parsed" if value is None else repr(value)
        raise error(f"{name}: card {key} must be a finite number, got {shown}")
    return float(value)


def is_ours(header):
    """Return whether a header was written by this package to be read back.

    Parameters
    ----------
    header : `~astropy.io.fits.Header`
        The header.

    Returns
    -------
    bool
        True if any of the keywords of this package is present, even if others are damaged.
    """
    return "WPDCVERS" in header or "WPDCTAB" in header


def positive_number(headers, keys):
    """Return the first positive finite number among some keywords.

    Parameters
    ----------
    headers : sequence of `~astropy.io.fits.Header`
        Searched in turn.
    keys : sequence of str
        Keywords, best first.

    Returns
    -------
    number : float or None
        `None` if there is none.
    """
    for header in headers:
        for key in keys:
            value = header_value(header, key)
            if (
                isinstance(value, int | float)
                and not isinstance(value, bool)
                and math.isfinite(value)
                and value > 0
            ):
                return float(value)
    return None


def header_shape(header):
    """Return the shape of the image a header belongs to.

    Parameters
    ----------
    header : `~astropy.io.fits.Header`
        The header, also of a tile-compressed image or from astrometry.net.

    Returns
    -------
    shape : (int, int) or None
        ``(ny, nx)``; `None` if the header does not tell.
    """
    for x, y in (("ZNAXIS1", "ZNAXIS2"), ("NAXIS1", "NAXIS2"), ("IMAGEW", "IMAGEH")):
        if x.startswith("NAXIS") and header_text(header, "XTENSION") in ("BINTABLE", "TABLE"):
            continue
        nx, ny = header_value(header, x), header_value(header, y)
        sizes = [n for n in (nx, ny) if isinstance(n, int | float) and n >= 1 and n == int(n)]
        if len(sizes) == 2:
            return int(ny), int(nx)
    return None


def history_of_wcs(header):
    """Return what a header says about the origin of its WCS.

    Parameters
    ----------
    header : `~astropy.io.fits.Header`
        The header.

    Returns
    -------
    text : str
        The last HISTORY card by which this package marks a WCS that it wrote; empty if there is
        none.
    """
    if "HISTORY" not in header:
        return ""
    told = [str(line) for line in header["HISTORY"] if str(line).startswith(WRITTEN_BY_US)]
    return told[-1].strip() if told else ""
