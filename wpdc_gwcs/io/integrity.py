"""Checks that a file is intact: its version, the size of its content, and its checksum.

A file can also do harm by its size: a few lines of YAML aliases may expand to more values than fit
into memory, and a small compressed block to more than fits on disk.
"""

import hashlib
import struct
from collections.abc import Mapping, Sequence

import numpy as np
import yaml
from astropy.io import fits

from wpdc_gwcs.exceptions import FileFormatError
from wpdc_gwcs.export import FORMAT_VERSION
from wpdc_gwcs.io.files import READ_ERRORS, first_line
from wpdc_gwcs.io.headers import is_ours

__all__ = [
    "check_size",
    "check_sums",
    "check_version",
    "content_sum",
    "parse_version",
]

# A solution of 100,000 frames has the names of all of them; everything else is small.
_MOST_NODES = 1_000_000
_DEEPEST = 100
# The largest of our files, a solution with its residual map, is 40 MB.
_MOST_BYTES = 4 << 30
_BLOCK = struct.Struct(">I4sQQQ16s")
_BLOCK_MAGIC = b"\xd3BLK"
_LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


def parse_version(text):
    """Parse a format version.

    Parameters
    ----------
    text : str
        Version such as ``1.2.0`` or ``1.0``.

    Returns
    -------
    tuple of int or None
        Numbers of the version; `None` if the text is not a version.
    """
    parts = str(text).split(".")
    if 2 <= len(parts) <= 3 and all(part.isdecimal() and part.isascii() for part in parts):
        return tuple(int(part[:9]) for part in parts)
    return None


def check_version(text, path):
    """Raise an error for a format version that only a later package can read.

    Parameters
    ----------
    text : str
        Format version of the file.
    path : path-like
        The file, for the message.

    Returns
    -------
    tuple of int
        Numbers of the version.  A later minor version is accepted, because it only adds optional
        content.

    Raises
    ------
    FileFormatError
        If the text is not a version, or is a later major version.
    """
    version = parse_version(text)
    if version is None:
        raise FileFormatError(f"{path}: format version must be like {FORMAT_VERSION}, got {text!r}")
    if version[0] > parse_version(FORMAT_VERSION)[0]:
        raise FileFormatError(
            f"{path}: format version must not be newer than {FORMAT_VERSION.split('.')[0]}.x, got "
            f"{text}: a newer wpdc_gwcs is needed"
        )
    return version


def check_sums(hdus, path):
    """Raise an error for a FITS file of this package that contradicts its CHECKSUM or DATASUM.

    Parameters
    ----------
    hdus : `~astropy.io.fits.HDUList`
        The open file.
    path : path-like
        The file, for the message.

    Raises
    ------
    FileFormatError
        If an HDU has wrong sums.  Headers of this package that were copied into other images are
        not checked, because their sums are those of another HDU.
    """
    for number, hdu in enumerate(hdus):
        try:
            # 0 means a wrong sum, 2 means that there is none.
            agrees = not _is_ours(hdu) or (hdu.verify_checksum() and hdu.verify_datasum())
        except READ_ERRORS as problem:
            raise FileFormatError(f"{path}: damaged FITS file: {first_line(problem)}") from problem
        if not agrees:
            raise FileFormatError(
                f"{path}: HDU {number} must agree with its CHECKSUM and DATASUM, does not: "
                "damaged, or edited without new sums (astropy: writeto(..., checksum=True))"
            )


def _is_ours(hdu):
    """Recognize our tables, and our headers as they were written: alone, or with zeros."""
    if hdu.name.startswith("WPDC_"):
        return True
    if not is_ours(hdu.header) or not isinstance(hdu, fits.PrimaryHDU):
        return False
    return hdu.data is None or not hdu.data.any()


def content_sum(tree):
    """Compute the checksum of a tree of plain values and arrays.

    Parameters
    ----------
    tree : dict
        Tree to write, or a tree that was read.

    Returns
    -------
    str
        SHA-256 in hexadecimal digits.  It depends on names and values only, not on their order or
        their form in the file.
    """
    digest = hashlib.sha256()
    _add(digest, tree)
    return digest.hexdigest()


def _add(digest, value):
    if isinstance(value, np.ndarray):
        # Files do not distinguish numbers of the same kind.
        # This package writes no other types; if a file has some, its sum differs.
        kinds = {"b": "<i8", "i": "<i8", "u": "<u8", "f": "<f8"}
        value = value.astype(kinds.get(value.dtype.kind, value.dtype))
        digest.update(f"array{value.shape}{value.dtype.str}".encode())
        digest.update(value.tobytes())
    elif isinstance(value, Mapping):
        digest.update(f"map{len(value)}".encode())
        for key in sorted(value):
            _add(digest, str(key))
            _add(digest, value[key])
    elif isinstance(value, str):
        text = value.encode()
        digest.update(f"text{len(text)}:".encode() + text)
    elif isinstance(value, Sequence):
        digest.update(f"list{len(value)}".encode())
        for item in value:
            _add(digest, item)
    else:
        digest.update(f"{type(value).__name__}{value!r};".encode())


def check_size(stream, path):
    """Raise an error for an ASDF file with excessive content, before anything is built from it.

    Parameters
    ----------
    stream : file object
        The file, open for reading bytes; its position is the beginning afterward.
    path : path-like
        The file, for the message.

    Raises
    ------
    FileFormatError
        If the tree is not YAML, if it is too large or too deep with all aliases expanded, or if
        the blocks need too much memory.
    """
    head = []
    for line in stream:
        head.append(line)
        if line.rstrip() == b"...":
            break
    _check_tree(b"".join(head), path)
    _check_blocks(stream, path)
    stream.seek(0)
    # asdf reads from the raw file under the buffer, which has already read a small file to its end.
    getattr(stream, "raw", stream).seek(0)


def _check_tree(text, path):
    sizes, stack, total = {}, [], 0
    try:
        for event in yaml.parse(text, Loader=_LOADER):
            anchor = getattr(event, "anchor", None)
            if isinstance(event, yaml.AliasEvent):
                if anchor not in sizes:
                    raise FileFormatError(f"{path}: damaged ASDF file: {anchor!r} is its own part")
                total += sizes[anchor]
            elif isinstance(event, yaml.ScalarEvent):
                total += 1
                sizes[anchor] = 1
            elif isinstance(event, yaml.CollectionStartEvent):
                total += 1
                stack.append((anchor, total))
                sizes.pop(anchor, None)
            elif isinstance(event, yaml.CollectionEndEvent):
                anchor, before = stack.pop()
                sizes[anchor] = total - before + 1
            if total > _MOST_NODES or len(stack) > _DEEPEST:
                raise FileFormatError(
                    f"{path}: the tree of an ASDF file must have at most {_MOST_NODES} values, "
                    f"{_DEEPEST} deep, has more"
                )
    except (yaml.YAMLError, ValueError, RecursionError) as problem:
        raise FileFormatError(f"{path}: damaged ASDF file: {first_line(problem)}") from problem


def _check_blocks(stream, path):
    """Go from block to block and add up their decompressed sizes."""
    total = 0
    start = stream.read(1)
    while start == b"\0":
        start = stream.read(1)
    magic = start + stream.read(3)
    while magic == _BLOCK_MAGIC:
        size = stream.read(2)
        header = stream.read(int.from_bytes(size)) if len(size) == 2 else b""
        if len(header) < _BLOCK.size:
            return  # cut short, which asdf reports
        _, _, allocated, _, data, _ = _BLOCK.unpack_from(header)
        total += data
        if total > _MOST_BYTES:
            raise FileFormatError(
                f"{path}: the blocks of an ASDF file must hold at most {_MOST_BYTES >> 30} GB, "
                f"hold {total / 2**30:.1f}"
            )
        stream.seek(min(allocated, 1 << 62), 1)
        magic = stream.read(4)
