"""Binned residuals of any number of stars."""

import numpy as np

from wpdc_gwcs.detector import on_detector

__all__ = ["N_FOLDS", "ResidualMap"]


# Sums that every bin keeps; w = 1 / sigma^2, where sigma^2 is the mean of both axes.
_SUMS = (
    "n", "w", "wx", "wy", "wxx", "wxy", "wyy",
    "wdx", "wdy", "wdxdx", "wdxdy", "wdydy", "wwvx", "wwvy",
)  # fmt: skip

# Bins along the longer side of the detector; 128 px for the paper's 9216.
_BINS = 72

# Numbers of bins are multiples of this, so that 2, 3 or 4 bins can be joined.
_BLOCK = 12

# Number of groups of exposures (for one exposure, of stars) that cross-validation leaves out.
N_FOLDS = 5


class ResidualMap:
    """Weighted residuals of any number of stars, binned over the detector, in constant memory.

    Parameters
    ----------
    image_shape : (int, int)
        Shape ``(ny, nx)`` of the detector in px.
    sums : (K, 14, my, mx) ndarray, optional
        Sums of an existing map, in the order of `ResidualMap.columns`.  Default: an empty map.
    shape : (int, int), optional
        Bins ``(my, mx)``.  Default: 72 along the longer side, and a multiple of 12 along the other.

    Raises
    ------
    ValueError
        If a shape is invalid.

    Notes
    -----
    Each bin has the number of stars, the sum of weights, the weighted first and second moments of
    the positions and of the residuals, and the variance of the mean.  They are kept separately for
    K = 5 groups of exposures, which cross-validation leaves out in turn.  Maps of the same geometry
    can be added in any order and grouping.

    Examples
    --------
    >>> import numpy as np
    >>> from wpdc_gwcs import ResidualMap
    >>> x, y = np.random.default_rng(1).uniform(0, 2047, (2, 5000))
    >>> maps = [
    ...     ResidualMap.from_residuals(x[i::2], y[i::2], 0.1, -0.2, x_err=0.05, y_err=0.05,
    ...                                image_shape=(2048, 2048), fold=i) for i in range(2)
    ... ]
    >>> total = maps[0] + maps[1]
    >>> total.n_stars, float(np.nanmax(total.mean[0]))
    (5000, 0.1)
    """

    columns = _SUMS

    def __init__(self, image_shape, sums=None, *, shape=None):
        ny, nx = (int(n) for n in image_shape)
        if min(ny, nx) < 1:
            raise ValueError(f"image_shape must be two positive sizes, got {image_shape}")
        self.image_shape = (ny, nx)
        if sums is None:
            if shape is None:
                size = max(ny, nx) * _BLOCK / _BINS
                shape = (_BLOCK * max(1, round(ny / size)), _BLOCK * max(1, round(nx / size)))
            sums = np.zeros((N_FOLDS, len(_SUMS), *shape))
        sums = np.asarray(sums, dtype=float)
        if sums.ndim != 4 or sums.shape[:2] != (N_FOLDS, len(_SUMS)):
            raise ValueError(
                f"sums must have shape ({N_FOLDS}, {len(_SUMS)}, my, mx), got {sums.shape}"
            )
        self.sums = sums

    @classmethod
    def from_residuals(cls, x, y, dx, dy, *, x_err, y_err, image_shape, fold=0, shape=None):
        """Make the map of the residuals of one frame.

        Parameters
        ----------
        x, y : (N,) array_like
            Positions on the detector, px, zero based.
        dx, dy : (N,) or float array_like
            Residuals X' - X_ref and Y' - Y_ref, px.
        x_err, y_err : (N,) or float array_like
            1-sigma errors of the residuals, px.
        image_shape : (int, int)
            Shape ``(ny, nx)`` of the detector.
        fold : int or (N,) array_like of int, optional
            Group of the exposure, or of each star, in cross-validation; any integer.
        shape : (int, int), optional
            Bins ``(my, mx)``.

        Returns
        -------
        ResidualMap
            The map, without stars that are off the detector, have NaN, or errors that are not
            positive.
        """
        self = cls(image_shape, shape=shape)
        ny, nx = self.image_shape
        my, mx = self.shape
        values = np.broadcast_arrays(
            *(np.asarray(v, dtype=float).ravel() for v in (x, y, dx, dy, x_err, y_err)),
            np.asarray(fold).ravel(),
        )
        x, y, dx, dy, x_err, y_err, fold = values
        variance = 0.5 * (x_err**2 + y_err**2)
        good = np.isfinite(x + y + dx + dy + variance) & (variance > 0)
        good &= on_detector(x, y, self.image_shape)
        x, y, dx, dy, x_err, y_err, fold, variance = (
            v[good] for v in (x, y, dx, dy, x_err, y_err, fold, variance)
        )
        ix = np.minimum(((x + 0.5) * (mx / nx)).astype(int), mx - 1)
        iy = np.minimum(((y + 0.5) * (my / ny)).astype(int), my - 1)
        index = ((fold.astype(int) % N_FOLDS) * my + iy) * mx + ix
        # Moments of position are about the center of the bin: second moments about a distant point
        # would be differences of large numbers.
        u = x - ((ix + 0.5) * (nx / mx) - 0.5)
        v = y - ((iy + 0.5) * (ny / my) - 0.5)
        w = 1.0 / variance
        terms = (
            np.ones_like(w), w, w * u, w * v, w * u * u, w * u * v, w * v * v, w * dx, w * dy,
            w * dx * dx, w * dx * dy, w * dy * dy, w * w * x_err**2, w * w * y_err**2,
        )  # fmt: skip
        for k, term in enumerate(terms):
            self.sums[:, k] = np.bincount(index, weights=term, minlength=N_FOLDS * my * mx).reshape(
                N_FOLDS, my, mx
            )
        return self

    def __add__(self, other):
        if not isinstance(other, ResidualMap):
            return NotImplemented
        if (self.image_shape, self.shape) != (other.image_shape, other.shape):
            raise ValueError(
                f"residual maps must have the same geometry: detector {self.image_shape} in "
                f"{self.shape} bins "
                f"and {other.image_shape} in {other.shape}"
            )
        return ResidualMap(self.image_shape, self.sums + other.sums)

    def __eq__(self, other):
        if not isinstance(other, ResidualMap):
            return NotImplemented
        return self.image_shape == other.image_shape and np.array_equal(self.sums, other.sums)

    __hash__ = None

    def __repr__(self):
        return f"<ResidualMap {self.image_shape} in {self.shape} bins, {self.n_stars} stars>"

    @property
    def shape(self):
        """Bins ``(my, mx)``."""
        return self.sums.shape[2:]

    @property
    def n_stars(self):
        """Number of stars in the map."""
        return int(round(self.sums[:, 0].sum()))

    @property
    def counts(self):
        """Number of stars in every bin, ``(my, mx)``."""
        return self.sums[:, 0].sum(0)

    @property
    def folds(self):
        """Groups that have stars."""
        return np.flatnonzero(self.sums[:, 0].sum((1, 2)) > 0)

    @property
    def mean(self):
        """Weighted mean residuals ``(2, my, mx)``, px; NaN where there are no stars."""
        total = self.sums.sum(0)
        with np.errstate(invalid="ignore", divide="ignore"):
            return total[7:9] / total[1]

    @property
    def sigma(self):
        """Standard errors of the mean residuals ``(2, my, mx)``, px, from the stars' errors."""
        total = self.sums.sum(0)
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.sqrt(total[12:14]) / total[1]

    @property
    def centroid(self):
        """Weighted mean positions ``(2, my, mx)`` of the stars in every bin, px."""
        total = self.sums.sum(0)
        with np.errstate(invalid="ignore", divide="ignore"):
            return total[2:4] / total[1] + self._centers()

    def _centers(self):
        (ny, nx), (my, mx) = self.image_shape, self.shape
        cx = (np.arange(mx) + 0.5) * (nx / mx) - 0.5
        cy = (np.arange(my) + 0.5) * (ny / my) - 0.5
        return np.array(np.meshgrid(cx, cy))

    def coarsen(self, factor=2):
        """Join bins along both axes.

        Parameters
        ----------
        factor : int, optional
            Bins joined along each axis.

        Returns
        -------
        ResidualMap
            The same residuals in larger bins.

        Raises
        ------
        ValueError
            If the factor does not divide the numbers of bins.
        """
        my, mx = self.shape
        if my % factor or mx % factor:
            raise ValueError(f"factor {factor} does not divide the numbers of bins {self.shape}")
        ky, kx = my // factor, mx // factor
        coarse = ResidualMap(self.image_shape, shape=(ky, kx))
        s = self.sums
        # Moments move from the centers of the small bins to those of the large ones.
        ox, oy = self._centers() - coarse._centers().repeat(factor, axis=1).repeat(factor, axis=2)
        moved = s.copy()
        moved[:, 2] += s[:, 1] * ox
        moved[:, 3] += s[:, 1] * oy
        moved[:, 4] += 2 * s[:, 2] * ox + s[:, 1] * ox**2
        moved[:, 5] += s[:, 2] * oy + s[:, 3] * ox + s[:, 1] * ox * oy
        moved[:, 6] += 2 * s[:, 3] * oy + s[:, 1] * oy**2
        coarse.sums = moved.reshape(*s.shape[:2], ky, factor, kx, factor).sum((3, 5))
        return coarse

    def displaced(self, dx, dy):
        """Add a displacement to the residuals of each bin.

        Parameters
        ----------
        dx, dy : (my, mx) array_like
            Displacement at the centroid of each bin, px.

        Returns
        -------
        ResidualMap
            Map in which the residuals of all stars of a bin are increased by its displacement.
        """
        dx, dy = np.asarray(dx, float), np.asarray(dy, float)
        sums = self.sums.copy()
        w, wx, wy = (self.sums[:, k] for k in (1, 7, 8))
        sums[:, 7] += w * dx
        sums[:, 8] += w * dy
        sums[:, 9] += 2 * wx * dx + w * dx**2
        sums[:, 10] += wx * dy + wy * dx + w * dx * dy
        sums[:, 11] += 2 * wy * dy + w * dy**2
        return ResidualMap(self.image_shape, sums)

    def weighted(self, factor):
        """Return the map with other weights of the residuals.

        Parameters
        ----------
        factor : float
            Positive factor that multiplies all weights and divides the variances of all means.

        Returns
        -------
        ResidualMap
            Map with the same numbers of stars.
        """
        sums = self.sums.copy()
        sums[:, 1:] *= factor
        return ResidualMap(self.image_shape, sums)

    def without(self, fold):
        """Return the map without one group, for cross-validation.

        Parameters
        ----------
        fold : int
            Group that is left out.

        Returns
        -------
        ResidualMap
            Map of the other groups.
        """
        sums = self.sums.copy()
        sums[fold] = 0.0
        return ResidualMap(self.image_shape, sums)

    def only(self, fold):
        """Return the map of a single group.

        Parameters
        ----------
        fold : int
            Group that is kept.

        Returns
        -------
        ResidualMap
            Map of that group.
        """
        sums = np.zeros_like(self.sums)
        sums[fold] = self.sums[fold]
        return ResidualMap(self.image_shape, sums)

    def to_tree(self):
        """Convert the map to a plain dictionary of numbers and arrays, for files.

        Returns
        -------
        dict
            Dictionary for `from_tree`.
        """
        return {"image_shape": list(self.image_shape), "columns": list(_SUMS), "sums": self.sums}

    @classmethod
    def from_tree(cls, tree):
        """Build a map from the dictionary of `to_tree`.

        Parameters
        ----------
        tree : dict
            As returned by `to_tree`.

        Returns
        -------
        ResidualMap
            Map equal to the original one.

        Raises
        ------
        ValueError
            If the dictionary has another layout.
        """
        if list(tree["columns"]) != list(_SUMS):
            raise ValueError(f"columns of the residual map must be {_SUMS}, got {tree['columns']}")
        return cls(tuple(tree["image_shape"]), np.array(tree["sums"], dtype=float))
