"""Squares of pixels against pixels taken one by one."""

import numpy as np
import pytest

from wpdc_gwcs.cutouts import cut_squares, on_image


@pytest.fixture
def image():
    return np.random.default_rng(1).normal(size=(23, 31)).astype(np.float32)


@pytest.mark.parametrize("half", [0, 1, 4, 20])
@pytest.mark.parametrize("margin", [-3, 0, 5])
def test_squares_are_the_pixels_clamped_at_the_rim(image, half, margin):
    rng = np.random.default_rng(2)
    ny, nx = image.shape
    xc, yc = rng.integers(margin, nx - margin, 50), rng.integers(margin, ny - margin, 50)
    squares, inside = cut_squares(image, xc, yc, half), on_image(image.shape, xc, yc, half)
    assert squares.shape == inside.shape == (50, 2 * half + 1, 2 * half + 1)
    assert squares.dtype == image.dtype
    for star, j, i in rng.integers(0, [50, 2 * half + 1, 2 * half + 1], (300, 3)):
        y, x = yc[star] - half + j, xc[star] - half + i
        assert inside[star, j, i] == (0 <= y < ny and 0 <= x < nx)
        assert squares[star, j, i] == image[min(max(y, 0), ny - 1), min(max(x, 0), nx - 1)]


def test_of_rows_and_columns_of_an_image(image):
    part = image[2:20:2, ::-1]
    x, y = np.array([3, 20]), np.array([1, 8])
    assert np.array_equal(cut_squares(part, x, y, 2), cut_squares(part.copy(), x, y, 2))


def test_of_no_sources(image):
    none = np.zeros(0, int)
    assert cut_squares(image, none, none, 3).shape == (0, 7, 7)
    assert on_image(image.shape, none, none, 3).shape == (0, 7, 7)
