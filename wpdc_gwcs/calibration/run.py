"""A whole run: every frame matched, every detector solved, one summary."""

import gc
import itertools
import logging
import os
import time
import uuid
from collections import deque
from collections.abc import Mapping
from contextlib import nullcontext
from dataclasses import dataclass, field, replace

import numpy as np
from astropy.table import QTable

from wpdc_gwcs.calibration.batches import are_independent, batches_of
from wpdc_gwcs.calibration.exposures import tie_exposures
from wpdc_gwcs.calibration.manifest import plan_run
from wpdc_gwcs.calibration.matched import FailedFrame
from wpdc_gwcs.calibration.results import ResultFolder
from wpdc_gwcs.calibration.settings import Settings
from wpdc_gwcs.calibration.solving import Batch, solve_or_fail
from wpdc_gwcs.calibration.story import (
    say,
    tell_catalog,
    tell_frames,
    tell_outcome,
    tell_result,
)
from wpdc_gwcs.calibration.summary import summarize
from wpdc_gwcs.calibration.work import Run, begin_group, match_group, sky_of_frames
from wpdc_gwcs.calibration.workers import Workers, stored_of
from wpdc_gwcs.catalogs import (
    catalog_source,
    fill_motions,
    read_catalog,
    split_extension,
)
from wpdc_gwcs.counts import counted
from wpdc_gwcs.description import Described
from wpdc_gwcs.exceptions import (
    CatalogError,
    ClusterError,
    DuplicateFrameError,
    FitError,
    InternalError,
)
from wpdc_gwcs.frame import Frame
from wpdc_gwcs.frozen import freeze_attributes
from wpdc_gwcs.stages import announce, listening
from wpdc_gwcs.threads import one_blas_thread

__all__ = ["CalibrationRun", "calibrate"]

log = logging.getLogger(__name__)

# Number of frames between searches for reference cycles, each of which takes the time of one frame.
# Models and their parameters refer to each other.  Without a search, their tables, a megabyte for a
# frame, would stay in memory, because a few large objects never trigger one.
_FRAMES_PER_SEARCH = 100
# Maximum number of frames that wait for their solutions by workers, about a megabyte each.
_MOST_SOLVING = 1000


@dataclass(frozen=True, eq=False, repr=False)
class CalibrationRun(Described):
    """The results of a call of `calibrate`.

    Parameters
    ----------
    calibrations : tuple of `Calibration`
        One for each solved frame, in the order of the input; empty if they are only written to
        files.
    solutions : dict
        `DistortionSolution` of each detector, by name.
    failures : dict
        Error of each frame that could not be solved, by name.
    summary : `~astropy.table.QTable`
        One row per frame: status, reason, counts, residual statistics, seconds.
    superseded : dict
        Previous solution of each detector that has changed, by name.
    cameras : tuple of `Camera`
        One for each group of detectors that were solved together.
    run_id : str
        Identifier of the run, which is in all its files.
    resumed : tuple of str
        Frames of an earlier run whose results were read from its files.

    Examples
    --------
    >>> from wpdc_gwcs import calibrate, simulate
    >>> sky = simulate(1, image_shape=(512, 512), density=60, distortion=3, seed=1)
    >>> run = calibrate([sky.exposures[0].frame()], sky.reference)
    >>> run.calibrations[0].frame, list(run.solutions), run.failures
    ('sim-01', ['sim'], {})
    >>> print(run.summary["frame", "status", "n_sources", "n_matched"])
    frame  status n_sources n_matched
    ------ ------ --------- ---------
    sim-01 solved       387       349
    """

    calibrations: tuple
    solutions: dict
    failures: dict
    summary: QTable = field(repr=False)
    superseded: dict = field(default_factory=dict)
    cameras: tuple = ()
    run_id: str = ""
    resumed: tuple = ()

    def __post_init__(self):
        names = ("calibrations", "solutions", "failures", "superseded", "cameras", "resumed")
        freeze_attributes(self, *names)


@one_blas_thread
def calibrate(
    frames,
    catalog,
    *,
    solution=None,
    update=False,
    settings=None,
    jobs=1,
    executor=None,
    output=None,
    overwrite=False,
    resume=False,
    keep=True,
    progress=None,
):
    """Calibrate frames against a reference catalog.

    Parameters
    ----------
    frames : Frame or iterable of Frame
        What `wpdc_gwcs.io.read_frames` returns; names must be unique.
    catalog : path-like, Table, SkyCoord, GaiaArchive or HatsCatalog
        Reference catalog: anything that `read_catalog` accepts or returns.  Of ``"gaia"``,
        ``"hats:PATH"`` and large files, only the part around the frames is read.
    solution : DistortionSolution, Camera or mapping, optional
        Stored solution (of a camera, or detector name to solution).  Its distortion is kept; the
        attitude of each frame is fitted, and a field if there is evidence for one.
    update : bool, optional
        Merge the new frames into the stored solution, and adapt it if the detector has changed,
        instead of keeping it fixed.
    settings : Settings, optional
        Options; the defaults work for any camera.
    jobs : int, optional
        Number of processes that measure and match frames, and write their files.
    executor : concurrent.futures.Executor, optional
        Executor that measures and matches frames instead, for example
        ``dask.distributed.Client(...).get_executor()``.  Each frame is sent with the part of the
        catalog that it needs.
    output : path-like, optional
        Folder into which all results are written, made if needed; those of a detector as soon as
        it is solved.
    overwrite : bool, optional
        Replace existing files.
    resume : bool, optional
        Continue a run in the folder: skip frames that are already done with the same catalog,
        settings and versions.  Results of other frames are kept, with their rows of the summary,
        so a survey can grow night by night.
    keep : bool, optional
        Whether all calibrations are returned.  With `False` they are only written to ``output``,
        and memory is needed only for the frames in work, however many there are.
    progress : callable, optional
        Called as ``progress(stage, done, total)`` while the run goes on; for the stages of one
        frame, which have no number, as ``progress(stage, 0, 0)``.

    Returns
    -------
    CalibrationRun
        Frames that could not be solved are in ``failures`` and have no calibration.

    Raises
    ------
    DuplicateFrameError
        If two frames have the same name.
    TypeError
        If an argument is not a frame, for example if it is a path.
    ValueError
        If there is no frame, or ``update`` is asked for with ``method="paper"``.
    InputError
        If the catalog cannot be used, a file cannot be written or may not be replaced, or a run
        with different settings is to be resumed.
    ClusterError
        If the executor has no workers left; results so far are written.

    Warns
    -----
    WPDCWarning
        If frames cannot belong to one exposure as their headers claim, see `tie_exposures`.

    Notes
    -----
    All frames of a camera are solved together and are kept in memory until then.  With a stored
    ``solution`` that covers all its detectors and is not updated, they are solved and written in
    batches of 16 exposures.

    References
    ----------
    WPDC-2P, arXiv:2603.09193.

    Examples
    --------
    >>> from wpdc_gwcs import calibrate, simulate
    >>> sky = simulate(2, image_shape=(1000, 1000), density=30, distortion=10, seed=2)
    >>> run = calibrate([exposure.frame() for exposure in sky.exposures], sky.reference)
    >>> [str(status) for status in run.summary["status"]]
    ['solved', 'solved']
    >>> wcs = run.calibrations[0].wcs
    >>> x, y = wcs.invert(*wcs(100.0, 200.0))
    >>> print(f"{x:.6f} {y:.6f}")
    100.000000 200.000000
    """
    frames = _as_frames(frames)
    settings = Settings() if settings is None else settings
    if jobs < 1:
        raise ValueError(f"jobs must be at least 1, got {jobs}")
    if resume and output is None:
        raise ValueError("resume needs output, the folder of the run to resume")
    if not keep and output is None:
        raise ValueError("keep=False needs output, a folder for the calibrations")
    if update and settings.method == "paper":
        raise ValueError(
            "update needs method='wpdc': the paper's table is always made from scratch"
        )
    progress = progress or (lambda stage, done, total: None)
    solution = getattr(solution, "solutions", solution)
    frames = _named_apart(tie_exposures(frames)) if solution is None else tie_exposures(frames)
    folder = None if output is None else ResultFolder(output, overwrite=overwrite, resume=resume)
    with folder or nullcontext(), listening(lambda stage: progress(stage, 0, 0)):
        groups = batches_of(
            frames,
            settings,
            solution=solution,
            update=update,
            earlier=() if folder is None else folder.earlier_groups(),
        )
        say(tell_frames, frames, groups)
        catalog = catalog_source(catalog, max_mag=settings.max_mag)
        path = catalog if isinstance(catalog, str | os.PathLike) else None
        # Before the catalog is read, which may take a while.
        if folder is not None:
            folder.check(groups, inputs=[] if path is None else [split_extension(path)[0]])
        if not hasattr(catalog, "stars_of"):
            # A table in memory is used as a whole; of a file, the part for the run is read once.
            region = None if path is None else sky_of_frames(frames, settings, solution)
            began = time.perf_counter()
            catalog = fill_motions(read_catalog(catalog, region=region))
            say(tell_catalog, catalog, time.perf_counter() - began)
        run_id = uuid.uuid4().hex[:12]
        if folder is not None:
            plan = plan_run(
                run_id,
                groups,
                settings=settings,
                catalog=catalog,
                catalog_path=path,
                solution=solution,
                update=update,
            )
            run_id = folder.begin(groups, plan).run
        # For batches that depend on nothing else, workers also make the files.
        remote = not keep and are_independent(settings, solution=solution, update=update)
        run = Run(frames, catalog, solution, settings, update, progress, run_id if remote else None)
        done = [group for group in groups if folder is not None and folder.is_done(group)]
        outcomes = {group[0].name: folder.load(group, keep=keep) for group in done}
        todo = [group for group in groups if group[0].name not in outcomes]
        jobs = min(jobs, sum(map(len, todo)))
        with Workers(jobs, executor) as workers:
            for group, outcome in _outcomes(todo, run, workers):
                kept = outcome if keep else replace(outcome, calibrations=[], files={})
                outcomes[group[0].name] = kept
                for name, error in outcome.failures.items():
                    _log_details(name, error, folder)
                if folder is not None:
                    announce("files")
                    began = time.perf_counter()
                    folder.write(group, outcome, workers)
                    log.info(
                        "files: results of %s written to %s (%.1f s)",
                        counted(len(group), "frame"), output, time.perf_counter() - began,
                    )  # fmt: skip
                # This frees its tables before the next outcome.
                del outcome
    resumed = tuple(frame.name for group in done for frame in group)
    return _joined(frames, list(outcomes.values()), run_id, resumed)


def _as_frames(frames):
    """List of one or more frames, with unique names."""
    frames = [frames] if isinstance(frames, Frame) else list(frames)
    if not frames:
        raise ValueError("calibrate needs at least one frame")
    seen = {}
    for frame in frames:
        if not isinstance(frame, Frame):
            raise TypeError(
                f"frames must be Frame objects, as read_frames gives, got {type(frame).__name__}"
            )
        if frame.name in seen:
            raise DuplicateFrameError(
                f"frame names must be unique: {seen[frame.name].source} and {frame.source} would "
                f"both write {frame.name}.wcs.asdf; calibrate them into different folders"
            )
        seen[frame.name] = frame
    return frames


def _outcomes(groups, run, workers):
    """Yield each group with its outcome, while the next groups are being matched.

    Only as many tasks as keep the workers busy are started, so that memory does not grow with the
    run.  If a cluster or the archive of the catalog is lost, the started groups come first.
    """
    other = _of_other_detectors(run.frames, run.solution)
    counter, n_frames, n_past = itertools.count(1), sum(map(len, groups)), 0
    run.progress("match", 0, n_frames)
    waiting, begun, solving, lost = deque(groups), deque(), deque(), None

    def begin():
        """Start the matching of the next groups, at least one."""
        nonlocal lost
        while waiting and lost is None:
            in_hand = sum(len(work.tasks) for work in begun)
            if begun and in_hand >= workers.in_hand:
                break
            try:
                begun.append(begin_group(waiting.popleft(), run, workers, other))
            except (CatalogError, ClusterError) as err:
                lost = err

    for k in range(len(groups)):
        begin()
        if not begun:
            break
        work = begun[0]
        try:
            frames = {f.name: f for f in work.group}
            results = {name: other[name] for name in frames} if other else {}
            for name in list(work.tasks):
                results[name] = work.tasks.pop(name)()
                say(tell_result, frames[name], results[name], run.settings)
                run.progress("match", next(counter), n_frames)
                begin()
            batch = _batch_of(work, results, run, None if other else workers)
        except ClusterError as err:
            lost = lost or err
            continue
        finally:
            begun.popleft()
        solving.append(_Solving(batch, workers if run.remote else None))
        del work, results, batch
        while solving and (solving[0].is_done() or _too_many(solving, workers)):
            run.progress("solve", k, len(groups))
            n_past += len(solving[0].batch.frames)
            yield solving.popleft().answer()
            if n_past >= _FRAMES_PER_SEARCH:
                n_past = 0
                gc.collect()
    while solving:
        yield solving.popleft().answer()
    if lost is not None:
        raise lost
    run.progress("solve", len(groups), len(groups))


def _batch_of(work, results, run, workers):
    """Match frames that could not be matched alone; all that the solution of the group needs."""
    group, problem = work.group, None
    if workers is not None:
        try:
            results = match_group(work, results, run, workers)
        except ClusterError:
            raise
        except Exception as error:  # noqa: BLE001  One camera must not end the whole run.
            problem = error
    return Batch(
        group,
        results,
        settings=run.settings,
        solution={f.detector: stored_of(run.solution, f.detector) for f in group},
        update=run.update,
        holdout=None if work.catalog is None else _holdout_mask(work.catalog, run.settings),
        problem=problem,
        run=run.remote,
    )


class _Solving:
    """A batch that is being solved: by a worker, or here when its answer is asked for."""

    def __init__(self, batch, workers):
        self.batch = batch
        self._began = time.perf_counter()
        self._future = None if workers is None else workers.start(solve_or_fail, batch.alone())

    def is_done(self):
        return self._future is None or self._future.done()

    def answer(self):
        """Frames and their outcome."""
        announce("solution")
        outcome, batch = None, self.batch
        if self._future is not None:
            try:
                outcome = batch.complete(self._future.result())
            except Exception as problem:  # noqa: BLE001  Such as the death of a worker.
                log.info(
                    "solution: %s could not be solved by a worker, and are solved here: %s",
                    counted(len(batch.frames), "frame"), problem,
                )  # fmt: skip
                self._began = time.perf_counter()
        if outcome is None:
            outcome = solve_or_fail(replace(batch, run=None))
        say(tell_outcome, outcome, time.perf_counter() - self._began)
        return batch.frames, outcome


def _too_many(solving, workers):
    """Whether enough batches are being solved to keep the workers busy or to fill the memory."""
    n_frames = sum(len(one.batch.frames) for one in solving)
    return len(solving) > workers.in_hand or n_frames > _MOST_SOLVING


def _log_details(name, error, folder):
    """Log the details of an internal error, in a file if there is a folder."""
    if not isinstance(error, InternalError):
        return
    if folder is None:
        log.error("%s: %s\n%s", name, error, error.details)
    else:
        log.info("%s: %s: details in %s", name, error, folder.log(name, error))


def _joined(frames, outcomes, run_id, resumed):
    """Combine the outcomes of groups to the result of a run."""
    calibrations = {c.frame: c for outcome in outcomes for c in outcome.calibrations}
    rows = {row["frame"]: row for outcome in outcomes for row in outcome.rows}
    joined = {
        name: {k: v for outcome in outcomes for k, v in getattr(outcome, name).items()}
        for name in ("solutions", "failures", "superseded")
    }
    return CalibrationRun(
        calibrations=[calibrations[f.name] for f in frames if f.name in calibrations],
        summary=summarize([rows[frame.name] for frame in frames], run_id),
        cameras=[camera for outcome in outcomes for camera in outcome.cameras],
        run_id=run_id,
        resumed=resumed,
        **joined,
    )


# Maximum number of detectors named in a message.
_MOST_NAMED = 6


def _of_other_detectors(frames, solution):
    """Fail all frames if no stored solution belongs to any of their detectors."""
    if not isinstance(solution, Mapping) or {f.detector for f in frames} & set(solution):
        return {}
    names = [repr(name) for name in solution]
    named = ", ".join(names[:_MOST_NAMED]) + ", ..." * (len(names) > _MOST_NAMED)
    return {
        f.name: FailedFrame(
            FitError(
                f"{f.source}: the frame is from detector {f.detector!r}, the stored solutions are "
                f"for {named or 'none'}"
            ),
            0,
            0.0,
        )
        for f in frames
    }


def _named_apart(frames):
    """Frames with different names for detectors of different cameras."""
    cameras = {}
    for frame in frames:
        cameras.setdefault(frame.detector, set()).add(frame.camera)
    return [
        replace(frame, detector=f"{frame.camera}-{frame.detector}")
        if frame.camera is not None and len(cameras[frame.detector]) > 1
        else frame
        for frame in frames
    ]


def _holdout_mask(catalog, settings):
    """Rows of the catalog that are held out of every fit, the same in all frames."""
    if settings.holdout == 0:
        return None
    size = int(np.max(catalog["catalog_index"], initial=-1)) + 1
    return np.random.default_rng(settings.seed).uniform(size=size) < settings.holdout
