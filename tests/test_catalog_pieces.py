"""Large catalogs: parts of files, of partitioned catalogs and of regions are what the whole has."""

import json
import tracemalloc
import warnings

import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.table import Table
from hypothesis import given, settings
from hypothesis import strategies as st

from wpdc_gwcs import calibrate, simulate
from wpdc_gwcs.catalogs import HatsCatalog, Region, identity_of, pieces, read_catalog
from wpdc_gwcs.exceptions import CatalogError, WPDCWarning

REGION = Region(ra=[0.2, 359.0], dec=[10.0, 11.0], radius=[0.5, 0.3])


def stars(n=3000, seed=0):
    rng = np.random.default_rng(seed)
    table = Table({"source_id": np.arange(n) + 2**60 + 1})
    table["ra"] = rng.uniform(-2, 2, n) % 360
    table["dec"] = rng.uniform(9, 12, n)
    table["pmra"], table["pmdec"] = rng.normal(0, 5, (2, n))
    table["pmra"][::7] = np.nan
    table["ref_epoch"] = 2016.0
    table["phot_g_mean_mag"] = rng.uniform(12, 20, n).astype("f4")
    table["name"] = [f"star, {k}" for k in range(n)]
    return table


def inside(catalog, region):
    """Independent truth: separations by astropy."""
    here = SkyCoord(catalog["ra"], catalog["dec"], unit="deg")
    return np.any(
        [
            here.separation(SkyCoord(*center, unit="deg")).deg <= r
            for *center, r in zip(region.ra, region.dec, region.radius, strict=True)
        ],
        axis=0,
    )


@pytest.fixture
def small_pieces(monkeypatch):
    """Files of a few kilobytes are large, and pieces have a few rows."""
    monkeypatch.setattr(pieces, "_LARGE", 1000)
    monkeypatch.setattr(pieces, "_PIECE", 700)


@given(
    st.lists(
        st.tuples(st.floats(0, 360), st.floats(-90, 90), st.floats(0, 180)), min_size=1, max_size=6
    )
)
@settings(max_examples=30, deadline=None)
def test_region_has_what_its_cones_have(cones):
    region = Region(*np.array(cones).T)
    rng = np.random.default_rng(4)
    ra, dec = rng.uniform(0, 360, 400), np.degrees(np.arcsin(rng.uniform(-1, 1, 400)))
    table = {"ra": ra, "dec": dec}
    found = region.contains(ra, dec)
    assert not np.any(inside(table, region) & ~found)
    assert not np.any(found & ~inside(table, region.widened(1.11, 1e-9)))


@pytest.mark.parametrize("values", [([], [], []), (1, 91, 1), (np.nan, 0, 1), (0, 0, -1)])
def test_what_is_no_region(values):
    with pytest.raises(ValueError, match="cone|region"):
        Region(*values)


@pytest.mark.parametrize("box", [(350, 10, -5, 5), (0, 360, 60, 90), (10, 11, -90, -89.5)])
def test_a_box_is_in_its_cone(box):
    west, east, south, north = box
    rng = np.random.default_rng(1)
    ra = west + rng.uniform(0, (east - west) % 360 or 360, 3000)
    assert Region.box(*box).contains(ra, rng.uniform(south, north, 3000)).all()
    with pytest.raises(ValueError, match="from south to north"):
        Region.box(1, 2, 3, 3)


@pytest.mark.parametrize("kind", ["fits", "csv", "csv.gz", "ecsv", "parquet", "tsv"])
def test_part_of_a_file_is_what_the_whole_has(tmp_path, small_pieces, kind):
    table = stars()
    path = tmp_path / f"ref.{kind}"
    if kind == "parquet":
        parquet = pytest.importorskip("pyarrow.parquet")
        import pyarrow

        columns = {name: np.asarray(table[name]) for name in table.colnames}
        parquet.write_table(pyarrow.table(columns), path, row_group_size=900)
    elif kind == "tsv":
        table.write(path, format="ascii.tab")
    else:
        table.write(path, format={"fits": "fits", "ecsv": "ascii.ecsv"}.get(kind, "ascii.csv"))
    whole, part = read_catalog(path), read_catalog(path, region=REGION)
    truth = whole[inside(whole, REGION)]
    assert set(truth["catalog_index"]) <= set(part["catalog_index"])
    assert len(truth) <= len(part) < 1.3 * len(truth)
    # Row for row, column for column.
    same = whole[np.isin(whole["catalog_index"], part["catalog_index"])]
    assert part.colnames == whole.colnames
    for name in whole.colnames:
        np.testing.assert_array_equal(part[name], same[name])
        assert part[name].dtype.kind == whole[name].dtype.kind
    assert identity_of(whole) is None
    assert identity_of(part) == identity_of(read_catalog(path, region=Region(0, 10, 1)))


def test_parquet_has_units_masks_and_metadata(tmp_path):
    pyarrow = pytest.importorskip("pyarrow")
    from astropy.table.meta import get_yaml_from_table
    from pyarrow import parquet

    table = Table({"ra": [1.0, 1.1] * u.rad, "dec": [0.1, 0.2] * u.rad}, meta={"REFEPOCH": 2015.5})
    table["pmra"], table["pmdec"] = [0.001, 0.002] * u.arcsec / u.yr, [1.0, 2.0] * u.mas / u.yr
    arrow = pyarrow.table({name: table[name].tolist() for name in table.colnames})
    arrow = arrow.append_column("source_id", pyarrow.array([2**60 + 1, None]))
    arrow = arrow.append_column("parallax", pyarrow.array([None, 3.0]))
    arrow = arrow.append_column("name", pyarrow.array(["a", None]))
    text = "\n".join(get_yaml_from_table(table)).encode()
    parquet.write_table(arrow.replace_schema_metadata({"table_meta_yaml": text}), tmp_path / "r.pq")
    catalog = read_catalog(tmp_path / "r.pq")
    np.testing.assert_allclose(catalog["ra"], np.degrees([1.0, 1.1]))
    np.testing.assert_allclose(catalog["pmra"], [1.0, 2.0])
    np.testing.assert_array_equal(catalog["parallax"], [np.nan, 3.0])
    assert catalog["source_id"].tolist() == [2**60 + 1, 0]
    assert catalog["ref_epoch"].tolist() == [2015.5] * 2


def test_parquet_without_its_reader(tmp_path, monkeypatch):
    from wpdc_gwcs import extras

    (tmp_path / "r.parquet").write_bytes(b"PAR1")
    monkeypatch.setattr(extras, "find_spec", lambda name: None)
    with pytest.raises(CatalogError, match=r"needs pyarrow.*pip install 'wpdc_gwcs\[hats\]'"):
        read_catalog(tmp_path / "r.parquet")


@pytest.mark.parametrize("rows", [700, 699, 701, 1400])
def test_pieces_that_end_with_the_file(tmp_path, small_pieces, rows):
    table = stars(rows)
    for kind in ("fits", "csv"):
        path = tmp_path / f"ref.{kind}"
        table.write(path)
        part = read_catalog(path, region=Region(0, 10, 30))
        assert list(part["catalog_index"]) == list(range(rows))


def test_small_files_are_read_whole(tmp_path):
    stars().write(tmp_path / "ref.fits")
    assert len(read_catalog(tmp_path / "ref.fits", region=REGION)) == 3000


def radians(table):
    table["ra"], table["dec"] = np.radians(table["ra"]), np.radians(table["dec"])
    table["ra"].unit = table["dec"].unit = "rad"


def text(table):
    sky = SkyCoord(table["ra"], table["dec"], unit="deg")
    table["ra"] = sky.ra.to_string("hour", sep=":", precision=6, pad=True)
    table["dec"] = sky.dec.to_string("deg", sep=":", precision=6, pad=True)


def dense(table):
    """Radians without a unit, which the density of all stars betrays."""
    table["ra"] = np.radians(table["ra"] % 5e-3)
    table["dec"] = np.radians(table["dec"] % 5e-3)


def other_names(table):
    table.rename_columns(["ra", "dec"], ["ALPHA_J2000", "DELTA_J2000"])


def nested(table):
    table["sky"] = SkyCoord(table["ra"], table["dec"], unit="deg")
    table.remove_columns(["ra", "dec"])


@pytest.mark.parametrize("change", [radians, text, dense, other_names, nested])
@pytest.mark.parametrize("kind", ["fits", "ecsv"])
def test_what_positions_mean_does_not_depend_on_pieces(tmp_path, small_pieces, change, kind):
    table = stars()
    change(table)
    path = tmp_path / f"ref.{kind}"
    table.write(path)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", WPDCWarning)
        whole, part = read_catalog(path), read_catalog(path, region=REGION)
    same = whole[np.isin(whole["catalog_index"], part["catalog_index"])]
    assert len(part) > 0
    np.testing.assert_array_equal(part["ra"], same["ra"])
    assert np.isin(whole["catalog_index"][inside(whole, REGION)], part["catalog_index"]).all()


def test_rows_off_the_sky_are_counted(tmp_path, small_pieces):
    table = stars()
    table["dec"][5:9], table["ra"][20] = 95.0, np.nan
    table.write(tmp_path / "ref.fits")
    with pytest.warns(WPDCWarning, match="4 of 3000 rows are left out"):
        part = read_catalog(tmp_path / "ref.fits", region=REGION)
    assert not np.isin([5, 6, 7, 8, 20], part["catalog_index"]).any()
    table["dec"][:2000] = 1e4
    table.write(tmp_path / "bad.fits")
    with pytest.raises(CatalogError, match="must lie in"):
        read_catalog(tmp_path / "bad.fits", region=REGION)


def test_a_part_without_stars(tmp_path, small_pieces):
    stars().write(tmp_path / "ref.fits")
    part = read_catalog(tmp_path / "ref.fits", region=Region(180, -50, 1))
    assert len(part) == 0
    simulation = simulate(1, image_shape=(512, 512), density=25, seed=2)
    run = calibrate(simulation.exposures[0].frame(), tmp_path / "ref.fits")
    assert "no star within" in str(run.failures["sim-01"])


def test_quoted_text_over_lines_and_broken_files(tmp_path, small_pieces, monkeypatch):
    path = tmp_path / "ref.csv"
    rows = [f'{k / 10},{10 + k % 3},"two\nlines"' for k in range(800)]
    path.write_text("ra,dec,note\n" + "\n".join(f"{k / 10},{10 + k % 3},x" for k in range(650)))
    assert len(read_catalog(path, region=Region(0, 10, 1))) < 650
    path.write_text("ra,dec,note\n" + "\n".join(rows))
    # A piece ends within a field: nothing is cut.
    monkeypatch.setattr(pieces, "_PIECE", 701)
    assert len(read_catalog(path, region=REGION)) == len(read_catalog(path)) == 800
    fits_path = tmp_path / "cut.fits"
    stars().write(fits_path)
    fits_path.write_bytes(fits_path.read_bytes()[:-9000])
    with pytest.raises(CatalogError, match="cut.fits"):
        read_catalog(fits_path, region=REGION)


def test_memory_is_that_of_the_part(tmp_path):
    n = 500_000
    rng = np.random.default_rng(0)
    columns = [
        fits.Column(name, "D", array=rng.uniform(-1, 1, n))
        for name in ("parallax", "ra_error", "dec_error", "a", "b", "c", "d", "e")
    ]
    position = {"ra": rng.uniform(0, 360, n), "dec": rng.uniform(-80, 80, n)}
    columns += [fits.Column(name, "D", array=values) for name, values in position.items()]
    path = tmp_path / "ref.fits"
    fits.BinTableHDU.from_columns(columns).writeto(path)
    assert path.stat().st_size > pieces._LARGE
    tracemalloc.start()
    part = read_catalog(path, region=Region(100, 0, 3))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert 100 < len(part) < 1000
    # Some copies of a piece of 4 MB, of a file of 40 MB.
    assert peak < 20e6


def hats(folder, table, orders=(3, 5), collection=False):
    """A small catalog as the importer of HATS lays it out, split unevenly."""
    healpix = pytest.importorskip("astropy_healpix")
    pyarrow = pytest.importorskip("pyarrow")
    from pyarrow import parquet

    root = folder / "stars" if collection else folder
    cells = {}
    for order in orders:
        level = healpix.HEALPix(2**order, order="nested")
        ra, dec = (np.asarray(table[name], float) * u.deg for name in ("ra", "dec"))
        cells[order] = level.lonlat_to_healpix(ra, dec)
    # Coarse cells with an even number are divided.
    fine = cells[orders[0]] % 2 == 0
    files = []
    for order, mask in zip(orders, (~fine, fine), strict=True):
        for cell in np.unique(cells[order][mask]):
            rows = table[mask & (cells[order] == cell)]
            name = f"Norder={order}/Dir={cell // 10000 * 10000}/Npix={cell}.parquet"
            path = root / "dataset" / name
            path.parent.mkdir(parents=True, exist_ok=True)
            columns = {
                n: np.asarray(rows[n]).astype(rows[n].dtype.newbyteorder("="))
                for n in rows.colnames
            }
            parquet.write_table(pyarrow.table(columns), path)
            files.append(path)
    (root / "hats.properties").write_text(
        "#HATS catalog\nobs_collection=stars\nhats_col_ra=ra\nhats_col_dec=dec\n"
    )
    parquet.write_metadata(pyarrow.schema([("ra", "double")]), root / "dataset" / "_metadata")
    if collection:
        (folder / "collection.properties").write_text("hats_primary_table_url=stars\n")
    return files


@pytest.mark.parametrize("collection", [False, True])
def test_hats_reads_the_partitions_of_the_region_alone(tmp_path, collection):
    table = stars(20_000)
    files = hats(tmp_path, table, collection=collection)
    catalog = HatsCatalog(tmp_path)
    near = catalog.files_of(REGION)
    assert 0 < len(near) < len(files)
    for path in set(files) - set(near):
        path.write_bytes(b"never looked at")
    found = read_catalog(f"hats:{tmp_path}", region=REGION)
    truth = table[inside(table, REGION)]
    assert set(truth["source_id"]) <= set(found["source_id"])
    assert len(found) < 1.3 * len(truth)
    order = np.argsort(found["source_id"])
    expected = table[np.isin(table["source_id"], found["source_id"])]
    for name in ("ra", "dec", "pmra", "phot_g_mean_mag"):
        np.testing.assert_array_equal(found[name][order], expected[name])
    near[0].write_bytes(b"PAR1 broken PAR1")
    with pytest.raises(CatalogError, match="a partition cannot be read"):
        read_catalog(catalog, region=REGION)


@pytest.mark.parametrize("center", [(10.0, 89.9), (0.0, -89.99), (45.0, 0.0), (315.0, 41.8)])
def test_partitions_at_poles_and_corners(tmp_path, center):
    rng = np.random.default_rng(3)
    offset = np.radians(rng.normal(0, 1.5, (2, 3000)))
    sky = SkyCoord(*center, unit="deg").directional_offset_by(
        np.arctan2(*offset) * u.rad, np.hypot(*offset) * u.rad
    )
    table = Table({"ra": sky.ra.deg, "dec": sky.dec.deg, "source_id": np.arange(3000) + 1})
    hats(tmp_path, table)
    region = Region(*center, 0.4)
    found = read_catalog(f"hats:{tmp_path}", region=region)
    assert set(found["source_id"]) == set(table["source_id"][inside(table, region)])


def test_hats_that_is_none(tmp_path):
    with pytest.raises(CatalogError, match="must be the folder of a catalog, is not a folder"):
        read_catalog(f"hats:{tmp_path / 'nowhere'}", region=REGION)
    with pytest.raises(CatalogError, match="hats.properties"):
        read_catalog(f"hats:{tmp_path}", region=REGION)
    (tmp_path / "hats.properties").write_text(json.dumps({}))
    pytest.importorskip("astropy_healpix")
    pytest.importorskip("pyarrow")
    with pytest.raises(CatalogError, match="has no partitions"):
        read_catalog(f"hats:{tmp_path}", region=REGION)
    (tmp_path / "collection.properties").write_text("x=y\n")
    with pytest.raises(CatalogError, match="names no catalog"):
        read_catalog(f"hats:{tmp_path}", region=REGION)


def test_what_is_divided_needs_a_region(tmp_path):
    (tmp_path / "hats.properties").write_text("")
    for source in ("gaia", f"hats:{tmp_path}"):
        with pytest.raises(CatalogError, match="needs a region of the sky"):
            read_catalog(source)


def test_frames_are_solved_from_a_divided_catalog(tmp_path):
    simulation = simulate(2, image_shape=(512, 512), density=25, seed=5)
    reference = Table(simulation.reference)
    hats(tmp_path / "hats", reference)
    frames = [e.frame() for e in simulation.exposures]
    whole = calibrate(frames, reference)
    run = calibrate(frames, f"hats:{tmp_path / 'hats'}")
    assert not run.failures
    for one, other in zip(run.calibrations, whole.calibrations, strict=True):
        a, b = (c.wcs(250.0, 200.0) for c in (one, other))
        assert np.hypot(*(np.subtract(a, b) * 3.6e6)) < 3  # mas
