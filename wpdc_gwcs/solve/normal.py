"""Normal equations: accumulated frame by frame, solved by elimination of local unknowns.

::

    frame: residual, designs, noise, field --frame_equations--> its products
    products of all frames --"+"--> Blocks of camera, detectors and exposures
    Blocks, priors --posterior--> means, and covariances of any detector in any exposure

Detectors are coupled only through the camera and the exposures, and exposures only through the
camera and the detectors.  The larger of the two groups is eliminated (Schur complement), so cost
and memory grow linearly with it.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import lapack

from wpdc_gwcs.solve.basis import inner_products

__all__ = [
    "Blocks",
    "Posterior",
    "accumulate",
    "frame_equations",
    "invert",
    "posterior",
    "posterior_factor",
]


@dataclass(frozen=True, eq=False)
class Blocks:
    """Normal matrix and right-hand side by the scope of the unknowns.

    Parameters
    ----------
    camera, detectors, exposures : (C, C), (D, P, P) and (E, K, K) ndarray
        Diagonal blocks.
    camera_detectors, camera_exposures : (D, C, P) and (E, C, K) ndarray
        Blocks of the camera with each detector and with each exposure.
    frames : dict
        Block ``(P, K)`` of each (detector, exposure).
    right : tuple of ndarray
        Right-hand sides ``(C,)``, ``(D, P)`` and ``(E, K)``.
    """

    camera: np.ndarray
    detectors: np.ndarray
    exposures: np.ndarray
    camera_detectors: np.ndarray
    camera_exposures: np.ndarray
    frames: dict
    right: tuple


def frame_equations(design, residual, weight, *, field=None):
    """Accumulate the rows of one frame.

    Parameters
    ----------
    design : Design
        Columns of the P unknowns at N stars.
    residual, weight : (2, N) ndarray
        Residuals and inverse variances, px.
    field : (parts, prior), optional
        Shapes of the frame's field along each axis, as from `Basis.along`, and their prior
        variances ``(M,)``.  It is marginalized: the noise covariance becomes
        diag(1 / weight) + shapes^T prior shapes.

    Returns
    -------
    matrix, right : (P, P) and (P,) ndarray
        Normal matrix and right-hand side.
    """
    _, p, n = design.mix.shape
    root = np.sqrt(weight)
    # The residual is treated as one more column, with its own shape.
    mix = np.zeros((2, p + 1, n + 1))
    mix[:, :p, :n], mix[:, p, n] = design.mix, 1.0
    rows = [np.vstack([design.shapes, residual[a]]) * root[a] for a in range(2)]
    products = sum(m.T @ (r @ r.T) @ m for m, r in zip(mix, rows))
    if field is not None:
        parts, prior = field
        heavy = []
        for a, (mine, shapes) in enumerate(parts):
            heavy.append((mine, shapes * np.sqrt(prior[mine])[:, None]))
            heavy[a][1][:] *= root[a]
        inner, cross = inner_products(heavy), np.zeros((len(prior), n + 1))
        for a, (mine, shapes) in enumerate(heavy):
            cross[mine] += shapes @ rows[a].T @ mix[a]
        inner[np.diag_indices_from(inner)] += 1.0
        factor, _ = lapack.dpotrf(inner, lower=1)
        half, _ = lapack.dtrtrs(factor, cross, lower=1)
        products = products - half.T @ half
    return products[:n, :n], products[:n, n]


def posterior_factor(normal, root):
    """Factor the posterior precision of coefficients in units of their prior.

    Parameters
    ----------
    normal : (K, K) ndarray
        Normal matrix, symmetric.
    root : (K,) ndarray
        Prior standard deviations.

    Returns
    -------
    factor : (K, K) ndarray
        Lower Cholesky factor of ``1 + root normal root``.
    info : int
        0, unless the matrix is not positive definite.
    """
    inner = np.multiply(normal, root, order="C")
    inner *= root[:, None]
    inner.flat[:: len(root) + 1] += 1.0
    # The transpose of a symmetric matrix is the same in the order of LAPACK, without a copy.
    return lapack.dpotrf(inner.T, lower=1, overwrite_a=1)


def invert(matrix):
    """Invert a symmetric positive definite matrix.

    Parameters
    ----------
    matrix : ndarray
        Matrix to invert.
    """
    root = _inverse_root(matrix)
    return root.T @ root


def _inverse_root(matrix):
    """Matrix R with R^T R the inverse of a symmetric matrix, scaled to a unit diagonal first."""
    if not matrix.size:
        return np.zeros_like(matrix)
    diagonal = np.diagonal(matrix)
    # After elimination, undetermined unknowns may have only rounding errors.
    scale = 1.0 / np.sqrt(np.maximum(diagonal, 1e-15 * diagonal.max()))
    scaled = matrix * scale[:, None] * scale
    factor, info = lapack.dpotrf(scaled, lower=1, clean=1)
    if info == 0:
        root, info = lapack.dtrtri(factor, lower=1)
    if info != 0:
        # Numerically singular: undetermined unknowns keep their prior.
        values, vectors = np.linalg.eigh(scaled)
        values = np.maximum(values, values[-1] * 1e-15)
        root = (vectors / np.sqrt(values)).T
    return root * scale


def accumulate(products, sizes, counts):
    """Add the products of all frames.

    Parameters
    ----------
    products : iterable of (int, int, ndarray, ndarray)
        Detector, exposure, normal matrix and right-hand side of each frame; its unknowns are those
        of the camera, of the detector and of the exposure, in that order.
    sizes : (int, int, int)
        Numbers of unknowns of the camera, of a detector, of an exposure.
    counts : (int, int)
        Numbers of detectors and exposures.

    Returns
    -------
    Blocks
        Sums.
    """
    c, p, k = sizes
    d, e = counts
    camera, right = np.zeros((c, c)), (np.zeros(c), np.zeros((d, p)), np.zeros((e, k)))
    detectors, exposures = np.zeros((d, p, p)), np.zeros((e, k, k))
    camera_detectors, camera_exposures = np.zeros((d, c, p)), np.zeros((e, c, k))
    frames = {}
    first, second = slice(0, c), slice(c, c + p)
    third = slice(c + p, c + p + k)
    for i, j, matrix, vector in products:
        camera += matrix[first, first]
        detectors[i] += matrix[second, second]
        exposures[j] += matrix[third, third]
        camera_detectors[i] += matrix[first, second]
        camera_exposures[j] += matrix[first, third]
        frames[i, j] = frames.get((i, j), 0.0) + matrix[second, third]
        right[0][:] += vector[first]
        right[1][i] += vector[second]
        right[2][j] += vector[third]
    return Blocks(camera, detectors, exposures, camera_detectors, camera_exposures, frames, right)


@dataclass(frozen=True, eq=False)
class Posterior:
    """Solution of the normal equations.

    Parameters
    ----------
    camera, detectors, exposures : (C,), (D, P) and (E, K) ndarray
        Unknowns.
    conditional : (E, K, K) ndarray
        Covariance of an exposure's unknowns with all others fixed.
    """

    camera: np.ndarray
    detectors: np.ndarray
    exposures: np.ndarray
    conditional: np.ndarray
    _globals: np.ndarray  # covariance of the unknowns that were not eliminated
    _inverse: np.ndarray  # of the blocks that were
    _response: np.ndarray  # minus their change with the others
    _local_detectors: bool

    def joint(self, detector, exposure):
        """Return the covariance of the unknowns of the camera, a detector and an exposure.

        Parameters
        ----------
        detector, exposure : int
            Numbers of the detector and the exposure.

        Returns
        -------
        (C + P + K, C + P + K) ndarray
            Covariance in this order.
        """
        c, p, k = len(self.camera), self.detectors.shape[1], self.exposures.shape[1]
        if self._local_detectors:
            local, start, size = detector, c + exposure * k, k
        else:
            local, start, size = exposure, c + detector * p, p
        chosen = np.concatenate([np.arange(c), np.arange(start, start + size)])
        response = self._response[local]
        mixed = -response @ self._globals
        own = self._inverse[local] - mixed @ response.T
        both = self._globals[np.ix_(chosen, chosen)]
        mixed = mixed[:, chosen]
        order = np.argsort(
            np.concatenate([np.arange(c), (c + p if self._local_detectors else c) + np.arange(size),
                            (c if self._local_detectors else c + p) + np.arange(len(own))]),
            kind="stable",
        )  # fmt: skip
        joint = np.block([[both, mixed.T], [mixed, own]])
        return joint[np.ix_(order, order)]

    def variances(self):
        """Variances of the unknowns of the camera and of all detectors, ``(C,)``, ``(D, P)``."""
        c, p = len(self.camera), self.detectors.shape[1]
        outer = np.diagonal(self._globals)
        if not self._local_detectors:
            return outer[:c], outer[c:].reshape(len(self.detectors), p)
        own = np.einsum("dii->di", self._inverse)
        spread = np.einsum("dpg,gh,dph->dp", self._response, self._globals, self._response,
                           optimize=True)  # fmt: skip
        return outer[:c], own + spread


def posterior(blocks, camera, detectors, exposures, pulls):
    """Solve the normal equations with priors.

    Parameters
    ----------
    blocks : Blocks
        Equations.
    camera, detectors : (C,) and (D, P) ndarray
        Prior inverse variances.
    exposures : (E, K, K) ndarray
        Prior inverse covariances.
    pulls : tuple of ndarray
        Contributions of the priors to the right-hand sides.

    Returns
    -------
    Posterior
        Means and covariances.
    """
    right = [r + pull for r, pull in zip(blocks.right, pulls)]
    c, (d, p), (e, k) = len(right[0]), right[1].shape, right[2].shape
    own_detectors = blocks.detectors + detectors[:, :, None] * np.eye(p)
    own_exposures = blocks.exposures + exposures
    # The polynomial of a detector with few stars may be almost free: it is not eliminated.
    local_detectors = d > 1 and d * p > e * k
    if local_detectors:
        local, rest, n, m = own_detectors, own_exposures, d, e
        to_camera, rest_camera = blocks.camera_detectors, blocks.camera_exposures
        local_right, rest_right, size = right[1], right[2], k
    else:
        local, rest, n, m = own_exposures, own_detectors, e, d
        to_camera, rest_camera = blocks.camera_exposures, blocks.camera_detectors
        local_right, rest_right, size = right[2], right[1], p
    total = c + m * size
    matrix = np.zeros((total, total))
    matrix[:c, :c] = blocks.camera + np.diag(camera)
    for j in range(m):
        s = slice(c + j * size, c + (j + 1) * size)
        matrix[s, s] = rest[j]
        matrix[:c, s], matrix[s, :c] = rest_camera[j], rest_camera[j].T
    cross = np.zeros((n, local.shape[1], total))
    cross[:, :, :c] = to_camera.transpose(0, 2, 1)
    for (i, j), block in blocks.frames.items():
        if local_detectors:
            cross[i][:, c + j * size : c + (j + 1) * size] = block
        else:
            cross[j][:, c + i * size : c + (i + 1) * size] = block.T
    vector = np.concatenate([right[0], rest_right.ravel()])
    inverse, response = np.empty_like(local), np.empty_like(cross)
    for i in range(n):
        root = _inverse_root(local[i])
        half = root @ cross[i]
        matrix -= half.T @ half
        vector -= half.T @ (root @ local_right[i])
        inverse[i], response[i] = root.T @ root, root.T @ half
    covariance = invert(matrix) if total else np.zeros((0, 0))
    outer = covariance @ vector
    inner = np.einsum("npq,nq->np", inverse, local_right) - response @ outer
    rest = outer[c:].reshape(m, size)
    found = (inner, rest) if local_detectors else (rest, inner)
    conditional = np.array([invert(one) for one in own_exposures]) if local_detectors else inverse
    return Posterior(outer[:c], *found, conditional, covariance, inverse, response, local_detectors)
