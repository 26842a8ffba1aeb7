"""Paths from folders, quoted patterns and lists of files."""

import glob
import os
import re
from pathlib import Path

from wpdc_gwcs.exceptions import InputError

__all__ = ["expand_paths"]

# Suffixes of frame files.
_FRAME = re.compile(r"\.(fits?|fts|cat|ldac)(\.(fz|gz|bz2|xz))?$|\.fz$", re.IGNORECASE)


def expand_paths(given, *, without=()):
    """Expand folders, patterns and lists to the paths of files.

    Parameters
    ----------
    given : iterable of str
        Paths, also ``path[EXT]``; folders, which stand for their FITS files and FITS_LDAC lists;
        patterns with ``*`` and ``?``; ``@FILE``, a text file with one of these per line.
    without : iterable of str, optional
        Files that are not frames, such as the catalog: left out of folders and patterns, also of
        those that the shell has expanded.

    Returns
    -------
    list of str
        The paths; those of a folder or a pattern are sorted by name.

    Raises
    ------
    InputError
        If a list cannot be read, or a folder, a pattern or a list yields no files.
    """
    others = {os.path.realpath(path) for path in without}
    found = [path for one in given for path in _expand(str(one), others)]
    # A catalog alone is a mistake, about which its reader has more to say.
    frames = [path for path in found if os.path.realpath(path) not in others]
    return frames or found


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
            what = "name other files one by one"
            if any(path.is_dir() for path in Path(one).iterdir()):
                what = f"its folders are {os.path.join(one, '*')}"
            raise InputError(
                f"{one}: the folder has no FITS file and no FITS_LDAC list (.fits, .fits.fz, .cat, "
                f".ldac, ...); {what}"
            )
        return found
    path, extension = re.fullmatch(r"(.*?)((?:\[[^\[\]]*\])*)", one, re.DOTALL).groups()
    if not ("*" in path or "?" in path) or os.path.lexists(one) or os.path.lexists(path):
        return [one]
    # Brackets are an extension or part of a name, not a pattern.
    pattern = re.sub(r"\[", "[[]", path)
    found = sorted(p for p in glob.glob(pattern) if os.path.realpath(p) not in others)
    if not found:
        raise InputError(f"{one}: no file matches this pattern")
    return [
        frame
        for p in found
        for frame in (_expand_path(p, others) if os.path.isdir(p) else [p + extension])
    ]


def _lines(path):
    try:
        # Bytes that are not UTF-8 are kept, as in other paths.
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
