"""Inverses of the normal matrices of many stars."""

import numpy as np

__all__ = ["inverses"]

# Added to the unit diagonal of normal matrices; far too small to change any result.
_RIDGE = 1e-13


def inverses(normal):
    """Invert symmetric matrices, some of which may be singular.

    Parameters
    ----------
    normal : (N, n, n) ndarray
        Normal matrices.

    Returns
    -------
    (N, n, n) ndarray
        Inverses, large where almost nothing is known, and zero where the diagonal is zero.
    """
    diagonal = np.einsum("sii->si", normal)
    known = diagonal > 0
    scale = np.sqrt(np.where(known, diagonal, 1.0))
    # Pseudo-inverses would take ten times as long.
    scaled = normal / scale[:, :, None] / scale[:, None, :]
    inverse = np.linalg.inv(scaled + (_RIDGE + ~known)[:, :, None] * np.eye(scale.shape[1]))
    scale = known / scale
    return inverse * scale[:, :, None] * scale[:, None, :]
