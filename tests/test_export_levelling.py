"""Fits whose greatest error is small; truth is the best approximation of |x|, which is known."""

import numpy as np
import pytest

from wpdc_gwcs.export import make_form
from wpdc_gwcs.export.levelling import levelling_weights
from wpdc_gwcs.models.powers import fit_polynomial


def errors(points, values, degree, weights=None):
    polynomial, origin = fit_polynomial(points, values, degree, weights)
    u = points - np.reshape(origin, (2, 1))
    return values - [np.polynomial.polynomial.polyval2d(*u, c) for c in polynomial]


@pytest.fixture
def points():
    t = np.cos(np.pi * (np.arange(65) + 0.5) / 65)
    return np.array(np.meshgrid(500.0 + 400.0 * t, 90.0 * t)).reshape(2, -1)


# x^2 + 1/8 is the best one of degrees 2 and 3, by equal errors of changing sign at 0, 1/2 and 1.
@pytest.mark.parametrize("axis", [0, 1])
def test_the_greatest_error_is_that_of_the_best_approximation(points, axis):
    values = np.zeros_like(points)
    values[axis] = np.abs(points[0] - 500.0) / 400.0
    weights = levelling_weights(points, values, 3)
    plain, level = (np.abs(errors(points, values, 3, w)) for w in (None, weights))
    assert plain.max() > 1.2 / 8
    assert 1 / 8 - 1e-3 < level.max() < 1.07 / 8
    assert np.sqrt(np.mean(level**2)) < 1.5 * np.sqrt(np.mean(plain**2))


def test_what_is_a_polynomial_stays_one(points):
    values = np.array([points[0] ** 2 - points[1], points[0] * points[1]])
    weights = levelling_weights(points, values, 2)
    assert np.abs(errors(points, values, 2, weights)).max() < 1e-8 * np.abs(values).max()


@pytest.mark.parametrize("form", ["tpv", "sip"])
def test_forms_are_no_worse_than_least_squares(form, monkeypatch):
    from test_io_formats import make_calibration

    calibration = make_calibration()
    level = make_form(calibration, form).deviation
    for module in ("tpv", "sip"):
        monkeypatch.setattr(f"wpdc_gwcs.export.{module}.levelling_weights", lambda pixels, *_: None)
    assert level < 0.95 * make_form(calibration, form).deviation
