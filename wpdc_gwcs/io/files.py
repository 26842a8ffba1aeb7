"""Files in general: their kind, completeness, and atomic writing."""

import bz2
import contextlib
import gzip
import lzma
import os
import re
import stat
import uuid
import warnings
from pathlib import Path

from astropy.io import fits

from wpdc_gwcs.catalogs import READ_ERRORS, special_file, split_extension
from wpdc_gwcs.exceptions import FileFormatError, InputError

__all__ = [
    "FITS_NAME",
    "READ_ERRORS",
    "OutputExistsError",
    "as_utf8",
    "atomic_path",
    "check_output",
    "check_suffix",
    "file_kind",
    "first_line",
    "make_folder",
    "open_fits",
    "open_stream",
    "place",
    "split_extension",
    "stem_of",
]

_BLOCK = 2880
_LONGEST_ENDING = 16
# Maximum number of axes in the standard, and of bytes in a file.
_MOST_AXES, _MOST_BYTES = 999, 1 << 63
_OPENERS = {"gzip": gzip.open, "bzip2": bz2.open, "xz": lzma.open}
_MAGIC = (
    (b"\x1f\x8b", "gzip"),
    (b"BZh", "bzip2"),
    (b"\xfd7zXZ\x00", "xz"),
    (b"#ASDF", "asdf"),
    (b"SIMPLE  =", "fits"),
)
# Files that are neither FITS, ASDF nor a table, and are given by mistake.
_FOREIGN = (
    (b"\xff\xd8\xff", "a JPEG picture"),
    (b"\x89PNG", "a PNG picture"),
    (b"GIF8", "a GIF picture"),
    (b"II*\0", "a TIFF or raw picture"),
    (b"MM\0*", "a TIFF or raw picture"),
    (b"%PDF", "a PDF"),
    (b"PK\x03\x04", "a ZIP archive"),
    (b"\x1f\x9d", "compressed by compress; decompress it first"),
)
# Tables that can be read: HDF5, Parquet, text in UTF-16.
_TABLES = (b"\x89HDF", b"PAR1", b"\xff\xfe", b"\xfe\xff")
# Text that is no table: JSON, and the manifest of a run, whose first entry is its name.
_MANIFEST = re.compile(rb'\s*\{\s*"run"\s*:')
_JSON = re.compile(rb'\s*(\{\s*["}]|\[\s*["{\[])')
# No other text begins with control characters other than blanks; headers may be padded with zeros.
_CONTROL = re.compile(rb".{0,7}\0|.*[\x01-\x08\x0e-\x1f\x7f]", re.DOTALL)
#: Names of FITS files.
FITS_NAME = re.compile(r"\.(fits?|fts|fz)(\.(gz|bz2|xz))?$", re.IGNORECASE)
# Kinds of the formats that are not FITS, and suffixes that belong to one kind.
_KINDS = {"asdf": "asdf", "stock": "asdf", "head": "head", "ecsv": "ecsv"}
_KIND_OF_SUFFIX = {
    ".asdf": "asdf",
    ".head": "head",
    ".ahead": "head",
    ".ecsv": "ecsv",
    ".fits": "fits",
    ".fit": "fits",
    ".fts": "fits",
}
_HEADER_NAME = re.compile(r"\.(a?head|hdr|txt)$", re.IGNORECASE)
_STEM_SUFFIXES = re.compile(
    r"\.(fz|gz|bz2|xz|fits?|fts|cat|ldac|ecsv|csv|txt|dat|tbl|head|asdf)$", re.IGNORECASE
)
# Control characters, line ends of Unicode, and the bytes that Python keeps as lone surrogates.
_UNFIT = re.compile(r"[\x00-\x1f\x7f-\x9f\u2028\u2029\udc80-\udcff]")


class OutputExistsError(InputError, FileExistsError):
    """An output file exists and may not be replaced.

    Examples
    --------
    >>> import tempfile
    >>> from astropy.table import Table
    >>> from wpdc_gwcs import write
    >>> from wpdc_gwcs.io import OutputExistsError
    >>> path = f"{tempfile.mkdtemp()}/stars.ecsv"
    >>> write(Table({"x": [1.0]}), path)
    >>> write(Table({"x": [2.0]}), path)
    Traceback (most recent call last):
        ...
    wpdc_gwcs.io.files.OutputExistsError: ...stars.ecsv: file exists and is kept; ...
    >>> issubclass(OutputExistsError, FileExistsError)
    True
    """


def first_line(error):
    """Return the first line of an error's message, for messages of one line.

    Parameters
    ----------
    error : Exception
        The error.

    Returns
    -------
    line : str
        First line of the message, or the name of its type without one.
    """
    return str(error).strip().split("\n")[0] or type(error).__name__


def as_utf8(text):
    r"""Return a text that every file can store.

    Parameters
    ----------
    text : str
        Possibly a path with bytes that are not UTF-8, which Python keeps as lone surrogates.

    Returns
    -------
    text : str
        The same, with such bytes written out.

    Examples
    --------
    >>> from wpdc_gwcs.io.files import as_utf8
    >>> print(as_utf8("caf\udce9.fits"))
    caf\udce9.fits
    """
    return text.encode("utf-8", "backslashreplace").decode("utf-8")


def stem_of(path):
    r"""Return the name of a file without its folder and the suffixes of data files.

    Parameters
    ----------
    path : path-like
        For example ``night1/a.fits.fz``.

    Returns
    -------
    stem : str
        For example ``a``.  Control characters and bytes that are not UTF-8 are written as in URLs,
        since tables and other files have to hold the name.

    Examples
    --------
    >>> from wpdc_gwcs.io.files import stem_of
    >>> stem_of("night1/a.1.fits.fz")
    'a.1'
    >>> stem_of("two\nlines.fits")
    'two%0Alines'
    """
    name = Path(path).name
    while (shorter := _STEM_SUFFIXES.sub("", name)) not in ("", name):
        name = shorter
    return _UNFIT.sub(
        lambda found: "".join(f"%{b:02X}" for b in found[0].encode("utf-8", "surrogateescape")),
        name,
    )


def file_kind(path, *, error=FileFormatError):
    """Recognize the kind of a file from its first bytes.

    Parameters
    ----------
    path : path-like
        The file.
    error : type, optional
        Subclass of `~wpdc_gwcs.exceptions.InputError` that is raised.

    Returns
    -------
    kind : str
        ``"fits"`` (compressed as a whole or not), ``"asdf"`` or ``"text"``.

    Raises
    ------
    InputError
        If the file is missing, unreadable or empty, or is not what its name says.
    """
    path = Path(path)
    if (what := special_file(path)) is not None:
        raise error(f"{path}: must be a file, is {what}")
    try:
        with open(path, "rb") as file:
            start = file.read(81)
    except OSError as problem:
        reason = problem.strerror or type(problem).__name__
        raise error(f"{path}: must be a readable file: {reason}") from problem
    if not start:
        raise error(f"{path}: must not be empty, the file has 0 bytes")
    kind = next((k for magic, k in _MAGIC if start.startswith(magic)), "text")
    if kind in _OPENERS:
        try:
            with _OPENERS[kind](path, "rb") as file:
                start = file.read(9)
        except READ_ERRORS as problem:
            raise error(f"{path}: damaged {kind} file: {first_line(problem)}") from problem
        kind = "fits" if start == b"SIMPLE  =" else "text"
    if kind == "text" and (what := _foreign(start)) is not None:
        raise error(f"{path}: must be FITS, ASDF or a table, is {what}")
    if kind == "fits" and (start[80:] in (b"\n", b"\r") or _HEADER_NAME.search(path.name)):
        # A header alone as text: cards in lines, or without line ends if the name says so.
        kind = "text"
    if kind != "fits" and FITS_NAME.search(path.name):
        shown = start[:9].decode("latin-1")
        raise error(f"{path}: a FITS file must begin with 'SIMPLE  =', got {shown!r}")
    return kind


def _foreign(start):
    """Tell what a file is that begins so, if it cannot be read; or `None`."""
    if start.startswith(_TABLES):
        return None
    known = next((what for magic, what in _FOREIGN if start.startswith(magic)), None)
    if known is None and _JSON.match(start):
        known = "a JSON file, the manifest of a run" if _MANIFEST.match(start) else "a JSON file"
    return known or ("another binary file" if _CONTROL.match(start) else None)


@contextlib.contextmanager
def open_fits(path, *, error=FileFormatError, lazy=False):
    """Open a FITS file after checking that it is complete.

    Parameters
    ----------
    path : path-like
        FITS file, plain, tile-compressed, or compressed as a whole (gzip, bzip2, xz).
    error : type, optional
        Subclass of `~wpdc_gwcs.exceptions.InputError` that is raised for any damage.
    lazy : bool, optional
        Read extensions on access, for use of one of many.

    Yields
    ------
    hdus : `~astropy.io.fits.HDUList`
        Read without a memory map; closed at the end of the block, within which no warning of any
        kind is shown.

    Notes
    -----
    astropy opens a truncated file with a warning; here it is an error, also if only the data are
    truncated.  Warnings of astropy about unusual headers do not concern users of a calibration.
    Because they are suppressed, do not issue other warnings inside the block.
    """
    path = Path(path)
    if (what := special_file(path)) is not None:
        raise error(f"{path}: must be a file, is {what}")
    number = _check_once(path, error)
    # Pass an open file: it is closed in any case, and '~' is an ordinary character.
    with warnings.catch_warnings(), open(path, "rb") as stream:
        warnings.simplefilter("ignore")
        try:
            hdus = fits.open(stream, memmap=False, lazy_load_hdus=lazy)
        except READ_ERRORS as problem:
            raise error(f"{path}: damaged FITS file: {first_line(problem)}") from problem
        with hdus:
            if not lazy and len(hdus) < number:
                # astropy silently drops what it cannot read, and everything after it.
                raise error(f"{path}: damaged FITS file: HDU {len(hdus)} cannot be read")
            try:
                yield hdus
            except InputError:
                raise
            except READ_ERRORS as problem:
                # Parts of a header are parsed only on access.
                raise error(f"{path}: damaged FITS file: {first_line(problem)}") from problem


# Files known to be complete, with their state: each frame of a mosaic opens its file again.
_complete = {}


def _check_once(path, error):
    try:
        state = path.stat()
    except OSError:
        state = None
    seen = state and (state.st_size, state.st_mtime_ns)
    if seen is None or _complete.get(path, (None,))[0] != seen:
        _complete[path] = seen, check_complete(path, error=error)
    return _complete[path][1]


@contextlib.contextmanager
def open_stream(path, mode="rb", *, like=None):
    """Open a file as a stream of bytes, with transparent compression.

    Parameters
    ----------
    path : path-like
        The file.
    mode : {"rb", "wb"}, optional
        Read or write.
    like : path-like, optional
        File whose compression a new file gets; itself by default.

    Yields
    ------
    stream : file object
        Yields or takes the uncompressed bytes.
    """
    with open(path if like is None else like, "rb") as file:
        start = file.read(9)
    kind = next((k for magic, k in _MAGIC if start.startswith(magic)), None)
    with _OPENERS.get(kind, open)(path, mode) as stream:
        yield stream


def check_complete(path, *, error=FileFormatError):
    """Follow the headers of a FITS file and make sure that the data they announce are there.

    Parameters
    ----------
    path : path-like
        FITS file, compressed as a whole or not.
    error : type, optional
        Subclass of `~wpdc_gwcs.exceptions.InputError` that is raised.

    Returns
    -------
    number : int
        Number of HDUs.

    Raises
    ------
    InputError
        If a header does not end or the data of an HDU end early.  Missing padding after the last
        data is accepted: such files are common and have all data.
    """
    path = Path(path)
    try:
        with open(path, "rb") as file:
            start = file.read(9)
        kind = next((k for magic, k in _MAGIC if start.startswith(magic)), None)
        if kind in _OPENERS:
            with _OPENERS[kind](path, "rb") as file:
                number = _walk(file, path, error, size=None)
                # Also verifies the checksum at the end of the compressed stream.
                while file.read(1 << 24):
                    pass
        else:
            with open(path, "rb") as file:
                number = _walk(file, path, error, size=path.stat().st_size)
        return number
    except InputError:
        raise
    except READ_ERRORS as problem:
        if getattr(problem, "strerror", None):
            raise error(f"{path}: must be a readable file: {problem.strerror}") from problem
        raise error(f"{path}: damaged FITS file: {first_line(problem)}") from problem


def _walk(file, path, error, size):
    """Go from header to header; `size` is the length of the file, if known."""
    number = position = 0
    while True:
        header = _read_mandatory(file, path, error, number)
        if header is None:
            return number
        position += header.pop("length")
        bits = abs(header.get("BITPIX", 8))
        for keyword, value in header.items():
            most = _MOST_AXES if keyword == "NAXIS" else _MOST_BYTES
            if keyword != "BITPIX" and not 0 <= value <= most:
                raise error(f"{path}: {keyword} of HDU {number} must be 0 to {most}, is {value}")
        axes = [header.get(f"NAXIS{i + 1}", 0) for i in range(header.get("NAXIS", 0))]
        if header.get("GROUPS") and axes and axes[0] == 0:
            axes = axes[1:]
        count = 1 if axes else 0
        for n in axes:
            count *= n
        data = bits // 8 * header.get("GCOUNT", 1) * (header.get("PCOUNT", 0) + count)
        there = _skip(file, data, position, size)
        if there < data:
            raise error(
                f"{path}: truncated file: HDU {number} must have {data} bytes of data, has {there}"
            )
        padded = -(-data // _BLOCK) * _BLOCK
        _skip(file, padded - data, position + data, size)
        position += padded
        number += 1


def _skip(file, length, position, size):
    """Move on by `length` bytes; return how many of them exist."""
    if size is not None:
        file.seek(position + length)
        return max(0, min(length, size - position))
    there = 0
    while there < length and (block := file.read(min(1 << 24, length - there))):
        there += len(block)
    return there


def _read_mandatory(file, path, error, number):
    """Read one header; the structural keywords and its length in bytes, `None` at the end."""
    wanted = re.compile(rb"(BITPIX|NAXIS\d*|PCOUNT|GCOUNT|GROUPS) *= *([-+\d]+|T)")
    found = {"length": 0}
    while True:
        block = file.read(_BLOCK)
        if found["length"] == 0 and block[:8] not in (b"SIMPLE  ", b"XTENSION"):
            # The end, or special records, which the standard tells readers to skip.
            return None
        found["length"] += _BLOCK
        for i in range(0, len(block), 80):
            card = block[i : i + 80]
            if card[:8] == b"END     " and len(block) == _BLOCK:
                return found
            if match := wanted.match(card):
                value = match[2]
                found[match[1].decode()] = True if value == b"T" else int(value)
        if len(block) < _BLOCK:
            raise error(f"{path}: truncated file: the header of HDU {number} does not end")


def check_suffix(path, format):
    """Check that the name of a file is not that of another format.

    Parameters
    ----------
    path : path-like
        File to be written.
    format : {"asdf", "stock", "head", "ecsv", "fits", "cpdis", "tpv", "sip", "tab"}
        Its format.  A suffix that belongs to no format is accepted.

    Raises
    ------
    InputError
        If the suffix is that of another kind of file.
    """
    kind = _KINDS.get(format, "fits")
    suffix = Path(path).suffix.lower()
    if _KIND_OF_SUFFIX.get(suffix, kind) != kind:
        raise InputError(
            f"{path}: the name of a file in the format {format} must end with .{kind}, ends with "
            f"{suffix}"
        )


def check_output(path, *, overwrite):
    """Check that a file can be written, before any work is done for it.

    Parameters
    ----------
    path : path-like
        File to be written.
    overwrite : bool
        Whether an existing file may be replaced.

    Raises
    ------
    OutputExistsError
        If the file exists and may not be replaced.
    InputError
        If the folder does not exist or cannot be written to.
    """
    path = Path(path)
    try:
        mode = path.stat().st_mode
    except FileNotFoundError:
        mode = None
    except (OSError, ValueError) as problem:
        reason = getattr(problem, "strerror", None) or first_line(problem)
        raise InputError(f"{path}: cannot be written: {reason}") from problem
    if mode is not None and stat.S_ISDIR(mode):
        raise InputError(f"{path}: the output must be a file, is a folder")
    if mode is not None and not stat.S_ISREG(mode):
        # Replacing a device by a file would remove it for everyone.
        raise InputError(f"{path}: the output must be a file, is a device, pipe or socket")
    if mode is not None and not overwrite:
        raise OutputExistsError(f"{path}: file exists and is kept; overwriting must be asked for")
    if not path.parent.is_dir():
        raise InputError(f"{path}: the output folder must exist, found no {path.parent}")
    if not os.access(path.parent, os.W_OK):
        raise InputError(f"{path}: the output folder must be writable, {path.parent} is not")


def make_folder(path):
    """Make the folder that files are written to, unless it is there.

    Parameters
    ----------
    path : path-like
        The folder; those above it are made as well.

    Raises
    ------
    InputError
        If it cannot be made, or is a file.
    """
    path = Path(path)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except FileExistsError as problem:
        raise InputError(f"{path}: the output folder must be a folder, is a file") from problem
    except (OSError, ValueError) as problem:
        reason = getattr(problem, "strerror", None) or problem
        raise InputError(f"{path}: the output folder must be writable: {reason}") from problem


def place(temporary, path, *, overwrite):
    """Give a finished file its final name.

    Parameters
    ----------
    temporary : path-like
        The file, on the same file system.
    path : path-like
        Final name.
    overwrite : bool
        Whether a file of this name may be replaced.

    Raises
    ------
    OutputExistsError
        If there is a file of this name that may not be replaced.
    """
    if overwrite:
        os.replace(temporary, path)
        return
    try:
        # Unlike a rename, a link never replaces a file written by others in the meantime.
        os.link(temporary, path)
    except FileExistsError:
        raise OutputExistsError(
            f"{path}: file exists and is kept; overwriting must be asked for"
        ) from None
    except OSError:
        # File systems without hard links.
        os.rename(temporary, path)
    else:
        os.unlink(temporary)


@contextlib.contextmanager
def atomic_path(path, *, overwrite=False):
    """Write a file atomically: the block writes a temporary file, which is then renamed.

    Parameters
    ----------
    path : path-like
        File to be written.
    overwrite : bool, optional
        Whether an existing file may be replaced.

    Yields
    ------
    temporary : `~pathlib.Path`
        Name to write to, in the same folder.  It is flushed to disk and renamed when the block
        ends well, and removed when anything is raised, `KeyboardInterrupt` included.

    Raises
    ------
    OutputExistsError
        If the file exists and may not be replaced, also when it appeared in the meantime.
    InputError
        If the file cannot be written.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> from wpdc_gwcs.io import atomic_path
    >>> folder = Path(tempfile.mkdtemp())
    >>> with atomic_path(folder / "notes.txt") as temporary:
    ...     size = temporary.write_text("all or nothing")
    ...     print((folder / "notes.txt").exists())
    False
    >>> (folder / "notes.txt").read_text()
    'all or nothing'
    """
    path = Path(path)
    check_output(path, overwrite=overwrite)
    # The suffix stays, because writers choose the format by it.  Absolute, because some of them
    # expand a leading '~'.
    ending = path.suffix if len(os.fsencode(path.suffix)) <= _LONGEST_ENDING else ""
    temporary = path.parent.absolute() / f".{uuid.uuid4().hex}.part{ending}"
    try:
        yield temporary
        with open(temporary, "rb+") as file:
            os.fsync(file.fileno())
        place(temporary, path, overwrite=overwrite)
    except InputError:
        raise
    except OSError as problem:
        reason = problem.strerror or first_line(problem)
        raise InputError(f"{path}: cannot be written: {reason}") from problem
    finally:
        with contextlib.suppress(FileNotFoundError):
            os.unlink(temporary)
