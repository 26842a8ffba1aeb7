"""Journal of a run: its progress since manifest and summary were last written.

::

    set of files with ENTRY --put in place--> .RUN.journal (a line more) --fold--> manifest, summary

Both files grow with the run, so writing them with every set would take a time that grows with the
square of its length.  They are written when they have grown by a certain fraction, and at the end.
In between, the journal has a line for each set.
"""

import json
import os
import re

import numpy as np

__all__ = ["ENTRY", "add_to_journal", "find_journals", "journal_of", "read_journal", "write_entry"]

#: File of a set that goes into the journal.
ENTRY = "entry.json"
_JOURNAL = re.compile(r"\.([0-9a-f]{12})\.journal")


def journal_of(folder, run):
    """Return the path of the journal of a run.

    Parameters
    ----------
    folder : Path
        Result folder.
    run : str
        Identity of the run.

    Returns
    -------
    Path
        Path of the journal, which may not exist.
    """
    return folder / f".{run}.journal"


def find_journals(folder):
    """Find the journals in a result folder.

    Parameters
    ----------
    folder : Path
        Result folder.

    Returns
    -------
    dict
        Paths of the journals by the identity of their runs; usually empty.
    """
    with os.scandir(folder) as entries:
        names = [found for entry in entries if (found := _JOURNAL.fullmatch(entry.name))]
    return {found[1]: folder / found[0] for found in names}


def write_entry(folder, states, rows):
    """Write the entry of a set of files into its folder.

    Parameters
    ----------
    folder : Path
        Folder of the set.
    states : dict
        Manifest entries by frame name.
    rows : dict
        Summary rows by frame name.
    """
    text = json.dumps({"states": states, "rows": rows}, default=_plain)
    (folder / ENTRY).write_text(text, encoding="utf-8")


def _plain(value):
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"{type(value).__name__} has no place in a summary")


def add_to_journal(entry, journal):
    """Add the entry of a set to the journal; adding it twice does no harm.

    Parameters
    ----------
    entry, journal : Path
        Files of the entry and of the journal.
    """
    with journal.open("a", encoding="utf-8") as file:
        # This ends a line that a killed program may have left incomplete.
        file.write("\n" + entry.read_text(encoding="utf-8") + "\n")
        file.flush()
        os.fsync(file.fileno())


def read_journal(path):
    """Read a journal.

    Parameters
    ----------
    path : Path
        The journal.

    Returns
    -------
    states, rows : dict
        Entries of all sets, as for `write_entry`.
    """
    states, rows = {}, {}
    for line in path.read_text(encoding="utf-8").splitlines():
        try:
            entry = json.loads(line)
        except ValueError:
            # An incomplete line: its set was still there and has been added again.
            continue
        states |= entry["states"]
        rows |= entry["rows"]
    return states, rows
