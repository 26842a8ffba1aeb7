"""All frames of one detector, solved together: one instrument, an attitude for each frame."""

import time
from dataclasses import asdict, replace
from datetime import UTC, datetime
from importlib.metadata import version

import numpy as np
from astropy.table import QTable

from wpdc_gwcs.calibration.checks import check_solution
from wpdc_gwcs.calibration.matched import optional_column
from wpdc_gwcs.calibration.start import (
    LinearWCS,
    detector_center,
    header_reference_point,
)
from wpdc_gwcs.evaluation import evaluate
from wpdc_gwcs.exceptions import FitError
from wpdc_gwcs.fitting import fit_attitude
from wpdc_gwcs.instrument import Exposure, solve_instrument
from wpdc_gwcs.matching import pair_nearest
from wpdc_gwcs.solution import Calibration

__all__ = ["solve_detector"]

# The joint solution is repeated with fresh pairs if more than this share of them changes.
_MAX_REMATCH = 3
_SETTLED = 0.01
_REMATCH_SIGMAS = 5.0


def solve_detector(group, settings, *, holdout=None, solution=None, update=False):
    """Solve the frames of one detector together.

    Parameters
    ----------
    group : list of MatchedFrame
        Matched frames of one detector.
    settings : Settings
        Choices.
    holdout : (n_catalog,) array_like of bool, optional
        Reference stars, by their row in the catalogue, that are kept out of every fit.
    solution : DistortionSolution, optional
        Stored solution of this detector.
    update : bool, optional
        Merge the frames into the stored solution.

    Returns
    -------
    solution : DistortionSolution
        The instrument.
    calibrations : list of Calibration
        One for each solved frame.
    failures : dict
        Frame name to error.

    Raises
    ------
    FitError
        If the instrument could not be determined, or the frames have different shapes.
    """
    shapes = {tuple(frame.image_shape) for frame in group}
    if len(shapes) > 1:
        raise FitError(
            f"detector {group[0].detector!r} has frames of different shapes (ny, nx): "
            + ", ".join(map(str, sorted(shapes)))
        )
    began = time.perf_counter()
    shape = group[0].image_shape
    crpix = _instrument_crpix(group[0], settings) if solution is None else solution.crpix
    failures, attitudes = {}, []
    for frame in group:
        try:
            attitudes.append(_attitude_of_pairs(frame, crpix))
        except FitError as err:
            failures[frame.name] = err
    group = [frame for frame in group if frame.name not in failures]
    if not group:
        raise next(iter(failures.values()))
    pairs = [frame.pairs for frame in group]
    choice = None
    for attempt in range(_MAX_REMATCH):
        result = solve_instrument(
            [_exposure(*args, holdout) for args in zip(group, pairs, attitudes, strict=True)],
            image_shape=shape,
            crpix=crpix,
            cd=attitudes[0].cd,
            weight=settings.radial_weight(shape),
            n_grid=settings.n_grid,
            lut=settings.lut,
            refine=settings.refine,
            solution=solution,
            update=update,
            table_choice=choice,
            detector=group[0].detector,
            seed=settings.seed,
        )
        if result.table_info is not None:
            choice = result.table_info.choice  # a few other pairs would choose no differently
        if attempt + 1 == _MAX_REMATCH:
            break
        fresh = [
            _rematch(frame, result.solution, fit)
            for frame, fit in zip(group, result.exposures, strict=True)
        ]
        moved = sum(
            _n_changed(old, new, fit.used)
            for old, new, fit in zip(pairs, fresh, result.exposures, strict=True)
        )
        if moved <= _SETTLED * sum(len(i_src) for i_src, _ in pairs):
            break
        pairs = fresh
        attitudes = [
            LinearWCS(crpix=crpix, cd=fit.cd, crval=fit.crval) if fit.reason is None else start
            for fit, start in zip(result.exposures, attitudes, strict=True)
        ]
    seconds = (time.perf_counter() - began) / len(group)
    instrument = replace(
        result.solution, provenance={**result.solution.provenance, **_provenance(group)}
    )
    calibrations, stored = [], None if update else solution
    for frame, found, fit in zip(group, pairs, result.exposures, strict=True):
        try:
            calibrations.append(
                _calibration(frame, found, fit, instrument, settings, holdout, seconds, stored)
            )
        except FitError as err:
            failures[frame.name] = err
    if not calibrations:
        raise next(iter(failures.values()))
    if solution is None or update:
        scatter = [c.statistics["residuals"] for c in calibrations]
        instrument.statistics["sigma_px"] = float(
            np.median([max(s["sigma_dx"], s["sigma_dy"]) for s in scatter])
        )
    return instrument, calibrations, failures


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


def _attitude_of_pairs(frame, crpix):
    """Fit a linear WCS to the pairs of a frame: near the truth whatever its header said."""
    i_src, i_ref = frame.pairs
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


def _exposure(frame, pairs, attitude, holdout):
    """Gather what the joint solution needs: pairs with the errors of both sides in px."""
    i_src, i_ref = pairs
    src, ref = frame.sources[i_src], frame.reference[i_ref]
    x_err, y_err = _position_errors(src, ref, attitude.cd)
    use = None if holdout is None else ~holdout[np.asarray(ref["catalog_index"])]
    return Exposure(
        name=frame.name,
        x=np.asarray(src["x"], float),
        y=np.asarray(src["y"], float),
        x_err=x_err,
        y_err=y_err,
        ra=np.asarray(ref["ra"], float),
        dec=np.asarray(ref["dec"], float),
        crval=attitude.crval,
        cd=attitude.cd,
        use=use,
    )


def _position_errors(src, ref, cd):
    """Errors of pairs in px, centroid and reference star together; None where there are none."""
    x_err, y_err = optional_column(src, "x_err"), optional_column(src, "y_err")
    if x_err is None or y_err is None:
        return None, None
    scale = np.sqrt(abs(np.linalg.det(cd))) * 3.6e6  # mas / px
    errors = [optional_column(ref, name) for name in ("ra_error", "dec_error")]
    if any(e is None for e in errors):
        return x_err, y_err
    # Small beside those of the centroids: the mean of both axes serves at any roll.
    reference = np.sqrt(np.mean(np.nan_to_num(errors) ** 2, axis=0)) / scale
    return np.hypot(x_err, reference), np.hypot(y_err, reference)


def _rematch(frame, solution, fit):
    """Pairs of all usable sources with the reference stars where the solution puts them."""
    if fit.reason is not None:
        return frame.pairs
    if fit.pv is not None:
        solution = replace(solution, pv=fit.pv)
    pick = np.flatnonzero(frame.usable)
    src = frame.sources[pick]
    xs, ys = solution.undistort(np.asarray(src["x"], float), np.asarray(src["y"], float))
    attitude = LinearWCS(crpix=solution.crpix, cd=fit.cd, crval=fit.crval)
    xr, yr = attitude.pixels(frame.reference["ra"], frame.reference["dec"])
    # The errors of the pairs say how far apart a star and its source can be.
    sigma = np.sqrt(0.5 * (fit.x_err**2 + fit.y_err**2))
    typical = np.nanmedian(sigma[fit.used])
    x_err, y_err = optional_column(src, "x_err"), optional_column(src, "y_err")
    if x_err is None or y_err is None:
        each = np.full(len(src), typical)
    else:
        each = np.sqrt(0.5 * (x_err**2 + y_err**2))
        each = np.nan_to_num(each, nan=typical)
        own = np.nan_to_num(np.nanmedian(each[np.searchsorted(pick, frame.pairs[0])]), nan=typical)
        each = np.clip(each * typical / own, 0.5 * typical, 10 * typical)
    i_src, i_ref, _ = pair_nearest(xs, ys, xr, yr, _REMATCH_SIGMAS * each)
    return pick[i_src], i_ref


def _n_changed(before, after, used):
    """Count new pairs and lost ones; what the fit had not used is no loss."""
    before, after = (np.array(p, np.int64).T for p in (before, after))
    key = [p[:, 0] << 32 | p[:, 1] for p in (before, after)]
    return int(np.sum(~np.isin(key[1], key[0])) + np.sum(~np.isin(key[0][used], key[1])))


def _calibration(frame, pairs, fit, instrument, settings, holdout, seconds, stored):
    """Make the result of one frame, if its solution passes its own checks."""
    if fit.reason is not None:
        raise FitError(f"{frame.source}: {fit.reason}")
    i_src, i_ref = pairs
    if fit.pv is not None:
        instrument = replace(instrument, pv=fit.pv)
    src, ref = frame.sources[i_src], frame.reference[i_ref]
    catalog_index = np.asarray(ref["catalog_index"])
    held = np.zeros(len(src), bool) if holdout is None else holdout[catalog_index]
    matches = QTable(
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
    # Not of use here, but to see whether residuals depend on them.
    for table, name in ((src, "snr"), (ref, "phot_g_mean_mag")):
        if name in table.colnames:
            matches[name] = optional_column(table, name)
    check_solution(frame, matches, instrument, stored=stored)
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
    }
    if held.any():
        statistics["holdout"] = asdict(evaluate(fit.dx[held], fit.dy[held]))
    return Calibration(
        frame=frame.name,
        solution=instrument,
        crval=np.asarray(fit.crval),
        cd=np.asarray(fit.cd),
        attitude_covariance=fit.covariance,
        pv_covariance=fit.pv_covariance,
        matches=matches,
        sources=frame.sources if frame.from_image else None,
        statistics=statistics,
        settings=asdict(settings),
        provenance=_provenance([frame]),
    )


def _provenance(group):
    return {
        "software": {
            "wpdc_gwcs": version("wpdc_gwcs"),
            "numpy": version("numpy"),
            "astropy": version("astropy"),
        },
        "inputs": [frame.source for frame in group],
        "created": datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ"),
    }
