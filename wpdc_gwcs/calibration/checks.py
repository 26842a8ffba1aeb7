"""Checks of a solution against its own stars.

A solution that contradicts its stars is never delivered.  A solution with shortcomings is delivered
as degraded, with the reasons.
"""

import numpy as np
from scipy.spatial import ConvexHull, QhullError, cKDTree

from wpdc_gwcs.counts import counted
from wpdc_gwcs.detector import on_detector
from wpdc_gwcs.evaluation import binned_residuals
from wpdc_gwcs.exceptions import FitError

__all__ = ["check_solution", "shortcomings"]

# Minimum number of stars that agree with a solution: with fewer, one wrong pair could spoil the six
# linear numbers.  If other frames determine the position of the detector, fewer stars are enough.
_MIN_STARS, _MIN_STARS_KNOWN = 10, 4

# Maximum scatter of the residuals, in px or in units of their errors, whichever is larger.
_MAX_SIGMA = 1.0
_MAX_OVER_ERRORS = 3.0

# Frames of one detector that are years apart may differ by a tenth of a pixel in some parts.  Their
# statistics show this, and it is no reason to doubt them.
_MAX_OFFSET = 0.25  # px

# Bad seeing makes centroids worse than those of the stored solution, but not by this factor.
_STORED_RATIO = 5.0

# Minimum fraction of the detector within the outline of the stars; about 35 random stars reach it.
_MIN_COVERAGE = 0.7

# Largest fraction of the detector that a circle without stars may cover: 20 or more random stars
# hardly ever leave such a hole, but stars along the edge always do.
_MAX_HOLE = 0.35

# Points along each axis at which circles are centered.
_HOLE_NODES = 41

# Uncertainty of the map, px, and the fraction of the detector that may exceed it.
_MAX_MAP_SIGMA, _UNCERTAIN_SHARE = 0.25, 0.05

# Minimum fraction of the matched stars that the fit uses, and of the shorter list that matches.
_MIN_USED, _MIN_COMPLETENESS = 0.7, 0.3

# The same for all detections, including those that are flagged, not round or faint.  If most are,
# the measurement itself is wrong, and the few correct pairs are luck.
_MIN_DETECTED = 0.25

# Limits of the area of a pixel relative to the median; beyond them, the map is close to folding.
_MIN_AREA, _MAX_AREA = 0.5, 2.0


def check_solution(frame, calibration, *, stored=None, known=False):
    """Raise an error if the solution of a frame contradicts its stars.

    Parameters
    ----------
    frame : MatchedFrame
        The frame, for messages.
    calibration : Calibration
        Calibration of the frame, with matches and statistics.
    stored : DistortionSolution, optional
        The stored solution, if the frame uses its distortion unchanged.
    known : bool, optional
        Whether other detectors or a stored solution determine the position of this detector.

    Raises
    ------
    FitError
        If too few stars agree with the solution, if its map folds, so that two pixels have the same
        position, or if the residuals scatter far more than their errors or than the residuals of
        the stored solution.

    Notes
    -----
    The pairs have already been tested against chance; this function tests the map.
    """
    statistics = calibration.statistics
    residuals = statistics["residuals"]
    least = _MIN_STARS_KNOWN if known else _MIN_STARS
    if statistics["n_used"] < least:
        raise FitError(
            f"{frame.source}: only {counted(statistics['n_used'], 'star')} could be fitted; at "
            f"least {least} are needed"
        )
    low, high = calibration.solution.area_range
    if not low > 0:
        raise FitError(
            f"{frame.source}: the map folds, it changes the area of pixels by factors of {low:.2f} "
            f"to {high:.2f}: its {counted(statistics['n_used'], 'star')} do not determine it"
        )
    used = np.asarray(calibration.matches["used"])
    sigma = max(residuals["sigma_dx"], residuals["sigma_dy"])
    errors = [np.asarray(calibration.matches[c], float)[used] for c in ("x_err", "y_err")]
    typical = float(np.median(errors))
    if sigma > max(_MAX_SIGMA, _MAX_OVER_ERRORS * typical):
        raise FitError(
            f"{frame.source}: the residuals scatter by {sigma:.2f} px; at most {_MAX_SIGMA} px, or "
            f"{_MAX_OVER_ERRORS:g} times their errors of {typical:.2f} px, is accepted"
        )
    expected = None if stored is None else stored.statistics.get("sigma_px")
    if expected is not None and sigma > max(_STORED_RATIO * expected, _MAX_OFFSET):
        raise FitError(
            f"{frame.source}: the residuals scatter by {sigma:.2f} px, those of the stored "
            f"solution by {expected:.2f} px: it is not for this detector, or no longer valid"
        )


def shortcomings(frame, calibration, *, held, known=False, stored=None):
    """List the shortcomings of a delivered solution.

    Parameters
    ----------
    frame : MatchedFrame
        The frame.
    calibration : Calibration
        Calibration of the frame, with matches, uncertainty and statistics.
    held : (N,) ndarray of bool
        Mask of the matches that were held out of the fit.
    known : bool, optional
        Whether other detectors or a stored solution determine the distortion.
    stored : DistortionSolution, optional
        The stored solution that was used.

    Returns
    -------
    list of str
        Reasons with their numbers; empty if the solution has no shortcomings.
    """
    reasons = []
    ny, nx = frame.image_shape
    matches = calibration.matches
    used = np.asarray(matches["used"])
    x, y = np.asarray(matches["x"], float)[used], np.asarray(matches["y"], float)[used]
    share = coverage(x, y, frame.image_shape)
    hole = largest_hole(x, y, frame.image_shape)
    if known:
        pass  # other frames have stars where this one has none
    elif share < _MIN_COVERAGE:
        reasons.append(
            f"its {counted(used.sum(), 'star')} cover {share:.0%} of the detector (x "
            f"{x.min():.0f} to {x.max():.0f} of {nx} px, y {y.min():.0f} to {y.max():.0f} of {ny})"
        )
    elif hole > _MAX_HOLE:
        reasons.append(
            f"a circle of {hole:.0%} of the detector is empty of its {counted(used.sum(), 'star')}"
        )
    sigma = np.max(np.asarray(calibration.sigma)[:2], axis=0)
    uncertain = float(np.mean(~(sigma <= _MAX_MAP_SIGMA)))
    if uncertain > _UNCERTAIN_SHARE:
        reasons.append(
            f"the map is uncertain by more than {_MAX_MAP_SIGMA} px over {uncertain:.0%} of the "
            f"detector, by {np.max(sigma):.2g} px at worst"
        )
    n = int(np.sum(~held))
    if used.sum() < _MIN_USED * n:
        reasons.append(f"only {used.sum()} of {n} matched stars agree with the solution")
    if stored is not None and not stored.holds_at(frame.epoch):
        reasons.append(
            f"the stored solution is valid {stored.validity}; the frame is from {frame.epoch:.4f}"
        )
    match = frame.diagnostics
    if match.completeness < _MIN_COMPLETENESS:
        reasons.append(
            f"only {match.n_pairs} of {match.n_sources} clean detections and {match.n_reference} "
            "reference stars on the frame match"
        )
    else:
        reasons += _few_detections(frame, match)
    if frame.epoch is None and "pmra" in frame.reference.colnames:
        reasons.append("the frame has no epoch: the stars' motions could not be applied (--epoch)")
    low, high = calibration.solution.area_range
    if not (low >= _MIN_AREA and high <= _MAX_AREA):
        reasons.append(f"the map changes the area of pixels by factors of {low:.2f} to {high:.2f}")
    offset = _offset_of_parts(matches, used, frame.image_shape, calibration.statistics)
    if offset is not None:
        reasons.append(offset)
    return reasons


def _few_detections(frame, match):
    """Reasons if few of all detections, or of the brightest clean ones, match."""
    sources = frame.sources
    detected = int(on_detector(sources["x"], sources["y"], frame.image_shape).sum())
    if match.n_pairs < _MIN_DETECTED * min(detected, match.n_reference):
        return [
            f"only {match.n_pairs} of {detected} detections match: {detected - match.n_sources} "
            "are left out (flagged, not round or faint); the catalog has "
            f"{counted(match.n_reference, 'star')} on the frame"
        ]
    # A shallow catalog has only the bright stars, and says nothing about the faint ones.
    clean = np.flatnonzero(frame.usable)
    if "flux" not in sources.colnames or len(clean) <= match.n_reference:
        return []
    flux = np.nan_to_num(np.asarray(sources["flux"], float)[clean], nan=-np.inf)
    bright = clean[np.argsort(-flux, kind="stable")[: match.n_reference]]
    matched = int(np.isin(bright, frame.pairs[0]).sum())
    if matched >= _MIN_COMPLETENESS * len(bright):
        return []
    return [
        f"only {matched} of the {len(bright)} brightest of {match.n_sources} clean detections "
        "match; the catalog has as many stars on the frame"
    ]


def coverage(x, y, image_shape):
    """Return the fraction of a detector within the outline of some stars.

    Parameters
    ----------
    x, y : (N,) array_like
        Pixels of the stars.
    image_shape : (int, int)
        Shape ``(ny, nx)``.

    Returns
    -------
    float
        Area of the convex hull of the stars divided by that of the detector.
    """
    if len(x) < 3:
        return 0.0
    try:
        return float(ConvexHull(np.stack([x, y], axis=1)).volume / np.prod(image_shape))
    except QhullError:
        return 0.0


def largest_hole(x, y, image_shape):
    """Return the fraction of a detector that the largest circle without stars covers.

    Parameters
    ----------
    x, y : (N,) array_like
        Pixels of the stars.
    image_shape : (int, int)
        Shape ``(ny, nx)``.

    Returns
    -------
    float
        Area of the circle divided by that of the detector, with the detector stretched to a
        square; 1 if there are no stars.
    """
    if not len(x):
        return 1.0
    ny, nx = image_shape
    nodes = (np.arange(_HOLE_NODES) + 0.5) / _HOLE_NODES
    u, v = (a.ravel() for a in np.meshgrid(nodes, nodes))
    stars = np.stack([(np.asarray(x) + 0.5) / nx, (np.asarray(y) + 0.5) / ny], axis=1)
    distance, _ = cKDTree(stars).query(np.stack([u, v], axis=1))
    # Near the edge, large empty circles are normal, so they do not count beyond it.
    rim = np.min([u, 1 - u, v, 1 - v], axis=0)
    return float(np.pi * np.max(np.minimum(distance, rim)) ** 2)


def _offset_of_parts(matches, used, image_shape, statistics):
    """Describe parts of the frame that are off as a whole; `None` if there are none."""
    sigma = max(statistics["residuals"]["sigma_dx"], statistics["residuals"]["sigma_dy"])
    columns = [np.asarray(matches[c], float)[used] for c in ("x", "y", "dx", "dy")]
    mean_dx, mean_dy, count = binned_residuals(*columns, image_shape=image_shape, n_bins=4)
    settled = count >= 10
    noise = 6 * sigma / np.sqrt(np.where(settled, count, 1))
    limit = np.maximum(noise, max(3 * sigma, _MAX_OFFSET))
    off = settled & (np.hypot(mean_dx, mean_dy) > limit)
    if not off.any():
        return None
    worst = np.nanmax(np.hypot(mean_dx, mean_dy)[off])
    return f"{off.sum()} of {settled.sum()} parts of the frame are off by up to {worst:.2f} px"
