"""Waves of a detector against waves, polynomials and noise that are known."""

import numpy as np
import pytest
from astropy import units as u
from numpy.testing import assert_allclose

from wpdc_gwcs import calibrate, read_catalog, simulate
from wpdc_gwcs.solve.waves import _count_places, candidates, fit_waves

LOW, HIGH = np.array([-3000.0, 500.0]), np.array([1000.0, 4500.0])
SIGMA = 0.03


def places(rng, n, low=LOW, high=HIGH):
    return low[:, None] + (high - low)[:, None] * rng.uniform(size=(2, n))


def some_waves(rng, n=5):
    """A function of the place: sines of lengths that are on no grid, each axis by itself."""
    length, turn, phase = rng.uniform(450, 1300, n), rng.uniform(0, np.pi, n), rng.uniform(0, 6, n)
    size = rng.normal(size=(2, n))
    vector = 2 * np.pi / length * np.array([np.cos(turn), np.sin(turn)])
    return lambda focal: 0.05 * size @ np.sin(vector.T @ focal + phase[:, None])


def without_polynomials(focal, values):
    """What is left for the waves: other terms have polynomials of up to the fifth degree."""
    u, v = (focal - 0.5 * (LOW + HIGH)[:, None]) / (0.5 * (HIGH - LOW)[:, None])
    rows = np.stack([u**i * v**j for i in range(6) for j in range(6 - i)], axis=1)
    return values - (rows @ np.linalg.lstsq(rows, values.T, rcond=None)[0]).T


def rms(values):
    return np.sqrt(np.mean(np.sum(values**2, axis=0)))


def fitted(rng, truth, n, sigma=SIGMA):
    focal = places(rng, n)
    errors = sigma * rng.uniform(0.5, 1.5, (2, n))
    residual = truth(focal) + rng.normal(size=(2, n)) * errors
    waves = fit_waves(LOW, HIGH, focal, residual, errors**2)
    grid = places(rng, 3000)
    return waves, grid, without_polynomials(grid, waves(grid) - truth(grid))


@pytest.mark.parametrize("n", [5000, 8000, 25_000])
def test_few_waves_are_found(rng, n):
    truth = some_waves(rng)
    waves, grid, error = fitted(rng, truth, n)
    # Five waves have twenty amplitudes; those, and directions and lengths, cost three times that.
    assert rms(error) < SIGMA * np.sqrt(2 * 60 / n) + 0.01 * rms(truth(grid))
    assert rms(error) < 0.25 * rms(truth(grid))


def test_few_places_tell_no_waves(rng):
    truth, variance = some_waves(rng), np.full((2, 6000), SIGMA**2)
    spread = places(rng, 6000)
    assert fit_waves(LOW, HIGH, spread, truth(spread), variance) is not None
    # Twenty exposures that point within a few pixels of each other.
    same = np.tile(places(rng, 300), 20) + rng.uniform(-10, 10, (2, 6000))
    assert fit_waves(LOW, HIGH, same, truth(same), variance) is None
    few = places(rng, 1000)
    assert fit_waves(LOW, HIGH, few, truth(few), variance[:, :1000]) is None
    # Waves that are a third of the errors may as well be there.
    weak = rng.normal(size=few.shape) * 10 * SIGMA
    assert fit_waves(LOW, HIGH, few, truth(few) + weak, 100 * variance[:, :1000]) is not None
    two = places(rng, 2)
    assert fit_waves(LOW, HIGH, two, truth(two), variance[:, :2]) is None


@pytest.mark.parametrize("n", [20, 2000])
def test_places_are_counted(rng, n):
    spread = 40 * rng.uniform(size=(2, n))
    assert_allclose(_count_places(spread), n, rtol=0.1)
    assert_allclose(_count_places(np.tile(spread, 5)), _count_places(spread), rtol=0.1)


def test_places_are_not_more_than_stars(rng):
    assert _count_places(40 * rng.uniform(size=(2, 30_000))) == 30_000


@pytest.mark.parametrize("n", [1000, 8000])
def test_noise_stays_out(rng, n):
    waves, grid, _ = fitted(rng, lambda focal: np.zeros_like(focal), n)
    # A small part of what the 850 candidates would take of the noise.
    taken = rms(without_polynomials(grid, waves(grid)))
    assert taken < 0.15 * SIGMA * np.sqrt(2 * min(850, n) / n)


def test_uncertainty_is_that_of_the_errors(rng):
    pulls = []
    for _ in range(4):
        waves, grid, error = fitted(rng, some_waves(rng), 6000)
        covariance = waves.covariance(grid)
        assert_allclose(covariance[0, 1], 0.0)
        pulls.append(error / np.sqrt(covariance[[0, 1], [0, 1]]))
    assert 0.7 < np.sqrt(np.mean(np.square(pulls))) < 1.7


def test_high_polynomials_are_theirs(rng):
    middle, half = 0.5 * (LOW + HIGH)[:, None], 0.5 * (HIGH - LOW)[:, None]

    def truth(focal):
        u, v = (focal - middle) / half
        return 0.3 * np.array([u**7 - 0.5 * u**5 * v**2, v**8])

    _, grid, error = fitted(rng, truth, 6000)
    assert rms(error) < 0.4 * rms(without_polynomials(grid, truth(grid)))


def test_low_polynomials_are_not(rng):
    middle, half = 0.5 * (LOW + HIGH)[:, None], 0.5 * (HIGH - LOW)[:, None]

    def truth(focal):
        u, v = (focal - middle) / half
        return 5.0 * np.array([u**3 - u * v, v**5 + 2 * u**2 * v**2])

    waves, grid, _ = fitted(rng, truth, 6000)
    assert rms(without_polynomials(grid, waves(grid))) < 0.1 * SIGMA


def test_averaging_changes_little(rng, monkeypatch):
    truth, focal = some_waves(rng), places(rng, 15_000)
    residual = truth(focal) + rng.normal(size=focal.shape) * SIGMA
    variance = np.full(focal.shape, SIGMA**2)
    grid = places(rng, 3000)
    every = fit_waves(LOW, HIGH, focal, residual, variance)(grid)
    monkeypatch.setattr("wpdc_gwcs.solve.waves._MOST_STARS", 10_000)
    cells = fit_waves(LOW, HIGH, focal, residual, variance)(grid)
    assert rms(every - cells) < 0.02 * rms(every)


@pytest.mark.parametrize("size", [(4000.0, 4000.0), (128.0, 4000.0), (2000.0, 1000.0)])
def test_candidates(size):
    orders, step = candidates(np.zeros(2), np.array(size))
    wave = orders * step[:, None]
    number = np.hypot(*wave)
    assert number.min() > 0
    assert number.max() <= 2 * np.pi / (0.1 * max(size)) * (1 + 1e-12)
    both = np.hstack([orders, -orders])
    assert len(set(map(tuple, both.T))) == both.shape[1]


def roll_off(focal, size=0.02, length=8.0):
    """A detector's stars move inward at its rims, within some pixels."""
    return size * (
        np.exp(-(focal - LOW[:, None]) / length) - np.exp(-(HIGH[:, None] - focal) / length)
    )


def test_rims_get_what_a_table_can_take(rng):
    waves = some_waves(rng)
    n = 45_000
    focal = places(rng, n)
    noise = SIGMA * rng.normal(size=(2, n))
    found = fit_waves(
        LOW, HIGH, focal, roll_off(focal) + waves(focal) + noise, np.full((2, n), SIGMA**2)
    )
    grid = places(rng, 40_000)
    left = without_polynomials(grid, found(grid) - roll_off(grid) - waves(grid))
    rim = np.min([*(grid - LOW[:, None]), *(HIGH[:, None] - grid)], axis=0) < 40
    # With steps of 80 px half of the roll-off's energy, and more, remains.
    assert rms(left[:, rim]) < 0.8 * rms(roll_off(grid[:, rim]))
    # Where there is none, none is seen.
    none = fit_waves(LOW, HIGH, focal, waves(focal) + noise, np.full((2, n), SIGMA**2))
    assert np.abs(none.coefficients[:, -4:]).max() < 0.003


@pytest.mark.parametrize("seed", [1, 4])
def test_uncertainty_between_stars_of_exposures_that_point_alike(seed):
    """Eight exposures within 20 px of each other, of stars 340 px apart, with waves of 0.3 px."""
    size = 4096
    simulation = simulate(
        8, image_shape=(size, size), distortion=30, waves=0.3, density=6, seed=seed,
        pixel_scale=0.074 * u.arcsec, dither=1.5 * u.arcsec,
    )  # fmt: skip
    frames = [exposure.frame() for exposure in simulation.exposures]
    calibration = calibrate(frames, read_catalog(simulation.reference)).calibrations[0]
    x, y = (a.ravel() for a in np.meshgrid(*2 * [np.linspace(0, size - 1, 21)]))
    found = calibration.wcs.invert(*simulation.exposures[0].sky(x, y), with_bounding_box=False)
    pulls = (np.array(found) - [x, y]) / calibration.uncertainty(x, y)[:2]
    assert np.sqrt(np.mean(pulls**2)) < 1.3
    assert np.abs(pulls).max() < 5
