"""Detectors that are matched tell where the others of their exposure must be.

::

    matched frames --geometry--> predictions with errors --narrow search--> more matched frames
          ^                                                                       |
          '-------------------------- until none is added ------------------------'

A detector of few stars, or one whose header is too wrong, cannot be matched alone.  Its neighbors
in the same exposure know pointing, rotation and scale, other exposures of the camera know its place
in the focal plane: what is left to search is so little that six pairs are proof.
"""

import logging
import time
from dataclasses import dataclass, replace

import numpy as np

from wpdc_gwcs.calibration.focal_plane import LocalPairs, fit_focal_plane, focal_planes
from wpdc_gwcs.calibration.matched import (
    FailedFrame,
    MatchedFrame,
    optional_column,
    reference_in_reach,
    usable_sources,
    with_errors,
)
from wpdc_gwcs.calibration.settings import Settings
from wpdc_gwcs.calibration.start import header_reference_point, linear_wcs, sky_of
from wpdc_gwcs.exceptions import MatchError
from wpdc_gwcs.matching import SmoothMap, match_nearby, match_planes
from wpdc_gwcs.threads import one_blas_thread

__all__ = ["start_from_neighbors"]

log = logging.getLogger(__name__)

# Searches reach so many standard errors of the prediction, and these margins in px: distortion
# within a detector that is not yet known.
_N_SIGMA = 4.0
_SHIFT_MARGIN, _BEND_MARGIN = 2.0, 1.0
# Widest search, px, step by step: what is near a matched detector comes first, and tells of the
# next; from the last on `match_planes` finds as much by itself.
_STEPS = (40.0, 120.0, 360.0)
# A frame is tried again when the search has become narrower by this factor.
_NARROWER = 0.8
# From so many pairs on, the full match may go on from the narrow search.
_FOR_FULL_MATCH = 8
_MOST_ROUNDS = 60
# A match that the other frames contradict: so many standard errors, px, and others that agree.
_WRONG_SIGMA, _WRONG_SHIFT, _WITNESSES = 8.0, 5.0, 2
# A match so complete cannot be a chance: then the header is wrong, not the match.
_BEYOND_DOUBT = 0.5


@one_blas_thread
def start_from_neighbors(frames, results, catalog, settings=None, *, solution=None):
    """Match the frames that could not be matched alone, from those of their exposure that could.

    Parameters
    ----------
    frames : list of Frame
        All frames of a run.
    results : dict
        Frame name to `MatchedFrame` or `FailedFrame`.
    catalog : `~astropy.table.Table`
        Reference catalogue as returned by `read_catalog`.
    settings : Settings, optional
        Choices of the run.
    solution : DistortionSolution or mapping, optional
        Stored solution, whose reference points the new matches start from.

    Returns
    -------
    dict
        As ``results``, in the same order, with more matched frames; a match that the other frames
        of its exposure prove wrong has been replaced, or failed.

    Notes
    -----
    Only frames with a camera and an exposure take part.  A frame that is still not matched keeps
    the reason that it had.
    """
    settings = Settings() if settings is None else settings
    results = dict(results)
    cameras = {}
    for frame in frames:
        if frame.camera is not None and frame.exposure is not None:
            cameras.setdefault(frame.camera, []).append(frame)
    for members in cameras.values():
        if _has_neighbors(members):
            for plane in focal_planes(members):
                results.update(_solve(plane, results, catalog, settings, solution))
    return results


def _has_neighbors(frames):
    return len({f.exposure for f in frames}) < len(frames)


@dataclass(frozen=True, eq=False)
class _Task:
    """A frame to be matched: what was measured on it, and what a search may use."""

    frame: object
    sources: object
    usable: np.ndarray
    crpix: np.ndarray


def _solve(plane, results, catalog, settings, solution):
    """Results of the frames of one focal plane that have changed."""
    results = {name: results[name] for name in plane.frames}
    matched = {n: r for n, r in results.items() if isinstance(r, MatchedFrame)}
    failed = {n: r for n, r in results.items() if n not in matched and _can_be_tried(r)}
    if not matched:
        return {}
    doubted, tried, geometry, step = {}, {}, None, 0
    for _ in range(_MOST_ROUNDS):
        geometry = fit_focal_plane(plane, _pairs_of(matched), geometry)
        wrong = _contradicted(plane, geometry, set(doubted))
        if wrong is not None:
            doubted[wrong] = matched.pop(wrong)
            failed[wrong] = doubted[wrong]
            # what was learnt with it in the wrong place is to be learnt anew
            geometry = None
            continue
        found = {}
        for name, result in failed.items():
            prediction = geometry.predict(plane.frames[name])
            if prediction is None or _N_SIGMA * prediction.shift > _STEPS[step]:
                continue
            if prediction.shift > _NARROWER * tried.get(name, np.inf):
                continue
            tried[name] = prediction.shift
            task = _task(plane.frames[name], result, solution)
            try:
                found[name] = _match(task, prediction, catalog, settings)
            except MatchError as err:
                log.debug("%s: %s", name, err)
        for name in found:
            log.info("%s: matched from its neighbors", name)
            failed.pop(name)
        matched.update(found)
        if not found:
            step += 1
            if step == len(_STEPS):
                break
    for name, before in doubted.items():
        if name not in matched:
            matched_alone = before.diagnostics.completeness > _BEYOND_DOUBT
            results[name] = before if matched_alone else _refusal(before, geometry)
    return results | matched


def _can_be_tried(result):
    """Frames without sources or with a stored solution that is not theirs have other troubles."""
    return result.sources is not None and isinstance(result.error, MatchError)


def _refusal(frame, geometry):
    error = MatchError(
        f"{frame.source}: the match contradicts those of the other detectors of exposure "
        f"{frame.exposure}; if the header has this detector in the wrong place, keep detectors "
        "apart (--no-camera)"
    )
    return FailedFrame(error, frame.n_sources, frame.seconds, frame.sources)


def _pairs_of(matched):
    return {
        name: LocalPairs(
            *(np.asarray(frame.sources[c], float)[frame.pairs[0]] for c in ("x", "y")),
            *(np.asarray(frame.reference[c], float)[frame.pairs[1]] for c in ("ra", "dec")),
        )
        for name, frame in matched.items()
    }


def _contradicted(plane, geometry, known):
    """Name of the matched frame that the others contradict most, or `None`."""
    exposures = [plane.frames[n].exposure for n in geometry.deviations]
    worst, most = None, _WRONG_SIGMA
    for name, (sigma, shift) in geometry.deviations.items():
        others = exposures.count(plane.frames[name].exposure) - 1
        if sigma > most and shift > _WRONG_SHIFT and others >= _WITNESSES and name not in known:
            worst, most = name, sigma
    return worst


def _task(frame, result, solution):
    sources = with_errors(result.sources)
    if isinstance(solution, dict):
        solution = solution.get(frame.detector)
    crpix = header_reference_point(frame) if solution is None else np.asarray(solution.crpix)
    return _Task(frame, sources, usable_sources(sources, frame.image_shape), crpix)


@dataclass(frozen=True, eq=False)
class _Corrected:
    """A predicted WCS with a linear correction in the plane of a start."""

    wcs: object
    start: object
    center: np.ndarray
    linear: np.ndarray

    def pixels(self, x, y):
        at = np.array(self.start.pixels(*sky_of(self.wcs, x, y))).T
        step = np.column_stack([np.ones(len(at)), at - self.center])
        return (at + step @ self.linear).T

    def pixel_to_world_values(self, x, y):
        return self.start.sky(*self.pixels(x, y))


def _match(task, prediction, catalog, settings):
    """Match a frame about its prediction; `MatchError` without evidence."""
    began = time.perf_counter()
    frame, sources = replace(task.frame, wcs=prediction), task.sources
    start = linear_wcs(prediction, task.crpix)
    reference = reference_in_reach(frame, catalog, start, settings)
    x, y = (np.asarray(sources[c], float) for c in ("x", "y"))
    xs, ys = start.pixels(*sky_of(prediction, x, y))
    pick = np.flatnonzero(task.usable & np.isfinite(xs) & np.isfinite(ys))
    ra, dec = (np.asarray(reference[c], float) for c in ("ra", "dec"))
    xr, yr = start.pixels(ra, dec)
    flux, mag = (
        optional_column(sources, "flux", pick),
        optional_column(reference, "phot_g_mean_mag"),
    )
    i_src, i_ref, linear, diagnostics = match_nearby(
        xs[pick],
        ys[pick],
        xr,
        yr,
        image_shape=frame.image_shape,
        max_shift=_N_SIGMA * prediction.shift + _SHIFT_MARGIN,
        max_bend=_N_SIGMA * prediction.bend + _BEND_MARGIN,
        flux=flux,
        mag=mag,
    )
    center = 0.5 * (np.array(frame.image_shape[::-1]) - 1)
    corrected = _Corrected(prediction, start, center, linear)
    start = linear_wcs(corrected, task.crpix)
    if len(i_src) >= _FOR_FULL_MATCH:
        try:
            i_src, i_ref, diagnostics = match_planes(
                *start.pixels(*sky_of(corrected, x[pick], y[pick])),
                *start.pixels(ra, dec),
                flux=flux,
                mag=mag,
                x_err=optional_column(sources, "x_err", pick),
                y_err=optional_column(sources, "y_err", pick),
                image_shape=frame.image_shape,
                start=SmoothMap.identity(frame.image_shape),
            )
        except MatchError as err:
            # what the narrow search has found is proof by itself
            log.debug("%s: %s", frame.name, err)
    return MatchedFrame(
        name=frame.name,
        source=frame.source,
        detector=frame.detector,
        image_shape=frame.image_shape,
        wcs=task.frame.wcs,
        sources=sources,
        usable=task.usable,
        reference=reference,
        pairs=(pick[i_src], i_ref),
        start=start,
        diagnostics=diagnostics,
        from_image=frame.load_image is not None,
        seconds=time.perf_counter() - began,
        exposure=frame.exposure,
        camera=frame.camera,
    )
