"""`wpdc catalog`: what is written is what the rules leave, and what is told is so."""

import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.table import Table

from wpdc_gwcs.catalogs import read_catalog
from wpdc_gwcs.catalogs.overview import count_by_magnitude, sky_area
from wpdc_gwcs.cli.app import run


def stars(n=2000, seed=0):
    rng = np.random.default_rng(seed)
    table = Table({"source_id": np.arange(n) + 10**17})
    table["ra"], table["dec"] = (rng.uniform(-1, 1, n)) % 360, rng.uniform(-31, -29, n)
    table["pmra"], table["pmdec"] = rng.normal(0, 5, (2, n))
    table["ra_error"] = table["dec_error"] = rng.uniform(0.1, 1, n)
    table["ruwe"] = rng.uniform(0.8, 2, n)
    table["ruwe"][:50] = np.nan
    table["ref_epoch"] = 2016.0
    table["phot_g_mean_mag"] = rng.uniform(12, 21, n)
    return table


@pytest.fixture
def two(tmp_path):
    """Two files that overlap, with other names of columns."""
    table = stars()
    table[:1200].write(tmp_path / "a.fits")
    other = table[1000:]
    other.rename_columns(["ra", "dec", "phot_g_mean_mag"], ["RA_ICRS", "DE_ICRS", "Gmag"])
    other.write(tmp_path / "b.csv")
    return table, [str(tmp_path / "a.fits"), str(tmp_path / "b.csv")]


@pytest.mark.parametrize("ending", ["fits", "ecsv", "csv", "vot", "parquet"])
def test_prepare_keeps_what_the_rules_leave(tmp_path, two, capsys, ending):
    if ending == "parquet":
        pytest.importorskip("pyarrow")
    table, paths = two
    output = tmp_path / f"out.{ending}"
    rules = ["--cone", "0,-30,0.8", "--max-mag", "20", "--max-ruwe", "1.4", "--max-error", "0.9"]
    assert run(["catalog", "prepare", *paths, "--output", str(output), *rules]) == 0
    near = SkyCoord(table["ra"], table["dec"], unit="deg").separation(SkyCoord(0, -30, unit="deg"))
    good = (near.deg <= 0.8) & (table["phot_g_mean_mag"] <= 20) & (table["ra_error"] <= 0.9)
    good &= ~(table["ruwe"] > 1.4)
    written = read_catalog(output)
    assert set(written["source_id"]) == set(table["source_id"][good])
    expected = table[good]
    order = np.argsort(written["source_id"])
    for name in ("ra", "pmra", "ruwe", "ref_epoch"):
        np.testing.assert_allclose(written[name][order], expected[name], rtol=1e-15)
    text = capsys.readouterr().out
    assert "2200  read" in text
    assert "200  repeated rows of a star" in text
    assert f"{good.sum()}  written to" in text
    assert run(["catalog", "prepare", paths[0], "--output", str(output)]) == 2


def test_a_box_across_right_ascension_zero(tmp_path, two):
    table, paths = two
    output = tmp_path / "box.fits"
    box = ["--box", "359.5,0.25,-30.5,-29.5"]
    assert run(["catalog", "prepare", *paths, "--output", str(output), *box, "-q"]) == 0
    ra = (table["ra"] + 180) % 360 - 180
    good = (ra >= -0.5) & (ra <= 0.25) & (np.abs(table["dec"] + 30) <= 0.5)
    assert set(Table.read(output)["source_id"]) == set(table["source_id"][good])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--cone", "1,2"], "--cone must be RA,DEC,RADIUS, got '1,2'"),
        (["--cone", "1,2,x"], "the radius of --cone must be a number, got 'x'"),
        (["--cone", "1,2,-1"], "--cone: a cone needs"),
        (["--cone", "1,99,1"], "--cone: dec must lie in [-90, 90] deg, got 99"),
        (["--cone", "east,1,1"], "--cone: ra must be a number of deg, or an angle such as 12:3"),
        (["--box", "1,2,5,4"], "--box: a box needs"),
        (["--box", "1,2,3,4", "--cone", "1,2,3"], "only one of"),
        (["--cone", "100,50,0.1"], "no stars are left"),
        (["--max-mag", "-5"], "no stars are left"),
        (["--around", "nowhere.fits"], "nowhere.fits"),
    ],
)
def test_what_cannot_be_prepared(tmp_path, two, capsys, options, message):
    output = tmp_path / "out.fits"
    assert run(["catalog", "prepare", two[1][0], "--output", str(output), *options]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert not output.exists()


def test_formats_and_places_that_are_needed(tmp_path, two, capsys):
    assert run(["catalog", "prepare", two[1][0], "--output", str(tmp_path / "a.png")]) == 2
    assert "must end with one of .fits" in capsys.readouterr().err
    assert run(["catalog", "info", "gaia"]) == 2
    assert "name the part of the sky: --cone" in capsys.readouterr().err
    assert run(["catalog", "info", two[1][0], "--cone", "100,50,0.1"]) == 2
    assert "no stars in this part" in capsys.readouterr().err


def test_info_tells_what_is_there(two, capsys):
    table, paths = two
    assert run(["catalog", "info", paths[0]]) == 0
    text = capsys.readouterr().out
    assert "stars       1200" in text
    ra = (table["ra"][:1200] + 180) % 360 - 180
    assert f"RA {ra.min() % 360:.4f} to {ra.max():.4f}" in text
    assert "epoch       2016\n" in text
    assert "lacks       parallax: no annual parallax" in text
    assert "ruwe for 95.8 % of the stars" in text
    first = np.sum(np.floor(table["phot_g_mean_mag"][:1200]) == 12)
    assert f" 12-13  {first:9d}" in text


@pytest.mark.parametrize("dec", [0.0, 60.0, 89.0])
@pytest.mark.parametrize("n", [300, 20_000])
def test_area_of_a_cone(dec, n):
    rng = np.random.default_rng(1)
    unit = SkyCoord(0, 0, unit="deg").ra.unit
    sky = SkyCoord(10, dec, unit="deg").directional_offset_by(
        rng.uniform(0, 360, n) * unit, 1.5 * np.sqrt(rng.uniform(0, 1, n)) * unit
    )
    catalog = read_catalog(Table({"ra": sky.ra.deg, "dec": sky.dec.deg}))
    assert sky_area(catalog) == pytest.approx(np.pi * 1.5**2, rel=0.25 if n < 1000 else 0.1)


def test_counts_are_those_of_the_stars():
    table = stars()
    counts = count_by_magnitude(read_catalog(table))
    expected = np.bincount(np.floor(table["phot_g_mean_mag"]).astype(int))[12:]
    np.testing.assert_array_equal(counts["n"], expected)
    area = 2 * np.cos(np.radians(30)) * 2
    assert np.sum(counts["density"].value) == pytest.approx(2000 / area, rel=0.12)
    here = np.floor(table["phot_g_mean_mag"]) == 12
    assert counts["position_error"][0].value == pytest.approx(np.median(table["ra_error"][here]))
