"""Inverses of normal matrices against numpy's, regular ones and singular ones together."""

import numpy as np

from wpdc_gwcs.centroids._inverses import inverses


def test_regular_and_singular_matrices_together():
    rng = np.random.default_rng(1)
    # Positions and fluxes of bright stars are of very different scales.
    jacobian = rng.normal(size=(20, 3, 30)) * np.array([1e6, 1e6, 1.0])[:, None]
    normal = jacobian @ jacobian.transpose(0, 2, 1)
    np.testing.assert_allclose(inverses(normal), np.linalg.inv(normal), rtol=1e-9)
    expected = np.linalg.inv(normal)
    normal[3] = 0.0
    normal[7, 2] = normal[7, :, 2] = 0.0
    # Two unknowns that only their sum is known of.
    normal[11] = normal[11, 0, 0] * np.array([[1, 1, 0], [1, 1, 0], [0, 0, 1]])
    found = inverses(normal)
    assert np.array_equal(found[3], np.zeros((3, 3)))
    np.testing.assert_allclose(found[7], np.linalg.pinv(normal[7]), rtol=1e-9)
    assert np.all(np.diag(found[11])[:2] > 1e9 * found[11, 2, 2])
    rest = np.delete(np.arange(20), [3, 7, 11])
    np.testing.assert_allclose(found[rest], expected[rest], rtol=1e-9)


def test_no_matrices():
    assert inverses(np.zeros((0, 3, 3))).shape == (0, 3, 3)
