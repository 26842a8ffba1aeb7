"""The 18 detectors with the literal and the default method: tables 1 and 2, figures 1 and 6.

::

    simulate --25 fields of a detector--> calibrate, both methods --> pool_residuals (table 2)
                                                                  --> score_frame (error of the WCS)
"""

from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from multiprocessing import get_context
from typing import NamedTuple

import numpy as np
from astropy.table import QTable

from wpdc_gwcs.calibration import Settings, calibrate
from wpdc_gwcs.evaluation import (
    format_table,
    pool_residuals,
    pool_scores,
    uncorrected_residuals,
)
from wpdc_gwcs.io import atomic_path, write_table
from wpdc_gwcs.plotting import plot_before_after, plot_focal_plane
from wpdc_gwcs.reproduction.results import tabulate_results
from wpdc_gwcs.reproduction.scale import SEED
from wpdc_gwcs.reproduction.scoring import CLOSE_PX, score_run
from wpdc_gwcs.simulation import simulate

__all__ = ["METHODS", "calibrate_fields", "reproduce_detectors", "simulate_fields"]

# The literal method of the paper, and the default method.
METHODS = {"literal": "paper", "ours": "wpdc"}
# The detector that is shown in the paper.
_SHOWN = "g-1"


def simulate_fields(detector, scale, *, seed):
    """Simulate the fields of a detector.

    Parameters
    ----------
    detector : str
        Name of a detector of the camera ``csst-msc``.
    scale : Scale
        Size of the reproduction.
    seed : int
        Seed of the camera and of the fields.

    Returns
    -------
    Simulation
        One exposure per field, with an exact catalog.
    """
    return simulate(
        1,
        camera="csst-msc",
        detectors=[detector],
        seed=seed,
        **scale.fields(seed),
        **scale.camera,
    )


def calibrate_fields(simulation, scale, *, method="wpdc", jobs=1, **settings):
    """Calibrate the fields of a detector.

    Parameters
    ----------
    simulation : Simulation
        As from `simulate_fields`.
    scale : Scale
        Size of the reproduction.
    method : {"wpdc", "paper"}, optional
        The default method, or the literal one of the paper.
    jobs : int, optional
        Number of processes that match frames.
    **settings
        Options of `~wpdc_gwcs.calibration.Settings`.

    Returns
    -------
    CalibrationRun
        The results.
    """
    return calibrate(
        [exposure.frame() for exposure in simulation.exposures],
        simulation.reference,
        settings=Settings(method=method, r0=scale.r0, **settings),
        jobs=jobs,
    )


def _quantities(pooled, score):
    s = pooled.statistics
    moments = ("mean_dx", "sigma_dx", "mean_dy", "sigma_dy")
    return {
        **{(name, "pix"): getattr(s, name) for name in moments},
        ("wcs_rms", "pix"): score.wcs_rms,
        # The error common to all exposures; the rest is the noise of single exposures.
        ("wcs_rms_static", "pix"): score.wcs_rms_static,
        ("wcs_max", "pix"): score.wcs_max,
        ("share_below_0p01", ""): score.share_below,
        # The paper has no truth: it counts the cells of its map with a short mean residual.
        ("share_of_cells_below_0p01", ""): pooled.share_below,
        ("n_stars", ""): s.n,
        ("n_wrong", ""): score.n_wrong_used,
    }


def reproduce_detectors(folder, scale, *, seed=SEED, jobs=1, progress=None):
    """Reproduce the paper's results for the detectors of the Main Survey Camera.

    Parameters
    ----------
    folder : Path
        Existing folder for tables and figures.
    scale : Scale
        Size of the reproduction.
    seed : int, optional
        Seed of the camera and of the fields.
    jobs : int, optional
        Number of processes, each with one detector at a time.
    progress : callable, optional
        Called as ``progress("detectors", done, total)``.

    Returns
    -------
    `~astropy.table.QTable`
        See `~wpdc_gwcs.reproduction.results.tabulate_results`.

    Notes
    -----
    Writes ``table2-literal``, ``table2-ours`` (``.txt`` and ``.tex``), ``table1-g-1.ecsv``,
    ``focal-plane.png``, and ``before-after-g-1-literal.png`` and ``-ours.png``.

    Examples
    --------
    >>> from wpdc_gwcs.reproduction import CLAIMS
    >>> len({c.item for c in CLAIMS if c.part == "detectors" and c.source == "table 2"})
    18
    """
    found, pooled, shown = {}, {name: [] for name in METHODS}, []
    made = _in_processes(partial(_reproduce_one, folder, scale, seed), scale.detectors, jobs)
    for done, (detector, one) in enumerate(zip(scale.detectors, made, strict=True)):
        for name in METHODS:
            pooled[name].append(one.residuals[name])
        shown.append(one.shown)
        found[detector, "largest_distortion", "pix"] = (one.distortion, one.distortion)
        for quantity, unit in one.numbers["ours"]:
            values = [one.numbers[name].get((quantity, unit), np.nan) for name in METHODS]
            found[detector, quantity, unit] = values
        if progress is not None:
            progress("detectors", done + 1, len(scale.detectors))
    size = max(v[0] for (_, quantity, _), v in found.items() if quantity == "largest_distortion")
    found["all", "largest_distortion", "pix"] = (size, size)
    for name, residuals in pooled.items():
        for form, suffix in (("ascii", "txt"), ("latex", "tex")):
            with atomic_path(folder / f"table2-{name}.{suffix}", overwrite=True) as temporary:
                temporary.write_text(format_table(residuals, form=form), encoding="utf-8")
    _draw_focal_plane(shown, scale, seed, folder)
    return tabulate_results("detectors", found)


class _Detector(NamedTuple):
    """Results of one detector: numbers and residuals by method, and a frame for the figure."""

    numbers: dict
    residuals: dict
    shown: object
    distortion: float


def _reproduce_one(folder, scale, seed, detector):
    """Calibrate one detector with both methods."""
    simulation = simulate_fields(detector, scale, seed=seed)
    numbers, pooled = {}, {}
    for name, method in METHODS.items():
        run = calibrate_fields(simulation, scale, method=method)
        pooled[name] = pool_residuals(run.calibrations, limit=CLOSE_PX)[0]
        numbers[name] = _quantities(pooled[name], pool_scores(score_run(simulation, run))[0])
        if detector == _SHOWN:
            numbers[name] |= _draw_shown(run, name, folder)
        if name == "ours":
            shown = run.calibrations[0]
        # From here on, only the residuals are needed of the rest.
        del run
    return _Detector(numbers, pooled, shown, simulation.distortion.greatest())


def _in_processes(function, values, jobs):
    """Results of a function, in the order of the values, by several processes at a time."""
    if jobs == 1:
        yield from map(function, values)
        return
    with ProcessPoolExecutor(min(jobs, len(values)), mp_context=get_context("spawn")) as pool:
        try:
            yield from pool.map(function, values)
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def _draw_shown(run, name, folder):
    """Draw the detector shown in the paper, and write its look-up table."""
    solution = run.calibrations[0].solution
    axes = plot_before_after(
        [uncorrected_residuals(c) for c in run.calibrations],
        [c.matches for c in run.calibrations],
        image_shape=solution.image_shape,
        titles=("linear WCS", f"{solution.detector}, {name}"),
    )
    axes[0, 0].figure.savefig(folder / f"before-after-{solution.detector}-{name}.png", dpi=110)
    table = solution.lookup_table
    if table is None:
        return {}
    x, y = np.meshgrid(table.x_grid, table.y_grid)
    dx, dy = np.asarray(table.dx), np.asarray(table.dy)
    columns = {"X_grid": x, "Y_grid": y, "dX_LUT": dx, "dY_LUT": dy}
    listed = QTable({key: value.ravel() for key, value in columns.items()})
    write_table(listed, folder / f"table1-{solution.detector}-{name}.ecsv", overwrite=True)
    ends = {"first": (0, 0), "last": (-1, -1)}
    return {
        (f"table_{axis}_{end}", "pix"): float(values[at])
        for end, at in ends.items()
        for axis, values in (("dx", dx), ("dy", dy))
    }


def _draw_focal_plane(calibrations, scale, seed, folder):
    """Draw the solved distortions at the positions of the detectors, for one pointing."""
    one = simulate(
        1,
        camera="csst-msc",
        detectors=list(scale.detectors),
        seed=seed,
        density=0.0,
        **scale.camera,
    )
    headers = {exposure.detector: exposure.wcs.wcs for exposure in one.exposures}
    placed = [
        replace(
            c, crval=headers[c.solution.detector].crval, cd=headers[c.solution.detector].cd,
            field=None,
        )
        for c in calibrations
    ]  # fmt: skip
    axes = plot_focal_plane(placed)
    axes.figure.savefig(folder / "focal-plane.png", dpi=130, bbox_inches="tight")
