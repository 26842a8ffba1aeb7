"""Matching of short lists: fifteen pairs must do, and chance must not pass for them."""

import math

import numpy as np
import pytest

from wpdc_gwcs.exceptions import MatchError
from wpdc_gwcs.matching import match_planes
from wpdc_gwcs.matching._evidence import log_chance_of_order
from wpdc_gwcs.matching._mapping import fit_smooth_map, turn_and_scale

SQUARE, NARROW = (2048, 2048), (4000, 128)


def make_few(seed, *, n=15, shape=SQUARE, distortion=8.0):
    """Few stars of a distorted frame, a fifth of either list without a partner.

    The distortion is cubic along the longer side, as of a fisheye whose axis is off the center.
    """
    rng = np.random.default_rng([seed, n])
    ny, nx = shape
    half = 0.5 * max(shape)
    size = np.array([nx, ny])
    lost = round(0.2 * n)
    on = rng.uniform(0, 1, (n + lost, 2)) * size
    around = rng.uniform(-0.25, 1.25, (round(1.25 * (n + lost)), 2)) * size
    around = around[((around < 0) | (around > size)).any(axis=1)]
    points = np.vstack([on, around])
    off = points - size / 2 - rng.uniform(-0.3, 0.3, 2) * size
    angle = np.deg2rad(0.2)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    reference = (points - size / 2) @ turn.T + size / 2 + [30.0, -20.0]
    reference += distortion * off * ((off / half) ** 2).sum(axis=1)[:, None] / half
    mag = rng.uniform(15, 20, len(points))
    found = np.vstack(
        [on[:n] + 0.03 * rng.normal(size=(n, 2)), rng.uniform(0, 1, (lost, 2)) * size]
    )
    found_mag = np.append(mag[:n] + 0.05 * rng.normal(size=n), rng.uniform(15, 20, lost))
    order = rng.permutation(len(found))
    return {
        "xs": found[order, 0],
        "ys": found[order, 1],
        "xr": reference[:, 0],
        "yr": reference[:, 1],
        "flux": 10 ** (-0.4 * found_mag[order]),
        "mag": mag,
        "image_shape": shape,
    }, np.where(order < n, order, -1)


@pytest.mark.parametrize("brightness", [True, False])
@pytest.mark.parametrize("seed", range(5))
def test_fifteen_stars_are_enough(seed, brightness):
    field, true = make_few(seed)
    if not brightness:
        del field["flux"], field["mag"]
    i, j, diagnostics = match_planes(**field)
    assert (true[i] == j).all()
    assert len(i) >= 13
    # counted at shifted positions alone they would not do
    assert diagnostics.significance < 9 or diagnostics.mapping.order == 1
    assert diagnostics.search_significance > 6.3


@pytest.mark.parametrize("seed", range(5))
def test_fifteen_stars_are_enough_on_a_narrow_frame(seed):
    field, true = make_few(seed, shape=NARROW, distortion=25.0)
    i, j, diagnostics = match_planes(**field)
    assert (true[i] == j).all()
    assert len(i) >= 11
    assert abs(diagnostics.rotation) < 1.5


@pytest.mark.parametrize("shape", [SQUARE, NARROW])
@pytest.mark.parametrize("seed", range(10))
def test_refuses_few_stars_of_another_field(seed, shape):
    field, _ = make_few(seed, n=12 + 2 * seed, shape=shape)
    other, _ = make_few(seed + 100, n=12 + 2 * seed, shape=shape)
    field |= {k: other[k] for k in ("xs", "ys", "flux")}
    with pytest.raises(MatchError, match="no match with sufficient evidence"):
        match_planes(**field)


def test_refuses_a_mirrored_narrow_frame():
    field, _ = make_few(1, n=25, shape=NARROW, distortion=25.0)
    field["xs"] = NARROW[1] - 1 - field["xs"]
    with pytest.raises(MatchError, match="mirrored"):
        match_planes(**field)


def test_needs_more_where_more_is_asked_for():
    field, _ = make_few(1)
    with pytest.raises(MatchError, match="with all mappings of so few stars counted"):
        match_planes(**field, min_significance=40.0)


def test_many_stars_are_judged_by_the_count_alone():
    field, _ = make_few(1, n=150)
    diagnostics = match_planes(**field)[2]
    assert math.isnan(diagnostics.search_significance)
    assert diagnostics.significance > 20


# Order of brightness


def test_order_of_equal_lists_has_one_chance_in_all_permutations(rng):
    values = rng.normal(size=8)
    assert log_chance_of_order(values, values) == pytest.approx(-math.log(math.factorial(8)))
    assert log_chance_of_order(values, -values) == pytest.approx(0.0, abs=1e-12)


def test_order_is_as_likely_as_it_says(rng):
    chances = np.exp([log_chance_of_order(*rng.normal(size=(2, 12))) for _ in range(2000)])
    for level in (0.05, 0.2, 0.5):
        assert np.mean(chances <= level) <= level + 4 * np.sqrt(level * (1 - level) / 2000)


def test_order_needs_values():
    values = np.array([1.0, 2.0, 3.0, np.nan, 4.0, -np.inf])
    assert log_chance_of_order(values, values) == 0.0


# Narrow frames


def test_rotation_of_a_narrow_frame_is_that_of_its_long_side():
    angle = np.deg2rad(0.5)
    # the short side is sheared by an ill-determined slope
    matrix = np.array([[1.0, -np.sin(angle)], [0.2, np.cos(angle)]])
    rotation, scale = turn_and_scale(matrix, NARROW)
    assert rotation == pytest.approx(0.5, abs=0.02)
    assert scale == pytest.approx(1.0, abs=1e-3)


def test_narrow_frame_fits_a_cubic_to_fifteen_pairs(rng):
    ny, nx = NARROW
    x, y = rng.uniform(0, nx, 15), rng.uniform(0, ny, 15)
    v = (y - ny / 2) / (ny / 2)
    options = {"center": np.array([nx / 2, ny / 2]), "scale": ny / 2}
    fit = fit_smooth_map(x, y, x + 5 * v**3, y + 40 * v**3, narrow=0, **options)
    assert fit.mapping.order == 3
    assert fit.n_terms == 7
    assert fit.scatter < 1e-3
    assert fit_smooth_map(x, y, x, y + 40 * v**3, **options).mapping.order < 3


def test_a_narrow_frame_takes_a_higher_order_once_wrong_pairs_are_out(rng):
    """With them there are pairs enough for all terms of degree 4, without for fewer of degree 5."""
    x, y = rng.uniform(0, 2000, 33), rng.uniform(0, 60, 33)
    u = (x - 999.5) / 1000
    wrong = np.arange(33) < 4
    x_ref, y_ref = x + 30 * u**5 + 30 * wrong, y + 10 * u**4
    x_ref, y_ref = (v + rng.normal(0, 0.01, 33) for v in (x_ref, y_ref))
    fit = fit_smooth_map(x, y, x_ref, y_ref, center=(999.5, 29.5), scale=1000.0, narrow=1)
    assert fit.mapping.order >= 5
    assert not fit.used[wrong].any()
    assert fit.mapping(x, y)[0][fit.used] == pytest.approx(x_ref[fit.used], abs=0.1)
