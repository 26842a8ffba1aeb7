"""Local corrections: a moving plane through the residuals of neighboring pairs."""

import numpy as np
from scipy.spatial import cKDTree

from wpdc_gwcs.matching._pairs import find_nearest
from wpdc_gwcs.robust import plane_scatter

__all__ = ["LocalCorrection"]

N_NEIGHBORS = 24
# The correction must reduce the scatter of left-out pairs to this fraction, or it is noise.
_WORTHWHILE = 0.97
_BLOCK = 32768


class LocalCorrection:
    """Least-squares plane through the residuals of the nearest pairs, evaluated at a position.

    Parameters
    ----------
    points : (N, 2) ndarray
        Starting positions of pairs, px.
    residual : (N, 2) ndarray
        Correction of the mapped positions of these pairs, px.
    """

    def __init__(self, points, residual):
        self.points = points
        self.residual = residual
        self.tree = cKDTree(points)

    @classmethod
    def if_worthwhile(cls, points, residual):
        """Build the correction, or `None` if it does not improve left-out pairs.

        Outliers are no problem: pairs are within a few standard deviations of the mapping.
        """
        if len(points) < 4 * N_NEIGHBORS:
            return None
        before = plane_scatter(*residual.T)
        correction = cls(points, residual)
        left_out = residual - correction(points, leave_out=True)[0]
        return correction if plane_scatter(*left_out.T) < _WORTHWHILE * before else None

    def __call__(self, positions, *, leave_out=False):
        """Evaluate the correction.

        Parameters
        ----------
        positions : (M, 2) ndarray
            Starting positions, px.
        leave_out : bool, optional
            Whether the positions are the pairs themselves, so that each pair is left out of its own
            correction.

        Returns
        -------
        correction : (M, 2) ndarray
            Correction of the mapped positions, px; zero where the neighbors lie on a line.
        leverage : (M,) ndarray
            Variance of the correction in units of the variance of one pair.
        """
        correction = np.zeros((len(positions), 2))
        leverage = np.zeros(len(positions))
        for start in range(0, len(positions), _BLOCK):
            part = slice(start, start + _BLOCK)
            _, near = find_nearest(self.tree, positions[part], N_NEIGHBORS + leave_out)
            near = near[:, 1:] if leave_out else near
            step = self.points[near] - positions[part][:, None, :]
            x, y = step[..., 0], step[..., 1]
            sx, sy = x.sum(1), y.sum(1)
            sxx, sxy, syy = (x * x).sum(1), (x * y).sum(1), (y * y).sum(1)
            # The first column of the inverse of the normal matrix of a + b x + c y.
            a, b, c = sxx * syy - sxy**2, sxy * sy - sx * syy, sx * sxy - sxx * sy
            determinant = N_NEIGHBORS * a + sx * b + sy * c
            good = determinant > 1e-6 * N_NEIGHBORS * sxx * syy
            scale = np.where(good, 1 / np.where(good, determinant, 1), 0)
            weight = (a[:, None] + b[:, None] * x + c[:, None] * y) * scale[:, None]
            correction[part] = (weight[..., None] * self.residual[near]).sum(1)
            leverage[part] = a * scale
        return correction, leverage
