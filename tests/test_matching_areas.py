"""Parts of a frame: right ones pass whatever the scatter of counts, wrong ones are found."""

import numpy as np
import pytest

from wpdc_gwcs.matching import MatchOptions, match_planes
from wpdc_gwcs.matching._evidence import _judge_areas

SIDE = 4096


def judge(seed, *, n, share, by_chance, hole=0.0):
    """Parts of a frame with a cluster; pairs at random, and none but chance ones in a corner."""
    rng = np.random.default_rng(seed)
    sources = rng.uniform(0, SIDE, (n, 2))
    clump = rng.random(n) < 0.5
    sources[clump] = np.clip(rng.normal([2000, 2200], 500, (clump.sum(), 2)), 0, SIDE - 1)
    is_star = rng.random(n) < share
    others = rng.uniform(0, SIDE, (round(n * share), 2))
    in_hole = (sources < hole).all(axis=1)
    paired = np.where(in_hole, rng.random(n) < by_chance, is_star)
    # ten shifts of the sources, each with its pairs by chance
    hits = np.concatenate([sources[rng.random(n) < by_chance] for _ in range(10)])
    reference = np.vstack([sources[is_star], others])
    return _judge_areas(sources, reference, sources[paired], hits, 0.1, (SIDE, SIDE))


@pytest.mark.parametrize("n", [400, 2500, 5000])
def test_right_matches_pass_whatever_the_number_of_parts(n):
    frames = [judge(seed, n=n, share=0.5, by_chance=0.03) for seed in range(60)]
    assert sum(area.judged for area in frames[0]) > {400: 5, 2500: 50, 5000: 100}[n]
    refused = [not all(area.accepted for area in areas) for areas in frames]
    # One in a hundred at most, by the rule; the rule leaves room for losses besides.
    assert sum(refused) <= 1


@pytest.mark.parametrize("n", [2500, 5000])
def test_wrong_corner_is_found(n):
    for seed in range(20):
        areas = judge(seed, n=n, share=0.7, by_chance=0.03, hole=1000.0)
        bad = [area for area in areas if not area.accepted]
        assert bad
        assert all(area.x < 1500 and area.y < 1500 for area in bad)


def test_options_are_checked():
    points = np.random.default_rng(1).uniform(0, 1000, (2, 50))
    for option, value in (("max_order", 9), ("min_purity", 1.5), ("max_rotation", -1.0)):
        with pytest.raises(ValueError, match=f"{option} must be"):
            match_planes(*points, *points, image_shape=(1000, 1000), **{option: value})
    with pytest.raises(TypeError, match="unexpected keyword argument 'max_orders'"):
        match_planes(*points, *points, image_shape=(1000, 1000), max_orders=3)
    assert MatchOptions() == MatchOptions(blind=False, min_significance=9.0)


def king_cluster(rng, n, core=300.0, rim=3000.0):
    """Places of a King (1962) profile about the middle of the frame."""
    radius = np.linspace(0, rim, 4001)
    floor = 1 / np.sqrt(1 + (rim / core) ** 2)
    density = (1 / np.sqrt(1 + (radius / core) ** 2) - floor) ** 2
    share = np.concatenate([[0], np.cumsum((density * radius)[1:])])
    r = np.interp(rng.uniform(0, share[-1], n), share, radius)
    angle = rng.uniform(0, 2 * np.pi, n)
    return SIDE / 2 + np.column_stack([r * np.cos(angle), r * np.sin(angle)])


@pytest.mark.parametrize("seed", range(4))
def test_cluster_is_matched_whatever_the_faintest_source(seed):
    """Cuts in brightness change the counts in every part; none of them may refuse the frame."""
    rng = np.random.default_rng(seed)
    stars = np.vstack([king_cluster(rng, 6000), rng.uniform(0, SIDE, (1200, 2))])
    stars = stars[((stars > 0) & (stars < SIDE - 1)).all(axis=1)]
    magnitude = 15 + 10 * rng.power(2.5, len(stars))
    snr = 10 ** (0.4 * (24.0 - magnitude))
    # Crowding loses stars in the core, most of them faint ones.
    lost = 0.6 * np.exp(-((np.hypot(*(stars - SIDE / 2).T) / 400) ** 2)) + 0.03
    seen = (rng.random(len(stars)) > lost) & (snr > 3)
    u = (stars - SIDE / 2) / SIDE
    bent = stars + 60 * u * (u**2).sum(axis=1, keepdims=True) + [9.0, -5.0]
    bent += rng.normal(0, 0.5, bent.shape) / np.maximum(snr, 3)[:, None]
    rows = np.flatnonzero(seen)
    places = np.vstack([bent[rows], rng.uniform(0, SIDE, (60, 2))])
    strength = np.concatenate([snr[rows], 10 ** rng.uniform(0.5, 1.5, 60)])
    for least in (3, 5, 8, 10, 15, 20, 25, 30, 40, 50, 70, 100):
        bright = strength >= least
        i, j, _ = match_planes(
            *places[bright].T,
            *stars.T,
            image_shape=(SIDE, SIDE),
            flux=strength[bright],
            mag=magnitude,
        )
        kept = np.flatnonzero(bright)[i]
        real = kept < len(rows)
        right = np.zeros(len(i), bool)
        right[real] = rows[kept[real]] == j[real]
        assert right.mean() > 0.995
        # In the core two stars are often within the reach of one.
        assert right.sum() > 0.8 * np.count_nonzero(bright[: len(rows)])
