"""A stored solution: the instrument as a table of a model, and how it is updated."""

from dataclasses import dataclass

import numpy as np

__all__ = ["StoredMap"]


@dataclass(frozen=True, eq=False)
class StoredMap:
    """Displacements that a stored solution subtracts: pixel less undistorted pixel.

    Parameters
    ----------
    solution : DistortionSolution
        The instrument.
    """

    solution: object

    def __call__(self, x, y):
        """Displacement of pixels.

        Parameters
        ----------
        x, y : (N,) ndarray
            Pixels.

        Returns
        -------
        (2, N) ndarray
            Px.
        """
        return np.array([x, y]) - np.array(self.solution.undistort(x, y))
