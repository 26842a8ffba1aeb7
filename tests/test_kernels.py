"""Both kinds of kernels: the same bits from C and from NumPy, and from arrays of any kind."""

import os
import subprocess
import sys

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from wpdc_gwcs import kernels
from wpdc_gwcs.kernels import in_numpy
from wpdc_gwcs.kernels.plane import Plane, arrange, arranged, box_numbers, tangent_numbers
from wpdc_gwcs.models import LookupTable
from wpdc_gwcs.models.mapping import PlaneMap
from wpdc_gwcs.models.tangent import deproject, project
from wpdc_gwcs.wcs import build_wcs

N = 1000.0


@pytest.fixture
def compiled():
    return pytest.importorskip("wpdc_gwcs.kernels._compiled", reason="no compiler when installed")


def polynomial(degree, rng):
    """A distortion of some percent of an image of 1000 px about its center."""
    powers = np.add.outer(np.arange(degree + 1), np.arange(degree + 1))
    values = rng.normal(size=(2, degree + 1, degree + 1)) * 5 / (N / 2) ** powers
    values *= powers <= degree
    values[0, 1, 0] += 1.0
    values[1, 0, 1] += 1.0
    values[:, 0, 0] += N / 2
    return values


def table(method, rng):
    nodes = np.linspace(-0.5, N - 0.5, 9)
    values = rng.normal(scale=0.3, size=(2, 9, 9))
    return LookupTable(nodes, nodes, *values, method=method)._cells()


def make_map(kind, rng):
    center = (N / 2, N / 2)
    radial = np.array([[0.0, 1e-4, 0.0, 1e-9], [0.0, 0.0, 0.0, -2e-9]])
    matrix = np.array([[1.0, 0.1], [0.0, 1.1]])
    return {
        "cells": lambda: PlaneMap(polynomial(3, rng), center, grid=table("cubic", rng)),
        "bilinear": lambda: PlaneMap(polynomial(3, rng), center, grid=table("linear", rng)),
        "linear": lambda: PlaneMap(polynomial(1, rng), center),
        "polynomial": lambda: PlaneMap(polynomial(7, rng), center),
        "radial": lambda: PlaneMap(polynomial(3, rng), center, radial=radial, radial_matrix=matrix),
        "all": lambda: PlaneMap(
            polynomial(5, rng),
            center,
            radial=radial,
            radial_matrix=matrix,
            grid=table("cubic", rng),
        ),
    }[kind]()


KINDS = ["cells", "bilinear", "linear", "polynomial", "radial", "all"]


def for_kernels(plane, module):
    """The same plane with its table laid out for one of the implementations."""
    if not plane.table.size:
        return plane
    coefficients = arranged(plane.table, kernels.CELL_ORDER)
    return plane._replace(table=arrange(coefficients, module.CELL_ORDER))


def points(rng, n=3000):
    """Points on an image, far and near outside it, on its rim and on nodes, NaN and infinite."""
    x, y = rng.uniform(-300, N + 300, (2, n))
    x[: n // 2], y[: n // 2] = rng.uniform(-0.5, N - 0.5, (2, n // 2))
    special = [-0.5, N - 0.5, 0.0, N / 2, 124.5, np.nan, np.inf, -np.inf, 1e12, -0.0]
    grid = np.array(np.meshgrid(special, special)).reshape(2, -1)
    return np.concatenate([x, grid[0]]), np.concatenate([y, grid[1]])


def both(compiled, name, n_outputs, planes, *args):
    """Results of one function of either implementation."""
    results = []
    for module in (compiled, in_numpy):
        outputs = np.full((n_outputs, *args[-1]), 7.0)
        laid_out = [p if p is None else for_kernels(p, module) for p in planes]
        getattr(module, name)(*laid_out, *args[:-1], *outputs)
        results.append(outputs)
    return results


def assert_same_bits(found, expected):
    """NaN in the same places, and all else the same to the last bit."""
    assert_array_equal(np.isnan(found), np.isnan(expected))
    good = ~np.isnan(expected)
    assert_array_equal(found[good].view(np.int64), expected[good].view(np.int64))


# ---- the same bits ---------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("name", "n_outputs"), [("evaluate", 2), ("jacobian", 6)])
def test_maps_of_the_plane_have_the_same_bits(kind, name, n_outputs, compiled, rng):
    plane = make_map(kind, rng).plane
    x, y = points(rng)
    found, expected = both(compiled, name, n_outputs, [plane], x, y, x.shape)
    assert np.isfinite(expected).sum() > 15_000 * n_outputs / 6
    assert_same_bits(found, expected)


@pytest.mark.parametrize("n", [0, 1, 7, 8, 127, 128, 129, 1000])
def test_any_number_of_points(n, compiled, rng):
    plane = make_map("all", rng).plane
    x, y = rng.uniform(0, N, (2, n))
    assert_same_bits(*both(compiled, "jacobian", 6, [plane], x, y, x.shape))


@pytest.mark.parametrize("kind", KINDS)
def test_inverses_have_the_same_bits(kind, compiled, rng):
    plane_map = make_map(kind, rng)
    x, y = points(rng)
    images = plane_map(x, y)
    limits = np.array([1e-9, plane_map._curvature, plane_map._orientation, 1e-6])
    box = box_numbers(((-0.5, N - 0.5), (-0.5, N - 0.5)), np.nan)
    for limit in (None, box):
        args = (limits, None, limit, *images, x.shape)
        found, expected = both(compiled, "invert", 2, [plane_map.plane, plane_map._start], *args)
        assert_same_bits(found, expected)
    inside = (np.abs(x - N / 2) < N / 2) & (np.abs(y - N / 2) < N / 2)
    assert_allclose(found[0][inside], x[inside], atol=1e-8)
    assert_allclose(found[1][inside], y[inside], atol=1e-8)


def test_inverses_from_a_polynomial_have_the_same_bits(compiled, rng):
    plane_map = make_map("cells", rng)
    images = plane_map(*points(rng))
    limits = np.array([1e-9, plane_map._curvature, plane_map._orientation, 1e-6])
    start = PlaneMap(polynomial(1, rng), (N / 2, N / 2)).plane
    args = (limits, None, None, *images, images[0].shape)
    found, expected = both(compiled, "invert", 2, [plane_map.plane, start], *args)
    assert np.isfinite(expected).sum() > 5000
    assert_same_bits(found, expected)


def test_folded_images_have_the_same_bits(compiled, rng):
    # Where the image is folded over Newton's method wanders, and finds what it must not find.
    wild = polynomial(3, rng)
    wild[0, 3, 0] -= 2 / (N / 2) ** 2
    plane_map = PlaneMap(wild, (N / 2, N / 2), grid=table("cubic", rng))
    x, y = points(rng)
    limits = np.array([1e-9, plane_map._curvature, plane_map._orientation, 1e-6])
    args = (limits, None, None, *plane_map(x, y), x.shape)
    found, expected = both(compiled, "invert", 2, [plane_map.plane, plane_map._start], *args)
    assert np.isnan(expected[0]).sum() > 500
    assert_same_bits(found, expected)


def sky(crval, rng):
    """A map to the tangent plane in radians and one by cells to the sky, with its tangent point."""
    crpix, cd = (N / 2, N / 2), 3e-5 * np.array([[-1.0, 0.2], [0.2, 1.0]])
    nodes = np.linspace(-0.5, N - 0.5, 9)
    lookup_table = LookupTable(nodes, nodes, *rng.normal(scale=1e-3, size=(2, 9, 9)))
    wcs = build_wcs(crpix=crpix, cd=cd, crval=crval, lookup_table=lookup_table)
    distortion, tangent = (step.transform for step in wcs.pipeline[:-1])
    return tangent._after(distortion._plane_map())


CRVALS = [(120.0, 30.0), (0.0, 0.0), (359.99, -60.0), (-10.0, 89.9), (33.0, 90.0), (10.0, -90.0)]


@pytest.mark.parametrize("crval", CRVALS)
def test_skies_have_the_same_bits(crval, compiled, rng):
    to_sky = sky(crval, rng)
    x, y = points(rng)
    # Nearly whole numbers of cells are quick; what lies outside them takes the long way.
    cells = to_sky._cells
    assert (cells is None) == (abs(crval[1]) > 80)
    box = box_numbers(((-0.5, N - 0.5), (-0.5, N - 200.0)), -1.0)
    for limit in (None, box):
        args = (to_sky._tangent, limit, x, y, x.shape)
        found, expected = both(compiled, "to_sky", 2, [to_sky._to_plane.plane, cells], *args)
        assert_same_bits(found, expected)
    found, expected = both(compiled, "to_sky", 2, [to_sky._to_plane.plane, None], *args)
    assert_same_bits(found, expected)
    args = (to_sky._tangent, *expected, x.shape)
    assert_same_bits(*both(compiled, "from_sky", 2, [], *args))


@pytest.mark.parametrize("crval", CRVALS)
@pytest.mark.parametrize("kind", ["cells", "polynomial"])
def test_rows_have_the_same_bits(crval, kind, compiled, rng):
    to_sky = sky(crval, rng)
    x, y = np.arange(300.0), np.arange(40.0, 451.0)
    plane = (
        to_sky._to_plane.plane
        if kind == "cells"
        else make_map(kind, rng).transformed(np.eye(2) * 1e-5).plane
    )
    cells = to_sky._cells if kind == "cells" else None
    args = (to_sky._tangent, x, y, (len(y), len(x)))
    found, expected = both(compiled, "rows_to_sky", 2, [plane, cells], *args)
    assert_same_bits(found, expected)
    all_x, all_y = np.tile(x, len(y)), np.repeat(y, len(x))
    args = (to_sky._tangent, None, all_x, all_y, all_x.shape)
    _, pixels = both(compiled, "to_sky", 2, [plane, cells], *args)
    assert_allclose(found.reshape(2, -1), pixels, rtol=3e-13, atol=1e-12)


def test_all_angles_have_the_same_bits(compiled, rng):
    # Right ascensions and declinations of all kinds, turns too many and those that end at zero.
    ra = np.concatenate([rng.uniform(-720, 720, 5000), np.arange(-720.0, 721.0, 15), [1e9, 1e300]])
    dec = np.concatenate([rng.uniform(-90, 90, 5000), np.arange(-720.0, 721.0, 15) / 8, [0.0, 1.0]])
    for crval in CRVALS:
        numbers = tangent_numbers(crval, [[0.3, 0.1], [-0.2, 0.4]], (3.0, 4.0))
        assert_same_bits(*both(compiled, "from_sky", 2, [], numbers, ra, dec, ra.shape))


# ---- the truth -------------------------------------------------------------------------------


needs_more_digits = pytest.mark.skipif(
    np.finfo(np.longdouble).eps > 1e-17, reason="no floating-point type with more digits"
)


@needs_more_digits
def test_sine_and_cosine(rng):
    angle = np.concatenate([rng.uniform(-360, 360, 20_000), np.arange(-360.0, 361.0, 15)])
    sine, cosine = in_numpy._sin_cos(angle)
    exact = angle.astype(np.longdouble) * (np.pi + np.longdouble(1.2246467991473532e-16)) / 180
    assert np.abs(sine - np.sin(exact)).max() < 3e-16
    assert np.abs(cosine - np.cos(exact)).max() < 3e-16
    near = np.abs(angle) < 44
    assert_allclose(sine[near], np.sin(exact[near]).astype(float), rtol=4e-16)
    assert in_numpy._sin_cos(np.array([180.0, -90.0, 30.0]))[0].tolist()[:2] == [0.0, -1.0]
    assert np.isnan(in_numpy._sin_cos(np.array([np.nan, np.inf, 1e10]))).all()


@needs_more_digits
def test_arc_tangent(rng):
    length = 10 ** rng.uniform(-12, 3, 20_000)
    direction = np.radians(rng.uniform(-180, 180, 20_000))
    y, x = length * np.sin(direction), length * np.cos(direction)
    exact = np.arctan2(y.astype(np.longdouble), x.astype(np.longdouble))
    exact *= 180 / (np.pi + np.longdouble(1.2246467991473532e-16))
    assert_allclose(in_numpy._arc_tangent(y, x), exact.astype(float), rtol=5e-16)
    y = np.array([0.0, 0.0, 0.0, 1.0, -1.0, 1.0, np.nan])
    x = np.array([0.0, 1.0, -1.0, 0.0, 0.0, 1.0, 1.0])
    expected = [0.0, 0.0, 180.0, 90.0, -90.0, 45.0, np.nan]
    with np.errstate(invalid="ignore"):
        assert_array_equal(in_numpy._arc_tangent(y, x), expected)


def test_projection_of_arrays_of_any_kind(rng):
    # What compiled loops could trip over: strides, byte orders, types, arrays nobody may write to.
    xi, eta = rng.uniform(-1, 1, (2, 70))
    expected = deproject(xi, eta, (10.0, 20.0))
    wide = np.zeros((2, 70, 3))
    wide[:, :, 1] = xi, eta
    frozen = xi.copy()
    frozen.flags.writeable = False
    for x, y in (
        (wide[0, :, 1], wide[1, :, 1]),
        (xi.astype(">f8"), eta.astype(">f8")),
        (frozen, eta),
        (xi[::-1][::-1], list(eta)),
    ):
        assert_array_equal(deproject(x, y, (10.0, 20.0)), expected)
    single = xi.astype(np.float32), eta.astype(np.float16)
    exact = deproject(single[0].astype(float), single[1].astype(float), (10.0, 20.0))
    assert_array_equal(deproject(*single, (10.0, 20.0)), exact)
    square = deproject(xi.reshape(7, 10).T, eta.reshape(7, 10).T, (10.0, 20.0))
    assert_array_equal(square[0].T.ravel(), expected[0])
    assert deproject(np.empty((0, 3)), 1.0, (10.0, 20.0))[0].shape == (0, 3)
    assert deproject(0.0, 0.0, (10.0, 20.0))[1].shape == ()
    assert_array_equal(deproject(1, 2, (10.0, 20.0)), deproject(1.0, 2.0, (10.0, 20.0)))


def test_arrays_of_the_same_memory(rng):
    # The answer to one and the same array for both coordinates.
    x = rng.uniform(-1, 1, 1000)
    assert_array_equal(project(x, x, (0.0, 0.0)), project(x, x.copy(), (0.0, 0.0)))


# ---- arguments of the compiled functions -----------------------------------------------------


def test_compiled_functions_refuse_what_they_cannot_take(compiled, rng):
    plane = for_kernels(make_map("cells", rng).plane, compiled)
    x, out = np.zeros(5), np.zeros(5)
    good = (plane, x, x, out, out.copy())
    compiled.evaluate(*good)
    frozen = out.copy()
    frozen.flags.writeable = False
    for position, value, error in (
        (0, plane[:3], TypeError),
        (0, list(plane), TypeError),
        (0, Plane(plane.head[:5], *plane[1:]), ValueError),
        (0, plane._replace(table=plane.table[1:].copy()), ValueError),
        (0, plane._replace(table=np.empty(0)), ValueError),
        (0, plane._replace(polynomial=np.zeros((5, 2, 2))), ValueError),
        (1, np.zeros(5, dtype=np.float32), TypeError),
        (1, np.zeros(5, dtype=">f8"), TypeError),
        (1, np.zeros(10)[::2], (BufferError, ValueError)),
        (2, np.zeros(4), ValueError),
        (3, np.zeros(6), ValueError),
        (4, frozen, (BufferError, ValueError)),
        (4, None, TypeError),
    ):
        args = list(good)
        args[position] = value
        with pytest.raises(error):
            compiled.evaluate(*args)
    with pytest.raises(TypeError, match="5 arguments"):
        compiled.evaluate(plane, x, x)


# ---- the choice ------------------------------------------------------------------------------


def version(**environment):
    return subprocess.run(
        [sys.executable, "-m", "wpdc_gwcs", "--version"],
        capture_output=True,
        text=True,
        env={**os.environ, **environment},
    )


def test_the_version_names_the_kernels():
    assert "(numpy kernels)" in version(WPDC_GWCS_KERNELS="numpy").stdout
    expected = version(WPDC_GWCS_KERNELS="").stdout
    assert "(compiled kernels)" in expected or "(numpy kernels)" in expected


def test_compiled_kernels_can_be_asked_for(compiled):
    assert "(compiled kernels)" in version(WPDC_GWCS_KERNELS="compiled").stdout


def test_unknown_kernels_are_one_line():
    done = version(WPDC_GWCS_KERNELS="fortran")
    assert done.returncode == 2
    assert done.stderr == (
        "wpdc: error: WPDC_GWCS_KERNELS must be 'compiled' or 'numpy', not 'fortran'\n"
    )
