"""Inverses of normal matrices against their definition, and pseudo-inverses of singular ones."""

import numpy as np

from wpdc_gwcs.centroids._inverses import inverses


def test_regular_and_singular_matrices_together():
    rng = np.random.default_rng(1)
    # Positions and fluxes of bright stars are of very different scales.
    jacobian = rng.normal(size=(20, 3, 30)) * np.array([1e6, 1e6, 1.0])[:, None]
    normal = jacobian @ jacobian.transpose(0, 2, 1)
    assert np.allclose(inverses(normal) @ normal, np.eye(3), atol=1e-9)
    normal[3] = 0.0
    normal[7, 2] = normal[7, :, 2] = 0.0
    found = inverses(normal)
    assert np.array_equal(found[3], np.zeros((3, 3)))
    assert np.allclose(found[7], np.linalg.pinv(normal[7]), rtol=1e-12)
    rest = np.delete(np.arange(20), [3, 7])
    assert np.allclose(found[rest] @ normal[rest], np.eye(3), atol=1e-9)


def test_no_matrices():
    assert inverses(np.zeros((0, 3, 3))).shape == (0, 3, 3)
