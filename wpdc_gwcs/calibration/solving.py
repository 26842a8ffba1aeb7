"""Frames that have been matched, solved together: in this process, or in a worker with their files.

::

    Batch --solve_or_fail--> Outcome (calibrations, or the bytes of their files)
"""

from dataclasses import dataclass, replace

import numpy as np
from astropy.table import Table

from wpdc_gwcs.calibration.camera import cameras_of, solve_camera
from wpdc_gwcs.calibration.matched import FailedFrame
from wpdc_gwcs.calibration.results import Outcome, with_files
from wpdc_gwcs.calibration.settings import Settings
from wpdc_gwcs.calibration.summary import summary_row
from wpdc_gwcs.calibration.workers import internal_error, without_maps
from wpdc_gwcs.camera import build_camera
from wpdc_gwcs.exceptions import WPDCError, without_frames

__all__ = ["Batch", "solve_or_fail"]


@dataclass(frozen=True, eq=False)
class Batch:
    """Frames that are solved together, and what their solution needs.

    Parameters
    ----------
    frames : list of Frame
        The frames.
    results : dict
        `MatchedFrame` or `FailedFrame` by frame name.
    settings : Settings
        Settings.
    solution : dict
        Stored solutions by detector; None for those without one.
    update : bool
        Whether stored solutions are updated.
    holdout : (n,) ndarray of bool or None
        Stars of the catalog that are kept out of every fit.
    problem : Exception or None
        Why the frames cannot be solved; None if nothing is known against it.
    run : str or None
        Identity of the run whose files are made with the solution; None if they are made later.
    """

    frames: list
    results: dict
    settings: Settings
    solution: dict
    update: bool
    holdout: np.ndarray | None
    problem: Exception | None
    run: str | None

    def alone(self):
        """Return the batch for another process, without what its solution does not need.

        Returns
        -------
        Batch
            Batch with the result that `complete` makes the same.
        """
        # The frames have been measured and load nothing more.
        unloaded = {"load_image": None, "load_mask": None, "load_weight": None}
        frames = [replace(f, load_sources=Table, **unloaded) for f in self.frames]
        solution = self.solution if self.update else without_maps(self.solution)
        return replace(self, frames=frames, solution=solution)

    def complete(self, outcome):
        """Put back what `alone` has left out.

        Parameters
        ----------
        outcome : Outcome
            Result of the batch of another process.

        Returns
        -------
        Outcome
            Result of the batch.  Stored solutions share their tables with those of all batches.
        """
        if self.update:
            return outcome

        def completed(solutions):
            return {name: _with_tables(one, self.solution[name]) for name, one in solutions.items()}

        cameras = [replace(c, solutions=completed(c.solutions)) for c in outcome.cameras]
        return replace(outcome, solutions=completed(outcome.solutions), cameras=cameras)


def _with_tables(solution, stored):
    """Give a solution the tables of the stored one, if there is one: they have not changed."""
    if stored is None:
        return solution
    names = ("lookup_table", "table_sigma", "residual_map")
    return replace(solution, **{name: getattr(stored, name) for name in names})


def solve_or_fail(batch):
    """Solve frames that have been matched.

    Parameters
    ----------
    batch : Batch
        The frames.

    Returns
    -------
    Outcome
        The result, in any case; with the files of the frames and without their calibrations if the
        batch asks for files.
    """
    try:
        if batch.problem is not None:
            raise batch.problem
        outcome = _solve(batch)
    except Exception as problem:  # noqa: BLE001  One camera must not end the whole run.
        error = problem if isinstance(problem, WPDCError) else internal_error(problem)
        without_frames(error)
        return Outcome(
            failures={frame.name: error for frame in batch.frames},
            rows=[
                summary_row(f, batch.results[f.name], None, error, batch.settings)
                for f in batch.frames
            ],
        )
    return outcome if batch.run is None else with_files(outcome, batch.run)


def _solve(batch):
    """Solve the frames camera by camera."""
    frames, results = batch.frames, batch.results
    outcome = Outcome()
    outcome.failures.update({n: r.error for n, r in results.items() if isinstance(r, FailedFrame)})
    matched = [r for r in results.values() if not isinstance(r, FailedFrame)]
    calibrations = {}
    for camera in cameras_of(matched):
        stored = {
            name: batch.solution[name]
            for name in {frame.detector for frame in camera}
            if batch.solution[name] is not None
        }
        solved, found, failed = solve_camera(
            camera, batch.settings, holdout=batch.holdout, solution=stored, update=batch.update
        )
        outcome.solutions.update(solved)
        for name, one in solved.items():
            if name in stored and one.valid_from != stored[name].valid_from:
                outcome.superseded[name] = replace(stored[name], valid_to=one.valid_from)
        if len(solved) > 1:
            outcome.cameras.append(_camera_of(camera, solved, found))
        calibrations.update({c.frame: c for c in found})
        outcome.failures.update({name: without_frames(error) for name, error in failed.items()})
    outcome.calibrations.extend(calibrations[f.name] for f in frames if f.name in calibrations)
    outcome.rows.extend(
        summary_row(
            f,
            results[f.name],
            calibrations.get(f.name),
            outcome.failures.get(f.name),
            batch.settings,
        )
        for f in frames
    )
    n_fields = sum(c.field is not None for c in outcome.calibrations)
    return replace(outcome, n_fields=n_fields)


def _camera_of(group, solutions, calibrations):
    """Camera of the detectors of a group, by the exposures that they share."""
    exposures = {}
    frames = {f.name: f for f in group}
    for c in calibrations:
        exposures.setdefault(frames[c.frame].exposure or c.frame, []).append(c)
    name = next((f.camera for f in group if f.camera), "camera")
    first = next(iter(solutions.values()))
    return build_camera(name, list(exposures.values()), solutions, provenance=first.provenance)
