"""Normal equations with one scope eliminated against dense solutions of the full system."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from wpdc_gwcs.solve.basis import Basis, inner_products
from wpdc_gwcs.solve.normal import accumulate, frame_equations, invert, posterior
from wpdc_gwcs.solve.terms import Design

# Unknowns of the camera, of a detector, of an exposure; more detectors than exposures and the
# other way round, so that either is eliminated.
SIZES = 2, 4, 3
MOSAIC, MANY = (5, 2), (2, 7)


def random_field(rng, n):
    """Six shapes, of which one moves along each axis alone."""
    along = np.array([0, 1, 2, 4, 5]), np.array([0, 1, 2, 3, 5])
    return [(mine, rng.normal(size=(5, n))) for mine in along], rng.uniform(0.1, 2.0, 6)


class System:
    """One frame of random rows for each detector in each exposure."""

    def __init__(self, rng, counts, *, field=False):
        self.counts = counts
        self.frames = {}
        for d in range(counts[0]):
            for e in range(counts[1]):
                n = 12
                self.frames[d, e] = {
                    "design": Design(rng.normal(size=(5, n)), rng.normal(size=(2, 5, sum(SIZES)))),
                    "residual": rng.normal(size=(2, n)),
                    "weight": rng.uniform(0.5, 3.0, (2, n)),
                    "field": random_field(rng, n) if field else None,
                }
        a = rng.normal(size=(counts[1], SIZES[2], SIZES[2]))
        self.priors = (
            rng.uniform(0.1, 1.0, SIZES[0]),
            rng.uniform(0.1, 1.0, (counts[0], SIZES[1])),
            a @ a.transpose(0, 2, 1),
        )
        self.pulls = (
            rng.normal(size=SIZES[0]),
            rng.normal(size=(counts[0], SIZES[1])),
            rng.normal(size=(counts[1], SIZES[2])),
        )

    def columns(self, d, e):
        c, p, k = SIZES
        start = c + self.counts[0] * p
        return np.concatenate(
            [np.arange(c), c + d * p + np.arange(p), start + e * k + np.arange(k)]
        )

    def dense(self):
        """Mean and covariance of all unknowns: camera, detectors, exposures."""
        c, p, k = SIZES
        size = c + self.counts[0] * p + self.counts[1] * k
        matrix = np.zeros((size, size))
        flat = np.concatenate([self.priors[0], self.priors[1].ravel()])
        matrix[range(len(flat)), range(len(flat))] = flat
        for e, prior in enumerate(self.priors[2]):
            own = len(flat) + e * k + np.arange(k)
            matrix[np.ix_(own, own)] = prior
        right = np.concatenate([pull.ravel() for pull in self.pulls])
        for (d, e), f in self.frames.items():
            rows = np.zeros((f["residual"].size, size))
            rows[:, self.columns(d, e)] = f["design"].rows.reshape(len(rows), -1)
            noise = np.diag(1 / f["weight"].ravel())
            if f["field"] is not None:
                shapes = np.zeros((6, 2, f["residual"].shape[1]))
                for a, (mine, values) in enumerate(f["field"][0]):
                    shapes[mine, a] = values
                basis = shapes.reshape(6, -1).T
                noise = noise + basis @ np.diag(f["field"][1]) @ basis.T
            inverse = np.linalg.inv(noise)
            matrix += rows.T @ inverse @ rows
            right += rows.T @ inverse @ f["residual"].ravel()
        covariance = np.linalg.inv(matrix)
        return covariance @ right, covariance

    def products(self, frames=None):
        for (d, e), f in frames or self.frames.items():
            yield d, e, *frame_equations(**f)

    def solve(self, frames=None):
        blocks = accumulate(self.products(frames), SIZES, self.counts)
        return posterior(blocks, *self.priors, self.pulls)


def flat(found):
    return np.concatenate([found.camera, found.detectors.ravel(), found.exposures.ravel()])


@pytest.mark.parametrize("field", [False, True])
@pytest.mark.parametrize("counts", [MOSAIC, MANY])
def test_equals_the_dense_solution(rng, counts, field):
    system = System(rng, counts, field=field)
    mean, covariance = system.dense()
    found = system.solve()
    assert_allclose(flat(found), mean, atol=1e-11)
    for d, e in system.frames:
        chosen = system.columns(d, e)
        assert_allclose(found.joint(d, e), covariance[np.ix_(chosen, chosen)], atol=1e-11)
        own = chosen[-SIZES[2] :]
        conditional = np.linalg.inv(np.linalg.inv(covariance)[np.ix_(own, own)])
        assert_allclose(found.conditional[e], conditional, atol=1e-11)
    variances = np.concatenate([v.ravel() for v in found.variances()])
    assert_allclose(variances, np.diagonal(covariance)[: len(variances)], atol=1e-11)


def test_blocks_add(rng):
    """Half of the stars of a frame and the other half make the whole frame."""
    system = System(rng, MOSAIC)
    halves = []
    for key, f in system.frames.items():
        for part in (slice(0, 5), slice(5, None)):
            cut = {k: f[k][:, part] for k in ("residual", "weight")}
            cut["design"] = Design(f["design"].shapes[:, part], f["design"].mix)
            halves.append((key, cut))
    assert_allclose(flat(system.solve(halves)), flat(system.solve()), atol=1e-11)


def test_order_of_the_frames_does_not_matter(rng):
    system = System(rng, MOSAIC)
    turned = list(system.frames.items())[::-1]
    assert_allclose(flat(system.solve(turned)), flat(system.solve()), atol=1e-12)


def test_nothing_shared(rng):
    """A stored instrument leaves only the exposures."""
    design = Design(rng.normal(size=(4, 8)), rng.normal(size=(2, 4, 3)))
    residual = rng.normal(size=(2, 8))
    one = frame_equations(design, residual, np.ones((2, 8)))
    blocks = accumulate([(0, 0, *one)], (0, 0, 3), (1, 1))
    nothing = np.zeros(0), np.zeros((1, 0))
    found = posterior(blocks, *nothing, np.zeros((1, 3, 3)), (*nothing, np.zeros((1, 3))))
    expected = np.linalg.lstsq(design.rows.reshape(16, 3), residual.ravel(), rcond=None)[0]
    assert_allclose(found.exposures[0], expected, atol=1e-12)
    assert found.joint(0, 0).shape == (3, 3)


def test_an_exposure_without_stars_has_its_prior(rng):
    system = System(rng, (1, 2))
    found = system.solve([((0, 0), system.frames[0, 0])])
    expected = np.linalg.solve(system.priors[2][1], system.pulls[2][1])
    assert_allclose(found.exposures[1], expected)


class TestInvert:
    def test_badly_scaled(self, rng):
        """Coefficients of px and of 1e8 px side by side."""
        scale = 10.0 ** rng.uniform(-8, 8, 6)
        a = rng.normal(size=(6, 20))
        matrix = (a @ a.T) * scale[:, None] * scale
        identity = (invert(matrix) @ matrix) / scale * scale[:, None]
        assert_allclose(identity, np.eye(6), atol=1e-9)

    def test_singular(self):
        """Two unknowns of which only the sum is determined."""
        found = invert(np.array([[1.0, 1.0], [1.0, 1.0]]))
        assert np.isfinite(found).all()
        assert_allclose(np.ones(2) @ found @ np.ones(2) / 4, 0.25, rtol=1e-6)
        assert found[0, 0] > 1e10


@pytest.mark.parametrize("kind", ["curl-free", "axes"])
@pytest.mark.parametrize("bends", [False, True])
def test_products_of_waves_leave_nothing_out(rng, kind, bends):
    """Those along each axis alone, added up, are the products of all."""
    orders = np.array([[1, 2, 1, 3], [1, 1, 2, 2]])
    basis = Basis(np.array([50.0, 40.0]), np.array([60.0, 50.0]), orders, bends)
    places = rng.uniform(0, 80, (2, 30))
    shapes = basis.shapes(places, kind)
    flat = shapes.reshape(len(shapes), -1)
    assert_allclose(
        inner_products(basis.along(places, kind)), flat @ flat.T, rtol=1e-12, atol=1e-12
    )
    for a, (mine, values) in enumerate(basis.along(places, kind)):
        assert_array_equal(shapes[mine, a], values)
        assert not np.delete(shapes[:, a], mine, axis=0).any()
