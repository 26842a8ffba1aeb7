"""Simulated stars that color moves: in closed form, and as a calibration finds it."""

import astropy.units as u
import numpy as np
import pytest

from wpdc_gwcs import calibrate, simulate
from wpdc_gwcs.cli.app import run
from wpdc_gwcs.evaluation import score_frame
from wpdc_gwcs.simulation import read_truth, write_simulation

SMALL = {"image_shape": (1000, 1000), "distortion": 10.0, "density": 40.0, "colors": (1.2, 0.5)}
SCALE = 300.0  # mas per px


def shifts(exposure):
    """Displacement of the stars per magnitude of color, px, on undistorted pixels."""
    stars = exposure.stars
    seen = exposure.distortion.undistort(stars["x"], stars["y"])
    true = exposure.linear_wcs.wcs_world2pix(stars["ra"], stars["dec"], 0)
    return np.subtract(seen, true) / (stars["color"] - 1.2), np.array(true)


def test_refraction_is_one_shift_in_each_exposure():
    simulation = simulate(3, refraction=60 * u.mas, seed=4, **SMALL)
    found = []
    for exposure in simulation.exposures:
        assert exposure.color == 1.2
        shift, _ = shifts(exposure)
        assert np.ptp(shift, axis=1).max() < 1e-3
        found.append(shift.mean(axis=1))
    np.testing.assert_allclose(np.hypot(*np.transpose(found)), 60 / SCALE, rtol=1e-3)
    assert np.hypot(*(found[0] - found[1])) > 0.01


def test_lateral_color_grows_from_the_axis():
    (exposure,) = simulate(1, lateral_color=90 * u.mas, seed=4, **SMALL).exposures
    shift, place = shifts(exposure)
    away = place - np.reshape(exposure.linear_wcs.wcs.crpix - 1, (2, 1))
    expected = 90 / SCALE * away / (1000 / np.sqrt(2))
    np.testing.assert_allclose(shift, expected, atol=1e-4)


def test_without_chromatism_nothing_changes():
    plain, same = (simulate(1, seed=4, **SMALL, **more).exposures[0] for more in ({}, {}))
    moved = simulate(1, seed=4, refraction=60 * u.mas, **SMALL).exposures[0]
    assert plain.color is same.color is None
    np.testing.assert_array_equal(plain.stars["ra"], moved.stars["ra"])
    assert moved.header["CRVAL1"] == plain.header["CRVAL1"]


def test_calibration_takes_color_away(tmp_path):
    simulation = simulate(
        3, refraction=150 * u.mas, lateral_color=60 * u.mas, seed=5, catalog_errors=False, **SMALL
    )
    write_simulation(simulation, tmp_path, images=())
    truth = read_truth(tmp_path)
    errors, sigma = {}, {}
    for name, catalog in (("colors", simulation.reference), ("none", simulation.reference.copy())):
        if name == "none":
            catalog.remove_column("bp_rp")
        done = calibrate([e.frame() for e in simulation.exposures], catalog)
        scores = [
            score_frame(c, truth.frames[c.frame], truth.stars(c.frame)) for c in done.calibrations
        ]
        errors[name] = np.sqrt(np.mean([s.wcs_rms**2 for s in scores]))
        m = done.calibrations[0].matches
        used = np.asarray(m["used"], bool)
        sigma[name] = np.hypot(np.std(m["dx"][used]), np.std(m["dy"][used]))
    # 150 mas times a scatter of 0.5 mag are 0.25 px along the direction of the zenith.
    assert errors["colors"] < 0.01
    assert sigma["none"] > 1.3 * sigma["colors"]
    assert all(t.color == 1.2 for t in truth.frames.values())


def test_color_must_be_known(tmp_path, capsys):
    with pytest.raises(ValueError, match="colors must be given where places depend on color"):
        simulate(1, refraction=10 * u.mas)
    with pytest.raises(TypeError, match="lateral_color must be a Quantity in rad"):
        simulate(1, lateral_color=10.0)
    arguments = ["simulate", "--output", str(tmp_path / "new"), "--refraction", "5"]
    assert run(arguments) == 2
    assert "colors must be given" in capsys.readouterr().err
