"""Does a solution agree with its own stars?  One that does not is never delivered."""

import numpy as np

from wpdc_gwcs.evaluation import binned_residuals, evaluate
from wpdc_gwcs.exceptions import FitError

__all__ = ["check_solution"]

_MIN_STARS = 10
_MAX_SIGMA = 1.0  # px

# Frames of one detector years apart differ by a tenth of a pixel in places: that is in their
# statistics, and no reason to refuse them.
_MAX_OFFSET = 0.25  # px

# Bad seeing makes centroids worse than those a stored solution was made of, but not this much.
_STORED_RATIO = 5.0


def check_solution(frame, matches, instrument, *, stored=None):
    """Raise an error unless the solution of a frame agrees with its stars, everywhere.

    Parameters
    ----------
    frame : MatchedFrame
        The frame, for its shape and for messages.
    matches : `~astropy.table.Table`
        Columns ``x``, ``y``, residuals ``dx``, ``dy`` in px, and ``used``.
    instrument : DistortionSolution
        The distortion the frame was solved with.
    stored : DistortionSolution, optional
        The stored solution, where the frame had to take its distortion as it is.

    Raises
    ------
    FitError
        If too few stars agree, they scatter too much, a part of the frame is off as a whole, or the
        map folds.

    Notes
    -----
    The pairs have been tested against chance before; what is tested here is the map.
    """
    used = np.asarray(matches["used"])
    dx, dy = np.asarray(matches["dx"]), np.asarray(matches["dy"])
    statistics = evaluate(dx[used], dy[used])
    if statistics.n < _MIN_STARS:
        raise FitError(
            f"{frame.source}: {statistics.n} stars agree with the solution, at least "
            f"{_MIN_STARS} must"
        )
    sigma = max(statistics.sigma_dx, statistics.sigma_dy)
    if not sigma <= _MAX_SIGMA:
        raise FitError(
            f"{frame.source}: the residuals scatter by {sigma:.2f} px, at most {_MAX_SIGMA} px are "
            "accepted"
        )
    expected = None if stored is None else stored.statistics.get("sigma_px")
    if expected is not None and sigma > max(_STORED_RATIO * expected, _MAX_OFFSET):
        raise FitError(
            f"{frame.source}: the residuals scatter by {sigma:.2f} px, those of the stored "
            f"solution by {expected:.2f} px: it is not that of this detector, or no longer"
        )
    ny, nx = frame.image_shape
    x, y = np.meshgrid(np.linspace(-0.5, nx - 0.5, 33), np.linspace(-0.5, ny - 0.5, 33))
    ux, uy = instrument.undistort(x, y)
    area = np.gradient(ux, axis=1) * np.gradient(uy, axis=0)
    area -= np.gradient(ux, axis=0) * np.gradient(uy, axis=1)
    area /= (nx / 32) * (ny / 32)
    if not np.all((area > 0.5) & (area < 2.0)):
        raise FitError(
            f"{frame.source}: the solution stretches the detector by {np.nanmin(area):.2f} to "
            f"{np.nanmax(area):.2f} in area, 0.5 to 2 is accepted: the stars do not determine the "
            "distortion everywhere"
        )
    mean_dx, mean_dy, count = binned_residuals(
        np.asarray(matches["x"])[used],
        np.asarray(matches["y"])[used],
        dx[used],
        dy[used],
        image_shape=frame.image_shape,
        n_bins=4,
    )
    settled = count >= 10
    noise = 6 * sigma / np.sqrt(np.where(settled, count, 1))
    limit = np.maximum(noise, max(3 * sigma, _MAX_OFFSET))
    off = settled & (np.hypot(mean_dx, mean_dy) > limit)
    if off.any():
        worst = np.nanmax(np.hypot(mean_dx, mean_dy)[off])
        raise FitError(
            f"{frame.source}: {off.sum()} of {settled.sum()} parts of the frame are off by up to "
            f"{worst:.2f} px"
        )
