"""Reproduction of the tables and figures of the paper, with public functions only."""

from pathlib import Path

from astropy.table import vstack

from wpdc_gwcs.exceptions import InputError
from wpdc_gwcs.io import write_table
from wpdc_gwcs.io.files import make_folder
from wpdc_gwcs.reproduction.bass import reproduce_bass
from wpdc_gwcs.reproduction.centroids import reproduce_centroids
from wpdc_gwcs.reproduction.claims import CLAIMS, Claim
from wpdc_gwcs.reproduction.cluster import reproduce_cluster
from wpdc_gwcs.reproduction.detectors import reproduce_detectors
from wpdc_gwcs.reproduction.results import tabulate_results
from wpdc_gwcs.reproduction.scale import FULL, QUICK, SEED, Scale
from wpdc_gwcs.reproduction.weights import reproduce_weights

__all__ = [
    "CLAIMS",
    "FULL",
    "PARTS",
    "QUICK",
    "SEED",
    "Claim",
    "Scale",
    "reproduce",
    "reproduce_bass",
    "reproduce_centroids",
    "reproduce_cluster",
    "reproduce_detectors",
    "reproduce_weights",
    "tabulate_results",
]

#: Functions that make the parts, by name.
PARTS = {
    "detectors": reproduce_detectors,
    "cluster": reproduce_cluster,
    "bass": reproduce_bass,
    "weights": reproduce_weights,
    "centroids": reproduce_centroids,
}


def reproduce(parts, folder, *, scale=FULL, seed=SEED, jobs=1, overwrite=False, progress=None):
    """Reproduce parts of the paper.

    Parameters
    ----------
    parts : sequence of str
        Names of parts, from `PARTS`.
    folder : path-like
        Folder for tables and figures, created if needed; each part has its own subfolder.
    scale : Scale, optional
        Size of the reproduction: `FULL`, as in the paper, or `QUICK`.
    seed : int, optional
        Random seed; the numbers in the documentation are for `SEED`.
    jobs : int, optional
        Number of processes that match frames.
    overwrite : bool, optional
        Whether an earlier reproduction in this folder may be replaced.
    progress : callable, optional
        Called as ``progress(part, done, total)``.

    Returns
    -------
    `~astropy.table.QTable`
        The table that is written to ``results.ecsv``: ``part``, ``item``, ``quantity``, ``unit``,
        ``paper``, ``literal``, ``ours``, ``source``.

    Raises
    ------
    InputError
        If there is no such part, or the folder cannot be written to.

    Examples
    --------
    >>> from wpdc_gwcs.reproduction import PARTS, reproduce
    >>> list(PARTS)
    ['detectors', 'cluster', 'bass', 'weights', 'centroids']
    >>> reproduce(["figure 3"], "paper")
    Traceback (most recent call last):
        ...
    wpdc_gwcs.exceptions.InputError: part must be one of detectors, cluster, bass, ...
    """
    for part in parts:
        if part not in PARTS:
            raise InputError(f"part must be one of {', '.join(PARTS)}, got {part!r}")
    folder = Path(folder)
    target = folder / "results.ecsv"
    if target.exists() and not overwrite:
        raise InputError(f"{target}: file exists, and is replaced only with --overwrite")
    tables = []
    for part in parts:
        make_folder(folder / part)
        tables.append(PARTS[part](folder / part, scale, seed=seed, jobs=jobs, progress=progress))
        # After every part: they take minutes each.
        results = vstack(tables)
        write_table(results, target, overwrite=overwrite or len(tables) > 1)
    return results
