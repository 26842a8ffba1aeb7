"""Results of a solved state: one solution per detector, one fit per exposure."""

from dataclasses import asdict, replace

import numpy as np

from wpdc_gwcs.solve.exposure import SolveResult
from wpdc_gwcs.solve.own_polynomial import own_polynomial
from wpdc_gwcs.solve.represent import (
    delivered_residual,
    frame_fit,
    represent_detector,
    represent_frame,
    unknown_errors,
)
from wpdc_gwcs.solve.state import all_residuals
from wpdc_gwcs.solve.strength import summarize_fields
from wpdc_gwcs.solve.tables import residual_maps

__all__ = ["frozen_result"]


def frozen_result(o, state, stored, infos, group, settings, cd, update):
    """Return the frozen results of a solved state.

    Parameters
    ----------
    o : Observations
        All stars.
    state : State
        Solved state.
    stored : dict
        Previous `~wpdc_gwcs.solution.DistortionSolution` of detectors, by name.
    infos : list
        `TableInfo` of each detector, `None` without a table.
    group : ndarray of int
        Fold of each star, see `~wpdc_gwcs.solve.tables.folds`.
    settings : dict
        ``n_grid``, ``lut``, ``refine``, ``degree``, ``pv_degree``, ``weight`` and other
        settings for the solutions.
    cd : (2, 2) ndarray or None
        Nominal linear map, deg / px.
    update : bool
        Whether stored solutions are updated.

    Returns
    -------
    SolveResult
        Solutions of the detectors and fits of the exposures.
    """
    n_grid, lut, refine, degree = (settings[k] for k in ("n_grid", "lut", "refine", "degree"))
    pv_degree = settings["pv_degree"]
    solutions = {}
    factors = [unknown_errors(o, state, k) for k in range(len(o.detectors))]
    tables = [
        _table_sigma(info, stored.get(d.name), factor)
        for d, info, factor in zip(o.detectors, infos, factors)
    ]
    weights = settings.pop("weight")
    del settings["pv_degree"]
    for k, detector in enumerate(o.detectors):
        if not any(o.detector_of[f] == k for f in state.active):
            continue
        if detector.name in stored:
            solution = stored[detector.name]
            if not update:
                solutions[detector.name] = solution
                continue
        else:
            solution = represent_detector(
                o, state, k, weight=weights[detector.name], degree=pv_degree,
                n_grid=0 if lut == "none" else n_grid, cd=cd,
                table_sigma=None if infos[k] is None else tables[k], factor=factors[k],
            )  # fmt: skip
        weight = weights[detector.name]
        solutions[detector.name] = replace(
            solution,
            statistics={
                **solution.statistics,
                **_statistics(o, state, k, infos[k], solution, settings),
            },
            settings={**settings, "weight": weight.name, "r0": float(weight.r0)},
        )
    residual = all_residuals(o, state)
    fits, places = [], {}
    for f in range(len(o.frames)):
        parts = {}
        if state.reason[f] is None:
            solution = solutions[o.detector(f).name]
            tabled = lut != "none" or refine == "field"
            parts = represent_frame(
                o, state, f, solution, n_grid=n_grid if tabled else 0,
                table_sigma=tables[o.detector_of[f]], factor=factors[o.detector_of[f]],
                places=places,
            )  # fmt: skip
            if not tabled:
                residual[:, o.slices[f]] = delivered_residual(o, f, solution, parts)
            if refine == "pv":
                parts = own_polynomial(o, state, f, solution, parts, residual, weights)
        fits.append(frame_fit(o, state, f, residual, parts))
    if not stored:
        solutions = _with_maps(o, state, group, solutions)
    rejected = {fit.name: fit.reason for fit in fits if fit.reason is not None}
    named = {d.name: i for d, i in zip(o.detectors, infos) if i is not None}
    color = float(o.reference_color) if np.isfinite(o.reference_color) else None
    return SolveResult(solutions, tuple(fits), rejected, named, color)


def _table_sigma(info, stored, factor):
    """Uncertainty of the part besides shared terms: a smoothed table or a stored solution."""
    if info is not None and info.sigma is not None:
        return info.sigma * np.array([factor, factor, 1.0])[:, None, None]
    return None if stored is None or info is not None else stored.table_sigma


def _with_maps(o, state, group, solutions):
    """Solutions with their binned residuals about the polynomials alone."""
    tables = [solutions[d.name].lookup_table if d.name in solutions else None for d in o.detectors]
    maps = residual_maps(o, state, group, tables)
    return {
        d.name: replace(solutions[d.name], residual_map=m)
        for d, m in zip(o.detectors, maps)
        if d.name in solutions
    }


def _statistics(o, state, k, info, solution, settings):
    frames = [f for f in state.active if o.detector_of[f] == k]
    kept = int(sum(state.kept[o.slices[f]].sum() for f in frames))
    statistics = {"n_exposures": len(frames), "n_used": kept}
    for name, value in statistics.items():
        statistics[name] = value + solution.statistics.get(name, 0)
    # One model for pairs with stated errors, and one for pairs without, whose scale is the error in
    # px; the first one is also given by itself.
    first = next(iter(state.error_models.values()))
    statistics |= {
        "error_scale": first["scale"], "error_floor": first["floor"],
        "error_models": state.error_models,
        "learned": solution.statistics.get("learned", {})
                 | {t.name: [float(v) for v in state.model.sigma[t.name]]
                    for t in state.model.terms if t.decay or t.chromatic},
    }  # fmt: skip
    if settings["lut"] != "none" and settings["refine"] in ("auto", "field"):
        statistics["fields"] = summarize_fields(
            [state.spectrum(o, f) for f in frames],
            solution.image_shape,
            solution.statistics.get("fields"),
        )
    if state.pooled:
        statistics["attitude_variation"] = state.pooled
    if info is not None:
        statistics["table"] = asdict(info.choice)
        statistics["table_chi2"] = float(info.chi2)
        statistics["table_candidates"] = [asdict(c) for c in info.candidates]
    return statistics
