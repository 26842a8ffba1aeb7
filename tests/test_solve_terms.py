"""Designs of the terms against closed forms and derivatives of what they stand for."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.polynomial.legendre import leggauss
from numpy.testing import assert_allclose
from scipy.special import eval_legendre

from wpdc_gwcs.solve import terms
from wpdc_gwcs.solve.terms import Block

STEP = 1e-6


@pytest.fixture
def block(rng):
    u, v = rng.uniform(-1, 1, (2, 40))
    return Block(u, v, np.ones(2), rng.uniform(-0.7, 0.7, (2, 40)), rng.normal(size=40))


ALL = [
    terms.polynomial(5),
    terms.polynomial(5, mosaic=True),
    terms.place(),
    terms.tilt(),
    terms.optics(4),
    terms.attitude(),
    terms.refraction(),
    terms.lateral_color(),
]


@pytest.mark.parametrize("term", ALL, ids=lambda t: t.name)
def test_sizes_agree(term, block):
    assert term.design(block).rows.shape == (2, 40, term.size)
    assert sorted(set(term.groups)) == list(range(len(term.start)))
    assert np.all(term.start > 0)


@pytest.mark.parametrize("term", ALL, ids=lambda t: t.name)
def test_only_chromatic_terms_depend_on_color(term, block):
    without = replace(block, color=np.zeros(40))
    if term.chromatic:
        assert not term.design(without).rows.any()
        assert term.design(block).rows.any()
    else:
        assert_allclose(term.design(without).rows, term.design(block).rows, rtol=0, atol=0)


@pytest.mark.parametrize(
    ("term", "place"), [(terms.polynomial(4), "detector"), (terms.optics(4), "focal")]
)
def test_polynomials_are_products_of_legendre(term, place, block):
    a, b = (block.u, block.v) if place == "detector" else block.focal
    powers = [(n - j, j) for n in range(2, 5) for j in range(n + 1)]
    # Of the mean square of that of one coordinate alone.
    expected = np.stack(
        [
            eval_legendre(i, a) * eval_legendre(j, b)
            * np.sqrt((2 * i + 1) * (2 * j + 1) / (2 * (i + j) + 1))
            for i, j in powers
        ],
        axis=1,
    )  # fmt: skip
    design = term.design(block).rows
    p = len(powers)
    assert_allclose(design[0, :, :p], expected, atol=1e-14)
    assert_allclose(design[1, :, p:], expected, atol=1e-14)
    assert not design[0, :, p:].any()
    assert not design[1, :, :p].any()
    assert list(term.groups) == 2 * [i + j - 2 for i, j in powers]


def test_degrees_of_a_polynomial_do_not_overlap():
    """They are orthogonal over a square detector, and to shift and linear map."""
    nodes, weights = leggauss(8)
    u, v = (a.ravel() for a in np.meshgrid(nodes, nodes))
    w = np.outer(weights, weights).ravel()
    block = Block(u, v, np.ones(2), np.array([u, v]), np.zeros_like(u))
    columns = terms.polynomial(5).design(block).rows[0, :, : terms.polynomial(5).size // 2]
    columns = np.column_stack([np.ones_like(u), u, v, columns])
    products = (columns * w[:, None]).T @ columns
    assert_allclose(products - np.diag(np.diagonal(products)), 0, atol=1e-13)


def test_place(block):
    """Derivatives of a detector that is moved, turned, and stretched."""
    z = np.array([block.u, block.v])
    turn, skew = np.array([[0.0, -1.0], [1.0, 0.0]]), np.array([[0.0, 1.0], [1.0, 0.0]])
    maps = [turn, np.eye(2), np.diag([1.0, -1.0]), skew]
    design = terms.place().design(block).rows
    assert_allclose(design[:, :, :2], np.broadcast_to(np.eye(2)[:, None], (2, 40, 2)))
    for column, matrix in enumerate(maps, start=2):
        assert_allclose(design[:, :, column], matrix @ z, atol=1e-15)
    rotation = [[np.cos(STEP), -np.sin(STEP)], [np.sin(STEP), np.cos(STEP)]]
    assert_allclose(design[:, :, 2], (rotation @ z - z) / STEP, atol=2 * STEP)


@pytest.mark.parametrize("axis", [0, 1])
def test_tilt_is_a_keystone(axis, block):
    """The derivative of the projection z / (1 - t z) of a tilted plane, less a shift."""
    z = np.array([block.u, block.v])
    tilted = (z / (1 - STEP * z[axis]) - z) / STEP
    column = terms.tilt().design(block).rows[:, :, axis]
    shift = np.zeros((2, 1))
    shift[axis] = 1 / 3
    expected = tilted - shift
    size = np.vdot(column, expected) / np.vdot(expected, expected)
    assert_allclose(column, size * expected, atol=2 * STEP)


def test_a_mosaic_has_its_keystone_once(rng):
    """Tilt and polynomial together are all polynomials of degree 2, none of them twice."""
    u, v = rng.uniform(-1, 1, (2, 200))
    block = Block(u, v, np.array([1.0, 0.6]), np.zeros((2, 200)), np.zeros(200))
    split = [terms.tilt(), terms.polynomial(2, mosaic=True)]
    columns = np.concatenate([t.design(block).rows for t in split], axis=2).reshape(400, -1)
    whole = terms.polynomial(2).design(block).rows.reshape(400, -1)
    assert columns.shape == whole.shape
    left = columns - whole @ np.linalg.lstsq(whole, columns, rcond=None)[0]
    assert_allclose(left, 0, atol=1e-12)
    assert np.linalg.matrix_rank(columns) == 6


def test_short_sides_have_small_columns(rng):
    """One variance for a degree means the same curvature in px along both sides."""
    u, v = rng.uniform(-1, 1, (2, 50))
    wide = Block(u, v, np.array([1.0, 0.25]), np.zeros((2, 50)), np.zeros(50))
    square = replace(wide, aspect=np.ones(2))
    ratio = (
        terms.polynomial(2).design(wide).rows[0, 0, :3]
        / terms.polynomial(2).design(square).rows[0, 0, :3]
    )
    assert_allclose(ratio, [1.0, 0.25, 0.0625])


def test_attitude(block):
    ax, bxx, bxy, ay, byx, byy = coefficients = np.array([0.3, 1.0, -2.0, -0.7, 0.5, 4.0])
    expected = np.array([[bxx, bxy], [byx, byy]]) @ block.focal + [[ax], [ay]]
    assert_allclose(terms.attitude().design(block).rows @ coefficients, expected, atol=1e-14)


def test_refraction(block):
    shift = terms.refraction().design(block).rows @ [0.02, -0.03]
    assert_allclose(shift, np.outer([0.02, -0.03], block.color), atol=1e-16)


def test_lateral_color_is_radial(block):
    shift = terms.lateral_color().design(block).rows @ [0.02, 0.05]
    radius = np.hypot(*block.focal)
    expected = block.color * (0.02 * radius + 0.05 * radius**3)
    assert_allclose(np.sum(shift * block.focal, axis=0) / radius, expected, atol=1e-15)
    assert_allclose(shift[0] * block.focal[1], shift[1] * block.focal[0], atol=1e-15)
