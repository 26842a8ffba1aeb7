"""Calibrations compared with the truth of a simulation.

::

    Calibration, FrameTruth --grid over the detector, matched stars--> error of the WCS
    matches, stars of the truth --> wrong pairs, pulls
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from astropy.table import QTable

from wpdc_gwcs.evaluation.cuts import Cuts

__all__ = ["TruthScore", "pool_scores", "score_frame", "tabulate_scores"]

_ALL = "all"
# For a source list, a pair is wrong if its star is not the star of the source.  For an image, it is
# wrong if the source is farther from its star than these limits, in errors and in px.
_FAR_SIGMA, _FAR_PX = 5.0, 1.0


@dataclass(frozen=True, eq=False)
class TruthScore:
    """Errors of a calibration compared with the truth.

    Parameters
    ----------
    frame : str
        Name of the frame; "all" for pooled ones.
    detector : str
        Name of the detector; "all" for a whole run.
    n_frames : int
        Number of frames.
    wcs_rms : float
        Root mean square of the length of the WCS's error over the detector, px.
    wcs_mean_dx, wcs_mean_dy : float
        Mean of the error along both axes, px.
    wcs_p95, wcs_max : float
        95th percentile and maximum of the length of the error, px.
    wcs_rms_static : float
        Root mean square of the error common to all frames of the detector, px.
    wcs_rms_stars : float
        Root mean square of the error at the stars of the fit, px.
    share_below : float
        Fraction of the area where the error is shorter than the limit.
    limit : float
        The limit, px.
    n_matched, n_wrong : int
        Number of pairs, and of wrong pairs.
    n_used, n_wrong_used : int
        The same for pairs in the fit.
    pull_wcs : float
        Ratio of the error of the WCS to its stated uncertainty, root mean square per axis; 1 is
        correct.
    pull_stars : float
        The same ratio for the measured positions, for the right pairs in the fit.
    error_x, error_y : (n, n) ndarray
        Error of the WCS on the grid over the detector, px; NaN outside the cuts.

    Examples
    --------
    >>> from wpdc_gwcs import Settings, calibrate, simulate
    >>> from wpdc_gwcs.evaluation import score_frame
    >>> sky = simulate(1, image_shape=(256, 256), density=120, distortion=2, seed=1)
    >>> exposure = sky.exposures[0]
    >>> run = calibrate([exposure.frame()], sky.reference, settings=Settings(lut="none"))
    >>> stars = exposure.observe()[1]
    >>> stars.rename_column("reference_index", "catalog_index")
    >>> score = score_frame(run.calibrations[0], exposure, stars)
    >>> score.wcs_rms < 0.05, score.wcs_rms < score.wcs_max, score.n_wrong
    (True, True, 0)
    """

    frame: str
    detector: str
    n_frames: int
    wcs_rms: float
    wcs_mean_dx: float
    wcs_mean_dy: float
    wcs_p95: float
    wcs_max: float
    wcs_rms_static: float
    wcs_rms_stars: float
    share_below: float
    limit: float
    n_matched: int
    n_wrong: int
    n_used: int
    n_wrong_used: int
    pull_wcs: float
    pull_stars: float
    error_x: np.ndarray
    error_y: np.ndarray


def score_frame(calibration, truth, stars, *, cuts=None, limit=0.01, n_grid=101):
    """Compare a calibrated frame with the truth.

    Parameters
    ----------
    calibration : Calibration
        The calibrated frame, with its ``matches``.
    truth : FrameTruth
        Truth of the frame.
    stars : `~astropy.table.Table`
        Truth of the stars, see `wpdc_gwcs.simulation.read_truth`: columns ``x``, ``y``,
        ``catalog_index`` and, for a source list, ``source_index``.
    cuts : Cuts, optional
        Limits on the area and on the stars.
    limit : float, optional
        Limit of the error for ``share_below``, px.
    n_grid : int, optional
        Points of the grid along each axis, from edge to edge of the detector.

    Returns
    -------
    TruthScore
        The score.

    Raises
    ------
    ValueError
        If the calibration has no matches, or is of another detector.

    Examples
    --------
    >>> from wpdc_gwcs import Settings, calibrate, simulate
    >>> from wpdc_gwcs.evaluation import score_frame
    >>> sky = simulate(1, image_shape=(256, 256), density=120, distortion=2, seed=1)
    >>> exposure = sky.exposures[0]
    >>> run = calibrate([exposure.frame()], sky.reference, settings=Settings(lut="none"))
    >>> stars = exposure.observe()[1]
    >>> stars.rename_column("reference_index", "catalog_index")
    >>> score = score_frame(run.calibrations[0], exposure, stars)
    >>> score.n_matched == len(run.calibrations[0].matches), score.n_wrong
    (True, 0)
    """
    m, solution = calibration.matches, calibration.solution
    if m is None:
        raise ValueError("score_frame needs a calibrated frame with its matches")
    if tuple(solution.image_shape) != tuple(truth.image_shape):
        raise ValueError(
            f"frame {calibration.frame} must have the shape of its truth, {truth.image_shape}, has "
            f"{tuple(solution.image_shape)}"
        )
    cuts = Cuts() if cuts is None else cuts
    if truth.color is not None:
        calibration = calibration.at_color(truth.color)
    x, y, dx, dy = truth.wcs_error(calibration.wcs, n_grid=n_grid)
    inside = cuts.place(x, y, solution.crpix)
    error = np.where(inside, [dx, dy], np.nan)
    sigma_x, sigma_y, rho = calibration.uncertainty(x, y)
    with np.errstate(invalid="ignore", divide="ignore"):
        a, b = error[0] / sigma_x, error[1] / sigma_y
        squared = (a * a - 2 * rho * a * b + b * b) / (1 - rho * rho) / 2

    chosen = cuts.select(m, solution.crpix)
    used = np.asarray(m["used"], bool) & chosen
    star, wrong = _true_stars(m, stars)
    at = [np.asarray(m[name], float)[used] for name in ("x", "y")]
    at_stars = truth.error_at(calibration.wcs, *at)
    right = used & ~wrong
    pulls = [
        (np.asarray(m[name], float)[right] - np.asarray(stars[name], float)[star[right]])
        / np.asarray(m[f"{name}_err"], float)[right]
        for name in ("x", "y")
    ]
    return TruthScore(
        calibration.frame,
        solution.detector,
        1,
        **_moments(error, limit),
        wcs_rms_static=np.nan,
        wcs_rms_stars=_rms(np.hypot(*at_stars)),
        limit=limit,
        n_matched=int(chosen.sum()),
        n_wrong=int((wrong & chosen).sum()),
        n_used=int(used.sum()),
        n_wrong_used=int((wrong & used).sum()),
        pull_wcs=_rms(np.sqrt(squared)),
        pull_stars=_rms(pulls),
        error_x=error[0].reshape(n_grid, n_grid),
        error_y=error[1].reshape(n_grid, n_grid),
    )


def _true_stars(matches, stars):
    """Row of each pair's star in the truth (-1 for none), and whether the pair is wrong."""
    catalog = np.asarray(matches["catalog_index"], int)
    row_of = _rows(stars["catalog_index"], catalog.max(initial=0) + 1)
    star = row_of[catalog]
    if "source_index" in stars.colnames:
        source = np.asarray(matches["source_index"], int)
        true = _rows(stars["source_index"], source.max(initial=0) + 1)[source]
        return star, (star < 0) | (true != star)
    off = np.hypot(
        *(np.asarray(matches[k], float) - np.asarray(stars[k], float)[star] for k in ("x", "y"))
    )
    error = np.hypot(*(np.asarray(matches[f"{k}_err"], float) for k in ("x", "y")))
    return star, (star < 0) | (off > np.maximum(_FAR_SIGMA * error, _FAR_PX))


def _rows(index, size):
    """Row of the truth for each index of a list or catalog, -1 for none."""
    index = np.asarray(index, int)
    known = np.flatnonzero((index >= 0) & (index < size))
    rows = np.full(size, -1)
    rows[index[known]] = known
    return rows


def _rms(values):
    values = np.asarray(values, float)
    values = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(values**2))) if values.size else np.nan


def _moments(error, limit):
    length = np.hypot(*error)
    inside = np.isfinite(length)
    if not inside.any():
        return dict.fromkeys(
            ("wcs_rms", "wcs_mean_dx", "wcs_mean_dy", "wcs_p95", "wcs_max", "share_below"), np.nan
        )
    length = length[inside]
    return {
        "wcs_rms": _rms(length),
        "wcs_mean_dx": float(error[0][inside].mean()),
        "wcs_mean_dy": float(error[1][inside].mean()),
        "wcs_p95": float(np.percentile(length, 95)),
        "wcs_max": float(length.max()),
        "share_below": float(np.mean(length < limit)),
    }


def pool_scores(scores):
    """Pool the scores of frames by detector, and over all detectors.

    Parameters
    ----------
    scores : sequence of TruthScore
        Scores of frames, all with the same limit.

    Returns
    -------
    list of TruthScore
        One for each detector, sorted by name; if there are several, the last one is for all.  The
        errors on the grid are means over the frames.

    Raises
    ------
    ValueError
        If there are no scores.

    Examples
    --------
    >>> from wpdc_gwcs import Settings, calibrate, simulate
    >>> from wpdc_gwcs.evaluation import pool_scores, score_frame
    >>> sky = simulate(2, image_shape=(256, 256), density=120, distortion=2, seed=1)
    >>> frames = [exposure.frame() for exposure in sky.exposures]
    >>> run = calibrate(frames, sky.reference, settings=Settings(lut="none"))
    >>> scores = []
    >>> for exposure, calibration in zip(sky.exposures, run.calibrations):
    ...     stars = exposure.observe()[1]
    ...     stars.rename_column("reference_index", "catalog_index")
    ...     scores.append(score_frame(calibration, exposure, stars))
    >>> (detector,) = pool_scores(scores)
    >>> detector.n_frames, detector.n_matched == sum(score.n_matched for score in scores)
    (2, True)
    """
    if not isinstance(scores, Sequence) or not scores:
        raise ValueError("pool_scores needs the scores of at least one frame")
    groups = {}
    for score in scores:
        groups.setdefault(score.detector, []).append(score)
    found = [_pool(group, detector) for detector, group in sorted(groups.items())]
    if len(found) > 1:
        static = _rms([s.wcs_rms_static for s in found])
        found.append(_pool(list(scores), _ALL, static))
    return found


def _pool(group, detector, static=None):
    errors = np.array([[s.error_x.ravel(), s.error_y.ravel()] for s in group]).transpose(1, 0, 2)
    mean = errors.mean(axis=1)
    number = np.array([s.n_used for s in group], float)

    def over_stars(name):
        values = np.array([getattr(s, name) for s in group])
        known = np.isfinite(values) & (number > 0)
        if not known.any():
            return np.nan
        return float(np.sqrt(np.average(values[known] ** 2, weights=number[known])))

    side = group[0].error_x.shape
    return TruthScore(
        _ALL,
        detector,
        len(group),
        **_moments(errors.reshape(2, -1), group[0].limit),
        wcs_rms_static=_rms(np.hypot(*mean)) if static is None else static,
        wcs_rms_stars=over_stars("wcs_rms_stars"),
        limit=group[0].limit,
        **{
            name: sum(getattr(s, name) for s in group)
            for name in ("n_matched", "n_wrong", "n_used", "n_wrong_used")
        },
        pull_wcs=_rms([s.pull_wcs for s in group]),
        pull_stars=over_stars("pull_stars"),
        error_x=mean[0].reshape(side),
        error_y=mean[1].reshape(side),
    )


def tabulate_scores(scores):
    """Tabulate scores.

    Parameters
    ----------
    scores : sequence of TruthScore
        Scores of frames, or pooled ones.

    Returns
    -------
    `~astropy.table.QTable`
        One row each, with all fields of `TruthScore` except the errors on the grid.

    Examples
    --------
    >>> from wpdc_gwcs import Settings, calibrate, simulate
    >>> from wpdc_gwcs.evaluation import score_frame, tabulate_scores
    >>> sky = simulate(1, image_shape=(256, 256), density=120, distortion=2, seed=1)
    >>> exposure = sky.exposures[0]
    >>> run = calibrate([exposure.frame()], sky.reference, settings=Settings(lut="none"))
    >>> stars = exposure.observe()[1]
    >>> stars.rename_column("reference_index", "catalog_index")
    >>> table = tabulate_scores([score_frame(run.calibrations[0], exposure, stars)])
    >>> print(table["frame", "detector", "n_wrong"])
    frame  detector n_wrong
    ------ -------- -------
    sim-01      sim       0
    """
    return QTable(
        [{k: v for k, v in vars(s).items() if k not in ("error_x", "error_y")} for s in scores]
    )
