"""Matched detectors as a starting point for the other detectors of their exposure.

::

    matched frames --geometry--> predictions with errors --narrow search--> more matched frames
          ^                                                                       |
          '-------------------------- until none is added ------------------------'

A detector with few stars, or with a header that is far off, cannot be matched alone.  Its neighbors
in the same exposure determine pointing, rotation and scale, and other exposures of the camera
determine its place in the focal plane.  The remaining search is so narrow that a few pairs are
proof.
"""

import logging
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from wpdc_gwcs.calibration.focal_plane import focal_planes
from wpdc_gwcs.calibration.geometry import LocalPairs, fit_geometry
from wpdc_gwcs.calibration.matched import (
    FailedFrame,
    MatchedFrame,
    reference_in_reach,
    usable_sources,
    with_errors,
)
from wpdc_gwcs.calibration.settings import Settings
from wpdc_gwcs.calibration.start import header_reference_point, linear_wcs, sky_of
from wpdc_gwcs.columns import numbers_or_none
from wpdc_gwcs.exceptions import MatchError
from wpdc_gwcs.matching import SmoothMap, match_nearby, match_planes
from wpdc_gwcs.threads import one_blas_thread

__all__ = ["start_from_neighbors"]

log = logging.getLogger(__name__)

# A search reaches this many standard errors of the prediction, plus these margins in px for unknown
# distortion within a detector.
_N_SIGMA = 4.0
_SHIFT_MARGIN, _BEND_MARGIN = 2.0, 1.0
# Widest search of each step, px: detectors near a matched one come first, and improve the
# prediction for the next ones.  Beyond the last step, `match_planes` finds as much by itself.
_STEPS = (40.0, 120.0, 360.0)
# Error that each of several exposures may have beyond their common error of the place, px.
_ALIKE = 4.0
# A frame is tried again if the search has become narrower by this factor.
_NARROWER = 0.8
# Minimum number of pairs from which the full match may continue after a narrow search.
_FOR_FULL_MATCH = 8
_MOST_ROUNDS = 60
# Limits for a match that the other frames contradict: standard errors, px, and the number of other
# frames that agree.
_WRONG_SIGMA, _WRONG_SHIFT, _WITNESSES = 7.0, 5.0, 2
_MOST_SUSPECTS = 5
# A match with this completeness cannot be due to chance: the header is wrong, not the match.
_BEYOND_DOUBT = 0.5


@one_blas_thread
def start_from_neighbors(frames, results, catalog, settings=None, *, solution=None):
    """Match the frames that could not be matched alone, starting from matched frames.

    Parameters
    ----------
    frames : list of Frame
        All frames of a run.
    results : dict
        `MatchedFrame` or `FailedFrame` by frame name.
    catalog : `~astropy.table.Table`
        Reference catalog as returned by `read_catalog`.
    settings : Settings, optional
        Settings of the run.
    solution : DistortionSolution or mapping, optional
        Stored solution, whose reference point is used for the new matches.

    Returns
    -------
    dict
        Like ``results``, in the same order, with more matched frames.  A match that the other
        frames of its exposure prove wrong is replaced, or fails.

    Notes
    -----
    Only frames with a camera and an exposure are used.  A frame that is still not matched keeps
    its original error.

    Examples
    --------
    >>> from wpdc_gwcs import read_catalog, simulate
    >>> from wpdc_gwcs.calibration import match_frame, start_from_neighbors
    >>> from wpdc_gwcs.calibration.matched import FailedFrame
    >>> from wpdc_gwcs.exceptions import MatchError
    >>> sky = simulate(1, camera="bass-90prime", detectors=["CCD1", "CCD2"],
    ...                image_shape=(512, 512), density=30, distortion=12, seed=2)
    >>> catalog = read_catalog(sky.reference)
    >>> one, two = [exposure.frame() for exposure in sky.exposures]
    >>> alone = {one.name: match_frame(one, catalog), two.name: FailedFrame(MatchError(), 0, 0.0)}
    >>> together = start_from_neighbors([one, two], alone, catalog)
    >>> [type(result).__name__ for result in together.values()]
    ['MatchedFrame', 'FailedFrame']
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
                if len(plane.exposures) == 1:
                    continue
                # An exposure whose optics or places differ from the others is solved by itself.
                for exposure in plane.exposures:
                    part = plane.of(exposure)
                    if any(isinstance(results[name], FailedFrame) for name in part.frames):
                        results.update(_solve(part, results, catalog, settings, solution))
    return results


def _has_neighbors(frames):
    return len({f.exposure for f in frames}) < len(frames)


@dataclass(frozen=True, eq=False)
class _Task:
    """A frame to be matched, with its sources and the data for a search."""

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
        geometry = fit_geometry(plane, _pairs_of(matched), geometry)
        wrong = _contradicted(plane, geometry, matched, doubted)
        if wrong is not None:
            doubted[wrong] = matched.pop(wrong)
            failed[wrong] = doubted[wrong]
            # Everything that was learned with this frame in the wrong place is learned again.
            geometry = None
            continue
        new = {}
        for name in failed:
            prediction = geometry.predict(plane.frames[name])
            if prediction is None or _N_SIGMA * prediction.shift > _STEPS[step]:
                continue
            if prediction.shift <= _NARROWER * tried.get(name, np.inf):
                tried[name] = prediction.shift
                new[name] = (
                    _task(plane.frames[name], failed[name], solution, settings),
                    prediction,
                )
        found = _match_all(new, catalog, settings)
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


def _match_all(new, catalog, settings):
    """Match frames about their predictions, one by one and then those of a detector together."""
    found, left = {}, {}
    for name, (task, prediction) in new.items():
        try:
            found[name] = _match(task, prediction, catalog, settings)
        except MatchError as err:
            log.debug("%s: %s", name, err)
            left.setdefault(task.frame.detector, []).append((task, prediction))
    have = {new[name][0].frame.detector for name in found}
    for detector, tried in left.items():
        # A frame that was found once is predicted better in the next round.
        if detector not in have and len(tried) > 1:
            try:
                found |= _match_together(*zip(*tried, strict=True), catalog, settings)
            except MatchError as err:
                log.debug("%s: %s", detector, err)
    return found


def _can_be_tried(result):
    """Return whether a failed frame can be tried again: it was measured, but not matched."""
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


def _contradicted(plane, geometry, matched, known):
    """Name of the matched frame that the others contradict, or `None`.

    A wrong frame makes others look wrong, especially the same detector in another exposure.  So the
    wrong one is that without which the rest agrees best.
    """
    exposures = [plane.frames[n].exposure for n in geometry.deviations]
    suspects = [
        (sigma, name)
        for name, (sigma, shift) in geometry.deviations.items()
        if sigma > _WRONG_SIGMA
        and shift > _WRONG_SHIFT
        and exposures.count(plane.frames[name].exposure) > _WITNESSES
        and name not in known
    ]
    if not suspects:
        return None
    pairs = _pairs_of(matched)
    disagreement = {}
    for _, name in sorted(suspects, reverse=True)[:_MOST_SUSPECTS]:
        rest = fit_geometry(plane, {n: p for n, p in pairs.items() if n != name})
        # Sum of squares, limited so that a single frame that is certainly wrong does not dominate.
        left = [min(sigma, 3 * _WRONG_SIGMA) ** 2 for sigma, _ in rest.deviations.values()]
        disagreement[name] = sum(left)
    return min(disagreement, key=disagreement.get)


def _task(frame, result, solution, settings):
    sources = with_errors(result.sources)
    if isinstance(solution, Mapping):
        solution = solution.get(frame.detector)
    crpix = header_reference_point(frame) if solution is None else np.asarray(solution.crpix)
    return _Task(frame, sources, usable_sources(sources, frame, settings), crpix)


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


@dataclass(frozen=True, eq=False)
class _Stars:
    """Both lists of a frame in the plane of its predicted start."""

    start: object
    reference: object
    pick: np.ndarray
    xs: np.ndarray
    ys: np.ndarray
    xr: np.ndarray
    yr: np.ndarray
    flux: np.ndarray | None
    mag: np.ndarray | None


def _stars(task, prediction, catalog, settings):
    """Project sources and reference stars; `MatchError` where there are no reference stars."""
    frame = replace(task.frame, wcs=prediction)
    start = linear_wcs(prediction, task.crpix)
    reference = reference_in_reach(frame, catalog, start, settings)
    xs, ys = start.pixels(*sky_of(prediction, task.sources["x"], task.sources["y"]))
    pick = np.flatnonzero(task.usable & np.isfinite(xs) & np.isfinite(ys))
    return _Stars(
        start,
        reference,
        pick,
        xs[pick],
        ys[pick],
        *start.pixels(reference["ra"], reference["dec"]),
        numbers_or_none(task.sources, "flux", pick),
        numbers_or_none(reference, "phot_g_mean_mag"),
    )


def _center(frame):
    return 0.5 * (np.array(frame.image_shape[::-1]) - 1)


def _search(prediction):
    """Largest shift and bend of a search about a prediction, px."""
    return {
        "max_shift": _N_SIGMA * prediction.shift + _SHIFT_MARGIN,
        "max_bend": _N_SIGMA * prediction.bend + _BEND_MARGIN,
    }


def _match_together(tasks, predictions, catalog, settings):
    """Match the frames of one detector in several exposures, which share the error of its place.

    Frames that have too few stars individually are proof together.  The common result is the
    prediction for each of them.
    """
    stars = [_stars(t, p, catalog, settings) for t, p in zip(tasks, predictions, strict=True)]

    def joined(name):
        parts = [getattr(s, name) for s in stars]
        return None if any(p is None for p in parts) else np.concatenate(parts)

    searches = [_search(p) for p in predictions]
    tiles = [
        np.repeat(np.arange(len(stars)), [len(getattr(s, name)) for s in stars])
        for name in ("xs", "xr")
    ]
    linear = match_nearby(
        *(joined(name) for name in ("xs", "ys", "xr", "yr")),
        image_shape=tasks[0].frame.image_shape,
        flux=joined("flux"),
        mag=joined("mag"),
        tiles=tiles,
        **{name: max(search[name] for search in searches) for name in searches[0]},
    )[2]
    found = {}
    for task, prediction, star in zip(tasks, predictions, stars, strict=True):
        corrected = _Corrected(prediction, star.start, _center(task.frame), linear)
        try:
            found[task.frame.name] = _match(
                task, corrected, catalog, settings, max_shift=_ALIKE, max_bend=_ALIKE
            )
        except MatchError as err:
            log.debug("%s: %s", task.frame.name, err)
    return found


def _match(task, prediction, catalog, settings, **search):
    """Match a frame about its prediction; `MatchError` without evidence."""
    began = time.perf_counter()
    frame, sources = task.frame, task.sources
    stars = _stars(task, prediction, catalog, settings)
    i_src, i_ref, linear, diagnostics = match_nearby(
        stars.xs,
        stars.ys,
        stars.xr,
        stars.yr,
        image_shape=frame.image_shape,
        flux=stars.flux,
        mag=stars.mag,
        **(search or _search(prediction)),
    )
    corrected = _Corrected(prediction, stars.start, _center(frame), linear)
    start = linear_wcs(corrected, task.crpix)
    if len(i_src) >= _FOR_FULL_MATCH:
        x, y = (np.asarray(sources[c], float)[stars.pick] for c in ("x", "y"))
        try:
            i_src, i_ref, diagnostics = match_planes(
                *start.pixels(*sky_of(corrected, x, y)),
                *start.pixels(stars.reference["ra"], stars.reference["dec"]),
                flux=stars.flux,
                mag=stars.mag,
                x_err=numbers_or_none(sources, "x_err", stars.pick),
                y_err=numbers_or_none(sources, "y_err", stars.pick),
                image_shape=frame.image_shape,
                start=SmoothMap.identity(frame.image_shape),
            )
        except MatchError as err:
            # The result of the narrow search is proof by itself.
            log.debug("%s: %s", frame.name, err)
    return MatchedFrame(
        name=frame.name,
        source=frame.source,
        detector=frame.detector,
        image_shape=frame.image_shape,
        wcs=frame.wcs,
        sources=sources,
        usable=task.usable,
        reference=stars.reference,
        pairs=(stars.pick[i_src], i_ref),
        start=start,
        diagnostics=diagnostics,
        from_image=frame.load_image is not None,
        seconds=time.perf_counter() - began,
        exposure=frame.exposure,
        camera=frame.camera,
        epoch=frame.epoch,
    )
