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
