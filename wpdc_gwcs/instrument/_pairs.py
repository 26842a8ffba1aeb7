"""All pairs of all exposures, checked, in flat arrays."""

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from wpdc_gwcs.exceptions import FitError
from wpdc_gwcs.fitting import MIN_STARS_ATTITUDE

# Smallest share of the detector that the stars' outline covers.
_MIN_COVERAGE = 0.2


class Pairs:
    """All pairs of all exposures in flat arrays, with one slice per exposure."""

    def __init__(self, exposures, image_shape, crpix):
        self.exposures, self.image_shape, self.crpix = exposures, image_shape, crpix
        sizes = [np.size(e.x) for e in exposures]
        edges = np.concatenate([[0], np.cumsum(sizes)])
        self.slices = [slice(a, b) for a, b in zip(edges[:-1], edges[1:])]
        n = int(edges[-1])
        self.x, self.y, self.ra, self.dec = (np.empty(n) for _ in range(4))
        self.given_error = np.full((2, n), np.nan)
        self.has_errors = np.zeros(n, bool)
        self.valid = np.ones(n, bool)
        for e, s in zip(exposures, self.slices):
            start = np.asarray(e.crval, dtype=float), np.asarray(e.cd, dtype=float)
            if not all(np.isfinite(a).all() for a in start) or np.linalg.det(start[1]) == 0:
                raise FitError(
                    f"exposure {e.name}: it must start from a finite CRVAL and an invertible CD, "
                    f"got {start[0].tolist()} and {start[1].tolist()}"
                )
            for name in ("x", "y", "ra", "dec"):
                value = np.ravel(np.asarray(getattr(e, name), dtype=float))
                if value.size != s.stop - s.start:
                    raise ValueError(
                        f"exposure {e.name}: {name} has {value.size} values, x has "
                        f"{s.stop - s.start}"
                    )
                getattr(self, name)[s] = value
            if e.x_err is not None and e.y_err is not None:
                self.given_error[0, s], self.given_error[1, s] = e.x_err, e.y_err
                self.has_errors[s] = True
            if e.use is not None:
                self.valid[s] &= np.asarray(e.use, bool)
        ny, nx = image_shape
        finite = np.isfinite(self.x + self.y + self.ra + self.dec)
        inside = (np.abs(self.x - 0.5 * (nx - 1)) <= 0.5 * nx) & (
            np.abs(self.y - 0.5 * (ny - 1)) <= 0.5 * ny
        )
        self.finite = finite & inside
        good_error = (np.isfinite(self.given_error) & (self.given_error > 0)).all(0)
        self.bad_error = self.has_errors & ~good_error
        allowed = int(self.valid.sum())
        self.valid &= self.finite & ~self.bad_error
        if not np.any(self.valid):
            raise FitError(
                f"none of {n} pairs can be used: {int((~finite).sum())} have NaN positions, "
                f"{int((finite & ~inside).sum())} lie off the detector of {nx} x {ny} px, "
                f"{int(self.bad_error.sum())} "
                f"have errors that are NaN, infinite or not positive, {n - allowed} are held out"
            )
        # Pairs of no known error count as 1 px until the residuals tell.
        self.sigma = np.where(self.has_errors & good_error, self.given_error, 1.0)
        self.half = 0.5 * max(image_shape)
        self.u = np.where(self.finite, (self.x - 0.5 * (nx - 1)) / self.half, 0.0)
        self.v = np.where(self.finite, (self.y - 0.5 * (ny - 1)) / self.half, 0.0)

    def __len__(self):
        return len(self.x)


def check_coverage(pairs):
    """Refuse stars that say nothing about most of the detector."""
    x, y = pairs.x[pairs.valid], pairs.y[pairs.valid]
    ny, nx = pairs.image_shape
    n = len(x)
    if n < MIN_STARS_ATTITUDE:
        raise FitError(f"{n} pairs are too few: at least {MIN_STARS_ATTITUDE} are needed")
    try:
        share = ConvexHull(np.stack([x, y], axis=1)).volume / (nx * ny)
    except QhullError:
        share = 0.0
    if share < _MIN_COVERAGE:
        raise FitError(
            f"the {n} stars span {share:.1%} of the detector (x {x.min():.0f} to {x.max():.0f} "
            f"of {nx} px, y "
            f"{y.min():.0f} to {y.max():.0f} of {ny}): at least {_MIN_COVERAGE:.0%} is needed "
            "for its distortion"
        )
