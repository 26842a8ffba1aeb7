"""The paper's literal solution of matched frames: header tangent points, and new pairs."""

import numpy as np

from wpdc_gwcs.calibration.start import LinearWCS, detector_center, linear_wcs
from wpdc_gwcs.matching import pair_again
from wpdc_gwcs.paper import solve_literally

__all__ = ["solve_frames_literally"]

#: Degree of the paper's polynomial.
_DEGREE = 3


def solve_frames_literally(group, settings, *, exposure_of, solution):
    """Solve frames as the paper does.

    Parameters
    ----------
    group : list of MatchedFrame
        Matched frames of any detectors; each is solved by itself.
    settings : Settings
        Settings of the run.
    exposure_of : callable
        ``exposure_of(frame, pairs, attitude)`` returns an `~wpdc_gwcs.solve.Exposure`.
    solution : dict
        Stored solutions by detector.

    Returns
    -------
    result : SolveResult
        Solutions and exposures.
    pairs : list of tuple
        Pairs of each frame from the last match.
    """
    starts = [_tangent_point(frame, settings, solution) for frame in group]
    pairs = [frame.pairs for frame in group]

    def rematch(k, correct):
        frame, start = group[k], starts[k]
        pick = np.flatnonzero(frame.usable)
        places = correct(*(np.asarray(frame.sources[c], float)[pick] for c in "xy"))
        stars = start.pixels(frame.reference["ra"], frame.reference["dec"])
        i_src, i_ref = pair_again(
            *places,
            *stars,
            np.searchsorted(pick, pairs[k][0]),
            pairs[k][1],
            image_shape=frame.image_shape,
        )
        pairs[k] = pick[i_src], i_ref
        return exposure_of(frame, pairs[k], start)

    shapes = {frame.detector: tuple(frame.image_shape) for frame in group}
    result, _ = solve_literally(
        [exposure_of(f, p, s) for f, p, s in zip(group, pairs, starts, strict=True)],
        [start.crpix for start in starts],
        image_shape=shapes,
        weight={name: settings.radial_weight(shape) for name, shape in shapes.items()},
        degree=_DEGREE if settings.degree == "auto" else settings.degree,
        n_grid=settings.n_grid,
        lut=settings.lut,
        solution=solution,
        rematch=rematch,
    )
    return result, pairs


def _tangent_point(frame, settings, solution):
    """Linear WCS of the header about the reference point that was chosen."""
    if frame.detector in solution or settings.reference_point == "header":
        return frame.start
    center = detector_center(frame.image_shape)
    if settings.reference_point == "center":
        return linear_wcs(frame.wcs, center)
    # "The matched source nearest to the detector center": its star is the tangent point.
    i_src, i_ref = frame.pairs
    x, y = (np.asarray(frame.sources[c], float)[i_src] for c in "xy")
    nearest = int(np.argmin(np.hypot(x - center[0], y - center[1])))
    point = np.array([x[nearest], y[nearest]])
    star = [float(frame.reference[c][i_ref[nearest]]) for c in ("ra", "dec")]
    return LinearWCS(crpix=point, cd=linear_wcs(frame.wcs, point).cd, crval=np.array(star))
