"""Work in progress: frames, their part of the catalog, and their matching.

::

    group --begin--> tasks, part of the catalog --> matched alone --> from neighbors --> blind
"""

import time
import warnings
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from astropy.table import Table

from wpdc_gwcs.calibration.matched import FailedFrame, sky_of_frame
from wpdc_gwcs.calibration.mosaic import start_from_neighbors
from wpdc_gwcs.calibration.settings import Settings
from wpdc_gwcs.calibration.story import say, tell_catalog
from wpdc_gwcs.calibration.workers import Task, stored_of, without_maps
from wpdc_gwcs.catalogs import Region, fill_motions, read_catalog
from wpdc_gwcs.counts import counted
from wpdc_gwcs.exceptions import MatchError, WPDCWarning

__all__ = ["InWork", "Run", "begin_group", "match_group", "sky_of_frames"]

# Years from the epoch of the catalog from which on a wrong date is more likely than an old plate,
# and where proper motions of 1 mas / yr matter anyway.
_FAR_EPOCH = 50.0


def sky_of_frames(frames, settings, solution):
    """Return the part of the sky that frames cover.

    Parameters
    ----------
    frames : list of Frame
        The frames.
    settings : Settings
        Settings; a blind search needs a larger region.
    solution : DistortionSolution, mapping or None
        Stored solutions.

    Returns
    -------
    Region or None
        None if no frame has a position.
    """
    cones = [
        sky_of_frame(frame, settings, solution=stored_of(solution, frame.detector))
        for frame in frames
    ]
    cones = [cone for cone in cones if cone is not None]
    return Region(*zip(*cones, strict=True)) if cones else None


@dataclass(frozen=True, eq=False)
class Run:
    """Common data of all frames of a run.

    Parameters
    ----------
    frames : list of Frame
        All frames.
    catalog : `~astropy.table.Table`, GaiaArchive or HatsCatalog
        Reference stars around all frames, or the source to read parts from.
    solution : DistortionSolution, mapping or None
        Stored solutions.
    settings : Settings
        Settings.
    update : bool
        Whether stored solutions are updated.
    progress : callable
        As for `calibrate`.
    remote : str or None
        Identity of the run if workers solve its batches and make their files; None if they are
        solved here.
    """

    frames: list
    catalog: object
    solution: object
    settings: Settings
    update: bool
    progress: Callable
    remote: str | None = None

    def catalog_of(self, group):
        """Return the reference stars of frames that are solved together.

        Parameters
        ----------
        group : list of Frame
            The frames.

        Returns
        -------
        `~astropy.table.Table`
            For an archive, only the part that the frames cover.
        """
        if not hasattr(self.catalog, "stars_of"):
            # Motions are filled in from the whole, so that a star moves the same way in all frames.
            return self.catalog
        sky = sky_of_frames(group, self.settings, self.solution)
        if sky is None:
            # These frames fail with any catalog.
            cones = (sky_of_frames([f], self.settings, self.solution) for f in self.frames)
            sky = next((cone for cone in cones if cone is not None), None)
        began = time.perf_counter()
        part = fill_motions(read_catalog(self.catalog, region=sky))
        say(tell_catalog, part, time.perf_counter() - began)
        return part


@dataclass(eq=False)
class InWork:
    """Frames that are solved together, and their tasks in progress.

    Parameters
    ----------
    group : list of Frame
        The frames.
    catalog : `~astropy.table.Table` or None
        Their part of the catalog; None if all of them have failed.
    tasks : dict
        Functions that return the results, by frame name.
    """

    group: list
    catalog: Table
    tasks: dict


def begin_group(group, run, workers, other):
    """Start the matching of a group.

    Parameters
    ----------
    group : list of Frame
        The frames.
    run : Run
        Common data of the run.
    workers : Workers
        Workers for the tasks.
    other : dict
        Results of frames that have failed already.

    Returns
    -------
    InWork
        Tasks in progress.
    """
    if other:
        return InWork(group, None, {})
    catalog = run.catalog_of(group)
    _warn_of_epochs(group, catalog)
    return InWork(group, catalog, _submit(group, catalog, run, workers, narrow=True))


def _warn_of_epochs(group, catalog):
    """Warn of frames so far from the epoch of the catalog that the date may be wrong."""
    if not {"pmra", "ref_epoch"} <= set(catalog.colnames) or not len(catalog):
        return
    middle = float(np.median(catalog["ref_epoch"]))
    far = [f for f in group if f.epoch is not None and abs(f.epoch - middle) > _FAR_EPOCH]
    if far:
        first = far[0]
        others = "" if len(far) == 1 else f" and {counted(len(far) - 1, 'other frame')}"
        warnings.warn(
            f"{first.source}{others}: the epoch {first.epoch:.2f} is "
            f"{abs(first.epoch - middle):.0f} years from that of the catalog, {middle:.2f}: check "
            "the date in the header, or give it with --epoch",
            WPDCWarning,
        )


def _submit(group, catalog, run, workers, *, narrow, sources=None):
    """Start the matching of single frames; return functions for the results by frame name.

    A blind search takes ten times as long, especially without a match: in an exposure of several
    detectors it is used only for frames that match neither alone nor through their neighbors.
    """
    settings = replace(run.settings, blind=False) if narrow else run.settings
    tied = _tied(group) if narrow else ()
    solution = without_maps(run.solution)
    return {
        frame.name: workers.submit(
            Task(
                frame,
                settings if not narrow or frame.name in tied else run.settings,
                catalog,
                solution,
                None if sources is None else sources[frame.name],
            )
        )
        for frame in group
    }


def _tied(group):
    """Names of the frames that share an exposure with others."""
    keys = [(f.camera, f.exposure) for f in group]
    counts = Counter(key for key in keys if None not in key)
    return {f.name for f, key in zip(group, keys, strict=True) if counts[key] > 1}


def match_group(work, results, run, workers):
    """Match the frames that could not be matched alone, from their neighbors, then blind.

    Parameters
    ----------
    work : InWork
        The frames.
    results : dict
        `MatchedFrame` or `FailedFrame` by frame name.
    run : Run
        Common data of the run.
    workers : Workers
        Workers for the tasks.

    Returns
    -------
    dict
        Like ``results``, with more matched frames.
    """
    group, catalog = work.group, work.catalog
    find = partial(start_from_neighbors, solution=run.solution)
    results = find(group, results, catalog, run.settings)
    if not run.settings.blind:
        return results
    tied = _tied(group)
    failed = [
        f
        for f in group
        if f.name in tied
        and isinstance(results[f.name], FailedFrame)
        and isinstance(results[f.name].error, MatchError)
    ]
    if not failed:
        return results
    sources = {f.name: results[f.name].sources for f in failed}
    tasks = _submit(failed, catalog, run, workers, narrow=False, sources=sources)
    again = {name: outcome() for name, outcome in tasks.items()}
    if all(isinstance(result, FailedFrame) for result in again.values()):
        return results | again
    return find(group, results | again, catalog, run.settings)
