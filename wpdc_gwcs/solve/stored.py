"""A stored solution as a table of the model, and its update by new exposures.

::

    residuals about the stored table = change (common) + field (each exposure) + noise
        --evidence--> no change: residuals are pooled with the stored ones
                      a change: the stored ones are shifted by it and downweighted, then pooled
"""

from dataclasses import dataclass, replace

import numpy as np

from wpdc_gwcs.lookup import TableChoice, build_lookup_table, choose_table
from wpdc_gwcs.models import LookupTable
from wpdc_gwcs.solve.change import AGAINST_CHANGE, POINTS
from wpdc_gwcs.solve.fields import with_fields
from wpdc_gwcs.solve.model import undistorted
from wpdc_gwcs.solve.tables import residual_maps

__all__ = ["StoredMap", "unswallowed_maps", "updated_solution"]


@dataclass(frozen=True, eq=False)
class StoredMap:
    """Displacements that a stored solution subtracts: pixel minus undistorted pixel.

    Parameters
    ----------
    solution : DistortionSolution
        The instrument.
    """

    solution: object

    def __call__(self, x, y):
        """Return the displacement of pixels.

        Parameters
        ----------
        x, y : (N,) ndarray
            Pixels.

        Returns
        -------
        (2, N) ndarray
            Px.
        """
        return np.array([x, y]) - np.array(self.solution.undistort(x, y))


def unswallowed_maps(o, state, group, base, commons):
    """Build residual maps without the fields of exposures, but with common residuals.

    Parameters
    ----------
    o : Observations
        Pairs.
    state : State
        Solved about the stored solution.
    group : (N,) ndarray of int
        Group of each pair in cross-validation.
    base : sequence of callable
        Displacements to add back for each detector instead of its current table.
    commons : dict
        Common `Change` of the exposures of each detector.

    Returns
    -------
    list of ResidualMap
        One for each detector.
    """
    model = state.model.changed(fields={}, statics=commons)
    fields = {}
    if any(state.spectra.values()):
        spectra = {}
        for e, own in state.spectra.items():
            common = next(
                (commons[int(o.detector_of[f])].field for f in o.frames_of(e)
                 if int(o.detector_of[f]) in commons), None
            )  # fmt: skip
            spectra[e] = own and common and replace(common, kind=own.kind)
        fields = with_fields(o, replace(state, model=model, spectra=spectra)).model.fields
    return residual_maps(o, replace(state, model=model.changed(fields=fields, statics={})),
                         group, base)  # fmt: skip


def change_on(o, state, k, change, x, y):
    """Return the displacement of pixels by a change, and its covariance.

    Parameters
    ----------
    o : Observations
        Pairs.
    state : State
        Solved about the stored solution.
    k : int
        Number of the detector.
    change : Change
        Change of the focal plane.
    x, y : (N,) ndarray
        Pixels.

    Returns
    -------
    moved : (2, N) ndarray
        Px along the axes of the detector.
    covariance : (2, 2, N) ndarray
        Px^2.
    """
    inverse = np.linalg.inv(state.model.geometry.matrix[k])
    focal = undistorted(state.model.changed(statics={}), k, o.detectors[k], x, y)
    covariance = np.einsum("ia,abn,jb->ijn", inverse, change.covariance(focal), inverse)
    return inverse @ change(focal), covariance


def updated_solution(o, state, k, change, solution, new, n_grid):
    """Add the residuals of new exposures to a stored solution, and make a new table.

    Parameters
    ----------
    o : Observations
        Pairs.
    state : State
        Solved about the stored solution.
    k : int
        Number of the detector.
    change : Change or None
        Change found in the new exposures; `None` if the detector has none.
    solution : DistortionSolution
        The stored solution.
    new : ResidualMap
        Residuals of the new exposures about its polynomial.
    n_grid : int
        Nodes of the table along each axis.

    Returns
    -------
    solution : DistortionSolution
        Updated solution; ``statistics["updates"]`` has a new entry.
    info : TableInfo
        Information about its table.
    """
    entry = {
        "n_exposures": 0 if change is None else len({
            int(o.exposure_of[f]) for f in state.active if o.detector_of[f] == k
        }),
        "process_noise": 0.0, "evidence": 0.0, "rms_change_px": 0.0, "max_change_px": 0.0,
    }  # fmt: skip
    old = solution.residual_map
    moved = change is not None and change.variance > 0
    if change is not None:
        entry |= {"process_noise": change.variance, "evidence": change.gain - AGAINST_CHANGE}
    if moved:
        old, summary = follow(o, state, k, change, solution)
        entry |= summary
    merged = old + new
    # The table of a detector in a mosaic depends on the stars of others, too.
    of_mosaic = "optics" in solution.statistics.get("learned", {}) or len(o.detectors) > 1
    choice, candidates = (TableChoice("none"), ()) if of_mosaic else choose_table(merged)
    table, info = build_lookup_table(merged, n_grid, choice=choice)
    sigma, info = info.sigma, replace(info, candidates=candidates)
    if table is None:
        table, sigma, info = solution.lookup_table, solution.table_sigma, None
        if change is not None:
            table = _moved_table(o, state, k, change, table, n_grid)
    if change is not None:
        # The table accounts for the errors of stars, not for the fields of exposures.
        x, y = o.detectors[k].grid(n_grid)
        _, covariance = change_on(o, state, k, change, x, y)
        spread = covariance[[0, 1], [0, 1]]
        if not moved:
            # Keep a larger uncertainty of the stored map.
            before = solution.covariance(x, y)[[0, 1], [0, 1]]
            if np.all(before > 0):
                spread = before * min(np.mean(spread) / np.mean(before), 1.0)
        spread = np.sqrt(spread).reshape(2, n_grid, n_grid)
        if info is None:
            sigma = np.array([*spread, np.zeros_like(spread[0])])
        else:
            sigma = np.array([*np.maximum(sigma[:2], spread), sigma[2]])
    statistics = {**solution.statistics,
                  "updates": [*solution.statistics.get("updates", []), entry]}  # fmt: skip
    return replace(
        solution, lookup_table=table, table_sigma=sigma, residual_map=merged,
        statistics=statistics,
    ), info  # fmt: skip


def _moved_table(o, state, k, change, table, n_grid):
    """Table of a detector after a change, even if it had none before."""
    if not np.any(change.coefficients):
        return table
    if table is None:
        shape = o.detectors[k].image_shape
        edges = [np.linspace(-0.5, n - 0.5, n_grid) for n in shape[::-1]]
        zero = np.zeros((n_grid, n_grid))
        table = LookupTable(*edges, zero, zero)
    x, y = np.meshgrid(table.x_grid, table.y_grid)
    shift, _ = change_on(o, state, k, change, x.ravel(), y.ravel())
    dx, dy = np.array([table.dx, table.dy]) - shift.reshape(2, *x.shape)
    return LookupTable(table.x_grid, table.y_grid, dx, dy, method=table.method)


def follow(o, state, k, change, solution):
    """Return the residual map of a stored solution after a change, and a summary of it.

    Parameters
    ----------
    o : Observations
        Pairs.
    state : State
        Solved about the stored solution.
    k : int
        Number of the detector.
    change : Change
        The change.
    solution : DistortionSolution
        The stored solution.

    Returns
    -------
    residual_map : ResidualMap
        Shifted map, downweighted according to the uncertainty of the change.
    summary : dict
        ``rms_change_px`` and ``max_change_px`` over the detector.
    """
    x, y = o.detectors[k].grid(POINTS)
    moved, covariance = change_on(o, state, k, change, x, y)
    size = np.hypot(*moved)
    before = np.nanmean(solution.covariance(x, y)[[0, 1], [0, 1]])
    if not np.isfinite(before):
        before = 0.0
    added = float(np.mean(covariance[[0, 1], [0, 1]]))
    factor = before / (before + added) if before + added > 0 else 1.0
    total = solution.residual_map
    centers = np.nan_to_num(total.centroid)
    at, _ = change_on(o, state, k, change, *centers.reshape(2, -1))
    residual_map = total.displaced(*-at.reshape(2, *total.shape)).weighted(factor)
    return residual_map, {
        "rms_change_px": float(np.sqrt(np.mean(size**2))),
        "max_change_px": float(size.max()),
    }
