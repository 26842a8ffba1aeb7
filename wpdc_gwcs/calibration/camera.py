"""The joint solution of all frames of a camera: its detectors and its exposures."""

import logging
import time
from dataclasses import asdict, replace
from datetime import UTC, datetime
from functools import partial

import astropy
import numpy as np
from astropy.table import Table

import wpdc_gwcs
from wpdc_gwcs.calibration.checks import check_solution, shortcomings
from wpdc_gwcs.calibration.free_stars import solve_free_stars
from wpdc_gwcs.calibration.literal import solve_frames_literally
from wpdc_gwcs.calibration.positions import with_sky_positions
from wpdc_gwcs.calibration.settings import Settings
from wpdc_gwcs.calibration.start import (
    LinearWCS,
    detector_center,
    header_reference_point,
)
from wpdc_gwcs.columns import numbers_or_none
from wpdc_gwcs.evaluation import evaluate
from wpdc_gwcs.exceptions import FitError
from wpdc_gwcs.fitting import MIN_STARS_ATTITUDE, fit_attitude
from wpdc_gwcs.frozen import with_statistics
from wpdc_gwcs.matching import pair_nearest
from wpdc_gwcs.models import deproject
from wpdc_gwcs.solution import Calibration
from wpdc_gwcs.solve import Exposure, solve

__all__ = ["cameras_of", "exposure_key", "solve_camera"]

log = logging.getLogger(__name__)

# The solution is repeated with fresh pairs if more than this share of them changes.
_MAX_REMATCH = 3
_SETTLED = 0.01
_REMATCH_SIGMAS = 5.0

# Units of the columns of matches.
_UNITS = {
    **dict.fromkeys(("x", "y", "x_err", "y_err", "dx", "dy"), "pix"),
    **dict.fromkeys(("ra", "dec"), "deg"),
    **dict.fromkeys(("ra_offset", "dec_offset"), "mas"),
}


def cameras_of(frames):
    """Group frames by camera: detectors that share an exposure belong to one camera.

    Parameters
    ----------
    frames : list of MatchedFrame
        All matched frames of a run.

    Returns
    -------
    list of list of MatchedFrame
        One list for each camera: frames that are connected by detectors and exposures.
    """
    parent = {}

    def root(key):
        parent.setdefault(key, key)
        while parent[key] != key:
            parent[key] = parent[parent[key]]
            key = parent[key]
        return key

    for frame in frames:
        parent[root(("exposure", exposure_key(frame)))] = root(_detector_key(frame))
    groups = {}
    for frame in frames:
        groups.setdefault(root(_detector_key(frame)), []).append(frame)
    return list(groups.values())


def exposure_key(frame):
    """Return the key that a frame shares with the other frames of its exposure.

    Parameters
    ----------
    frame : Frame or MatchedFrame
        The frame.

    Returns
    -------
    hashable
        Camera and exposure; the name of the frame if it belongs to no exposure.
    """
    if frame.camera is None or frame.exposure is None:
        return frame.name
    return (frame.camera, frame.exposure)


def _detector_key(frame):
    return ("detector", frame.camera, frame.detector)


def solve_camera(group, settings, *, holdout=None, solution=None, update=False):
    """Solve the frames of one camera together.

    Parameters
    ----------
    group : list of MatchedFrame
        Matched frames of detectors that share exposures, or of one detector.
    settings : Settings
        Settings of the run.
    holdout : (n_catalog,) array_like of bool, optional
        Mask over the rows of the catalog: stars that are kept out of every fit.
    solution : dict, optional
        Stored solutions by detector.
    update : bool, optional
        Whether to merge the frames into the stored solutions.

    Returns
    -------
    solutions : dict
        `DistortionSolution` of each detector, by name.
    calibrations : list of Calibration
        One for each solved frame.
    failures : dict
        Error of each frame that could not be solved, by name.

    Examples
    --------
    >>> from wpdc_gwcs import Settings, simulate
    >>> from wpdc_gwcs.calibration import match_frame, solve_camera
    >>> sky = simulate(1, image_shape=(512, 512), density=60, distortion=3, seed=1)
    >>> exposure = sky.exposures[0]
    >>> matched = match_frame(exposure.frame(), sky.reference)
    >>> solutions, (calibration,), failures = solve_camera([matched], Settings())
    >>> dx, dy = exposure.error_at(calibration.wcs, 100.0, 200.0)
    >>> bool(abs(dx) < 0.02), bool(abs(dy) < 0.02), failures
    (True, True, {})
    """
    solution = solution or {}
    failures = {}
    group = _of_one_shape(group, failures)
    if update:
        group = _of_valid_epoch(group, solution, failures)
    began = time.perf_counter()
    if settings.method == "paper" and group:
        exposure_of = partial(_exposure, holdout=holdout)
        result, pairs = solve_frames_literally(
            group, settings, exposure_of=exposure_of, solution=solution
        )
        return _delivered(group, pairs, result, settings, holdout, solution, failures, began)
    shapes = {frame.detector: tuple(frame.image_shape) for frame in group}
    crpix = {}
    for frame in group:
        if frame.detector in solution:
            crpix[frame.detector] = np.asarray(solution[frame.detector].crpix, float)
        elif frame.detector not in crpix:
            crpix[frame.detector] = _instrument_crpix(frame, settings)
    least = _least_pairs(group, solution)
    attitudes = {}
    for frame in group:
        try:
            attitudes[frame.name] = _attitude_of_pairs(frame, crpix[frame.detector], least)
        except FitError as err:
            failures[frame.name] = err
    group = [frame for frame in group if frame.name not in failures]
    if not group:
        return {}, [], failures
    pairs = [frame.pairs for frame in group]
    options = {
        "image_shape": shapes, "crpix": crpix, "weight": _weights(settings, shapes),
        "degree": settings.degree, "n_grid": settings.n_grid, "lut": settings.lut,
        "refine": settings.refine, "solution": solution or None, "update": update,
        "seed": settings.seed,
    }  # fmt: skip
    choice = None
    for attempt in range(_MAX_REMATCH):
        exposures = [_exposure(f, p, attitudes[f.name], holdout) for f, p in zip(group, pairs)]
        try:
            result = solve(exposures, table_choice=choice, **options)
        except FitError as err:
            return {}, [], failures | _own_reasons(group, err)
        if len(result.table_infos) == len(shapes):
            # A few changed pairs do not change the choice.
            choice = {name: info.choice for name, info in result.table_infos.items()}
        if attempt + 1 == _MAX_REMATCH:
            break
        fresh = [
            frame.pairs
            if fit.reason is not None
            else _rematch(frame, old, _as_calibration(frame, fit, result), fit)
            for frame, old, fit in zip(group, pairs, result.exposures, strict=True)
        ]
        moved = sum(
            _n_changed(old, new, fit.used)
            for old, new, fit in zip(pairs, fresh, result.exposures, strict=True)
        )
        if moved <= _SETTLED * sum(len(i_src) for i_src, _ in pairs):
            break
        pairs = fresh
        for frame, fit in zip(group, result.exposures, strict=True):
            if fit.reason is None:
                attitudes[frame.name] = LinearWCS(
                    crpix=crpix[frame.detector], cd=fit.cd, crval=fit.crval
                )
    if settings.free_stars:
        try:
            result = solve_free_stars(exposures, result, partial(solve, **options))
        except FitError as err:
            return {}, [], failures | _own_reasons(group, err)
    return _delivered(
        group, pairs, result, settings, holdout, solution, failures, began, update=update
    )


def _delivered(group, pairs, result, settings, holdout, solution, failures, began, *, update=False):
    """Make the results of all frames that pass their checks, and of their detectors."""
    seconds = (time.perf_counter() - began) / len(group)
    solutions = {}
    for name, one in result.solutions.items():
        own = [f for f in group if f.detector == name and f.name not in result.rejected]
        if update and name in solution:
            one = _dated(one, own, solution[name])
        if update or name not in solution:
            # A stored solution that is not updated keeps the provenance of its own frames.
            one = replace(one, provenance=_provenance(own, one.provenance if update else {}))
        solutions[name] = one
    result = replace(result, solutions=solutions)
    calibrations = []
    for frame, found, fit in zip(group, pairs, result.exposures, strict=True):
        try:
            calibrations.append(
                _calibration(
                    frame, found, fit, result, settings, holdout, seconds,
                    stored=None if update else solution.get(frame.detector),
                )
            )  # fmt: skip
        except FitError as err:
            failures[frame.name] = err
    scatters = _scatters(calibrations, [] if update else solution)
    calibrations = [
        replace(c, solution=_with_scatter(c.solution, scatters))
        if c.solution.detector in scatters
        else c
        for c in calibrations
    ]
    solved = {c.solution.detector for c in calibrations}
    solutions = {n: _with_scatter(s, scatters) for n, s in result.solutions.items() if n in solved}
    return solutions, calibrations, failures


def _weights(settings, shapes):
    """Radial weight of each detector; `None` if no table corrects what the default leaves out."""
    if settings.lut == "none" and settings.weight == Settings.weight:
        return None
    return {name: settings.radial_weight(shape) for name, shape in shapes.items()}


def _of_valid_epoch(group, solution, failures):
    """Frames of the time for which the stored solutions hold; the others cannot update them."""
    for frame in group:
        stored = solution.get(frame.detector)
        if stored is not None and not stored.holds_at(frame.epoch):
            failures[frame.name] = FitError(
                f"{frame.source}: the frame is of {frame.epoch:.4f}, the stored solution is valid "
                f"{stored.validity}: it cannot be updated with it"
            )
    return [frame for frame in group if frame.name not in failures]


def _dated(solution, frames, stored):
    """Tell the epochs of an update; a changed solution is valid from the first."""
    *before, last = solution.statistics["updates"]
    epochs = [f.epoch for f in frames if f.epoch is not None]
    first, final = (min(epochs), max(epochs)) if epochs else (None, None)
    last = {"first_epoch": first, "last_epoch": final, **last}
    solution = with_statistics(solution, updates=[*before, last])
    if last["process_noise"] == 0:
        return solution
    log.info(
        "detector %s has changed by %.3g px rms, %.3g px at most (log evidence %.1f)",
        solution.detector, last["rms_change_px"], last["max_change_px"], last["evidence"],
    )  # fmt: skip
    earlier = stored.provenance.get("epochs") or []
    if first is None or (earlier and first <= earlier[1]):
        log.warning(
            "detector %s: no epoch separates the stored solution from the changed one: neither "
            "gets a period of validity", solution.detector,
        )  # fmt: skip
        return solution
    return replace(solution, valid_from=first)


def _of_one_shape(group, failures):
    """Frames of the detectors whose frames have one shape; the others fail."""
    shapes = {}
    for frame in group:
        shapes.setdefault(frame.detector, set()).add(tuple(frame.image_shape))
    for frame in group:
        if len(shapes[frame.detector]) > 1:
            failures[frame.name] = FitError(
                f"detector {frame.detector!r} has frames of different shapes (ny, nx): "
                + ", ".join(map(str, sorted(shapes[frame.detector])))
            )
    return [frame for frame in group if frame.name not in failures]


# Minimum number of pairs of a frame whose detector is already known: they only have to prove that
# the position is right.
_MIN_PAIRS_KNOWN = 4


def _least_pairs(group, solution):
    """Pairs that each frame needs: fewer where other frames, or a stored solution, know more."""
    known = bool(solution) or len({f.detector for f in group}) > 1
    return _MIN_PAIRS_KNOWN if known else MIN_STARS_ATTITUDE


def _own_reasons(group, err):
    """Give each frame of a camera that could not be solved its own error."""
    reasons = getattr(err, "reasons", {})
    return {f.name: FitError(f"{f.source}: {reasons.get(f.name, err)}") for f in group}


def _scatters(calibrations, stored):
    """Scatter of the frames of each detector that is not stored, px."""
    found = {}
    for c in calibrations:
        if c.solution.detector not in stored:
            of = c.statistics["residuals"]
            found.setdefault(c.solution.detector, []).append(max(of["sigma_dx"], of["sigma_dy"]))
    return {name: float(np.median(values)) for name, values in found.items()}


def _with_scatter(solution, scatters):
    if solution.detector not in scatters:
        return solution
    return with_statistics(solution, sigma_px=scatters[solution.detector])


def _as_calibration(frame, fit, result, **more):
    """Calibration of a frame from the result of the solution."""
    solution = result.solutions[frame.detector]
    if fit.pv is not None:
        solution = replace(solution, pv=fit.pv)
    if fit.crpix is not None:
        solution = replace(solution, crpix=fit.crpix, cd=fit.cd)
    return Calibration(
        frame=frame.name,
        solution=solution,
        crval=np.asarray(fit.crval),
        cd=np.asarray(fit.cd),
        field=fit.field,
        sigma=fit.sigma,
        color_shift=fit.color_shift,
        reference_color=result.reference_color,
        **more,
    )


def _instrument_crpix(frame, settings):
    """Choose the reference point of the instrument, px, zero based."""
    center = detector_center(frame.image_shape)
    if settings.reference_point == "header":
        return header_reference_point(frame)
    if settings.reference_point == "center":
        return center
    x, y = (np.asarray(frame.sources[c], float)[frame.pairs[0]] for c in "xy")
    nearest = np.argmin(np.hypot(x - center[0], y - center[1]))
    return np.array([x[nearest], y[nearest]])


def _attitude_of_pairs(frame, crpix, least):
    """Fit a linear WCS to the pairs of a frame: near the truth whatever its header said."""
    i_src, i_ref = frame.pairs
    if least <= len(i_src) < MIN_STARS_ATTITUDE:
        return LinearWCS(crpix=crpix, cd=frame.start.cd, crval=_sky_at(frame.start, crpix))
    fit = fit_attitude(
        np.asarray(frame.sources["x"], float)[i_src],
        np.asarray(frame.sources["y"], float)[i_src],
        np.asarray(frame.reference["ra"], float)[i_ref],
        np.asarray(frame.reference["dec"], float)[i_ref],
        crpix=crpix,
        crval=frame.start.crval,
        cd=frame.start.cd,
        clip=np.inf,  # the distortion is in the residuals
    )
    return LinearWCS(crpix=crpix, cd=fit.cd, crval=fit.crval)


def _sky_at(wcs, crpix):
    """Sky position of a reference point in a linear WCS about another one."""
    return np.array(deproject(*(wcs.cd @ (crpix - wcs.crpix)), wcs.crval))


def _exposure(frame, pairs, attitude, holdout):
    """Gather what the joint solution needs: pairs with the errors of both sides in px."""
    i_src, i_ref = pairs
    src, ref = frame.sources[i_src], frame.reference[i_ref]
    x_err, y_err, reference_err = _position_errors(src, ref, attitude.cd)
    use = None if holdout is None else ~holdout[np.asarray(ref["catalog_index"])]
    return Exposure(
        name=frame.name,
        x=np.asarray(src["x"], float),
        y=np.asarray(src["y"], float),
        x_err=x_err,
        y_err=y_err,
        reference_err=reference_err,
        star=np.asarray(ref["catalog_index"]),
        ra=np.asarray(ref["ra"], float),
        dec=np.asarray(ref["dec"], float),
        crval=attitude.crval,
        cd=attitude.cd,
        use=use,
        color=numbers_or_none(ref, "bp_rp"),
        detector=frame.detector,
        exposure=exposure_key(frame),
    )


def _position_errors(src, ref, cd):
    """Errors of pairs, centroid and reference star together, and the latter alone, px.

    None where there are none.
    """
    x_err, y_err = numbers_or_none(src, "x_err"), numbers_or_none(src, "y_err")
    if x_err is None or y_err is None:
        return None, None, None
    scale = np.sqrt(abs(np.linalg.det(cd))) * 3.6e6  # mas / px
    errors = [numbers_or_none(ref, name) for name in ("ra_error", "dec_error")]
    if any(e is None for e in errors):
        return x_err, y_err, None
    # They are small compared with those of the centroids, so the mean of both axes is good enough
    # at any roll.
    reference = np.sqrt(np.mean(np.nan_to_num(errors) ** 2, axis=0)) / scale
    return np.hypot(x_err, reference), np.hypot(y_err, reference), reference


def _rematch(frame, pairs, calibration, fit):
    """Pairs of all usable sources with the reference stars where the solution puts them."""
    pick = np.flatnonzero(frame.usable)
    src = frame.sources[pick]
    xs, ys = calibration.undistort(np.asarray(src["x"], float), np.asarray(src["y"], float))
    attitude = LinearWCS(crpix=calibration.solution.crpix, cd=fit.cd, crval=fit.crval)
    xr, yr = attitude.pixels(frame.reference["ra"], frame.reference["dec"])
    # The errors of the pairs limit the distance between a star and its source.
    sigma = np.sqrt(0.5 * (fit.x_err**2 + fit.y_err**2))
    typical = np.nanmedian(sigma[fit.used])
    x_err, y_err = numbers_or_none(src, "x_err"), numbers_or_none(src, "y_err")
    if x_err is None or y_err is None:
        each = np.full(len(src), typical)
    else:
        each = np.sqrt(0.5 * (x_err**2 + y_err**2))
        each = np.nan_to_num(each, nan=typical)
        own = np.nan_to_num(np.nanmedian(each[np.searchsorted(pick, frame.pairs[0])]), nan=typical)
        each = np.clip(each * typical / own, 0.5 * typical, 10 * typical)
    i_src, i_ref, _ = pair_nearest(xs, ys, xr, yr, _REMATCH_SIGMAS * each)
    i_src = pick[i_src]
    # Pairs in the fit are correct; stars with poor positions may be farther from their sources.
    old = fit.used & ~np.isin(pairs[0], i_src) & ~np.isin(pairs[1], i_ref)
    return np.append(i_src, pairs[0][old]), np.append(i_ref, pairs[1][old])


def _n_changed(before, after, used):
    """Count new pairs and lost ones; what the fit had not used is no loss."""
    before, after = (np.array(p, np.int64).T for p in (before, after))
    key = [p[:, 0] << 32 | p[:, 1] for p in (before, after)]
    return int(np.sum(~np.isin(key[1], key[0])) + np.sum(~np.isin(key[0][used], key[1])))


def _calibration(frame, pairs, fit, result, settings, holdout, seconds, *, stored):
    """Make the result of one frame, if its solution passes its own checks."""
    if fit.reason is not None:
        raise FitError(f"{frame.source}: {fit.reason}")
    i_src, i_ref = pairs
    src, ref = frame.sources[i_src], frame.reference[i_ref]
    catalog_index = np.asarray(ref["catalog_index"])
    held = np.zeros(len(src), bool) if holdout is None else holdout[catalog_index]
    matches = Table(
        {
            "source_index": i_src.astype(np.int64),
            "catalog_index": catalog_index.astype(np.int64),
            "x": np.asarray(src["x"], float),
            "y": np.asarray(src["y"], float),
            "x_err": fit.x_err,
            "y_err": fit.y_err,
            "ra": np.asarray(ref["ra"], float),
            "dec": np.asarray(ref["dec"], float),
            "dx": fit.dx,
            "dy": fit.dy,
            "used": fit.used,
            "holdout": held,
        }
    )
    if fit.reference_offset is not None:
        matches["ra_offset"], matches["dec_offset"] = fit.reference_offset
    for name in matches.colnames:
        matches[name].unit = _UNITS.get(name)
    # Not used here, but they show whether residuals depend on them.
    for table, name in ((src, "snr"), (ref, "phot_g_mean_mag"), (ref, "bp_rp")):
        if name in table.colnames:
            matches[name] = numbers_or_none(table, name)
            matches[name].unit = table[name].unit
    residuals = evaluate(fit.dx[fit.used], fit.dy[fit.used])
    scale = np.sqrt(abs(np.linalg.det(fit.cd))) * 3.6e6
    statistics = {
        "n_sources": len(frame.sources),
        "n_matched": len(matches),
        "n_used": int(fit.used.sum()),
        "pixel_scale_mas": float(scale),
        "rms_mas": residuals.rms * scale,
        "residuals": asdict(residuals),
        "match": frame.diagnostics.to_dict(),
        "seconds": frame.seconds + seconds,
        **{k: v for k, v in fit.statistics.items() if k in ("field", "free_stars")},
    }
    if held.any():
        statistics["holdout"] = asdict(evaluate(fit.dx[held], fit.dy[held]))
    calibration = _as_calibration(
        frame, fit, result,
        matches=matches,
        sources=frame.sources if frame.from_image else None,
        statistics=statistics,
        settings=asdict(settings),
        provenance=_provenance([frame]),
    )  # fmt: skip
    together = len(result.solutions) > 1 and settings.method != "paper"
    known = stored is not None or together
    check_solution(frame, calibration, stored=stored, known=known)
    reasons = shortcomings(frame, calibration, held=held, known=known, stored=stored)
    status = "degraded" if reasons else "solved"
    return with_sky_positions(with_statistics(calibration, status=status, reasons=reasons))


def _provenance(group, before=None):
    """Versions, inputs and epochs of frames, those of a stored solution included."""
    before = before or {}
    epochs = [*(before.get("epochs") or []), *(f.epoch for f in group if f.epoch is not None)]
    return {
        **before,
        "software": {
            "wpdc_gwcs": wpdc_gwcs.__version__,
            "numpy": np.__version__,
            "astropy": astropy.__version__,
        },
        "inputs": [*before.get("inputs", []), *(frame.source for frame in group)],
        "epochs": [min(epochs), max(epochs)] if epochs else None,
        "created": datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ"),
    }
