"""`wpdc monitor`: test whether a stored solution still holds, now and over a survey."""

import logging
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from wpdc_gwcs.cli.app import app
from wpdc_gwcs.cli.files import match_files, read_stored, read_with_wcs, wcs_beside
from wpdc_gwcs.cli.options import Overwrite, Quiet, Verbose, require_free, require_plotting
from wpdc_gwcs.counts import counted
from wpdc_gwcs.exceptions import FitError, InputError

log = logging.getLogger("wpdc_gwcs.cli")

# Maximum number of periods that are reported one by one.
_MOST_PERIODS = 40
_MOST_CELLS = 5
# What is said of frames whose residuals are not simply about the stored solution.
_OTHER_MAP = (
    "calibrated with another map than the stored one, so the residuals about the stored one were "
    "computed from their stars"
)
_NOT_CHECKED = (
    "no *.wcs.asdf file beside the match table, so it cannot be checked whether the frame was "
    "calibrated with this solution"
)
_LEFT_OUT = "left out: calibrated with another map, and too few stars for an attitude"


@app.command(
    "monitor",
    no_args_is_help=True,
    epilog="Example: wpdc monitor ccd1.solution.asdf tonight --every 1 --output drift.ecsv",
)
def monitor_command(
    solution: Annotated[
        Path,
        typer.Argument(
            metavar="SOLUTION",
            help="The stored *.solution.asdf, or *.camera.asdf for all detectors.",
        ),
    ],
    paths: Annotated[
        list[Path],
        typer.Argument(
            metavar="MATCHES...",
            help="Results of frames of its detectors: *.matches.ecsv, *.wcs.asdf or folders.",
        ),
    ],
    every: Annotated[
        float | None,
        typer.Option(
            metavar="DAYS", help="Test periods of this length in days separately; 1: each night."
        ),
    ] = None,
    false_alarm: Annotated[
        float,
        typer.Option(metavar="P", help="Accepted probability of any alarm without a change."),
    ] = 0.01,
    output: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Write the cells (ECSV); with --every write the periods, and their cells to FILE "
            "with .cells before its suffix.",
        ),
    ] = None,
    plots: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR", help="Also draw each detector over time, in total and cell by cell."
        ),
    ] = None,
    overwrite: Overwrite = False,
    verbose: Verbose = 0,
    quiet: Quiet = False,
):
    """Test whether a stored solution is still valid.

    The exit status is 1 if it is not.  The frames should have been calibrated with it: wpdc
    calibrate --solution SOLUTION.  For others, the residuals about it are computed from the
    positions of their stars.  The part of a change that the fields of single exposures have
    absorbed is added back.  All detectors of a camera are tested, and --false-alarm is shared by
    all detectors and periods.
    """
    from wpdc_gwcs.calibration.names import file_stem
    from wpdc_gwcs.io import write_table

    if plots is not None:
        require_plotting("--plots")
    if every is not None and not 0 < every < float("inf"):
        raise InputError(f"--every must be positive, in days, got {every:g}")
    if not 0 < false_alarm < 1:
        raise InputError(f"--false-alarm must be between 0 and 1, got {false_alarm:g}")
    cells_file = None
    if output is not None:
        require_free(output, overwrite, format="ecsv")
        if every is not None:
            cells_file = output.with_suffix(f".cells{output.suffix}")
            require_free(cells_file, overwrite)
    solutions = _solutions(solution)
    figures = {
        name: [plots / f"{file_stem(name)}.{kind}.png" for kind in ("history", "cells")]
        for name in (solutions if plots is not None else ())
    }
    for one in (file for files in figures.values() for file in files):
        require_free(one, overwrite)
    frames = _frames(match_files(paths), need_epochs=every is not None)
    mine = {name: _of_detector(frames, name) for name in solutions}
    if not any(mine.values()):
        named = ", ".join(sorted({str(f.detector) for f in frames})[:6])
        raise InputError(
            f"{solution}: is for detector {', '.join(solutions)}, the frames are from {named}: use "
            "a solution of their detector"
        )
    periods = {name: _periods(found, every) for name, found in mine.items() if found}
    share = false_alarm / sum(map(len, periods.values()))
    drifted, rows, cells = False, [], []
    for name, parts in periods.items():
        notes = {}
        drift = history = None
        if every is None:
            drift = _test(solutions[name], parts[0], share, notes)
        if every is not None or plots is not None:
            history = _follow(solutions[name], parts, share, notes)
        _warn(solutions[name], mine[name], notes)
        if every is None:
            drifted |= drift.drifted
            cells.append(_named(drift.cells, name))
            if not quiet:
                _tell(name, drift, len(parts[0]))
        if every is not None:
            drifted |= bool(len(history.alarms))
            rows.append(_named(history.periods, name))
            cells.append(_named(history.cells, name))
            if not quiet:
                _tell_history(history)
        if plots is not None:
            _draw(history, figures[name])
    if output is not None:
        write_table(_stacked(cells if every is None else rows), output, overwrite=overwrite)
    if cells_file is not None:
        write_table(_stacked(cells), cells_file, overwrite=overwrite)
    if drifted:
        typer.echo(
            "make a new solution from recent frames (wpdc calibrate), or update this one "
            "(wpdc calibrate --solution ... --update)",
            err=True,
        )
        raise typer.Exit(1)


@dataclass(frozen=True)
class _MonitoredFrame:
    """Match table of a frame, with its detector and epoch."""

    path: Path
    detector: str | None
    epoch: float

    def matches(self, solution, notes):
        """Read the residuals about a solution; note what is said of the frame, by its path."""
        from wpdc_gwcs.evaluation import has_map_of, residuals_of_attitude

        table, calibration = read_with_wcs(self.path)
        if calibration is None:
            notes[self.path] = _NOT_CHECKED
            return table
        shape = calibration.solution.image_shape
        if shape != solution.image_shape:
            raise InputError(
                f"{self.path}: must have the shape (ny, nx) of the stored solution, "
                f"{solution.image_shape}, has {shape}; give frames of this shape only"
            )
        if not has_map_of(calibration, solution):
            notes[self.path] = _OTHER_MAP
        try:
            return residuals_of_attitude(calibration, table, solution=solution)
        except FitError:
            notes[self.path] = _LEFT_OUT
            return table[:0]


def _solutions(path):
    from wpdc_gwcs.solution import DistortionSolution

    stored = read_stored(path, "monitor")
    if isinstance(stored, DistortionSolution):
        return {stored.detector: stored}
    return dict(stored.solutions)


def _frames(paths, *, need_epochs):
    """Detector and epoch of each table, from the summary of its folder or its WCS file."""
    known = {folder: _summary_of(folder) for folder in dict.fromkeys(p.parent for p in paths)}
    found = []
    for path in paths:
        name = path.name.removesuffix(".matches.ecsv")
        detector, epoch = known[path.parent].get(name, (None, np.nan))
        if detector is None or (need_epochs and not np.isfinite(epoch)):
            detector, epoch = _told_by_wcs(wcs_beside(path), detector)
        if need_epochs and not np.isfinite(epoch):
            raise InputError(
                f"{path}: --every needs an epoch, which neither summary.ecsv nor the *.wcs.asdf "
                "file beside it has (calibrate with --epoch)"
            )
        found.append(_MonitoredFrame(path, detector, epoch))
    return found


def _summary_of(folder):
    from wpdc_gwcs.io import read_table

    path = folder / "summary.ecsv"
    if not path.exists():
        return {}
    table = read_table(path)
    if not {"frame", "detector", "epoch"} <= set(table.colnames):
        return {}
    columns = (table[name] for name in ("frame", "detector", "epoch"))
    return {
        str(f): (str(d), float(getattr(e, "value", e))) for f, d, e in zip(*columns, strict=True)
    }


def _told_by_wcs(path, detector):
    from wpdc_gwcs.io import read

    if not path.exists():
        return detector, np.nan
    calibration = read(path)
    epochs = calibration.provenance.get("epochs") or (np.nan, np.nan)
    return calibration.solution.detector, float(np.mean(epochs))


def _of_detector(frames, name):
    """Frames of a detector; tables without the name of a detector are included."""
    return [frame for frame in frames if frame.detector in (name, None)]


def _periods(frames, every):
    from wpdc_gwcs.evaluation import split_periods

    if every is None:
        return [frames]
    parts = split_periods([frame.epoch for frame in frames], every)
    return [[frames[k] for k in part] for part in parts]


def _test(solution, frames, false_alarm, notes):
    from wpdc_gwcs.evaluation import detect_drift

    tables = (f.matches(solution, notes) for f in frames)
    try:
        return detect_drift(solution, tables, false_alarm=false_alarm)
    except ValueError as err:
        raise InputError(f"{solution.detector}: {err}") from err


def _follow(solution, periods, false_alarm, notes):
    from wpdc_gwcs.evaluation import track_drift

    told = (
        ([f.epoch for f in part], [f.matches(solution, notes) for f in part]) for part in periods
    )
    return track_drift(solution, told, false_alarm=false_alarm)


def _warn(solution, frames, notes):
    """Warn of frames that were not calibrated with the solution, or are not of its time."""
    for note, n in Counter(notes.values()).items():
        first = next(path for path, text in notes.items() if text == note)
        log.warning("%s: %s: %s", solution.detector, _share(n, frames, first), note)
    outside = [f for f in frames if np.isfinite(f.epoch) and not solution.holds_at(f.epoch)]
    if outside:
        log.warning(
            "%s: %s: of another time than the stored solution, which is valid %s",
            solution.detector,
            _share(len(outside), frames, outside[0].path),
            solution.validity,
        )


def _share(n, frames, first):
    also = ", ..." if n > 1 else ""
    return f"{n} of {counted(len(frames), 'frame')} ({first}{also})"


def _tell(name, drift, n_frames):
    verdict = "has drifted" if drift.drifted else "no drift found"
    typer.echo(
        f"{name}: {verdict} (p = {drift.p_value:.2g}, {counted(drift.n_stars, 'star')} in "
        f"{counted(n_frames, 'frame')})"
    )
    if drift.drifted:
        typer.echo(f"  by {drift.amplitude:.4f} px rms in {drift.area:.0%} of the detector")
    for cell in drift.cells[drift.cells["changed"]][:_MOST_CELLS]:
        typer.echo(
            f"  x {cell['x_min'].value:.0f} to {cell['x_max'].value:.0f}, "
            f"y {cell['y_min'].value:.0f} to {cell['y_max'].value:.0f}: "
            f"dx {cell['dx'].value:+.4f} +- {cell['sigma_dx'].value:.4f}, "
            f"dy {cell['dy'].value:+.4f} +- {cell['sigma_dy'].value:.4f} px"
        )


def _tell_history(history):
    alarms = history.alarms
    untested = int(np.sum(~np.isfinite(history.periods["p_value"])))
    also = f", {untested} with too few stars" if untested else ""
    typer.echo(
        f"{history.detector}: {counted(len(alarms), 'alarm')} in "
        f"{counted(len(history.periods), 'period')}{also}, "
        f"{counted(int(np.sum(history.periods['n_frames'])), 'frame')}"
    )
    for row in alarms[:_MOST_PERIODS]:
        typer.echo(
            f"  {row['first_epoch']:.4f} to {row['last_epoch']:.4f}: drifted by "
            f"{row['amplitude'].value:.4f} px rms in {row['area']:.0%} of the detector "
            f"(p = {row['p_value']:.2g}, {counted(row['n_stars'], 'star')} in "
            f"{counted(row['n_frames'], 'frame')})"
        )
    if len(alarms) > _MOST_PERIODS:
        typer.echo(f"  and {len(alarms) - _MOST_PERIODS} more: in the table of --output FILE")


def _named(table, detector):
    table = table.copy()
    table.add_column(np.full(len(table), detector), name="detector", index=0)
    return table


def _stacked(tables):
    from astropy.table import vstack

    return vstack(tables, metadata_conflicts="silent")


def _draw(history, files):
    from wpdc_gwcs import plotting
    from wpdc_gwcs.io.files import make_folder

    make_folder(files[0].parent)
    try:
        for plot, file in zip(
            (plotting.plot_drift_history, plotting.plot_cell_history), files, strict=True
        ):
            plot(history).savefig(file, dpi=110)
    except OSError as err:
        raise InputError(
            f"{files[0].parent}: the folder of --plots must be writable: {err.strerror}"
        ) from err
