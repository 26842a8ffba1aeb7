"""Orientations of the reference stars that a blind search tries."""

import numpy as np

__all__ = ["HALF_STEP", "N_ORIENTATIONS", "orientations"]

#: Largest rotation from the nearest orientation, deg.  Near the center of the frame, it moves stars
#: by less than the error of the pointing that is searched anyway.
HALF_STEP = 22.5
#: Number of orientations.
N_ORIENTATIONS = 16


def orientations():
    """List the orientations, those of the header and of a mirrored one.

    Returns
    -------
    list of (2, 2) ndarray
        Orthogonal matrices, the identity first; right angles are exact.

    Examples
    --------
    >>> from wpdc_gwcs.matching._orientations import orientations
    >>> len(orientations())
    16
    """
    quarter = np.array([[0.0, -1.0], [1.0, 0.0]])
    half = np.sqrt(0.5) * (np.eye(2) + quarter)
    right = [np.linalg.matrix_power(quarter, n) for n in range(4)]
    turns = right + [turn @ half for turn in right]
    return turns + [turn @ np.diag([-1.0, 1.0]) for turn in turns]
