"""Peaks in windows: the same as in whole images, and sep sees only what is high."""

import numpy as np
import pytest
import sep
from numpy.testing import assert_array_equal
from scipy import ndimage

from wpdc_gwcs.detection import _extract, subtract_background
from wpdc_gwcs.detection._windows import CELL, find_windows, high_cells
from wpdc_gwcs.kernels import peaks_in_numpy

LINES = {"narrow": [0.25, 0.5, 0.25], "none": [1.0], "broad": [0.1, 0.2, 0.4, 0.2, 0.1]}


@pytest.fixture
def compiled():
    return pytest.importorskip("wpdc_gwcs.kernels._compiled", reason="no compiler when installed")


def noise(rng, shape=(75, 150)):
    image = rng.normal(size=shape).astype(np.float32)
    return image, rng.uniform(0.8, 1.2, shape).astype(np.float32)


def arguments(rng, line, masked):
    image, rms = noise(rng)
    mask = rng.random(image.shape) < 0.3 if masked else None
    line = np.array(LINES[line], np.float32)
    return image, rms, mask, line, 2.5 * float((line**2).sum()), 8


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("line", LINES)
@pytest.mark.parametrize("name", ["compiled", "numpy"])
def test_cells_are_those_of_a_filtered_image(name, line, masked, request, rng):
    module = request.getfixturevalue("compiled") if name == "compiled" else peaks_in_numpy
    image, rms, mask, line, factor, size = arguments(rng, line, masked)
    cells = np.zeros((10, 19), bool)
    module.mark_cells(image, rms, mask, line, factor, size, 0, 4, cells)
    module.mark_cells(image, rms, mask, line, factor, size, 4, 10, cells)
    values = (image if mask is None else np.where(mask, 0, image)).astype(float)
    for axis in (0, 1):
        values = ndimage.correlate1d(values, line.astype(float), axis, mode="constant")
    high = np.zeros((80, 152), bool)
    high[:75, :150] = values > factor * rms
    expected = high.reshape(10, 8, 19, 8).any(axis=(1, 3))
    assert_array_equal(cells, expected)
    assert 0.02 < cells.mean() < 0.9


def test_cells_are_only_added(compiled, rng):
    image, rms, mask, line, factor, size = arguments(rng, "narrow", False)
    for module in (compiled, peaks_in_numpy):
        cells = np.zeros((10, 19), bool)
        cells[2] = True
        module.mark_cells(image, rms, mask, line, factor, size, 2, 3, cells)
        assert_array_equal(np.argwhere(cells), [[2, k] for k in range(19)])


def test_the_compiled_kernel_refuses_what_makes_no_cells(compiled, rng):
    good = [*arguments(rng, "narrow", True), 0, 10, np.zeros((10, 19), bool)]
    compiled.mark_cells(*good)
    compiled.mark_cells(*good[:5], np.int64(8), *good[6:])
    for position, value, error in (
        (0, good[0].ravel(), ValueError),
        (0, good[0].astype(float), TypeError),
        (1, good[1][1:].copy(), ValueError),
        (2, good[2][1:].copy(), ValueError),
        (3, np.ones(2, np.float32), ValueError),
        (3, np.ones(3), TypeError),
        (4, "high", TypeError),
        (5, 0, ValueError),
        (5, 8.0, TypeError),
        (6, -1, ValueError),
        (7, 11, ValueError),
        (8, np.zeros((10, 18), bool), ValueError),
    ):
        args = list(good)
        args[position] = value
        with pytest.raises(error):
            compiled.mark_cells(*args)


def test_windows_hold_their_cells():
    cells = np.zeros((7, 9), bool)
    cells[0, 0] = cells[1, 1] = cells[4, 2:6] = cells[6, 8] = True
    shape = (6 * CELL + 5, 8 * CELL + 3)
    found, labels = find_windows(cells, shape, 2)
    assert found == [
        (slice(0, 2 * CELL + 2), slice(0, 2 * CELL + 2)),
        (slice(4 * CELL - 2, 5 * CELL + 2), slice(2 * CELL - 2, 6 * CELL + 2)),
        (slice(6 * CELL - 2, shape[0]), slice(8 * CELL - 2, shape[1])),
    ]
    assert_array_equal(labels > 0, cells)
    assert [labels[0, 0], labels[1, 1], labels[6, 8]] == [1, 1, 3]


def crowd(rng, shape=(1500, 700), n=150):
    """Stars and galaxies, at the rims too, and bright ones side by side."""
    image = rng.normal(100, 5, shape)
    x, y = rng.uniform(-3, shape[1] + 3, n), rng.uniform(-3, shape[0] + 3, n)
    x[:10], y[:10] = x[10:20] + 4, y[10:20] + 2
    flux, sigma = 10 ** rng.uniform(1.7, 4, n), rng.choice([1.0, 1.3, 4.0], n)
    for x0, y0, f, s in zip(x, y, flux, sigma, strict=True):
        rows, columns = (slice(max(int(c) - 40, 0), max(int(c) + 41, 0)) for c in (y0, x0))
        j, i = np.mgrid[rows, columns]
        j, i = j[: shape[0] - rows.start], i[: shape[0] - rows.start]
        j, i = j[:, : shape[1] - columns.start], i[:, : shape[1] - columns.start]
        image[rows, columns] += f * np.exp(-((i - x0) ** 2 + (j - y0) ** 2) / 2 / s**2)
    return image


@pytest.mark.parametrize("fwhm", [0.0, 6.0])
@pytest.mark.parametrize("masked", [False, True])
def test_windows_have_the_peaks_of_the_image(masked, fwhm, rng, monkeypatch):
    image = crowd(rng)
    mask = None
    if masked:
        mask = rng.random(image.shape) < 0.01
        mask[300:340, 300:340] = True
    background = subtract_background(image, mask=mask)
    monkeypatch.setattr(_extract, "_CROWDED", 1.0)  # never the whole strip

    def peaks(sparse):
        parts = []
        for start, _, found in _extract.search(background, 5.0, 1.0, fwhm, sparse=sparse):
            found["y"] += start
            found["ycpeak"] += start
            parts.append(found)
        found = np.concatenate(parts)
        return found[np.lexsort([found["xcpeak"], found["ycpeak"]])]

    # without deblending, which shares out faint pixels at random
    whole, windows = peaks(False), peaks(True)
    assert len(whole) > 90
    for name in ("x", "y", "xcpeak", "ycpeak", "npix", "cpeak", "a", "b"):
        np.testing.assert_allclose(windows[name], whole[name], rtol=1e-6, err_msg=name)


def test_an_image_of_noise_has_no_windows(rng):
    background = subtract_background(rng.normal(100, 5, (400, 300)))
    assert list(_extract.search(background, 8.0, 0.002, sparse=True)) == []


def test_sep_is_left_as_it_was(rng):
    before = sep.get_extract_pixstack(), sep.get_sub_object_limit()
    background = subtract_background(crowd(rng, (300, 300), 20))
    for sparse in (False, True):
        assert len(list(_extract.search(background, 5.0, 0.002, sparse=sparse)))
        assert (sep.get_extract_pixstack(), sep.get_sub_object_limit()) == before


def test_threads_change_nothing(rng, monkeypatch):
    image, rms = noise(rng, (700, 90))
    expected = None
    for n in (1, 3):
        monkeypatch.setattr("wpdc_gwcs.threads.count_threads", lambda n=n: n)
        cells = high_cells(image, rms, None, LINES["narrow"], 1.3)
        assert expected is None or (cells == expected).all()
        expected = cells
    assert 0 < expected.mean() < 1
