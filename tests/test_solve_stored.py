"""Updates of a stored solution: they follow a change, and nothing else."""

from dataclasses import replace

import numpy as np
import pytest
from astropy.table import Table
from numpy.testing import assert_allclose

from wpdc_gwcs import ResidualMap, detect_drift
from wpdc_gwcs.models import deproject
from wpdc_gwcs.solve import Exposure, solve
from wpdc_gwcs.solve.spectrum import Spectrum
from wpdc_gwcs.solve.strength import summarize_fields

SIDE = 1024
CENTER = 0.5 * (SIDE - 1)
CD = np.array([[-2e-5, 3e-7], [3e-7, 2e-5]])
NOISE = 0.03
STARS = 250
WAVE = 0.18


class Camera:
    """One detector whose exposures have turbulence, and which a wave may change."""

    def __init__(self, seed, turbulence=0.015):
        self.rng = np.random.default_rng(seed)
        self.turbulence = turbulence
        self.wave = 0.0

    def displacement(self, x, y):
        u, v = (np.asarray(x) - CENTER) / CENTER, (np.asarray(y) - CENTER) / CENTER
        wave = self.wave * np.sin(2 * np.pi * (0.8 * u + 0.6 * v) + 0.7)
        return np.array([2 * u * (u * u + v * v) + 0.6 * wave, u * v + 0.8 * wave])

    def field(self, x, y, n=8):
        rng = self.rng
        k = 2 * np.pi / (SIDE * rng.uniform(0.5, 2.0, n))
        angle, phase = rng.uniform(0, 2 * np.pi, (2, n))
        size = self.turbulence * rng.normal(size=(2, n)) * np.sqrt(2 / n)
        waves = np.outer(k * np.cos(angle), x) + np.outer(k * np.sin(angle), y) + phase[:, None]
        return size @ np.sin(waves)

    def expose(self, n, stars=STARS):
        out = []
        for i in range(n):
            x, y = self.rng.uniform(0, SIDE - 1, (2, stars))
            place = self.displacement(x, y) + [x - CENTER, y - CENTER] + self.field(x, y)
            crval = 30.0 + 0.01 * self.rng.normal(size=2)
            ra, dec = deproject(*(CD @ place), crval)
            x, y = np.array([x, y]) + NOISE * self.rng.normal(size=(2, stars))
            error = np.full(stars, NOISE)
            out.append(Exposure(f"e{i}", x, y, ra, dec, crval, CD, error, error))
        return out

    def error(self, solution, n=31):
        """Root mean square over the detector, both axes, but for what attitudes take."""
        x, y = (a.ravel() for a in np.meshgrid(*[np.linspace(0, SIDE - 1, n)] * 2))
        found, true = np.array(solution.undistort(x, y)), self.displacement(x, y) + [x, y]
        rows = np.stack([np.ones_like(x), *found], axis=1)
        rest = true.T - rows @ np.linalg.lstsq(rows, true.T, rcond=None)[0]
        return float(np.sqrt(np.mean(np.sum(rest**2, axis=1))))


def solved(exposures, **options):
    return solve(exposures, image_shape=(SIDE, SIDE), **options)


def drift_of(exposures, stored):
    """What `wpdc monitor` says of the exposures."""
    result = solved(exposures, solution=stored, refine="attitude")
    matches = [
        Table({"x": e.x, "y": e.y, "dx": f.dx, "dy": f.dy, "x_err": f.x_err, "y_err": f.y_err})
        for e, f in zip(exposures, result.exposures, strict=True)
    ]
    return detect_drift(stored, matches)


@pytest.fixture(scope="module")
def camera():
    camera = Camera(5)
    return camera, solved(camera.expose(8)).solution


@pytest.fixture(scope="module")
def unchanged(camera):
    return camera[0].expose(5)


@pytest.fixture(scope="module")
def changed(camera):
    truth, _ = camera
    truth.wave = WAVE
    exposures = truth.expose(5)
    truth.wave = 0.0
    return exposures


def last(solution):
    return solution.statistics["updates"][-1]


def test_the_fields_of_the_stored_exposures_are_remembered(camera):
    fields = camera[1].statistics["fields"]
    assert fields["n"] == 8
    assert 0.005 < fields["amplitude"] < 0.2


@pytest.mark.parametrize(("n", "limit"), [(1, 0.06), (5, 0.03)])
def test_follows_a_wave(camera, changed, n, limit):
    truth, stored = camera
    updated = solved(changed[:n], solution=stored, update=True).solution
    truth.wave = WAVE
    before, after = truth.error(stored), truth.error(updated)
    truth.wave = 0.0
    assert before > 0.1
    assert after < limit
    entry = last(updated)
    assert entry["n_exposures"] == n
    assert entry["process_noise"] > 0
    assert entry["evidence"] > 3
    assert_allclose(entry["rms_change_px"], WAVE / np.sqrt(2), rtol=0.25)
    assert entry["max_change_px"] > entry["rms_change_px"]
    # The uncertainty says what the map may be wrong by.
    sigma = np.sqrt(np.mean(np.sum(updated.table_sigma[:2] ** 2, axis=0)))
    assert 0.4 * after < sigma < 3 * after


@pytest.mark.parametrize("n", [1, 5])
def test_stays_where_nothing_has_changed(camera, unchanged, n):
    truth, stored = camera
    updated = solved(unchanged[:n], solution=stored, update=True).solution
    assert last(updated)["process_noise"] == 0
    assert last(updated)["rms_change_px"] == 0
    assert truth.error(updated) < 1.05 * truth.error(stored)
    assert updated.residual_map.n_stars > stored.residual_map.n_stars


def test_updates_are_counted_one_after_the_other(camera, unchanged):
    _, one = camera
    for exposure in unchanged[:2]:
        one = solved([exposure], solution=one, update=True).solution
    assert [u["n_exposures"] for u in one.statistics["updates"]] == [1, 1]
    assert one.statistics["n_exposures"] == 10
    assert one.statistics["fields"]["n"] >= 8


def test_monitor_agrees(camera, unchanged, changed):
    _, stored = camera
    for exposures, drifted in ((unchanged, False), (changed, True)):
        updated = solved(exposures, solution=stored, update=True).solution
        assert (last(updated)["process_noise"] > 0) is drifted
        assert drift_of(exposures, stored).drifted is drifted
    # A single frame has a field of its own, which is no drift.
    assert not drift_of(unchanged[:1], stored).drifted


def test_a_change_by_attitudes_alone_is_none(camera, unchanged):
    turned = [
        replace(e, x=CENTER + 1.0005 * (e.x - CENTER), y=CENTER + 0.9998 * (e.y - CENTER))
        for e in unchanged
    ]
    updated = solved(turned, solution=camera[1], update=True).solution
    assert last(updated)["process_noise"] == 0


def test_maps_are_moved_and_weighted():
    rng = np.random.default_rng(1)
    x, y = rng.uniform(0, 999, (2, 2000))
    dx, dy = rng.normal(0, 0.1, (2, 2000))
    one = ResidualMap.from_residuals(x, y, dx, dy, x_err=0.1, y_err=0.1, image_shape=(1000, 1000))
    other = ResidualMap.from_residuals(
        x, y, dx + 0.3, dy - 0.2, x_err=0.1, y_err=0.1, image_shape=(1000, 1000)
    )
    shape = one.shape
    moved = one.displaced(np.full(shape, 0.3), np.full(shape, -0.2))
    assert_allclose(moved.sums, other.sums, atol=1e-8)
    light = one.weighted(0.25)
    assert_allclose(light.mean, one.mean)
    assert_allclose(light.sigma, 2 * one.sigma)
    assert light.n_stars == one.n_stars


def test_fields_of_several_runs_are_pooled():
    spectra = [Spectrum(0.03, 1000.0), Spectrum(0.04, 1000.0), None]
    own = summarize_fields(spectra, (SIDE, SIDE))
    assert own["n"] == 3
    assert_allclose(own["amplitude"], np.sqrt(0.03 * 0.04))
    again = summarize_fields([Spectrum(0.05, 1000.0)] * 3, (SIDE, SIDE), own)
    assert again["n"] == 6
    assert own["amplitude"] < again["amplitude"] < 0.05
    # Exposures without fields are few beside those with them.
    assert summarize_fields([None], (SIDE, SIDE), own) == own
    none = summarize_fields([None] * 8, (SIDE, SIDE))
    assert none["amplitude"] == 0
    assert none["scatter"] < 0.5


@pytest.mark.parametrize("wave", [0.0, WAVE])
def test_few_stars_do_not_cost_the_table(camera, wave):
    # 40 stars carry no table by themselves; what is known of the detector stays.
    truth, stored = camera
    light = replace(stored, residual_map=ResidualMap((SIDE, SIDE)))
    truth.wave = wave
    exposures = truth.expose(4, stars=12)
    updated = solved(exposures, solution=light, update=True).solution
    before, after = truth.error(stored), truth.error(updated)
    truth.wave = 0.0
    assert updated.lookup_table is not None
    assert after < 1.2 * before
    assert last(updated)["n_exposures"] == 4
