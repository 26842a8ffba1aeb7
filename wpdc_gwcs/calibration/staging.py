"""Sets of files that get their names together, or not at all.

::

    group of frames --write--> .RUN.part/ --rename--> .RUN.done/ --move--> the folder

A set is written into a hidden folder, which is renamed when it is complete.  Before that, existing
files are unchanged.  After that, the whole set will be put in place, even if the program is killed,
because the next run continues where it stopped.
"""

import json
import os
import re
import shutil

from wpdc_gwcs.calibration.journal import ENTRY, add_to_journal, journal_of
from wpdc_gwcs.exceptions import InputError

try:
    import fcntl
except ImportError:  # a system without locks of this kind
    fcntl = None

__all__ = [
    "FRAME_SUFFIXES",
    "MANIFEST",
    "REMOVED",
    "SUMMARY",
    "clean",
    "lock",
    "put_in_place",
]

#: Files of a frame, in the order in which they get their names.
FRAME_SUFFIXES = (".sources.ecsv", ".matches.ecsv", ".wcs.asdf")
#: Files of the run.
SUMMARY, MANIFEST = "summary.ecsv", "manifest.json"
#: File of a set that names those that are to go.
REMOVED = "removed.json"
# Names of the hidden folders of this package.
_STAGED = re.compile(r"\.[0-9a-f]{12}\.(part|done)")


def lock(folder):
    """Keep other runs out of a folder.

    Parameters
    ----------
    folder : Path
        The folder.

    Returns
    -------
    int or None
        File descriptor that holds the lock until it is closed, however the program ends; `None`
        if the file system has no locks.

    Raises
    ------
    InputError
        If another run is in it.
    """
    if fcntl is None:
        return None
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(descriptor)
        raise InputError(
            f"{folder}: another run is writing to this folder: wait, or choose another folder"
        ) from None
    except OSError:
        os.close(descriptor)
        return None
    return descriptor


def clean(folder):
    """Complete interrupted sets that were being put in place, and remove incomplete ones.

    Parameters
    ----------
    folder : Path
        Folder with a lock.
    """
    for path in sorted(folder.iterdir()):
        if not (_STAGED.fullmatch(path.name) and path.is_dir()):
            continue
        if path.suffix == ".done":
            put_in_place(path, folder)
        else:
            shutil.rmtree(path, ignore_errors=True)


def put_in_place(done, folder):
    """Rename the files of a set to their final names; the WCS of a frame follows its tables.

    Parameters
    ----------
    done : Path
        Folder with the set, or the remaining files of it; it is removed.
    folder : Path
        Result folder.
    """
    try:
        removed = json.loads((done / REMOVED).read_text(encoding="utf-8"))
    except FileNotFoundError:
        removed = []
    for name in removed:
        (folder / name).unlink(missing_ok=True)
    journal = journal_of(folder, done.name.split(".")[1])
    # Frame by frame, so that the files of a frame appear at nearly the same time.
    for name in sorted(os.listdir(done), key=_order):
        if name == ENTRY:
            add_to_journal(done / name, journal)
        elif name != REMOVED:
            os.replace(done / name, folder / name)
            if name == MANIFEST:
                # The manifest has everything from the journal.
                journal.unlink(missing_ok=True)
    shutil.rmtree(done)


def _order(name):
    for k, suffix in enumerate(FRAME_SUFFIXES):
        if name.endswith(suffix):
            return 0, name.removesuffix(suffix), k
    # The manifest is the last one, because it claims that the others exist.
    return {MANIFEST: 3, SUMMARY: 2, ENTRY: 2}.get(name, 1), name, 0
