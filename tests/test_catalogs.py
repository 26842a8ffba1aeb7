"""Reference catalogs: names, units, epochs, and motion against astropy."""

import contextlib
import gzip
import warnings

import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import SkyCoord, get_body
from astropy.io import fits
from astropy.stats import mad_std
from astropy.table import MaskedColumn, QTable, Table, vstack
from astropy.time import Time
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from wpdc_gwcs.catalogs import (
    fill_motions,
    propagate,
    read_catalog,
    scale_errors,
    select_cone,
)
from wpdc_gwcs.exceptions import CatalogError, WPDCWarning


def stars(n=20, seed=0):
    rng = np.random.default_rng(seed)
    return Table(
        {
            "source_id": np.arange(n) + 10**17,
            "ra": rng.uniform(0, 360, n) * u.deg,
            "dec": rng.uniform(-80, 80, n) * u.deg,
            "pmra": rng.normal(0, 50, n) * u.mas / u.yr,
            "pmdec": rng.normal(0, 50, n) * u.mas / u.yr,
            "parallax": rng.uniform(0.1, 100, n) * u.mas,
            "ref_epoch": np.full(n, 2016.0) * u.yr,
            "phot_g_mean_mag": rng.uniform(10, 20, n) * u.mag,
        }
    )


@pytest.mark.parametrize(
    ("suffix", "format"),
    [("fits", None), ("ecsv", None), ("csv", None), ("vot", "votable"), ("fits.gz", None)],
)
def test_file_formats(tmp_path, suffix, format):
    table = stars()
    path = tmp_path / f"ref.{suffix}"
    # Without units, as CSV has none; the defaults are the same.
    Table({c: np.asarray(table[c]) for c in table.colnames}).write(path, format=format)
    catalog = read_catalog(path)
    for name in table.colnames:
        np.testing.assert_allclose(catalog[name], np.asarray(table[name]), rtol=1e-14)
    assert catalog["ra"].dtype == float
    assert list(catalog["catalog_index"]) == list(range(len(table)))


@pytest.mark.parametrize(
    ("ra", "dec"),
    [
        ("RA", "DEC"),
        ("RA_ICRS", "DE_ICRS"),
        ("ALPHA_J2000", "DELTA_J2000"),
        ("X_WORLD", "Y_WORLD"),
        ("RAJ2000", "DEJ2000"),
        ("ra_deg", "dec_deg"),
    ],
)
def test_names_of_positions(ra, dec):
    catalog = read_catalog(Table({ra: [10.0], dec: [-20.0]}))
    assert (catalog["ra"][0], catalog["dec"][0]) == (10.0, -20.0)
    assert "ref_epoch" not in catalog.colnames


def test_damaged_description_of_columns(tmp_path):
    # What astropy writes of columns with units beyond FITS is YAML in COMMENT cards.
    path = tmp_path / "c.fits"
    QTable({"ra": [10.0] * u.deg, "dec": [1.0] * u.deg, "t": Time(["J2016.0"])}).write(path)
    damaged = path.read_bytes().replace(b"COMMENT datatype:  ", b"COMMENT datatype: [")
    path.write_bytes(damaged)
    with pytest.raises(CatalogError, match=r"c.fits: cannot be read as a table: YamlParseError"):
        read_catalog(path)


def test_exact_name_before_capitals():
    catalog = read_catalog(Table({"RA": [1.0], "ra": [2.0], "dec": [3.0]}))
    assert catalog["ra"][0] == 2.0


def test_units_are_converted():
    table = QTable(
        {
            "ra": [1.0] * u.hourangle,
            "dec": [0.1] * u.rad,
            "pmra": [1.0] * u.arcsec / u.yr,
            "pmdec": [1.0] * u.deg / u.Myr,
            "parallax": [0.1] * u.arcsec,
            "ra_error": [1e-6] * u.deg,
            "ref_epoch": [2015.5] * u.yr,
        }
    )
    catalog = read_catalog(table)
    assert catalog["ra"][0] == pytest.approx(15.0)
    assert catalog["dec"][0] == pytest.approx(np.degrees(0.1))
    assert catalog["pmra"][0] == pytest.approx(1000.0)
    assert catalog["pmdec"][0] == pytest.approx(3.6)
    assert catalog["parallax"][0] == pytest.approx(100.0)
    assert catalog["ra_error"][0] == pytest.approx(3.6)
    assert catalog["ra"].unit == u.deg
    assert isinstance(table["ra"], u.Quantity)  # the argument is left alone


def test_rows_without_position_are_dropped_and_masked_is_nan():
    table = Table(
        {
            "ra": [10.0, np.nan, 12.0, np.inf],
            "dec": MaskedColumn([0.0, 0.0, 1.0, 0.0], mask=[False, False, False, False]),
            "pmra": MaskedColumn([1.0, 2.0, 3.0, 4.0], mask=[True, False, False, False]),
            "pmdec": [1.0, 2.0, np.inf, 4.0],
            "ref_epoch": [2016.0] * 4,
        }
    )
    catalog = read_catalog(table)
    assert list(catalog["catalog_index"]) == [0, 2]
    assert np.isnan(catalog["pmra"][0])
    assert np.isnan(catalog["pmdec"][1])
    # Reading what was read keeps the rows of the first input.
    again = read_catalog(catalog[1:])
    assert list(again["catalog_index"]) == [2]


def test_right_ascension_is_wrapped():
    assert read_catalog(Table({"ra": [-1.0, 360.0], "dec": [0.0, 0.0]}))["ra"].tolist() == [359, 0]


def test_skycoord():
    coordinates = SkyCoord(
        [1.0, 2.0] * u.deg,
        [3.0, 4.0] * u.deg,
        pm_ra_cosdec=[5, 6] * u.mas / u.yr,
        pm_dec=[7, 8] * u.mas / u.yr,
        obstime=Time("J2015.5"),
    )
    catalog = read_catalog(coordinates)
    np.testing.assert_allclose(catalog["pmra"], [5, 6])
    np.testing.assert_allclose(catalog["ref_epoch"], 2015.5)
    assert len(read_catalog(SkyCoord(1.0, 2.0, unit="deg"))) == 1


@pytest.mark.parametrize(
    "names",
    [
        ("bp_rp", "ra_dec_corr", "ra_pmra_corr", "dec_pmdec_corr", "parallax_error"),
        ("BP-RP", "RADEcor", "RApmRAcor", "DEpmDEcor", "e_Plx"),
    ],
)
def test_colors_and_correlations(tmp_path, names):
    rows = Table(np.arange(10.0).reshape(2, 5) / 10, names=names)
    rows["ra"], rows["dec"] = [10.0, 10.1], [5.0, 5.1]
    rows[names[0]][1] = np.nan
    rows.write(tmp_path / "a.fits")
    catalog = read_catalog(tmp_path / "a.fits")
    np.testing.assert_array_equal(catalog["bp_rp"], [0.0, np.nan])
    assert catalog["bp_rp"].unit == u.mag
    assert catalog["parallax_error"].unit == u.mas
    for column, name in zip(
        ("ra_dec_corr", "ra_pmra_corr", "dec_pmdec_corr", "parallax_error"), names[1:], strict=True
    ):
        np.testing.assert_array_equal(catalog[column], rows[name])
    # Nothing is lost on the way to the frame, nor by reading again.
    kept = read_catalog(select_cone(propagate(catalog, 2020.0), 10.0, 5.0, 0.01))
    assert kept["bp_rp"].tolist() == [0.0]
    assert kept["ra_dec_corr"].tolist() == [0.1]


@pytest.mark.parametrize(
    "bands", [("phot_bp_mean_mag", "phot_rp_mean_mag"), ("BPmag", "RPmag"), ("bp_mag", "rp_mag")]
)
def test_color_from_two_bands(bands):
    table = Table({"ra": [1.0, 2.0, 3.0], "dec": [0.0, 0.0, 0.0]})
    table[bands[0]] = MaskedColumn([15.5, 16.0, 17.0], mask=[False, True, False])
    table[bands[1]] = [14.0, 15.0, 15.0]
    np.testing.assert_array_equal(read_catalog(table)["bp_rp"], [1.5, np.nan, 2.0])
    # A color of the catalog's own comes first, star by star.
    table["bp_rp"] = [1.25, 0.5, np.nan]
    np.testing.assert_array_equal(read_catalog(table)["bp_rp"], [1.25, 0.5, 2.0])
    table.remove_columns(["bp_rp", bands[0]])
    assert "bp_rp" not in read_catalog(table).colnames


def test_correlations_are_numbers():
    table = Table({"ra": [1.0], "dec": [2.0], "ra_dec_corr": [0.5] * u.mas})
    with pytest.warns(WPDCWarning, match="'ra_dec_corr' must have the unit none, has 'mas'"):
        assert "ra_dec_corr" not in read_catalog(table).colnames


def ldac_reference(path, epoch=True):
    header = "SIMPLE  =                    T".ljust(80) + "END".ljust(80)
    head = fits.BinTableHDU.from_columns(
        [fits.Column("Field Header Card", "160A", array=np.array([header]))], name="LDAC_IMHEAD"
    )
    columns = [
        fits.Column("X_WORLD", "1D", array=[10.0, 11.0]),
        fits.Column("Y_WORLD", "1D", array=[-5.0, 5.0]),
        fits.Column("ERRA_WORLD", "1E", array=[2e-7, 2e-7]),
        fits.Column("ERRB_WORLD", "1E", array=[1e-7, 1e-7]),
        fits.Column("ERRTHETA_WORLD", "1E", array=[0.0, 90.0]),
        fits.Column("MAG", "1E", array=[15.0, 16.0]),
    ]
    if epoch:
        columns.append(fits.Column("OBSDATE", "1D", unit="yr", array=[2015.0, 2015.0]))
    objects = fits.BinTableHDU.from_columns(columns, name="LDAC_OBJECTS")
    fits.HDUList([fits.PrimaryHDU(), head, objects]).writeto(path)


def test_ldac(tmp_path):
    ldac_reference(tmp_path / "ref.cat")
    catalog = read_catalog(tmp_path / "ref.cat")
    np.testing.assert_allclose(catalog["ra_error"], [0.72, 0.36], rtol=1e-6)
    np.testing.assert_allclose(catalog["dec_error"], [0.36, 0.72], rtol=1e-6)
    np.testing.assert_allclose(catalog["ref_epoch"], 2015.0)
    np.testing.assert_allclose(catalog["phot_g_mean_mag"], [15, 16])


def test_extension_of_a_fits_file(tmp_path):
    path = tmp_path / "two.fits"
    first = fits.table_to_hdu(Table({"ra": [1.0], "dec": [2.0]}))
    second = fits.table_to_hdu(Table({"ra": [3.0], "dec": [4.0]}))
    second.name = "GAIA"
    fits.HDUList([fits.PrimaryHDU(), first, second]).writeto(path)
    assert read_catalog(path)["ra"][0] == 1.0
    assert read_catalog(f"{path}[2]")["ra"][0] == 3.0
    assert read_catalog(f"{path}[GAIA]")["ra"][0] == 3.0
    with pytest.raises(CatalogError, match=r"two.fits.*NONE"):
        read_catalog(f"{path}[NONE]")


@pytest.mark.parametrize(
    ("meta", "description", "epoch"),
    [
        ({"EPOCH": "J2000.0"}, "", 2000.0),
        ({"REF_EPOCH": 1991.25}, "", 1991.25),
        ({"ID": "I_355_gaiadr3", "description": "Gaia DR3 Part 1"}, "", 2016.0),
        ({"COMMENT": ["downloaded from gaia_dr2.gaia_source"]}, "", 2015.5),
        ({}, "Right ascension (ICRS) at Ep=2015.5", 2015.5),
    ],
)
def test_epoch_of_metadata(meta, description, epoch):
    table = Table({"ra": [1.0], "dec": [2.0], "pmra": [1.0], "pmdec": [1.0]}, meta=meta)
    table["ra"].description = description
    assert read_catalog(table)["ref_epoch"][0] == epoch


def test_epoch_is_assumed_aloud():
    table = Table({"ra": [1.0], "dec": [2.0], "pmra": [1.0], "pmdec": [1.0]})
    with pytest.warns(WPDCWarning, match=r"without a reference epoch: 2016.0"):
        catalog = read_catalog(table)
    assert catalog["ref_epoch"][0] == 2016.0


@pytest.mark.parametrize(("value", "year"), [(57388.5, 2016.0), (2457389.0, 2016.0)])
def test_epoch_as_a_julian_date(value, year):
    table = Table({"ra": [1.0], "dec": [2.0], "epoch": [value]})
    assert read_catalog(table)["ref_epoch"][0] == pytest.approx(year, abs=0.01)


def write_text(path, text):
    path.write_text(text)
    return path


class TestBadInput:
    def test_missing(self, tmp_path):
        with pytest.raises(CatalogError, match=r"no.fits: catalog must be an existing file"):
            read_catalog(tmp_path / "no.fits")

    def test_empty(self, tmp_path):
        with pytest.raises(CatalogError, match="must not be empty, the file has 0 bytes"):
            read_catalog(write_text(tmp_path / "a.fits", ""))

    def test_text_named_fits(self, tmp_path):
        with pytest.raises(CatalogError, match="must begin with 'SIMPLE  ='"):
            read_catalog(write_text(tmp_path / "a.fits", "hello world\n"))

    def test_folder(self, tmp_path):
        with pytest.raises(CatalogError, match="must be a file, is a folder"):
            read_catalog(tmp_path)

    def test_truncated(self, tmp_path):
        stars(500).write(tmp_path / "a.fits")
        data = (tmp_path / "a.fits").read_bytes()
        (tmp_path / "b.fits").write_bytes(data[: len(data) // 2])
        with pytest.raises(CatalogError, match=r"b.fits"):
            read_catalog(tmp_path / "b.fits")

    def test_garbage(self, tmp_path):
        (tmp_path / "a.dat").write_bytes(bytes(range(256)) * 20)
        with pytest.raises(CatalogError, match=r"a.dat"):
            read_catalog(tmp_path / "a.dat")

    def test_image(self, tmp_path):
        fits.writeto(tmp_path / "a.fits", np.zeros((3, 3)))
        with pytest.raises(CatalogError, match="must have a table extension"):
            read_catalog(tmp_path / "a.fits")

    def test_no_rows(self, tmp_path):
        stars()[:0].write(tmp_path / "a.fits")
        with pytest.raises(
            CatalogError, match=r"a.fits: catalog must have at least one row, has 0"
        ):
            read_catalog(tmp_path / "a.fits")

    def test_no_positions(self):
        with pytest.raises(CatalogError, match="must have columns 'ra' and 'dec'.*has a, b"):
            read_catalog(Table({"a": [1.0], "b": [2.0]}))

    def test_all_nan(self):
        with pytest.raises(CatalogError, match="none of 2 rows has"):
            read_catalog(Table({"ra": [np.nan, 1.0], "dec": [1.0, np.nan]}))

    @pytest.mark.parametrize(("column", "unit"), [("pmra", "deg"), ("parallax", "s")])
    def test_units_of_columns_that_may_be_missing(self, column, unit):
        table = stars()
        table[column].unit = unit
        with pytest.warns(WPDCWarning, match=f"'{column}' must have .*'{unit}': it is left out"):
            catalog = read_catalog(table)
        assert column not in catalog.colnames
        assert len(catalog) == len(table)

    @pytest.mark.parametrize(("column", "unit"), [("ra", "m"), ("dec", "mag")])
    def test_units(self, tmp_path, column, unit):
        table = stars()
        table[column].unit = unit
        table.write(tmp_path / "a.fits")
        with pytest.raises(CatalogError, match=f"a.fits: unit of column '{column}'.*got '{unit}'"):
            read_catalog(tmp_path / "a.fits")

    def test_unknown_unit(self, tmp_path):
        table = fits.BinTableHDU.from_columns(
            [
                fits.Column("ra", "1D", unit="furlongs", array=[1.0]),
                fits.Column("dec", "1D", array=[1.0]),
            ]
        )
        table.writeto(tmp_path / "a.fits")
        with pytest.raises(CatalogError, match="must be an angle, got 'furlongs'"):
            read_catalog(tmp_path / "a.fits")

    @pytest.mark.parametrize("unit", ["degrees", "DEG", "Degree"])
    def test_units_that_are_nearly_right(self, tmp_path, unit):
        columns = [
            fits.Column("ra", "1D", unit=unit, array=[1.0]),
            fits.Column("dec", "1D", unit=unit, array=[1.0]),
            fits.Column("pmra", "1D", unit="mas/year", array=[1.0]),
        ]
        fits.BinTableHDU.from_columns(columns).writeto(tmp_path / "a.fits")
        catalog = read_catalog(tmp_path / "a.fits")
        assert (catalog["ra"][0], catalog["pmra"][0]) == (1.0, 1.0)

    def test_text_positions(self):
        with pytest.raises(CatalogError, match="column 'ra' must be numeric, got 'Vega'"):
            read_catalog(Table({"ra": ["Vega"], "dec": ["+1:00:00"]}))

    @pytest.mark.parametrize("wrong", [[0.0, 90.5], [91.0, 180.0]])
    def test_most_declinations_out_of_range(self, wrong):
        table = Table({"ra": [1.0, *range(len(wrong))], "dec": [95.0, *wrong]})
        with pytest.raises(CatalogError, match=r"'dec' must lie in .*got 95 in row 0"):
            read_catalog(table)

    def test_impossible_epoch(self):
        with pytest.raises(CatalogError, match="'ref_epoch' must be a Julian year.*got 16"):
            read_catalog(Table({"ra": [1.0], "dec": [2.0], "ref_epoch": [16.0]}))

    def test_wrong_type(self):
        with pytest.raises(TypeError, match="must be a path, a Table or a SkyCoord, got int"):
            read_catalog(3)


def truth(table, epoch):
    """Where astropy puts the stars."""
    start = SkyCoord(
        np.asarray(table["ra"]) * u.deg,
        np.asarray(table["dec"]) * u.deg,
        pm_ra_cosdec=np.asarray(table["pmra"]) * u.mas / u.yr,
        pm_dec=np.asarray(table["pmdec"]) * u.mas / u.yr,
        obstime=Time(2016.0, format="jyear", scale="tcb"),
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return start.apply_space_motion(Time(epoch, format="jyear", scale="tcb"))


@settings(deadline=None, max_examples=30)
@given(
    st.lists(
        st.tuples(
            st.floats(0, 359.999),
            st.floats(-89.9, 89.9),
            st.floats(-9e3, 9e3).filter(lambda pm: abs(pm) != 999.0),
            st.floats(-9e3, 9e3).filter(lambda pm: abs(pm) != 999.0),
        ),
        min_size=1,
        max_size=5,
        unique_by=lambda row: (round(row[0], 6), round(row[1], 6)),
    ),
    st.floats(1950, 2100),
)
def test_motion_is_that_of_astropy(rows, epoch):
    ra, dec, pmra, pmdec = np.array(rows).T
    table = Table([ra, dec, pmra, pmdec], names=["ra", "dec", "pmra", "pmdec"])
    table["ref_epoch"] = 2016.0
    moved = propagate(read_catalog(table), epoch)
    expected = truth(table, epoch)
    got = SkyCoord(moved["ra"], moved["dec"], unit="deg")
    # astropy goes through light times with a tiny parallax; that leaves some 1e-8 of the motion.
    motion = np.hypot(pmra, pmdec) * abs(epoch - 2016.0) / 1e3
    assert np.all(got.separation(expected).arcsec < 1e-7 + 1e-6 * motion)
    scale = 1e-3 + 1e-5 * np.hypot(pmra, pmdec)
    assert np.all(np.abs(moved["pmra"] - expected.pm_ra_cosdec.to_value("mas/yr")) < scale)


def test_motion_over_the_pole_and_back():
    start = read_catalog(
        Table(
            {
                "ra": [0.0, 359.9999],
                "dec": [89.9999, 0.0],
                "pmra": [0.0, 1e5],
                "pmdec": [1e5, 0.0],
                "ref_epoch": [2016.0, 2016.0],
            }
        )
    )
    moved = propagate(start, 2026.0)
    assert moved["ra"][0] == pytest.approx(180.0)
    assert moved["ra"][1] == pytest.approx(359.9999 + 1000 / 3600 - 360, abs=1e-5)
    back = propagate(moved, 2016.0)
    np.testing.assert_allclose(back["dec"], start["dec"], atol=1e-9)
    np.testing.assert_allclose((back["ra"] - start["ra"] + 180) % 360, 180, atol=1e-9)
    assert start["ref_epoch"][0] == 2016.0  # the argument is left alone


def test_stars_without_motion_stay_put():
    table = Table(
        {
            "ra": [1.0, 2.0, 3.0],
            "dec": [0.0, 0.0, 0.0],
            "pmra": [np.nan, 100.0, 100.0],
            "pmdec": [1.0, np.nan, 100.0],
            "ref_epoch": [2000.0] * 3,
        }
    )
    moved = propagate(read_catalog(table), Time("J2100"))
    assert moved["ra"][:2].tolist() == [1.0, 2.0]
    assert moved["ra"][2] != 3.0
    plain = read_catalog(Table({"ra": [1.0], "dec": [2.0]}))
    assert propagate(plain, 2030.0)["ra"][0] == 1.0


def test_errors_grow_with_time():
    table = Table(
        {
            "ra": [1.0],
            "dec": [2.0],
            "pmra": [1.0],
            "pmdec": [1.0],
            "ra_error": [3.0],
            "dec_error": [1.0],
            "pmra_error": [0.4],
            "pmdec_error": [np.nan],
            "ref_epoch": [2016.0],
        }
    )
    moved = propagate(read_catalog(table), 2026.0)
    assert moved["ra_error"][0] == pytest.approx(5.0)
    assert moved["dec_error"][0] == pytest.approx(1.0)


def test_errors_and_correlations_are_those_of_drawn_stars():
    position, motion, rho, years = 2.0, 0.3, -0.8, 12.0
    table = Table(
        {"ra": [1.0], "dec": [2.0], "pmra": [5.0], "pmdec": [-3.0], "ref_epoch": [2016.0]}
    )
    for axis in ("ra", "dec"):
        table[f"{axis}_error"], table[f"pm{axis}_error"] = position, motion
    table["ra_pmra_corr"], table["dec_pmdec_corr"] = rho, np.nan
    moved = propagate(read_catalog(table), 2016.0 + years)
    for axis, r in (("ra", rho), ("dec", 0.0)):
        cov = [[position**2, r * position * motion], [r * position * motion, motion**2]]
        p, m = np.random.default_rng(5).multivariate_normal([0, 0], cov, 200_000).T
        later = p + m * years
        assert moved[f"{axis}_error"][0] == pytest.approx(later.std(), rel=0.01)
        correlation = moved[f"{axis}_pm{axis}_corr"][0]
        assert correlation == pytest.approx(np.corrcoef(later, m)[0, 1], abs=0.01)
    back = propagate(moved, 2016.0)
    np.testing.assert_allclose([back["ra_error"][0], back["dec_error"][0]], position, rtol=1e-9)
    np.testing.assert_allclose(
        [back["ra_pmra_corr"][0], back["dec_pmdec_corr"][0]], [rho, 0], atol=1e-9
    )


def test_all_correlations_are_those_of_drawn_stars():
    names, years = ("ra", "dec", "pmra", "pmdec"), 9.0
    errors = np.array([2.0, 1.5, 0.3, 0.2])
    rho = np.array(
        [[1.0, 0.4, -0.3, 0.5], [0.4, 1.0, 0.2, -0.4], [-0.3, 0.2, 1.0, -0.6], [0.5, -0.4, -0.6, 1]]
    )
    table = Table({"ra": [1.0], "dec": [0.0], "pmra": [5.0], "pmdec": [-3.0]})
    table["ref_epoch"] = 2016.0
    for k, one in enumerate(names):
        table[f"{one}_error"] = errors[k]
        for m in range(k):
            table[f"{names[m]}_{one}_corr"] = rho[m, k]
    moved = propagate(read_catalog(table), 2016.0 + years)
    drawn = np.random.default_rng(3).multivariate_normal(
        np.zeros(4), rho * np.outer(errors, errors), 400_000
    )
    drawn[:, :2] += years * drawn[:, 2:]
    expected = np.corrcoef(drawn.T)
    for k, one in enumerate(names):
        for m in range(k):
            found = moved[f"{names[m]}_{one}_corr"][0]
            assert found == pytest.approx(expected[m, k], abs=0.01), (names[m], one)
    back = propagate(moved, 2016.0)
    assert back["ra_dec_corr"][0] == pytest.approx(0.4, abs=1e-9)
    # Where no error is known, the correlation is what was given.
    table.remove_columns(["ra_error", "pmra_error"])
    assert propagate(read_catalog(table), 2025.0)["ra_dec_corr"][0] == 0.4


def test_radial_velocity_is_that_of_astropy():
    # Barnard's star, and one without a parallax of use
    table = Table({"ra": [269.4521, 269.5], "dec": [4.6934, 4.7]})
    table["pmra"], table["pmdec"], table["ref_epoch"] = [-801.551, 0.0], [10362.394, 50.0], 2016.0
    table["parallax"], table["parallax_error"] = [546.9759, -0.1], [0.04, 0.1]
    table["radial_velocity"] = [-110.47, 300.0]
    moved = propagate(read_catalog(table), 2066.0)
    star = SkyCoord(
        269.4521 * u.deg,
        4.6934 * u.deg,
        distance=1000 / 546.9759 * u.pc,
        pm_ra_cosdec=-801.551 * u.mas / u.yr,
        pm_dec=10362.394 * u.mas / u.yr,
        radial_velocity=-110.47 * u.km / u.s,
        obstime=Time(2016.0, format="jyear", scale="tdb"),
    ).apply_space_motion(Time(2066.0, format="jyear", scale="tdb"))
    got = SkyCoord(moved["ra"], moved["dec"], unit="deg")
    assert got[0].separation(star).mas < 0.5
    table.remove_column("radial_velocity")
    without = propagate(read_catalog(table), 2066.0)
    still = SkyCoord(without["ra"], without["dec"], unit="deg")
    assert 1400 < still[0].separation(star).mas < 1800  # 1.2 mas / yr2
    assert got[1].separation(still[1]).mas == 0


def test_errors_of_bad_fits_are_scaled():
    table = Table({"ra": [1.0, 2.0, 3.0], "dec": [0.0] * 3, "ruwe": [1.39, 2.5, np.nan]})
    table["ra_error"] = table["pmra_error"] = 0.2
    catalog = read_catalog(table)
    scaled = scale_errors(catalog)
    for name in ("ra_error", "pmra_error"):
        np.testing.assert_allclose(scaled[name], [0.2, 0.5, 0.2])
        assert list(catalog[name]) == [0.2] * 3
        assert scaled[name].unit == catalog[name].unit
    table.remove_column("ruwe")
    plain = read_catalog(table)
    assert scale_errors(plain) is plain


def test_unknown_errors_do_not_hide_the_known():
    table = Table({"ra": [1.0, 2.0, 3.0], "dec": [2.0] * 3, "pmra": [1.0] * 3, "pmdec": [1.0] * 3})
    table["ref_epoch"] = 2016.0
    table["pmra_error"] = [0.5, np.nan, 0.5]
    moved = propagate(read_catalog(table), 2026.0)
    np.testing.assert_array_equal(moved["ra_error"], [5.0, np.nan, 5.0])
    assert "dec_error" not in moved.colnames
    table["ra_error"] = [np.nan, 1.0, 12.0]
    moved = propagate(read_catalog(table), 2026.0)
    np.testing.assert_array_equal(moved["ra_error"], [5.0, 1.0, 13.0])
    assert np.isnan(propagate(read_catalog(table), 2016.0)["ra_error"][0])


BULK, SPREAD, YEARS = np.array([8.0, -6.0]), 5.0, 12.0


def moving_field(n=4000, unknown=0.4, center=(0.0, 40.0), seed=3):
    """Stars of a common motion with a scatter, mas/yr; not all are known. Also all motions."""
    rng = np.random.default_rng(seed)
    frame = SkyCoord(*center, unit="deg").skyoffset_frame()
    x, y = rng.uniform(-0.5, 0.5, (2, n)) * u.deg
    pm = (BULK[:, None] + rng.normal(0, SPREAD, (2, n))) * u.mas / u.yr
    sky = SkyCoord(x, y, pm_lon_coslat=pm[0], pm_lat=pm[1], frame=frame).icrs
    table = Table({"ra": sky.ra.deg, "dec": sky.dec.deg})
    table["pmra"], table["pmdec"] = sky.pm_ra_cosdec.to_value(pm.unit), sky.pm_dec.to_value(pm.unit)
    table["ref_epoch"] = 2016.0
    table["ra_error"], table["dec_error"] = 0.2, 0.3
    table["pmra_error"], table["pmdec_error"] = 0.1, 0.1
    known = table.copy()
    lacking = rng.uniform(size=n) < unknown
    for name in ("pmra", "pmdec", "pmra_error", "pmdec_error"):
        table[name][lacking] = np.nan
    return table, known, lacking


# Across RA 0, and around the pole, where East turns from star to star.
@pytest.mark.parametrize("center", [(0.0, 40.0), (77.0, 90.0)])
def test_stars_of_unknown_motion_go_with_their_neighbors(center):
    table, known, lacking = moving_field(center=center)
    moved = propagate(read_catalog(table), 2016.0 + YEARS)
    expected = truth(known, 2016.0 + YEARS)
    expected = SkyCoord(expected.ra, expected.dec)
    got = SkyCoord(moved["ra"], moved["dec"], unit="deg")
    east, north = (a.to_value(u.mas) for a in expected.spherical_offsets_to(got))
    np.testing.assert_array_equal(moved["pm_from_neighbors"], lacking)
    assert np.hypot(east, north)[~lacking].max() < 1e-3
    for offset, name, error in ((east, "ra_error", 0.2), (north, "dec_error", 0.3)):
        offset, sigma = offset[lacking], np.asarray(moved[name])
        # The common motion, 120 mas, is gone; the scatter of each, 60 mas, and of the median stay.
        scatter = SPREAD * YEARS * np.sqrt(1 + 1.57 / 30)
        assert np.abs(offset.mean()) < 3.5 * 60.0 * np.sqrt(1 / 1600 + 1.57 / 2400)
        assert offset.std() == pytest.approx(scatter, rel=0.05)
        assert np.median(sigma[lacking]) == pytest.approx(scatter, rel=0.05)
        pulls = offset / sigma[lacking]
        # The MAD of 30 stars is uncertain by a fifth, which widens the tails: 1.09 and 1.03, with
        # a scatter of 0.035 between fields.
        assert np.std(pulls) == pytest.approx(1.09, abs=0.1)
        assert mad_std(pulls) == pytest.approx(1.03, abs=0.1)
        np.testing.assert_allclose(sigma[~lacking], np.hypot(error, 0.1 * YEARS))


@pytest.mark.parametrize("n_known", [5, 8])
def test_error_of_a_filled_motion_is_right_with_few_known(rng, n_known):
    n = n_known + 1
    drawn = rng.normal(0, SPREAD, (500, n))
    pulls = []
    for pmra in drawn:
        table = Table({"ra": np.linspace(10.0, 10.01, n), "dec": np.zeros(n), "pmra": pmra})
        table["pmdec"], table["ref_epoch"] = 0.0, 2016.0
        table["pmra"][0] = np.nan
        catalog = fill_motions(read_catalog(table))
        pulls.append((catalog["pmra"][0] - pmra[0], catalog["pmra_error"][0]))
    offset, error = np.transpose(pulls)
    assert error.mean() == pytest.approx(offset.std(), rel=0.1)


def test_motion_is_that_of_the_near():
    # Two groups of stars with motions of their own, and stars without one in each.
    ra = np.r_[np.linspace(10.0, 10.1, 40), np.linspace(11.0, 11.1, 40)]
    pmra = np.repeat([50.0, -50.0], 40) + np.tile([-1.0, 0.0, 1.0, 0.0], 20)
    table = Table({"ra": ra, "dec": np.zeros(80), "pmra": pmra, "pmdec": np.full(80, 7.0)})
    table["ref_epoch"] = 2016.0
    table["pmra"][[3, 50]] = np.nan
    table["pmdec"][[3, 20]] = np.nan
    catalog = fill_motions(read_catalog(table))
    assert catalog["pmra"][3] == pytest.approx(50.0, abs=1.0)
    assert catalog["pmra"][50] == pytest.approx(-50.0, abs=1.0)
    np.testing.assert_allclose(catalog["pmdec"], 7.0, atol=1e-9)
    # What is known on one axis stays.
    assert catalog["pmra"][20] == pmra[20]
    assert np.isnan(catalog["pmra_error"][20])
    assert np.flatnonzero(catalog["pm_from_neighbors"]).tolist() == [3, 20, 50]


def test_a_star_moves_alike_in_every_part_of_the_catalog():
    table, _, lacking = moving_field(n=500)
    whole = fill_motions(read_catalog(table))
    part = select_cone(whole, 0.0, 40.0, 0.05)
    assert 1 < len(part) < 20
    assert np.any(part["pm_from_neighbors"])
    rows = np.asarray(part["catalog_index"])
    moved, all_moved = propagate(part, 2030.0), propagate(whole, 2030.0)[rows]
    for name in ("ra", "dec", "ra_error", "dec_error"):
        np.testing.assert_array_equal(moved[name], all_moved[name])
    # Neither filling nor reading again takes a filled motion for a measured one.
    assert fill_motions(whole) is whole
    np.testing.assert_array_equal(read_catalog(whole)["pm_from_neighbors"], lacking)
    # There and back again.
    back = propagate(propagate(whole, 2030.0), 2016.0)
    np.testing.assert_allclose(back["dec"], whole["dec"], rtol=0, atol=1e-10)
    np.testing.assert_allclose(back["ra_error"], whole["ra_error"], atol=1e-5)


def test_errors_of_filled_motions_without_columns_of_errors():
    table, _, lacking = moving_field(n=500)
    table.remove_columns(["ra_error", "dec_error", "pmra_error", "pmdec_error"])
    moved = propagate(read_catalog(table), 2016.0 + YEARS)
    for name in ("ra_error", "dec_error"):
        sigma = np.asarray(moved[name])
        assert np.isnan(sigma[~lacking]).all()
        assert np.median(sigma[lacking]) == pytest.approx(SPREAD * YEARS, rel=0.1)
        assert moved[name].unit == u.mas
    # At the epoch of the catalog there is nothing to add.
    assert np.isnan(propagate(read_catalog(table), 2016.0)["ra_error"]).all()


@pytest.mark.parametrize("n_known", [0, 4])
def test_too_few_known_motions_say_nothing(n_known):
    table, _, _ = moving_field(n=30, unknown=0.0)
    for name in ("pmra", "pmdec", "pmra_error", "pmdec_error"):
        table[name][n_known:] = np.nan
    catalog = read_catalog(table)
    assert fill_motions(catalog) is catalog
    moved = propagate(catalog, 2030.0)
    for name in ("ra", "dec", "ra_error", "dec_error"):
        np.testing.assert_array_equal(moved[name][n_known:], catalog[name][n_known:])
    assert "pm_from_neighbors" not in moved.colnames


def test_nothing_to_fill():
    one = Table(
        {"ra": [1.0], "dec": [2.0], "pmra": [np.nan], "pmdec": [np.nan], "ref_epoch": [2016.0]}
    )
    for table in (stars(), one, Table({"ra": [1.0], "dec": [2.0]})):
        catalog = read_catalog(table)
        assert fill_motions(catalog) is catalog
    table, _, lacking = moving_field(n=100)
    catalog = read_catalog(table)
    fill_motions(catalog)
    assert np.isnan(catalog["pmra"][lacking]).all()  # the argument is left alone


def test_unknown_motion_and_unknown_epoch():
    table, _, lacking = moving_field(n=100)
    row = int(np.flatnonzero(lacking)[0])
    table["ref_epoch"][row] = np.nan
    moved = propagate(read_catalog(table), 2030.0)
    assert moved["ra"][row] == table["ra"][row]
    assert moved["ra_error"][row] == 0.2


def test_annual_parallax_is_that_of_astropy():
    table = stars()
    catalog = read_catalog(table)
    catalog["parallax"][3] = np.nan
    epoch = 2018.3
    seen = propagate(catalog, epoch, parallax=True)
    unseen = propagate(catalog, epoch)
    time = Time(epoch, format="jyear", scale="tdb")
    from astropy.coordinates import get_body_barycentric

    earth = get_body_barycentric("earth", time)
    far = SkyCoord(
        np.asarray(unseen["ra"]) * u.deg,
        np.asarray(unseen["dec"]) * u.deg,
        distance=1000.0 / np.nan_to_num(np.asarray(catalog["parallax"]), nan=1e-9) * u.pc,
    ).cartesian
    expected = SkyCoord(far - earth, frame="icrs")
    got = SkyCoord(seen["ra"], seen["dec"], unit="deg")
    assert got.separation(expected).max() < 1e-6 * u.arcsec
    assert seen["ra"][3] == unseen["ra"][3]
    assert np.abs(seen["ra"] - unseen["ra"]).max() > 1e-6


@pytest.mark.parametrize("epoch", [2016.0, 2016.3, 2019.62])
def test_stars_move_towards_the_sun_by_their_parallax(epoch):
    table = Table({"ra": [270.0, 33.0], "dec": [66.5607, -20.0], "parallax": [100.0, 100.0]})
    catalog = read_catalog(table)
    seen = propagate(catalog, epoch, parallax=True)
    before, after = (SkyCoord(c["ra"], c["dec"], unit="deg") for c in (catalog, seen))
    sun = get_body("sun", Time(epoch, format="jyear"))
    sun = SkyCoord(sun.ra, sun.dec)  # aberration and the Sun's own way are within a degree
    shift = before.separation(after).to_value(u.mas)
    angle = before.separation(sun)
    # The distance of the Sun is within 1.7 % of an au, that of the barycenter within 0.8 % of it.
    np.testing.assert_allclose(shift, 100.0 * np.sin(angle), rtol=0.03)
    turn = before.position_angle(after) - before.position_angle(sun)
    assert np.abs(turn.wrap_at(180 * u.deg)).max() < 2 * u.deg
    assert seen["parallax"].tolist() == [100.0, 100.0]


def test_noise_of_parallaxes_is_not_applied(rng):
    n = 20_000
    true = rng.exponential(0.4, n)
    error = np.exp(rng.uniform(np.log(0.05), np.log(1.0), n))
    measured = true + error * rng.normal(size=n)
    error[0], measured[1] = np.nan, np.nan
    ra = 40.0 + np.arange(n) * 2e-6  # apart, or they would be one star
    table = Table({"ra": ra, "dec": np.full(n, 15.0), "parallax": measured})

    def shifts(parallax, error=None):
        table["parallax"] = parallax
        table["parallax_error"] = np.zeros(n) if error is None else error
        seen = propagate(read_catalog(table), 2016.3, parallax=True)
        return (np.asarray(seen["ra"]) - ra) * 3.6e6

    unit = shifts(np.ones(n))[0]
    applied = shifts(measured, error) / unit
    # An unknown error leaves the value, an unknown parallax the place.
    assert applied[0] == pytest.approx(measured[0], abs=1e-4)
    assert applied[1] == 0.0
    used = applied[2:]
    rms = np.sqrt(np.mean((used - true[2:]) ** 2))
    plain = np.sqrt(np.mean((measured[2:] - true[2:]) ** 2))
    significant = np.where(measured > 3 * error, measured, 0.0)[2:]
    assert rms < 0.31 < 0.8 * plain
    assert rms < 0.85 * np.sqrt(np.mean((significant - true[2:]) ** 2))
    assert rms < 0.6 * np.sqrt(np.mean(true**2))
    assert used.min() >= -1e-6
    # Near stars keep theirs; without errors all do, whatever their sign.
    assert shifts(np.full(n, 50.0), np.full(n, 0.5))[0] / unit == pytest.approx(50.0, rel=2e-4)
    assert shifts(np.full(n, -2.0))[0] / unit == pytest.approx(-2.0, rel=1e-4)


@pytest.mark.parametrize("epoch", [np.nan, np.inf])
def test_epoch_must_be_finite(epoch):
    with pytest.raises(ValueError, match="epoch must be a finite Julian year"):
        propagate(read_catalog(stars()), epoch)


@settings(deadline=None, max_examples=50)
@given(st.floats(0, 360), st.floats(-90, 90), st.floats(0, 180))
def test_cone_is_that_of_astropy(ra, dec, radius):
    rng = np.random.default_rng(1)
    catalog = read_catalog(
        Table(
            {
                "ra": rng.uniform(0, 360, 200),
                "dec": np.degrees(np.arcsin(rng.uniform(-1, 1, 200))),
            }
        )
    )
    selected = select_cone(catalog, ra, dec, radius)
    distance = SkyCoord(catalog["ra"], catalog["dec"], unit="deg").separation(
        SkyCoord(ra, dec, unit="deg")
    )
    clear = np.abs(distance.deg - radius) > 1e-9
    inside = np.isin(np.asarray(catalog["catalog_index"]), np.asarray(selected["catalog_index"]))
    assert np.array_equal(inside[clear], (distance.deg < radius)[clear])


def test_cone_has_its_rim_and_its_bounds():
    catalog = read_catalog(Table({"ra": [10.0], "dec": [0.0]}))
    assert len(select_cone(catalog, 10.0, 0.0, 0.0)) == 1
    for bad in (-1.0, np.nan):
        with pytest.raises(ValueError, match="radius >= 0"):
            select_cone(catalog, 10.0, 0.0, bad)


def test_gaia_dr2_of_the_wircam_field(shared_data):
    path = shared_data / "wircam" / "gaia_dr2.fits"
    catalog = read_catalog(path)
    assert len(catalog) == 49977
    assert "phot_g_mean_mag" not in catalog.colnames
    assert np.isnan(catalog["pmra"]).sum() == 5411
    assert set(np.asarray(catalog["ref_epoch"])) == {2015.5}
    raw = fits.getdata(path)
    np.testing.assert_array_equal(catalog["ra"], raw["ra"])
    # The positions at the epoch of the frame that the table of matches has been given by others.
    matched = Table.read(shared_data / "wircam" / "matched_NE_NW.ecsv.gz", format="ascii.ecsv")
    moved = propagate(catalog, 2011.5945)
    index = {s: i for i, s in enumerate(np.asarray(catalog["source_id"]))}
    rows = [index[g] for g in matched["gid"] if g in index]
    known = [g in index for g in matched["gid"]]
    assert len(rows) > 1000
    cosine = np.cos(np.radians(np.asarray(matched["dec"])[known]))
    offset = (np.asarray(moved["ra"])[rows] - np.asarray(matched["ra"])[known]) * cosine * 3.6e6
    moving = np.isfinite(np.asarray(catalog["pmra"])[rows])
    assert np.median(np.abs(offset[moving])) < 20.0


def cluster(rng, n=400, ra=150.0, dec=20.0):
    """Stars all over a tenth of a degree, with Gaia's columns."""
    table = Table({"source_id": np.arange(1, n + 1) * 7})
    table["ra"], table["dec"] = ra + rng.uniform(0, 0.1, n), dec + rng.uniform(0, 0.1, n)
    for name, value in (("ra_error", 0.2), ("dec_error", 0.2), ("pmra", 3.0), ("pmdec", -2.0)):
        table[name] = value
    table["ref_epoch"], table["phot_g_mean_mag"] = 2016.0, rng.uniform(14, 21, n)
    return table


class TestCopies:
    @pytest.mark.parametrize("share", [0.03, 0.5, 1.0])
    def test_by_identifier(self, rng, share):
        table = cluster(rng)
        again = table[rng.random(len(table)) < share]
        with pytest.warns(WPDCWarning, match=f"{len(again)} of {400 + len(again)} rows repeat"):
            catalog = read_catalog(vstack([table, again]))
        assert catalog["catalog_index"].tolist() == list(range(400))

    def test_by_errors(self, rng):
        table = cluster(rng)
        table.remove_column("source_id")
        again = table[:20].copy()
        again["ra"] += rng.normal(0, 0.2 / 3.6e6, 20)
        again["ra_error"] = 0.1
        with pytest.warns(WPDCWarning, match="20 of 420 rows repeat a star"):
            catalog = read_catalog(vstack([table, again]))
        # The more precise row of each star is kept.
        assert sorted(catalog["catalog_index"]) == list(range(20, 420))

    @pytest.mark.parametrize("with_magnitudes", [True, False])
    def test_beyond_errors(self, rng, with_magnitudes):
        table = cluster(rng)
        table.remove_column("source_id")
        again = table[rng.random(400) < 0.4]
        turn = rng.uniform(0, 2 * np.pi, len(again))
        again["ra"] += 0.05 / 3600 * np.cos(turn) / np.cos(np.radians(20))
        again["dec"] += 0.05 / 3600 * np.sin(turn)
        if with_magnitudes:
            again["phot_g_mean_mag"] += rng.normal(0, 0.02, len(again))
        else:
            table.remove_column("phot_g_mean_mag")
            again.remove_column("phot_g_mean_mag")
        with pytest.warns(WPDCWarning, match=r"rows repeat a star that another row has"):
            catalog = read_catalog(vstack([table, again]))
        # Without magnitudes, a star or two are as close to another one by chance.
        assert 400 - 2 * (not with_magnitudes) <= len(catalog) <= 400

    def test_at_another_epoch(self, rng):
        table = cluster(rng)
        table["pmra"] = 5000.0
        table.remove_column("source_id")
        again = propagate(read_catalog(table), 2020.0)[table.colnames]
        with pytest.warns(WPDCWarning, match="400 of 800 rows"):
            assert len(read_catalog(vstack([table, again]))) == 400

    def test_double_stars_are_two(self, rng):
        table = cluster(rng)
        other = table[:6].copy()
        other["source_id"] += 1
        other["dec"] += 0.2 / 3600
        other["phot_g_mean_mag"] += 0.3
        assert len(read_catalog(vstack([table, other]))) == 406

    def test_identifiers_that_tell_nothing_apart(self, rng):
        table = cluster(rng)
        table["source_id"] = 1
        assert len(read_catalog(table)) == 400


class TestWhatFilesBring:
    @pytest.mark.parametrize("word", ["null", "NULL", "", "--", "N/A", "nan", "bad", "-999"])
    @pytest.mark.parametrize("suffix", ["csv", "ecsv", "dat"])
    def test_missing_values(self, tmp_path, word, suffix):
        rows = f"ra,dec,pmra,pmdec,ref_epoch\n10.0,-5.0,{word},{word},2016.0\n10.1,-5.1,3,1,2016\n"
        head = ""
        if suffix == "ecsv":
            names = rows.split("\n")[0].split(",")
            head = "# %ECSV 1.0\n# ---\n# delimiter: ','\n# datatype:\n" + "".join(
                f"# - {{name: {name}, datatype: float64}}\n" for name in names
            )
        path = tmp_path / f"a.{suffix}"
        path.write_text(head + rows)
        catalog = read_catalog(path)
        assert catalog["ra"].tolist() == [10.0, 10.1]
        np.testing.assert_array_equal(catalog["pmra"], [np.nan, 3.0])

    @pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "latin-1"])
    @pytest.mark.parametrize("delimiter", [",", ";", "\t"])
    def test_encodings_and_delimiters(self, tmp_path, encoding, delimiter):
        text = "ra,dec,näme\n10.0,-5.0,é\n".replace(",", delimiter)
        (tmp_path / "a.csv").write_bytes(text.encode(encoding))
        assert read_catalog(tmp_path / "a.csv")["dec"][0] == -5.0

    def test_ecsv_in_a_compressed_csv(self, tmp_path):
        text = (
            "# %ECSV 1.0\n# ---\n# delimiter: ','\n# datatype:\n"
            "# - {name: ra, unit: rad, datatype: float64}\n"
            "# - {name: dec, unit: rad, datatype: float64}\nra,dec\n0.1,0.2\nnull,0.3\n"
        )
        (tmp_path / "GaiaSource_0.csv.gz").write_bytes(gzip.compress(text.encode()))
        catalog = read_catalog(tmp_path / "GaiaSource_0.csv.gz")
        assert catalog["ra"][0] == pytest.approx(np.degrees(0.1), rel=1e-14)
        assert len(catalog) == 1

    @pytest.mark.parametrize("sentinel", [-999.0, 1e20, -9999.0])
    def test_row_out_of_range(self, sentinel):
        table = Table({"ra": [10.0, sentinel, 10.2], "dec": [-5.0, sentinel, -5.2]})
        with pytest.warns(WPDCWarning, match="1 of 3 rows left out: 1 out of range"):
            assert read_catalog(table)["catalog_index"].tolist() == [0, 2]

    def test_cell_that_is_no_number(self):
        table = Table({"ra": ["10.0", "bad", "10.2"], "dec": [-5.0, -5.1, -5.2]})
        with pytest.warns(WPDCWarning, match="1 that cannot be read .'bad', '-5.1' in row 1"):
            assert read_catalog(table)["ra"].tolist() == [10.0, 10.2]

    def test_text_magnitudes(self):
        table = Table({"ra": [10.0, 11.0], "dec": [-5.0, 1.0], "mag": ["bright", "faint"]})
        with pytest.warns(WPDCWarning, match="column 'mag' must be numeric, got 'bright'"):
            assert "phot_g_mean_mag" not in read_catalog(table).colnames

    def test_magnitudes_that_stand_for_none(self):
        table = Table({"ra": [10.0, 11.0], "dec": [-5.0, 1.0], "mag": [99.0, 15.0]})
        np.testing.assert_array_equal(read_catalog(table)["phot_g_mean_mag"], [np.nan, 15.0])

    @pytest.mark.parametrize("form", ["{}:{:02d}:{:06.3f}", "{} {:02d} {:06.3f}"])
    def test_sexagesimal(self, form):
        table = Table(
            {"RAJ2000": [form.format(10, 30, 1.5)], "DEJ2000": ["-" + form.format(5, 6, 7)]}
        )
        catalog = read_catalog(table)
        assert catalog["ra"][0] == pytest.approx(15 * (10 + 30 / 60 + 1.5 / 3600), abs=1e-10)
        assert catalog["dec"][0] == pytest.approx(-(5 + 6 / 60 + 7 / 3600), abs=1e-10)

    def test_radians_by_density(self, rng):
        table = cluster(rng)["ra", "dec"]
        radians = Table({c: np.radians(table[c]) for c in ("ra", "dec")})
        with pytest.warns(WPDCWarning, match="no unit and are taken to be radians"):
            catalog = read_catalog(radians)
        np.testing.assert_allclose(catalog["ra"], table["ra"], rtol=1e-12)

    def test_degrees_near_the_origin(self, rng):
        table = cluster(rng, ra=1.5, dec=0.3)["ra", "dec"]
        assert read_catalog(table)["ra"][0] == table["ra"][0]
        table.rename_columns(["ra", "dec"], ["coord_ra", "coord_dec"])
        with pytest.raises(CatalogError, match="'coord_ra' and 'coord_dec' must have a unit"):
            read_catalog(table)

    def test_single_precision(self, rng):
        table = cluster(rng)
        table["ra"], table["dec"] = table["ra"].astype("f4"), table["dec"].astype("f4")
        with pytest.warns(WPDCWarning, match="single precision, which rounds them by up to 27 mas"):
            catalog = read_catalog(table)
        # The step of 150 deg is 2**-16 deg; its uniform distribution adds to the errors.
        assert catalog["ra_error"][0] == pytest.approx(3.6e6 / 2**16 / np.sqrt(12), rel=1e-3)

    def test_old_system(self):
        table = Table({"ra": [10.0], "dec": [20.0]}, meta={"RADESYS": "FK4"})
        expected = SkyCoord(10.0, 20.0, unit="deg", frame="fk4").icrs
        assert read_catalog(table)["ra"][0] == pytest.approx(expected.ra.deg, abs=1e-10)

    def test_column_of_coordinates(self, tmp_path):
        table = Table({"mag": [12.0]})
        table["sky"] = SkyCoord([10.0], [20.0], unit="deg")
        table.write(tmp_path / "a.ecsv")
        catalog = read_catalog(tmp_path / "a.ecsv")
        assert (catalog["ra"][0], catalog["phot_g_mean_mag"][0]) == (10.0, 12.0)

    @settings(deadline=None, max_examples=100, suppress_health_check=list(HealthCheck))
    @given(st.binary(max_size=300), st.sampled_from(["csv", "ecsv", "fits", "dat", "vot", "xml"]))
    def test_no_other_error_whatever_the_file(self, tmp_path, content, suffix):
        path = tmp_path / f"a.{suffix}"
        path.write_bytes(content)
        with contextlib.suppress(CatalogError), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            read_catalog(path)

    @settings(deadline=None, max_examples=100)
    @given(
        st.lists(
            st.sampled_from(["ra", "dec", "pmra", "mag", "ref_epoch", "source_id", "ra_error"]),
            unique=True,
        ),
        st.data(),
    )
    def test_no_other_error_whatever_the_columns(self, names, data):
        cells = st.one_of(
            st.floats(), st.integers(-(2**60), 2**60), st.text(max_size=8), st.none(), st.booleans()
        )
        table = Table()
        for name in names:
            table[name] = np.array(data.draw(st.lists(cells, min_size=3, max_size=3)), dtype=object)
        with contextlib.suppress(CatalogError), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            read_catalog(table)
