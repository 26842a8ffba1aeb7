"""Inverses of the normal matrices of many stars."""

import numpy as np

__all__ = ["inverses"]

# Determinant of a matrix of unit diagonal from which its inverse is good to nine digits.
_SOUND = 1e-6


def inverses(normal):
    """Invert symmetric matrices, those that are all but singular as far as they can be.

    Parameters
    ----------
    normal : (N, n, n) ndarray
        Normal matrices.

    Returns
    -------
    (N, n, n) ndarray
        Inverses; pseudo-inverses, which take ten times as long, where a matrix has none.
    """
    diagonal = np.einsum("sii->si", normal)
    with np.errstate(divide="ignore", invalid="ignore"):
        sound = np.linalg.det(normal) > _SOUND * diagonal.prod(axis=1)
    if sound.all():
        return np.linalg.inv(normal)
    result = np.empty_like(normal)
    result[sound] = np.linalg.inv(normal[sound])
    result[~sound] = np.linalg.pinv(normal[~sound])
    return result
