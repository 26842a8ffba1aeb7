"""Wings of bright stars beyond the pixels that the PSF is learned from."""

import numpy as np
import pytest

from wpdc_gwcs.centroids import build_epsf, fit_centroids, subtract_stars
from wpdc_gwcs.detection import detect_companions, detect_sources, subtract_background
from wpdc_gwcs.flags import FLAG_EDGE

SHAPE, SKY, GAIN, SIGMA = (700, 700), 60.0, 1.0, 0.75


def wings(r):
    """A twentieth of the light in wings as those of an Airy disk, which fall with the cube."""
    return 0.05 * 3 / (2 * np.pi) * (r**2 + 9) ** -1.5


def draw(x, y, flux, *, half=60):
    """Gaussian stars with wide wings, as seen by pixels."""
    image = np.zeros(SHAPE)
    fine = (np.arange(5) - 2) / 5
    for x0, y0, f in zip(x, y, flux, strict=True):
        ix, iy = (
            np.arange(max(round(c) - half, 0), min(round(c) + half + 1, n))
            for c, n in ((x0, SHAPE[1]), (y0, SHAPE[0]))
        )
        u, v = (i[:, None] + fine - c for i, c in ((ix, x0), (iy, y0)))
        core_x, core_y = (
            np.exp(-(w**2) / 2 / SIGMA**2).mean(axis=1) / SIGMA / np.sqrt(2 * np.pi) for w in (u, v)
        )
        r = np.hypot(iy[:, None] - y0, ix - x0)
        model = 0.95 * np.outer(core_y, core_x) + wings(r)
        image[iy[0] : iy[-1] + 1, ix[0] : ix[-1] + 1] += f * model
    return image


@pytest.fixture(scope="module")
def field():
    rng = np.random.default_rng(8)
    y, x = (v.ravel() + rng.uniform(-6, 6, v.size) for v in np.mgrid[30:680:45, 30:680:45])
    flux = 10 ** rng.uniform(3.5, 5.6, x.size)
    noisy = rng.poisson((draw(x, y, flux) + SKY) * GAIN) / GAIN
    background = subtract_background(noisy)
    sources = detect_sources(background, gain=GAIN)
    return x, y, flux, background, sources, build_epsf(background, sources, gain=GAIN)


def test_wings_are_those_of_the_stars(field):
    grid = np.asarray(field[-1].data)
    grid = grid if grid.ndim == 2 else grid.mean(axis=0)
    center = len(grid) // 2
    reach = center // 4
    assert reach > 12
    for r in (8, 10, 12):
        values = [grid[center + dy * 4, center + dx * 4] for dy, dx in ((0, r), (r, 0), (0, -r))]
        # The PSF has the light within its first 7 px, 0.98 of all.
        assert np.mean(values) == pytest.approx(wings(r), rel=0.25)


def test_no_companions_around_bright_stars(field):
    x, y, flux, background, sources, epsf = field
    fitted = fit_centroids(background, sources, epsf, gain=GAIN)
    left = subtract_stars(background, fitted, epsf, gain=GAIN)
    found = detect_companions(left, fitted)
    distance = np.hypot(
        np.subtract.outer(np.asarray(found["x"]), x), np.subtract.outer(np.asarray(found["y"]), y)
    )
    assert np.sum((distance[:, flux > 1e5].min(axis=1) < 20) & (distance.min(axis=1) > 2)) == 0


def test_frames_without_wings_get_none():
    """A Gaussian ends within the grid that it is learned on."""
    rng = np.random.default_rng(9)
    y, x = (v.ravel() + rng.uniform(-6, 6, v.size) for v in np.mgrid[30:680:45, 30:680:45])
    flux = 10 ** rng.uniform(3.5, 5.6, x.size)
    image = np.zeros(SHAPE)
    iy, ix = np.mgrid[-8:9, -8:9]
    for x0, y0, f in zip(x, y, flux, strict=True):
        row, column = round(y0), round(x0)
        star = np.exp(-((ix + column - x0) ** 2 + (iy + row - y0) ** 2) / 2)
        image[row - 8 : row + 9, column - 8 : column + 9] += f * star / 2 / np.pi
    background = subtract_background(rng.poisson(image + SKY).astype(float))
    epsf = build_epsf(background, detect_sources(background, gain=GAIN), gain=GAIN)
    grid = np.asarray(epsf.data)
    assert grid.shape[-1] <= 4 * 2 * 10 + 1


def test_stars_beside_the_edge_are_used_once_they_are_fitted():
    rng = np.random.default_rng(10)
    y, x = (v.ravel() + rng.uniform(-6, 6, v.size) for v in np.mgrid[30:680:35, 30:680:35])
    near = np.arange(40, 680, 40)
    distance = rng.uniform(0, 2.5, near.size) - 0.5
    x, y = np.concatenate([x, distance, near]), np.concatenate([y, near, 699 - distance])
    flux = 10 ** rng.uniform(3.5, 5, x.size)
    background = subtract_background(rng.poisson(draw(x, y, flux) + SKY).astype(float))
    sources = detect_sources(background, gain=GAIN)
    fitted = fit_centroids(
        background, sources, build_epsf(background, sources, gain=GAIN), gain=GAIN
    )
    offset = np.hypot(
        np.subtract.outer(x, np.asarray(fitted["x"])), np.subtract.outer(y, np.asarray(fitted["y"]))
    )
    row, found = offset.argmin(axis=1), offset.min(axis=1) < 0.5
    inside = np.minimum(np.minimum(x, y), np.minimum(699 - x, 699 - y)) + 0.5
    edge = np.asarray(fitted["flags"])[row] & FLAG_EDGE > 0
    assert edge[found & (inside < 0.3)].all()
    beside = found & (inside > 0.8) & (inside < 2)
    assert beside.sum() > 10
    assert edge[beside].mean() < 0.1
    used = beside & (np.asarray(fitted["flags"])[row] == 0)
    pull = [
        (np.asarray(fitted[c])[row] - v)[used] / np.asarray(fitted[f"{c}_err"])[row][used]
        for c, v in (("x", x), ("y", y))
    ]
    assert np.std(np.concatenate(pull)) < 1.35
