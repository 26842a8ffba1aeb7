"""What a run has done since its manifest and its summary were written.

::

    set of files with ENTRY --put in place--> .RUN.journal (a line more) --fold--> manifest, summary

Both grow with the run.  Writing them with every set would take a time that grows with its square;
they are written when they have grown by a share of themselves, and at the end; until then a line
for each set tells the rest.
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
    """Name the journal of a run.

    Parameters
    ----------
    folder : Path
        Result folder.
    run : str
        Identity of the run.

    Returns
    -------
    Path
        It may not be there.
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
        Identity of the run to path; mostly none.
    """
    with os.scandir(folder) as entries:
        names = [found for entry in entries if (found := _JOURNAL.fullmatch(entry.name))]
    return {found[1]: folder / found[0] for found in names}


def write_entry(folder, states, rows):
    """Write what a set of files is into its folder.

    Parameters
    ----------
    folder : Path
        Where the set is made.
    states : dict
        Frame name to what the manifest says of it.
    rows : dict
        Frame name to its row of the summary.
    """
    text = json.dumps({"states": states, "rows": rows}, default=_plain)
    (folder / ENTRY).write_text(text, encoding="utf-8")


def _plain(value):
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"{type(value).__name__} has no place in a summary")


def add_to_journal(entry, journal):
    """Add the entry of a set; twice is as good as once.

    Parameters
    ----------
    entry, journal : Path
        Files.
    """
    with journal.open("a", encoding="utf-8") as file:
        # What a program that was killed had begun to write ends here.
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
        As in `write_entry`, of all sets.
    """
    states, rows = {}, {}
    for line in path.read_text(encoding="utf-8").splitlines():
        try:
            entry = json.loads(line)
        except ValueError:
            # Cut off; its set is still there, and has been added again.
            continue
        states |= entry["states"]
        rows |= entry["rows"]
    return states, rows
