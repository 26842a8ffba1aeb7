"""The one definition of a usable star."""

import numpy as np
import pytest
from astropy.table import Table

from wpdc_gwcs.flags import FLAG_NAMES, FLAG_SATURATED
from wpdc_gwcs.selection import judge_sources, left_out, select_sources


@pytest.fixture
def sources(rng):
    n = 400
    return Table(
        {
            "x": rng.uniform(0, 1000, n),
            "y": rng.uniform(0, 800, n),
            "snr": rng.uniform(40, 400, n),
            "roundness": rng.normal(0, 0.03, n),
            "flags": np.zeros(n, int),
        }
    )


@pytest.mark.parametrize("common", [0.0, 0.9, -1.6])
def test_round_is_what_the_stars_are(sources, common):
    sources["roundness"] += common
    sources["roundness"][:20] += 0.6
    assert select_sources(sources).tolist() == [False] * 20 + [True] * 380


def test_round_varies_over_the_detector(sources):
    # From -0.5 to 0.5 along x: more than the limit away from what is typical of all.
    sources["roundness"] += sources["x"] / 1000 - 0.5
    assert select_sources(sources).mean() > 0.99
    sources["roundness"][0] = 0.6 - (sources["x"][0] / 1000 - 0.5)
    sources["roundness"][0] += 0.5 if sources["x"][0] < 500 else -1.6
    assert not select_sources(sources)[0]


def test_limit_of_the_roundness(sources):
    sources["roundness"][0] += 0.45
    assert not select_sources(sources)[0]
    assert select_sources(sources, max_roundness=0.6)[0]


def test_what_is_not_known_leaves_nothing_out(sources):
    for name in ("roundness", "snr"):
        sources[name][:5] = np.nan
    assert select_sources(sources).all()
    assert select_sources(sources["x", "y"]).all()


def test_noise_is_no_shape(sources, rng):
    faint = np.arange(0, 400, 2)
    sources["snr"][faint] = 12
    sources["roundness"][faint] += rng.normal(0, 0.08, 200)
    assert select_sources(sources)[faint].mean() > 0.98


def test_every_rule_counts(sources):
    sources["flags"][:3] = FLAG_SATURATED
    sources["roundness"][2:10] = 1.0
    sources["snr"][10:12] = 5
    sources["x"][12] = np.nan
    sources["x"][13] = 2000
    sources["flags"][14] = 1 << 20
    rules = judge_sources(sources, image_shape=(800, 1000))
    counts = {name: int(out.sum()) for name, out in rules.items() if out.any()}
    assert counts == {
        "without a position": 1,
        "beside the detector": 1,
        "saturated": 3,
        "with other flags": 1,
        "below S/N 10": 2,
        "not round": 7,
    }
    assert left_out(rules).startswith(
        "15 of 400 sources left out: 7 not round, 3 saturated, 2 below"
    )
    good = judge_sources(sources[20:])
    assert left_out(good) == "none of 380 sources left out"


def test_every_flag_has_a_name():
    from wpdc_gwcs import flags

    bits = {getattr(flags, name) for name in flags.__all__ if name != "FLAG_NAMES"}
    assert bits == set(FLAG_NAMES)
