"""Many files in few words: folders, patterns in quotes, and lists of files."""

import glob
import os
import re
from pathlib import Path

from wpdc_gwcs.exceptions import InputError

__all__ = ["expand_paths"]

# What the files of frames are called.
_FRAME = re.compile(r"\.(fits?|fts|cat|ldac)(\.(fz|gz|bz2|xz))?$|\.fz$", re.IGNORECASE)


def expand_paths(given, *, without=()):
    """Tell which files are meant, where the shell has not.

    Parameters
    ----------
    given : iterable of str
        Paths as they are, ``path[EXT]`` too; folders, of which FITS files and FITS_LDAC lists are
        taken; patterns with ``*`` and ``?``; ``@FILE``, which has any of these, one in a line.
    without : iterable of str, optional
        Files that lie among the frames of a folder and are none, such as the catalog.

    Returns
    -------
    list of str
        Those of a folder or a pattern sorted by name.

    Raises
    ------
    InputError
        If a list cannot be read, or there is nothing in a folder, a pattern or a list.
    """
    others = {os.path.realpath(path) for path in without}
    return [path for one in given for path in _expand(str(one), others)]


def _expand(one, others):
    if one.startswith("@") and len(one) > 1 and not os.path.lexists(one):
        return [p for line in _lines(Path(one[1:])) for p in _expand_path(line, others)]
    return _expand_path(one, others)


def _expand_path(one, others):
    if os.path.isdir(one):
        found = sorted(
            entry.path
            for entry in os.scandir(one)
            if _FRAME.search(entry.name)
            and not entry.name.startswith(".")
            and entry.is_file()
            and os.path.realpath(entry.path) not in others
        )
        if not found:
            raise InputError(
                f"{one}: the folder has no FITS file and no FITS_LDAC list (.fits, .fits.fz, .cat, "
                ".ldac, ...); name other files one by one"
            )
        return found
    path, extension = re.fullmatch(r"(.*?)((?:\[[^\[\]]*\])*)", one, re.DOTALL).groups()
    if not ("*" in path or "?" in path) or os.path.lexists(one) or os.path.lexists(path):
        return [one]
    # A bracket is an extension, or a part of a name.
    pattern = re.sub(r"\[", "[[]", path)
    found = sorted(p for p in glob.glob(pattern) if os.path.realpath(p) not in others)
    if not found:
        raise InputError(f"{one}: no file matches this pattern")
    return [p + extension for p in found]


def _lines(path):
    try:
        # As paths are: bytes that are no UTF-8 are kept.
        text = os.fsdecode(path.read_bytes())
    except OSError as err:
        raise InputError(f"@{path}: the list of files must be readable: {err.strerror}") from err
    if "\0" in text:
        raise InputError(f"@{path}: must be a text file with one path per line, has binary data")
    lines = [line.strip() for line in text.splitlines()]
    lines = [line for line in lines if line and not line.startswith("#")]
    if not lines:
        raise InputError(f"@{path}: the list names no files")
    return lines
