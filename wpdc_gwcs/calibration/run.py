"""A whole run: every frame matched, every detector solved, one summary."""

import time
from collections import Counter
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from functools import partial
from multiprocessing import get_context

import numpy as np
from astropy.table import QTable, Table

from wpdc_gwcs.calibration.camera import cameras_of, solve_camera
from wpdc_gwcs.calibration.exposures import tie_exposures
from wpdc_gwcs.calibration.matched import FailedFrame, match_frame
from wpdc_gwcs.calibration.measure import measure_sources, quality_of
from wpdc_gwcs.calibration.mosaic import start_from_neighbors
from wpdc_gwcs.calibration.settings import Settings
from wpdc_gwcs.camera import build_camera
from wpdc_gwcs.catalogs import fill_motions
from wpdc_gwcs.exceptions import FitError, MatchError, WPDCError
from wpdc_gwcs.frame import Frame
from wpdc_gwcs.threads import one_blas_thread

__all__ = ["CalibrationRun", "calibrate"]


@dataclass(frozen=True, eq=False)
class CalibrationRun:
    """Everything a call of `calibrate` found.

    Parameters
    ----------
    calibrations : list of `Calibration`
        One for each solved frame, in the order of the input.
    solutions : dict
        Detector name to `DistortionSolution`.
    failures : dict
        Frame name to the error that kept it from being solved.
    summary : `~astropy.table.QTable`
        One row per frame: status, reason, counts, residual statistics, seconds.
    superseded : dict
        Detector name to the stored solution that an update has found changed, valid until then.
    cameras : list of `Camera`
        One for each group of detectors that were solved together.
    """

    calibrations: list
    solutions: dict
    failures: dict
    summary: QTable = field(repr=False)
    superseded: dict = field(default_factory=dict)
    cameras: list = field(default_factory=list)


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
    progress=None,
):
    """Calibrate frames against a reference catalogue.

    Parameters
    ----------
    frames : Frame or sequence of Frame
        What `wpdc_gwcs.io.read_frames` returns; names must be unique.
    catalog : `~astropy.table.Table`
        Reference catalogue as returned by `read_catalog`.
    solution : DistortionSolution, Camera or mapping, optional
        Stored solution (of a camera, or detector name to solution): only the attitudes of the
        frames are fitted.
    update : bool, optional
        Merge the new frames into the stored solution, and let it follow a change, instead of
        keeping it fixed.
    settings : Settings, optional
        Choices; the defaults work for any camera.
    jobs : int, optional
        Processes in which frames are measured and matched.
    executor : concurrent.futures.Executor, optional
        Where frames are measured and matched instead, for example
        ``dask.distributed.Client(...).get_executor()``.
    progress : callable, optional
        Called as ``progress(stage, done, total)`` while the run goes on.

    Returns
    -------
    CalibrationRun
        Frames that could not be solved are in ``failures`` and have no calibration.

    Raises
    ------
    ValueError
        If two frames have the same name, or there is none.

    Warns
    -----
    WPDCWarning
        If frames that are said to be of one exposure cannot be, see `tie_exposures`.

    References
    ----------
    WPDC-2P, arXiv:2603.09193.
    """
    frames = list(frames) if isinstance(frames, (list, tuple)) else [frames]
    settings = Settings() if settings is None else settings
    if not frames:
        raise ValueError("calibrate needs at least one frame")
    names = [frame.name for frame in frames]
    if len(set(names)) < len(names):
        twice = sorted({n for n in names if names.count(n) > 1})
        raise ValueError(f"frame names must be unique, got twice: {', '.join(twice)}")
    if jobs < 1:
        raise ValueError(f"jobs must be at least 1, got {jobs}")
    progress = progress or (lambda stage, done, total: None)
    # Once and from the whole catalogue: a star moves alike in all frames.
    catalog = fill_motions(catalog)
    frames = _named_apart(tie_exposures(frames)) if solution is None else tie_exposures(frames)

    solution = getattr(solution, "solutions", solution)
    common = {"catalog": catalog, "solution": solution, "settings": settings}
    results = _of_other_detectors(frames, solution)
    if not results:
        results = _match_exposures(frames, common, jobs, executor, progress)
    failures = {n: r.error for n, r in results.items() if isinstance(r, FailedFrame)}
    matched = [r for r in results.values() if not isinstance(r, FailedFrame)]

    solutions, calibrations, superseded, cameras = {}, {}, {}, []
    groups = cameras_of(matched)
    holdout = _holdout_mask(catalog, settings)
    for k, group in enumerate(groups):
        progress("solve", k, len(groups))
        stored = {
            name: _stored_of(solution, name)
            for name in {frame.detector for frame in group}
            if _stored_of(solution, name) is not None
        }
        solved, found, failed = solve_camera(
            group, settings, holdout=holdout, solution=stored, update=update
        )
        solutions |= solved
        for name, one in solved.items():
            if name in stored and one.valid_from != stored[name].valid_from:
                superseded[name] = replace(stored[name], valid_to=one.valid_from)
        if len(solved) > 1:
            cameras.append(_camera_of(group, solved, found))
        calibrations.update({c.frame: c for c in found})
        failures.update(failed)
    progress("solve", len(groups), len(groups))
    ordered = [calibrations[n] for n in names if n in calibrations]
    summary = _summarize(frames, results, calibrations, failures, settings)
    return CalibrationRun(ordered, solutions, failures, summary, superseded, cameras)


# Detectors named in a message.
_MOST_NAMED = 6


def _of_other_detectors(frames, solution):
    """Fail all frames if not one of the stored solutions is of a detector of theirs."""
    if not isinstance(solution, Mapping) or {f.detector for f in frames} & set(solution):
        return {}
    names = [repr(name) for name in solution]
    named = ", ".join(names[:_MOST_NAMED]) + ", ..." * (len(names) > _MOST_NAMED)
    return {
        f.name: FailedFrame(
            FitError(
                f"{f.source}: the frame is of detector {f.detector!r}, the stored solutions are of "
                f"{named or 'none'}"
            ),
            0,
            0.0,
        )
        for f in frames
    }


def _named_apart(frames):
    """Frames whose detectors have different names where they are of different cameras."""
    cameras = {}
    for frame in frames:
        cameras.setdefault(frame.detector, set()).add(frame.camera)
    return [
        replace(frame, detector=f"{frame.camera}-{frame.detector}")
        if frame.camera is not None and len(cameras[frame.detector]) > 1
        else frame
        for frame in frames
    ]


def _camera_of(group, solutions, calibrations):
    """Camera of the detectors of a group, by the exposures that they share."""
    exposures = {}
    frames = {f.name: f for f in group}
    for c in calibrations:
        exposures.setdefault(frames[c.frame].exposure or c.frame, []).append(c)
    name = next((f.camera for f in group if f.camera), "camera")
    first = next(iter(solutions.values()))
    return build_camera(name, list(exposures.values()), solutions, provenance=first.provenance)


def _match_exposures(frames, common, jobs, executor, progress):
    """Match frames alone, then from their neighbors: frame name to `MatchedFrame` or error.

    A blind search takes ten times as long, above all to find nothing: in an exposure of several
    detectors it is left for those that neither they themselves nor their neighbors could match.
    """
    settings = common["settings"]
    keys = [(f.camera, f.exposure) for f in frames]
    counts = Counter(key for key in keys if None not in key)
    tied = {f.name for f, key in zip(frames, keys, strict=True) if counts[key] > 1}
    narrow = replace(settings, blind=False)
    tasks = [_Task(f, narrow if f.name in tied else settings) for f in frames]
    results = _match_frames(tasks, common, jobs, executor, progress)
    results = start_from_neighbors(frames, results, **common)
    if not (settings.blind and tied):
        return results
    tasks = [
        _Task(f, settings, results[f.name].sources)
        for f in frames
        if f.name in tied
        and isinstance(results[f.name], FailedFrame)
        and isinstance(results[f.name].error, MatchError)
    ]
    if not tasks:
        return results
    again = _match_frames(tasks, common, jobs, executor, lambda stage, done, total: None)
    if all(isinstance(result, FailedFrame) for result in again.values()):
        return results | again
    return start_from_neighbors(frames, results | again, **common)


@dataclass(frozen=True, eq=False)
class _Task:
    """A frame to be matched, how, and its sources where they have been measured."""

    frame: Frame
    settings: Settings
    sources: Table | None = None


@one_blas_thread
def _match_or_fail(task, catalog, solution):
    began = time.perf_counter()
    frame, sources = task.frame, task.sources
    try:
        stored = _stored_for(solution, frame)
        if sources is None:
            sources = measure_sources(frame, task.settings)
        return match_frame(frame, catalog, task.settings, sources=sources, solution=stored)
    except WPDCError as err:
        n_sources = 0 if sources is None else len(sources)
        return FailedFrame(err, n_sources, time.perf_counter() - began, sources)


# A worker process is given the catalogue once, not with each frame.
_in_worker = {}


def _start_worker(**common):
    _in_worker.update(common)


def _match_in_worker(task):
    return _match_or_fail(task, **_in_worker)


def _match_frames(tasks, common, jobs, executor, progress):
    """Frame name to `MatchedFrame` or error, in the order of the tasks."""
    common = {name: common[name] for name in ("catalog", "solution")}
    results = {}

    def collect(run):
        for task, result in zip(tasks, run, strict=True):
            results[task.frame.name] = result
            progress("match", len(results), len(tasks))
        return results

    progress("match", 0, len(tasks))
    if executor is not None:
        return collect(executor.map(partial(_match_or_fail, **common), tasks))
    if jobs == 1 or len(tasks) == 1:
        return collect(map(partial(_match_or_fail, **common), tasks))
    with ProcessPoolExecutor(
        min(jobs, len(tasks)),
        mp_context=get_context("spawn"),
        initializer=partial(_start_worker, **common),
    ) as pool:
        try:
            return collect(pool.map(_match_in_worker, tasks))
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def _stored_of(solution, detector):
    """Pick the stored solution of a detector: solutions come alone or by detector."""
    return solution.get(detector) if isinstance(solution, Mapping) else solution


def _stored_for(solution, frame):
    """Find the stored solution of a frame, and refuse one of another detector."""
    solution = _stored_of(solution, frame.detector)
    if solution is not None and tuple(solution.image_shape) != tuple(frame.image_shape):
        raise FitError(
            f"{frame.source}: the frame has shape (ny, nx) {tuple(frame.image_shape)}, the stored "
            f"solution is for {tuple(solution.image_shape)}"
        )
    if solution is not None and frame.detector != solution.detector:
        raise FitError(
            f"{frame.source}: the frame is of detector {frame.detector!r}, the stored solution of "
            f"{solution.detector!r}; if they are one, name it (--detector {solution.detector})"
        )
    return solution


def _holdout_mask(catalog, settings):
    """Rows of the catalogue that are kept out of every fit, the same in all frames."""
    if settings.holdout == 0:
        return None
    size = int(np.max(catalog["catalog_index"])) + 1
    return np.random.default_rng(settings.seed).uniform(size=size) < settings.holdout


def _summarize(frames, results, calibrations, failures, settings):
    """One row per frame, whatever became of it."""
    rows = []
    for frame in frames:
        found = calibrations.get(frame.name)
        result = results[frame.name]
        row = {
            "frame": frame.name,
            "detector": frame.detector,
            "camera": frame.camera or "",
            "exposure": frame.exposure or "",
            "status": "failed" if found is None else found.statistics["status"],
            "reason": " ".join(str(failures[frame.name]).split())
            if found is None
            else "; ".join(found.statistics["reasons"]),
            "n_sources": result.n_sources,
            "n_matched": 0 if found is None else found.statistics["n_matched"],
        }
        # A frame may be matched with good evidence and fail afterwards.
        evidence = getattr(result, "diagnostics", None)
        for name in ("n_pairs", "n_ambiguous"):
            row[name] = getattr(evidence, name, 0)
        for name in ("expected_by_chance", "purity", "completeness", "significance"):
            row[name] = getattr(evidence, name, np.nan)
        statistics = {} if found is None else found.statistics
        inside, outside = (statistics.get(key, {}) for key in ("residuals", "holdout"))
        for name in ("mean_dx", "sigma_dx", "mean_dy", "sigma_dy"):
            row[name] = inside.get(name, np.nan)
        for name in ("sigma_dx", "sigma_dy"):
            row[f"holdout_{name}"] = outside.get(name, np.nan)
        row["rms_mas"] = statistics.get("rms_mas", np.nan)
        row["seconds"] = statistics.get("seconds", result.seconds)
        row |= quality_of(frame, result.sources, settings)
        rows.append(row)
    table = QTable(rows)
    for name in table.colnames:
        if "_d" in name:
            table[name].unit = "pix"
    table["rms_mas"].unit, table["seconds"].unit, table["fwhm"].unit = "mas", "s", "pix"
    return table
