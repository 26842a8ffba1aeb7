"""`wpdc match`: the pairs and their evidence, or one line and the right exit status."""

import re

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table
from astropy.wcs import WCS

from wpdc_gwcs.cli.app import run

SIDE = 1024


@pytest.fixture(scope="module")
def sky():
    """Catalog and sources of one frame; source i is star i."""
    rng = np.random.default_rng(7)
    wcs = WCS(naxis=2)
    wcs.wcs.ctype = ["RA---TAN", "DEC--TAN"]
    wcs.wcs.crval, wcs.wcs.crpix = [210.0, 12.0], [SIDE / 2, SIDE / 2]
    wcs.wcs.cd = np.array([[-1, 0.01], [0.01, 1]]) * 0.3 / 3600
    x, y = rng.uniform(0, SIDE - 1, (2, 300))
    ra, dec = wcs.pixel_to_world_values(x + 12 + 3 * (x / SIDE) ** 3, y - 7)
    noise = rng.normal(size=(2, 300)) * 0.03
    sources = Table({"x": x + noise[0], "y": y + noise[1], "flux": rng.uniform(1, 100, 300)})
    catalog = Table({"ra": ra, "dec": dec})
    return wcs, sources, catalog


@pytest.fixture
def match(sky, tmp_path):
    """Run the command on tables; what was changed is given."""

    def call(*options, sources=None, catalog=None, cd=None):
        wcs = sky[0].deepcopy()
        if cd is not None:
            wcs.wcs.cd = wcs.wcs.cd @ cd
        header = wcs.to_header()
        header.update(NAXIS=2, NAXIS1=SIDE, NAXIS2=SIDE)
        fits.PrimaryHDU(np.zeros((SIDE, SIDE), np.uint8), header).writeto(
            tmp_path / "h.fits", overwrite=True
        )
        (sky[1] if sources is None else sources).write(tmp_path / "sources.ecsv", overwrite=True)
        (sky[2] if catalog is None else catalog).write(tmp_path / "catalog.ecsv", overwrite=True)
        files = {"--wcs": "h.fits", "--catalog": "catalog.ecsv", "--output": "pairs.ecsv"}
        named = [str(v) for name, file in files.items() for v in (name, tmp_path / file)]
        return run(["match", str(tmp_path / "sources.ecsv"), *named, *options])

    return call


def failure(capsys, tmp_path):
    """The one line of a failure, which leaves no table."""
    captured = capsys.readouterr()
    assert captured.out == ""
    (line,) = captured.err.strip().splitlines()
    assert not (tmp_path / "pairs.ecsv").exists()
    return line


def test_writes_pairs_and_evidence(match, sky, tmp_path, capsys):
    assert match() == 0
    pairs = Table.read(tmp_path / "pairs.ecsv")
    assert pairs.colnames == [
        "source_index", "catalog_index", "x", "y", "ra", "dec", "dx", "dy", "separation",
    ]  # fmt: skip
    assert len(pairs) > 290
    np.testing.assert_array_equal(pairs["source_index"], pairs["catalog_index"])
    np.testing.assert_allclose(pairs["ra"], sky[2]["ra"][pairs["catalog_index"]], atol=1e-12)
    assert np.median(pairs["separation"]) < 0.1
    assert np.median(pairs["dy"]) == pytest.approx(7, abs=0.5)
    evidence = pairs.meta["evidence"]
    assert evidence["n_pairs"] == len(pairs)
    assert evidence["expected_by_chance"] < 1
    assert evidence["purity"] > 0.99
    assert evidence["completeness"] > 0.95
    assert evidence["n_ambiguous"] < 5
    said = capsys.readouterr()
    assert f"{len(pairs)} pairs" in said.out
    assert "expected by chance" in said.out
    assert "the first pixel was taken to be 0 (--origin 1 if it is 1)" in said.err


def test_what_is_given_by_hand(match, tmp_path, capsys):
    assert match("--origin", "1", "--epoch", "2016-07-02", "--overwrite") == 0
    assert "--origin" not in capsys.readouterr().err
    assert match("--origin", "0", "--overwrite") == 0
    for option, value in (("--origin", "2"), ("--epoch", "soon"), ("--pixel-scale", "-1")):
        assert match(option, value, "--overwrite") == 2
        assert f"{option} must be" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("change", "status", "message"),
    [
        (lambda s, c: (s[:1], c), 1, "too few sources to match: 1 "),
        (lambda s, c: (s[:0], c), 1, "has no rows"),
        (lambda s, c: (s, c[:1]), 1, "too few reference stars .* 1 "),
        (lambda s, c: (s, c[:0]), 2, "catalog must have at least one row"),
        (lambda s, c: (Table({"x": s["x"], "y": s["x"]}), c), 1, "no match with sufficient"),
        (lambda s, c: (Table({"x": s["x"], "y": s["y"] * np.nan}), c), 1, "too few sources"),
        (lambda s, c: (s, Table({"ra": c["ra"], "dec": c["dec"] + 20})), 1, "no star within"),
        (lambda s, c: (s, Table({"ra": c["ra"]})), 2, "dec"),
    ],
    ids=["1", "0", "1 ref", "0 ref", "line", "nan", "elsewhere", "no dec"],
)
def test_bad_input_is_one_line(match, sky, tmp_path, capsys, change, status, message):
    sources, catalog = change(*sky[1:])
    assert match(sources=sources, catalog=catalog) == status
    line = failure(capsys, tmp_path)
    assert line.startswith("wpdc: error: ")
    assert re.search(message, line)


@pytest.mark.parametrize("how", ["duplicates", "nan", "identical fluxes", "hole"])
def test_odd_input_has_the_right_answer(match, sky, tmp_path, how):
    _, sources, catalog = (s.copy() if isinstance(s, Table) else s for s in sky)
    if how == "duplicates":
        rows = np.tile(np.arange(300), 2)
        sources, catalog = sources[rows], catalog[rows]
    elif how == "nan":
        sources["x"][::7] = np.nan
        catalog["dec"][3::7] = np.nan
    elif how == "identical fluxes":
        sources["flux"] = 1.0
        catalog["phot_g_mean_mag"] = 20.0
    else:
        catalog["ra"][sources["x"] > SIDE / 2] = np.nan
    assert match("-q", sources=sources, catalog=catalog) == 0
    pairs = Table.read(tmp_path / "pairs.ecsv")
    assert len(pairs) > {"nan": 200, "hole": 130}.get(how, 290)
    np.testing.assert_array_equal(pairs["source_index"], pairs["catalog_index"])


WRONG = {
    "mirrored": np.diag([-1, 1]),
    "quarter turn": [[0, -1], [1, 0]],
    "scale": np.eye(2) * 1.05,
}


@pytest.mark.parametrize("name", WRONG)
def test_wrong_header_needs_blind(match, tmp_path, capsys, name):
    assert match(cd=WRONG[name]) == 1
    assert "--blind" in failure(capsys, tmp_path)


@pytest.mark.parametrize("name", WRONG)
def test_blind_finds_what_the_header_has_wrong(match, tmp_path, name):
    assert match("--blind", "-q", cd=WRONG[name]) == 0
    pairs = Table.read(tmp_path / "pairs.ecsv")
    assert len(pairs) > 280
    np.testing.assert_array_equal(pairs["source_index"], pairs["catalog_index"])
