"""Frames in work: what they share, their part of the catalog, and how each of them is matched.

::

    group --begin--> tasks, part of the catalog --> matched alone --> from neighbors --> blind
"""

import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

from astropy.table import Table

from wpdc_gwcs.calibration.matched import FailedFrame, sky_of_frame
from wpdc_gwcs.calibration.mosaic import start_from_neighbors
from wpdc_gwcs.calibration.settings import Settings
from wpdc_gwcs.calibration.story import say, tell_catalog
from wpdc_gwcs.calibration.workers import Task, stored_of
from wpdc_gwcs.catalogs import Region, fill_motions, read_catalog
from wpdc_gwcs.exceptions import MatchError

__all__ = ["InWork", "Run", "begin_group", "match_group", "sky_of_frames"]


def sky_of_frames(frames, settings, solution):
    """Tell what part of the sky frames cover.

    Parameters
    ----------
    frames : list of Frame
        The frames.
    settings : Settings
        A blind search needs more.
    solution : DistortionSolution, mapping or None
        Stored solutions.

    Returns
    -------
    Region or None
        None where none of them tells.
    """
    cones = [
        sky_of_frame(frame, settings, solution=stored_of(solution, frame.detector))
        for frame in frames
    ]
    cones = [cone for cone in cones if cone is not None]
    return Region(*zip(*cones, strict=True)) if cones else None


@dataclass(frozen=True, eq=False)
class Run:
    """What all frames of a run share.

    Parameters
    ----------
    frames : list of Frame
        All of them.
    catalog : `~astropy.table.Table`, GaiaArchive or HatsCatalog
        Reference stars about all frames, or what parts of it are read from.
    solution : DistortionSolution, mapping or None
        Stored solutions.
    settings : Settings
        Choices.
    update : bool
        Whether stored solutions are updated.
    progress : callable
        As for `calibrate`.
    """

    frames: list
    catalog: object
    solution: object
    settings: Settings
    update: bool
    progress: Callable

    def catalog_of(self, group):
        """Return the reference stars of frames that are solved together.

        Parameters
        ----------
        group : list of Frame
            The frames.

        Returns
        -------
        `~astropy.table.Table`
            Of an archive, no more than they cover.
        """
        if not hasattr(self.catalog, "stars_of"):
            # Of all frames, its motions filled from the whole: a star moves alike in all of them.
            return self.catalog
        sky = sky_of_frames(group, self.settings, self.solution)
        if sky is None:
            # They fail by themselves, whatever the catalog.
            cones = (sky_of_frames([f], self.settings, self.solution) for f in self.frames)
            sky = next((cone for cone in cones if cone is not None), None)
        began = time.perf_counter()
        part = fill_motions(read_catalog(self.catalog, region=sky))
        say(tell_catalog, part, time.perf_counter() - began)
        return part


@dataclass(eq=False)
class InWork:
    """Frames that are solved together, and what is under way for them.

    Parameters
    ----------
    group : list of Frame
        The frames.
    catalog : `~astropy.table.Table` or None
        Their part of the catalog; none where all of them have failed already.
    tasks : dict
        Frame name to what returns its result.
    """

    group: list
    catalog: Table
    tasks: dict


def begin_group(group, run, workers, other):
    """Have the frames of a group matched.

    Parameters
    ----------
    group : list of Frame
        The frames.
    run : Run
        What they share with the others.
    workers : Workers
        Who does it.
    other : dict
        Results of frames that have failed already: then there is nothing to do.

    Returns
    -------
    InWork
        What is under way.
    """
    if other:
        return InWork(group, None, {})
    catalog = run.catalog_of(group)
    return InWork(group, catalog, _submit(group, catalog, run, workers, narrow=True))


def _submit(group, catalog, run, workers, *, narrow, sources=None):
    """Have frames matched alone: frame name to what will return the result.

    A blind search takes ten times as long, above all to find nothing: in an exposure of several
    detectors it is left for those that neither they themselves nor their neighbors could match.
    """
    settings = replace(run.settings, blind=False) if narrow else run.settings
    tied = _tied(group) if narrow else ()
    return {
        frame.name: workers.submit(
            Task(
                frame,
                settings if not narrow or frame.name in tied else run.settings,
                catalog,
                run.solution,
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
        Frame name to `MatchedFrame` or `FailedFrame`.
    run : Run
        What they share with the others.
    workers : Workers
        Who does it.

    Returns
    -------
    dict
        As ``results``, with more matched frames.
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
