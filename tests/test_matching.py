"""Matching: the right pairs, or a refusal that says why."""

import warnings
from dataclasses import FrozenInstanceError

import gwcs
import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import ICRS, SkyCoord
from astropy.io import fits
from astropy.modeling import models
from astropy.table import MaskedColumn, QTable, Table
from astropy.time import Time
from astropy.wcs import WCS, FITSFixedWarning
from astropy.wcs.wcsapi import SlicedLowLevelWCS
from gwcs import coordinate_frames as cf

from wpdc_gwcs.exceptions import MatchError
from wpdc_gwcs.matching import (
    SmoothMap,
    match_nearby,
    match_planes,
    match_sources,
    pair_nearest,
)

SHAPE = (2048, 2048)


def make_field(
    seed=1,
    *,
    n=400,
    shape=SHAPE,
    shift=(60.0, -40.0),
    rotation=0.5,
    scale=1.005,
    distortion=30.0,
    lost=0.05,
    spurious=0.15,
    noise=0.05,
    surplus=1.0,
):
    """Reference stars and sources with a cubic distortion, and who is who.

    The reference covers twice the frame's width; a quarter of it is on the frame.  Brightness is in
    magnitudes; spurious sources are faint.
    """
    rng = np.random.default_rng(seed)
    ny, nx = shape
    half = 0.5 * max(nx, ny)
    n_all = int(4 * n * surplus)
    x = rng.uniform(-0.5 * nx, 1.5 * nx, n_all)
    y = rng.uniform(-0.5 * ny, 1.5 * ny, n_all)
    mag = 20 + np.log10(rng.uniform(0.01, 1, n_all)) * 2
    a, b = rng.normal(size=(2, 7)) * [1, 1, 1, 0.6, 0.6, 0.6, 0.6]

    def bend(px, py):
        p, q = (px - nx / 2) / half, (py - ny / 2) / half
        return np.array([p * p, p * q, q * q, p**3, p * p * q, p * q * q, q**3])

    grid = bend(*np.meshgrid(np.linspace(0, nx, 33), np.linspace(0, ny, 33))).reshape(7, -1)
    gain = distortion / np.hypot(a @ grid, b @ grid).max()

    def distort(px, py):
        terms = bend(px, py)
        r = np.deg2rad(rotation)
        u_, v_ = px - nx / 2, py - ny / 2
        return (
            nx / 2 + shift[0] + scale * (np.cos(r) * u_ - np.sin(r) * v_) + gain * (a @ terms),
            ny / 2 + shift[1] + scale * (np.sin(r) * u_ + np.cos(r) * v_) + gain * (b @ terms),
        )

    found = np.flatnonzero((rng.uniform(size=n_all) > lost) & (np.arange(n_all) < 4 * n))
    xs, ys = distort(x[found], y[found])
    on = (xs > 0) & (xs < nx - 1) & (ys > 0) & (ys < ny - 1)
    found, xs, ys = found[on], xs[on], ys[on]
    m = int(spurious * len(found))
    xs = np.append(xs + rng.normal(size=len(xs)) * noise, rng.uniform(0, nx, m))
    ys = np.append(ys + rng.normal(size=len(ys)) * noise, rng.uniform(0, ny, m))
    true = np.append(found, np.full(m, -1))
    flux = 10 ** (-0.4 * np.append(mag[found], rng.uniform(19, 20, m)))
    order = rng.permutation(len(xs))
    return {
        "xs": xs[order],
        "ys": ys[order],
        "xr": x,
        "yr": y,
        "flux": flux[order],
        "mag": mag,
        "true": true[order],
        "shape": shape,
    }


def run(field, *, brightness=True, **options):
    more = {"flux": field["flux"], "mag": field["mag"]} if brightness else {}
    return match_planes(
        field["xs"],
        field["ys"],
        field["xr"],
        field["yr"],
        image_shape=field["shape"],
        **more,
        **options,
    )


def assert_right(field, i, j, *, recall=0.99, false=0.0):
    true = field["true"]
    assert (true[i] == j).sum() >= recall * (true >= 0).sum()
    assert (true[i] != j).sum() <= false * len(i)
    assert len(np.unique(i)) == len(i)
    assert len(np.unique(j)) == len(j)


@pytest.mark.parametrize("brightness", [True, False])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_planes_finds_all_pairs(seed, brightness):
    field = make_field(seed)
    i, j, diagnostics = run(field, brightness=brightness)
    assert_right(field, i, j)
    assert (np.diff(i) > 0).all()
    assert diagnostics.n_pairs == len(i)
    assert diagnostics.purity > 0.99
    assert diagnostics.significance > 20
    assert diagnostics.scatter == pytest.approx(0.05, rel=0.25)


def test_planes_reports_the_header_error():
    field = make_field(4, shift=(100.0, -70.0), rotation=0.8, scale=0.99, distortion=0.0)
    diagnostics = run(field)[2]
    # the mapping goes from the sources to the reference: the inverse of what was put in
    assert diagnostics.rotation == pytest.approx(-0.8, abs=1e-3)
    assert diagnostics.scale == pytest.approx(1 / 0.99, abs=1e-5)
    inverse = np.linalg.inv(
        0.99
        * np.array(
            [
                [np.cos(0.8 * u.deg), -np.sin(0.8 * u.deg)],
                [np.sin(0.8 * u.deg), np.cos(0.8 * u.deg)],
            ]
        )
    )
    assert diagnostics.shift == pytest.approx(inverse @ [-100.0, 70.0], abs=0.5)
    assert diagnostics.parity == 1


def test_pair_nearest_matches_brute_force(rng):
    xs, ys = rng.uniform(0, 30, (2, 150))
    xr, yr = rng.uniform(0, 30, (2, 150))
    i, j, n_ambiguous = pair_nearest(xs, ys, xr, yr, 1.0)
    near = np.hypot(xs[:, None] - xr, ys[:, None] - yr) <= 1.0
    alone = near & (near.sum(1) == 1)[:, None] & (near.sum(0) == 1)[None]
    assert sorted(zip(i, j)) == sorted(zip(*np.nonzero(alone)))
    assert n_ambiguous == near.any(1).sum() - alone.any(1).sum()


def test_pair_nearest_ignores_positions_that_are_not_finite():
    i, j, n_ambiguous = pair_nearest([1, np.nan, 5], [1, 1, 5], [5, np.inf, 1], [5, 5, 1.2], 0.5)
    assert list(i) == [0, 2]
    assert list(j) == [2, 0]
    assert n_ambiguous == 0


def test_pair_nearest_takes_a_radius_per_source():
    i, j, _ = pair_nearest([0, 10], [0, 0], [0.5, 10.5], [0, 0], [1.0, 0.1])
    assert list(i) == [0]
    assert list(j) == [0]


def test_pair_nearest_of_nothing():
    i, j, n_ambiguous = pair_nearest([], [], [1.0], [1.0], 1.0)
    assert len(i) == len(j) == n_ambiguous == 0
    assert len(pair_nearest([1.0], [1.0], [], [], 1.0)[0]) == 0


@pytest.mark.parametrize("radius", [-1.0, np.nan])
def test_pair_nearest_rejects_bad_radius(radius):
    with pytest.raises(ValueError, match="radius must be"):
        pair_nearest([1.0], [1.0], [1.0], [1.0], radius)


def test_pair_nearest_rejects_unequal_lengths():
    with pytest.raises(ValueError, match="xs and ys must be"):
        pair_nearest([1.0, 2.0], [1.0], [1.0], [1.0], 1.0)


def test_mapping_turns_back():
    field = make_field(8, distortion=60.0)
    mapping = run(field)[2].mapping
    x, y = np.random.default_rng(0).uniform(0, 2047, (2, 500))
    back = mapping.inverse(*mapping(x, y))
    np.testing.assert_allclose(back, [x, y], atol=0.05)


def test_mapping_keeps_shape():
    mapping = SmoothMap.identity(SHAPE).shifted(1.0, 2.0)
    x, y = mapping(np.zeros((3, 4)), np.zeros((3, 4)))
    assert x.shape == y.shape == (3, 4)
    assert (x == 1.0).all()
    assert (y == 2.0).all()
    shift, matrix = mapping.linear_part()
    np.testing.assert_allclose(shift, [1, 2], atol=1e-9)
    np.testing.assert_allclose(matrix, np.eye(2), atol=1e-9)


# Hard fields


@pytest.mark.parametrize(
    "kwargs",
    [
        {"distortion": 200.0, "n": 600},
        {"spurious": 1.0, "lost": 0.4},
        {"n": 60, "shift": (250.0, 150.0), "rotation": 1.0, "scale": 0.99},
        {"n": 300, "surplus": 6.0},
        {"n": 400, "spurious": 8.0, "distortion": 100.0},
        {"n": 5000, "distortion": 100.0, "rotation": -1.0},
        {"noise": 0.0},
        {"noise": 1.0},
    ],
    ids=[
        "steep",
        "spurious",
        "sparse",
        "deep-reference",
        "deep-sources",
        "crowded",
        "noise-free",
        "noisy",
    ],
)
@pytest.mark.parametrize("brightness", [True, False])
def test_hard_fields(kwargs, brightness):
    field = make_field(11, **kwargs)
    i, j, _ = run(field, brightness=brightness)
    assert_right(field, i, j, recall=0.97, false=0.002)


def test_order_of_rows_does_not_matter(rng):
    field = make_field(12)
    i, j, _ = run(field)
    p, q = rng.permutation(len(field["xs"])), rng.permutation(len(field["xr"]))
    mixed = {k: field[k][p] for k in ("xs", "ys", "flux")}
    mixed |= {k: field[k][q] for k in ("xr", "yr", "mag")} | {"shape": field["shape"]}
    k, m, _ = run(mixed)
    assert set(zip(p[k], q[m])) == set(zip(i, j))


def test_inputs_stay_as_they_are():
    field = make_field(13)
    before = {k: np.copy(field[k]) for k in ("xs", "ys", "xr", "yr", "flux", "mag")}
    run(field)
    for k, v in before.items():
        np.testing.assert_array_equal(field[k], v)


def test_errors_set_the_radius_star_by_star(rng):
    field = make_field(14, noise=0.0, n=800)
    error = np.where(rng.uniform(size=len(field["xs"])) < 0.5, 0.02, 0.4)
    field["xs"] = field["xs"] + rng.normal(size=len(error)) * error
    field["ys"] = field["ys"] + rng.normal(size=len(error)) * error
    i, j, _ = run(field, x_err=error, y_err=error)
    assert_right(field, i, j, recall=0.985)


def test_start_from_a_mapping():
    field = make_field(15)
    i, j, diagnostics = run(field)
    k, m, again = run(field, start=diagnostics.mapping.shifted(2.0, -1.0))
    np.testing.assert_array_equal(k, i)
    np.testing.assert_array_equal(m, j)
    assert "patterns" not in again.timings
    with pytest.raises(MatchError, match="no match with sufficient evidence"):
        run(field, start=SmoothMap.identity(SHAPE))


# Blind


TURNS = {
    "mirrored": [[-1, 0], [0, 1]],
    "quarter turn": [[0, -1], [1, 0]],
    "half turn": [[-1, 0], [0, -1]],
    "mirrored quarter turn": [[0, 1], [1, 0]],
}


def turn(field, matrix, shift=(0.0, 0.0)):
    """Same field with another header error on top: the reference moves."""
    ny, nx = field["shape"]
    center = np.array([0.5 * (nx - 1), 0.5 * (ny - 1)])
    points = np.column_stack([field["xr"], field["yr"]])
    points = (points - center) @ np.asarray(matrix, float).T + center + shift
    return field | {"xr": points[:, 0], "yr": points[:, 1]}


@pytest.mark.parametrize("name", TURNS)
def test_blind_finds_turned_frames(name):
    field = turn(make_field(16), TURNS[name])
    with pytest.raises(MatchError, match="blind=True"):
        run(field)
    i, j, diagnostics = run(field, blind=True)
    assert_right(field, i, j)
    assert diagnostics.parity == round(np.linalg.det(TURNS[name]))
    # the mapping is that of the frame as it was given
    x, y = diagnostics.mapping(field["xs"][i], field["ys"][i])
    assert np.median(np.hypot(x - field["xr"][j], y - field["yr"][j])) < 0.2


@pytest.mark.parametrize("shape", [(2048, 2048), (2048, 600)])
@pytest.mark.parametrize(("angle", "parity"), [(8.0, 1), (22.0, -1), (67.0, 1), (157.0, -1)])
def test_blind_finds_any_rotation(shape, angle, parity):
    field = make_field(16, shape=shape, distortion=10.0, rotation=0.0)
    c, s = np.cos(np.deg2rad(angle)), np.sin(np.deg2rad(angle))
    turned = turn(field, np.array([[c, -s], [s, c]]) @ np.diag([parity, 1]))
    with pytest.raises(MatchError, match="blind=True"):
        run(turned)
    i, j, found = run(turned, blind=True)
    assert_right(field, i, j)
    assert found.parity == parity
    assert found.rotation == pytest.approx(angle, abs=0.5)
    # The evidence is that of the frame, whatever the header says.
    _, _, upright = run(field)
    assert found.completeness == pytest.approx(upright.completeness, abs=0.01)
    assert len(found.areas) == len(upright.areas)


def test_a_wider_search_is_suggested_only_where_it_can_help():
    field = turn(make_field(17, scale=1.0), np.eye(2) * 0.8)
    for blind in (False, True):
        with pytest.raises(
            MatchError, match=r"pairs have 0\.(799|80)\d* times its scale"
        ) as caught:
            run(field, blind=blind)
        assert "blind" not in str(caught.value)


@pytest.mark.parametrize("scale", [0.95, 1.05])
def test_blind_finds_wrong_scale(scale):
    field = turn(make_field(17, scale=1.0), np.eye(2) * scale)
    with pytest.raises(MatchError, match=r"scale .* is off by .*blind=True"):
        run(field)
    i, j, diagnostics = run(field, blind=True)
    assert_right(field, i, j)
    assert diagnostics.scale == pytest.approx(scale, abs=2e-3)


def test_blind_finds_wrong_pointing():
    field = turn(make_field(18, shift=(0.0, 0.0)), np.eye(2), (0.25 * 2048, 0.0))
    with pytest.raises(MatchError, match=r"(pointing|evidence).*blind=True"):
        run(field)
    i, j, diagnostics = run(field, blind=True)
    assert_right(field, i, j)
    assert diagnostics.shift[0] == pytest.approx(0.25 * 2048, abs=3)


# What cannot be matched


def test_refuses_another_field():
    field, other = make_field(6), make_field(7)
    field |= {k: other[k] for k in ("xr", "yr", "mag")}
    with pytest.raises(MatchError, match=r"no match with sufficient evidence.*blind=True"):
        run(field)
    with pytest.raises(MatchError) as error:
        run(field, blind=True)
    assert "blind" not in str(error.value)


@pytest.mark.parametrize("which", ["xs", "yr"])
@pytest.mark.parametrize("n", [30, 400])
def test_refuses_shuffled_positions(rng, which, n):
    field = make_field(19, n=n)
    field[which] = rng.permutation(field[which])
    with pytest.raises(MatchError, match="no match with sufficient evidence"):
        run(field)


@pytest.mark.parametrize("n", [0, 1, 3, 5])
def test_refuses_a_handful_of_sources(n):
    field = make_field(20)
    on = np.flatnonzero(field["true"] >= 0)[:n]
    field |= {k: field[k][on] for k in ("xs", "ys", "flux", "true")}
    with pytest.raises(MatchError, match=f"too few sources to match: {n} "):
        run(field)


@pytest.mark.parametrize("n", [0, 1, 3, 5])
def test_refuses_a_handful_of_reference_stars(n):
    field = make_field(21)
    on = field["true"][field["true"] >= 0][:n]
    field |= {k: field[k][on] for k in ("xr", "yr", "mag")}
    with pytest.raises(MatchError, match=f"too few reference stars .* {n} "):
        run(field)


def test_refuses_a_catalog_of_another_part_of_the_sky():
    field = make_field(22)
    field["xr"] = field["xr"] + 1e5
    with pytest.raises(MatchError, match=r"too few reference stars in reach of the frame.*: 0"):
        run(field)


def test_refuses_stars_on_a_line(rng):
    x = rng.uniform(0, 2000, 100)
    with pytest.raises(MatchError, match="no match with sufficient evidence"):
        match_planes(x, 500 + 0.3 * x, x + 20, 510 + 0.3 * x, image_shape=SHAPE)


def test_refuses_when_half_of_the_frame_does_not_match(rng):
    field = make_field(23, n=800)
    right = field["xs"] > 1024
    field["ys"][right] = rng.permutation(field["ys"][right])
    with pytest.raises(MatchError, match="parts of the frame lack pairs"):
        run(field)


# Fields that repeat themselves


def bend(x, y):
    """Header error and distortion of the frame, px."""
    u, v = (x - 1024) / 1024, (y - 1024) / 1024
    return x + 31 - 9 * v + 15 * u * v + 10 * u**3, y - 17 + 9 * u - 12 * u * u + 9 * v**3


def make_repeating(stars, seen, rng):
    """Sources where `seen` marks stars that are on the frame; 5 % of them lost."""
    x, y = stars.T
    on = seen & (x > 0) & (x < 2048) & (y > 0) & (y < 2048) & (rng.uniform(size=len(x)) > 0.05)
    true = np.flatnonzero(on)
    xs, ys = bend(x[true], y[true])
    xs, ys = (p + rng.normal(size=len(true)) * 0.05 for p in (xs, ys))
    return {"xs": xs, "ys": ys, "xr": x, "yr": y, "true": true, "shape": SHAPE}


def make_lattice(rng, *, step=100.0, jitter=0.0, margin=600):
    nodes = np.arange(-margin, 2048 + margin, step)
    stars = np.stack(np.meshgrid(nodes, nodes), axis=-1).reshape(-1, 2)
    stars = stars + rng.normal(size=stars.shape) * jitter
    return make_repeating(stars, np.ones(len(stars), bool), rng)


@pytest.mark.parametrize("margin", [600, 0], ids=["endless", "as large as the frame"])
@pytest.mark.parametrize("seed", [1, 2])
def test_refuses_a_perfect_lattice(seed, margin):
    with pytest.raises(MatchError, match="match is ambiguous|no match with sufficient evidence"):
        run(make_lattice(np.random.default_rng(seed), margin=margin), brightness=False)


@pytest.mark.parametrize("jitter", [5.0, 15.0])
def test_solves_a_jittered_lattice(rng, jitter):
    field = make_lattice(rng, step=60.0, jitter=jitter)
    i, j, _ = run(field, brightness=False)
    assert_right(field, i, j)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_lattice_of_little_jitter_is_never_silently_wrong(seed):
    field = make_lattice(np.random.default_rng(seed), step=80.0, jitter=1.0)
    try:
        i, j, _ = run(field, brightness=False)
    except MatchError:
        return
    assert_right(field, i, j)


def make_copies(rng, *, angle=0.0, share=1.0):
    """A catalog with every star (or a share of them) twice, the second one shifted and turned."""
    stars = rng.uniform(-300, 2348, (900, 2))
    c, s = np.cos(np.deg2rad(angle)), np.sin(np.deg2rad(angle))
    copies = (stars - 1024) @ np.array([[c, s], [-s, c]]) + 1024 + [137.0, -81.0]
    copies = copies[rng.uniform(size=len(copies)) < share]
    return np.vstack([stars, copies]), np.arange(900 + len(copies)) < 900


@pytest.mark.parametrize("angle", [0.0, 1.0])
@pytest.mark.parametrize("first", [True, False])
def test_refuses_a_catalog_that_has_the_field_twice(rng, angle, first):
    stars, original = make_copies(rng, angle=angle)
    field = make_repeating(stars, original == first, rng)
    with pytest.raises(MatchError, match=r"ambiguous: \d+ pairs .* and \d+ pairs .* px apart"):
        run(field, brightness=False)


@pytest.mark.parametrize("angle", [0.0, 1.0])
def test_solves_a_field_of_which_a_part_comes_twice(rng, angle):
    stars, original = make_copies(rng, angle=angle, share=0.4)
    field = make_repeating(stars, original, rng)
    i, j, _ = run(field, brightness=False)
    assert_right(field, i, j)


def test_solves_a_field_that_is_seen_twice(rng):
    stars, original = make_copies(rng)
    field = make_repeating(stars, np.ones(len(stars), bool), rng)
    i, j, _ = run(field, brightness=False)
    assert_right(field, i, j)


def test_blind_refuses_a_field_that_is_its_own_half_turn(rng):
    half = rng.uniform(-300, 2348, (300, 2))
    stars = np.vstack([half, 2047 - half])
    field = make_repeating(stars, np.ones(len(stars), bool), rng)
    i, j, _ = run(field, brightness=False)
    assert_right(field, i, j)
    with pytest.raises(MatchError, match="match is ambiguous"):
        run(field, brightness=False, blind=True)


# Odd input that has a right answer


def test_positions_that_are_not_finite_are_ignored():
    field = make_field(24)
    field["xs"][::10] = np.nan
    field["yr"][::10] = np.inf
    field["true"][::10] = -1
    field["true"][field["true"] % 10 == 0] = -1
    i, j, _ = run(field)
    assert_right(field, i, j)


def test_duplicates_count_once():
    field = make_field(25)
    n = len(field["xs"])
    twice = field | {k: np.tile(field[k], 2) for k in ("xs", "ys", "flux", "xr", "yr", "mag")}
    i, j, diagnostics = run(twice)
    assert (i < n).all()
    assert_right(field, i, j)
    assert diagnostics.n_duplicates == n + len(field["xr"])


def test_near_duplicates_are_left_out():
    field = make_field(26)
    stars = field["true"][field["true"] >= 0]
    double = stars[: len(stars) // 4]
    for k, offset in (("xr", 0.05), ("yr", 0.0), ("mag", 0.0)):
        field[k] = np.append(field[k], field[k][double] + offset)
    i, j, diagnostics = run(field)
    assert not np.isin(j, double).any()
    assert (field["true"][i] == j).all()
    assert diagnostics.n_ambiguous == pytest.approx(len(double), abs=2)


def test_identical_fluxes_say_nothing():
    field = make_field(27)
    field["flux"] = np.ones_like(field["flux"])
    field["mag"] = np.full_like(field["mag"], np.nan)
    i, j, _ = run(field)
    assert_right(field, i, j)


def test_reference_with_a_hole_over_half_of_the_frame():
    field = make_field(28)
    hole = field["xr"] > 1024
    keep = np.flatnonzero(~hole)
    new = np.full(len(field["xr"]), -1)
    new[keep] = np.arange(len(keep))
    field |= {k: field[k][keep] for k in ("xr", "yr", "mag")}
    field["true"] = np.where(field["true"] >= 0, new[field["true"]], -1)
    i, j, _ = run(field)
    assert_right(field, i, j)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"image_shape": (0, 10)}, "image_shape must be"),
        ({"flux": [1.0]}, "flux must have one value per star"),
        ({"x_err": [1.0]}, "x_err and y_err must have one value per source"),
    ],
)
def test_rejects_bad_options(options, message):
    field = make_field(29)
    with pytest.raises(ValueError, match=message):
        match_planes(
            *(field[k] for k in ("xs", "ys", "xr", "yr")), **({"image_shape": SHAPE} | options)
        )


# Tables and sky positions


def make_tables(seed=5, **kwargs):
    field = make_field(seed, **kwargs)
    wcs = make_wcs()
    ra, dec = wcs.pixel_to_world_values(field["xr"], field["yr"])
    sources = Table({"x": field["xs"], "y": field["ys"], "flux": field["flux"]})
    catalog = QTable({"ra": ra * u.deg, "dec": dec * u.deg, "phot_g_mean_mag": field["mag"]})
    return field, wcs, sources, catalog


def test_sources_returns_table():
    field, wcs, sources, catalog = make_tables()
    matches, diagnostics = match_sources(sources, catalog, wcs, image_shape=SHAPE)
    assert_right(field, matches["source_index"], matches["catalog_index"])
    assert matches["separation"].unit == u.pix
    assert np.median(matches["separation"]) < 0.2 * u.pix
    assert matches.meta["evidence"]["n_pairs"] == len(matches)
    offset = np.hypot(matches["dx"] - 60 * u.pix, matches["dy"] + 40 * u.pix)
    assert np.median(offset) < 20 * u.pix
    np.testing.assert_allclose(
        matches["ra"].value, catalog["ra"][matches["catalog_index"]].value, rtol=0, atol=1e-12
    )
    with pytest.raises(FrozenInstanceError):
        diagnostics.n_pairs = 0


def same_pairs(a, b):
    return len(a) == len(b) and all(
        (a[name] == b[name]).all() for name in ("source_index", "catalog_index")
    )


def test_sources_takes_sky_coordinates():
    _, wcs, sources, catalog = make_tables()
    matches, _ = match_sources(sources, catalog, wcs, image_shape=SHAPE)
    sky = SkyCoord(catalog["ra"], catalog["dec"])
    assert same_pairs(matches, match_sources(sources, sky, wcs, image_shape=SHAPE)[0])
    assert same_pairs(
        matches, match_sources(sources, sky.transform_to("fk5"), wcs, image_shape=SHAPE)[0]
    )
    seen = wcs.pixel_to_world(sources["x"], sources["y"])
    assert same_pairs(matches, match_sources(seen, sky, wcs, image_shape=SHAPE)[0])


def test_sources_takes_low_level_and_generalized_wcs():
    _, wcs, sources, catalog = make_tables()
    matches, _ = match_sources(sources, catalog, wcs, image_shape=SHAPE)
    low = SlicedLowLevelWCS(wcs, (slice(None), slice(None)))
    assert same_pairs(matches, match_sources(sources, catalog, low, image_shape=SHAPE)[0])
    chain = (
        models.Shift(1 - wcs.wcs.crpix[0]) & models.Shift(1 - wcs.wcs.crpix[1])
        | models.AffineTransformation2D(wcs.wcs.cd)
        | models.Pix2Sky_TAN()
        | models.RotateNative2Celestial(*wcs.wcs.crval, 180)
    )
    frames = [
        cf.Frame2D(name="detector", axes_names=("x", "y"), unit=(u.pix, u.pix)),
        cf.CelestialFrame(name="icrs", reference_frame=ICRS(), unit=(u.deg, u.deg)),
    ]
    general = gwcs.WCS([(frames[0], chain), (frames[1], None)])
    general.bounding_box = ((-0.5, 2047.5), (-0.5, 2047.5))
    general.array_shape = SHAPE
    assert same_pairs(matches, match_sources(sources, catalog, general)[0])


def test_sources_moves_the_catalog_to_the_epoch(rng):
    field, wcs, sources, catalog = make_tables()
    n = len(catalog)
    pmra, pmdec = rng.normal(size=(2, n)) * 200
    pmra[::5] = pmdec[::5] = 0.0
    late = SkyCoord(
        catalog["ra"],
        catalog["dec"],
        pm_ra_cosdec=pmra * u.mas / u.yr,
        pm_dec=pmdec * u.mas / u.yr,
        distance=10 * u.pc,
        obstime=Time(2026.0, format="jyear"),
    )
    early = late.apply_space_motion(new_obstime=Time(2016.0, format="jyear"))
    table = Table({"ra": early.ra.deg, "dec": early.dec.deg})
    table["pmra"] = early.pm_ra_cosdec.to_value(u.mas / u.yr)
    table["pmdec"] = early.pm_dec.to_value(u.mas / u.yr)
    table["pmra"][::5] = table["pmdec"][::5] = np.nan
    table["ref_epoch"] = 2016.0
    still, _ = match_sources(sources, catalog, wcs, image_shape=SHAPE)
    moved, _ = match_sources(sources, table, wcs, image_shape=SHAPE, epoch=2026.0)
    assert same_pairs(still, moved)
    np.testing.assert_allclose(still["ra"].value, moved["ra"].value, rtol=0, atol=2e-9)
    np.testing.assert_allclose(still["dec"].value, moved["dec"].value, rtol=0, atol=2e-9)
    sky, _ = match_sources(
        sources, early, wcs, image_shape=SHAPE, epoch=Time(2026.0, format="jyear")
    )
    assert same_pairs(still, sky)


def test_sources_leaves_out_what_is_not_a_clean_star():
    _, wcs, sources, catalog = make_tables()
    n = len(sources)
    sources["roundness"] = np.where(np.arange(n) % 7 == 0, -0.5, 0.1)
    sources["snr"] = np.where(np.arange(n) % 7 == 1, 9.0, 50.0)
    sources["flags"] = np.where(np.arange(n) % 7 == 2, 4, 0)
    matches, _ = match_sources(sources, catalog, wcs, image_shape=SHAPE)
    assert not np.isin(matches["source_index"] % 7, (0, 1, 2)).any()
    assert len(matches) > 0.45 * n
    sources["snr"] = 1.0
    with pytest.raises(MatchError, match=f"{n} of {n} sources left out"):
        match_sources(sources, catalog, wcs, image_shape=SHAPE)


def test_sources_takes_units_and_masks():
    _, wcs, sources, catalog = make_tables()
    matches, _ = match_sources(sources, catalog, wcs, image_shape=SHAPE)
    other = QTable(catalog)
    other["ra"] = catalog["ra"].to(u.hourangle)
    other["phot_g_mean_mag"] = MaskedColumn(
        catalog["phot_g_mean_mag"], mask=np.arange(len(catalog)) % 50 == 0
    )
    assert len(match_sources(sources, other, wcs, image_shape=SHAPE)[0]) == len(matches)


def test_sources_without_a_shape_uses_what_the_sources_span():
    field, wcs, sources, catalog = make_tables()
    matches, _ = match_sources(sources, catalog, wcs)
    assert_right(field, matches["source_index"], matches["catalog_index"])


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        (lambda s, c: (s["x",], c), ValueError, "sources must have a column 'y'"),
        (lambda s, c: (s, c["ra",]), ValueError, "catalog must have a column 'dec'"),
        (lambda s, c: (s, QTable(c) | {"ra": 1}), TypeError, None),
        (lambda s, c: (np.zeros(3), c), TypeError, "sources must be a Table or a SkyCoord"),
        (lambda s, c: (s, "gaia.fits"), TypeError, "catalog must be a Table or a SkyCoord"),
    ],
    ids=["no y", "no dec", "dict", "array", "path"],
)
def test_sources_rejects_bad_input(change, error, message):
    _, wcs, sources, catalog = make_tables()
    with pytest.raises(error, match=message):
        match_sources(*change(sources, catalog), wcs, image_shape=SHAPE)


def test_sources_rejects_units_that_are_not_angles():
    _, wcs, sources, catalog = make_tables()
    catalog["ra"] = catalog["ra"].value * u.m
    with pytest.raises(ValueError, match="column 'ra' must have a unit like deg; got m"):
        match_sources(sources, catalog, wcs, image_shape=SHAPE)


def test_sources_of_an_empty_table():
    _, wcs, sources, catalog = make_tables()
    with pytest.raises(MatchError, match="none of 0 sources"):
        match_sources(sources[:0], catalog, wcs, image_shape=SHAPE)
    with pytest.raises(MatchError, match="too few reference stars"):
        match_sources(sources, catalog[:0], wcs, image_shape=SHAPE)


@pytest.mark.parametrize("name", ["wircam_J_1325839p", "wircam_H2_2108902p"])
def test_real_frame_with_a_wrong_header(shared_data, name):
    sep = pytest.importorskip("sep")
    with fits.open(shared_data / "wircam" / f"{name}.fits.fz") as hdus:
        data = np.ascontiguousarray(hdus[1].data, dtype=np.float32)
        header = hdus[1].header
    background = sep.Background(data)
    found = sep.extract(data - background, 6.0, err=background.globalrms)
    sources = Table({"x": found["x"], "y": found["y"], "flags": found["flag"]})
    catalog = Table.read(shared_data / "wircam" / "gaia_dr2.fits")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FITSFixedWarning)
        wcs = WCS(header)
    epoch = Time(header["MJD-OBS"], format="mjd")
    straight, _ = match_sources(sources, catalog, wcs, image_shape=data.shape, epoch=epoch)
    angle = np.deg2rad(1.0)
    wcs.wcs.cd = wcs.wcs.cd @ [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    wcs.wcs.crval = wcs.wcs.crval + np.array([12 / np.cos(np.deg2rad(wcs.wcs.crval[1])), 9]) / 3600
    wrong, diagnostics = match_sources(sources, catalog, wcs, image_shape=data.shape, epoch=epoch)
    assert same_pairs(straight, wrong)
    assert len(straight) > 0.85 * diagnostics.n_sources
    assert abs(diagnostics.rotation) == pytest.approx(1.0, abs=0.25)


def make_wcs(shape=SHAPE):
    wcs = WCS(naxis=2)
    wcs.wcs.ctype = ["RA---TAN", "DEC--TAN"]
    wcs.wcs.crval = [150.0, -40.0]
    wcs.wcs.crpix = [0.5 * (shape[1] + 1), 0.5 * (shape[0] + 1)]
    wcs.wcs.cd = np.array([[-1.0, 0.02], [0.02, 1.0]]) * 0.2 / 3600
    wcs.wcs.radesys = "ICRS"
    return wcs


# --- nearby: a prediction and few stars ---------------------------------------------------------


def nearby_field(rng, n_sources, *, density=3e-4, shape=(1000, 1000), false=0):
    """Few of the stars of a field, displaced a little, and sources that are none."""
    reference = rng.uniform(-400, 1400, (rng.poisson(density * 1800**2), 2))
    on = np.flatnonzero(((reference > 0) & (reference < 1000)).all(axis=1))
    rows = rng.permutation(on)[:n_sources]
    step = reference[rows] - 500
    moved = reference[rows] + [31, -17] + step @ [[2e-3, 4e-3], [-4e-3, 2e-3]]
    moved = moved + rng.normal(scale=0.05, size=moved.shape)
    return np.vstack([moved, rng.uniform(0, 1000, (false, 2))]), reference, rows, shape


@pytest.mark.parametrize(("n", "false"), [(6, 0), (8, 4), (60, 30), (250, 300)])
def test_nearby_finds_few_stars(rng, n, false):
    for _ in range(5):
        sources, reference, rows, shape = nearby_field(rng, n, false=false)
        i, j, linear, diagnostics = match_nearby(
            *sources.T, *reference.T, image_shape=shape, max_shift=60, max_bend=6
        )
        right = (i < n) & (rows[np.minimum(i, n - 1)] == j)
        assert right.sum() >= 0.9 * n
        assert (~right).sum() <= 1 + 0.02 * false
        np.testing.assert_allclose(linear[0], [-31, 17], atol=1.0)
        assert diagnostics.n_pairs == len(i)
        assert diagnostics.significance > 4.7  # P < 1e-5
        x, y = diagnostics.mapping(*sources[i].T)
        assert np.hypot(*(np.column_stack([x, y]) - reference[j]).T).max() < 1.0


def test_nearby_is_not_deceived_by_chance(rng):
    accepted = 0
    for n in [4, 5, 6, 8, 12, 20, 50, 200] * 25:
        _, reference, _, shape = nearby_field(rng, 1)
        sources = rng.uniform(0, 1000, (n, 2))
        try:
            match_nearby(*sources.T, *reference.T, image_shape=shape, max_shift=80, max_bend=8)
        except MatchError:
            continue
        accepted += 1
    assert accepted == 0


def test_nearby_needs_four_pairs_and_one_answer(rng):
    sources, reference, _, shape = nearby_field(rng, 6)
    options = {"image_shape": shape, "max_shift": 60, "max_bend": 6}
    with pytest.raises(MatchError, match="too few stars to match: 3 sources"):
        match_nearby(*sources[:3].T, *reference.T, **options)
    twice = np.vstack([reference, reference + [9.0, 5.0]])
    with pytest.raises(MatchError, match="ambiguous|not enough to be sure"):
        match_nearby(*sources.T, *twice.T, **options)
    with pytest.raises(MatchError, match="predict"):
        match_nearby(*sources.T, *(reference + 5000).T, **options)


def test_nearby_joins_exposures(rng):
    fields = [nearby_field(rng, 4) for _ in range(4)]
    sources, reference = (np.vstack([f[k] for f in fields]) for k in (0, 1))
    tiles = [np.repeat(np.arange(4), [len(f[k]) for f in fields]) for k in (0, 1)]
    _, _, linear, diagnostics = match_nearby(
        *sources.T, *reference.T, image_shape=(1000, 1000), max_shift=60, max_bend=6, tiles=tiles
    )
    assert diagnostics.n_pairs >= 15
    np.testing.assert_allclose(linear[0], [-31, 17], atol=0.3)
