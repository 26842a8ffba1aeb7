"""Calibrations and solutions in all formats; truth is astropy.wcs and what was written."""

import itertools
import os
import warnings
from dataclasses import replace

import asdf
import numpy as np
import pytest
from astropy.coordinates import ICRS
from astropy.io import fits
from astropy.modeling import models
from astropy.table import Table
from astropy.wcs import WCS
from gwcs import WCS as GWCS
from gwcs import coordinate_frames as cf
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.polynomial import polynomial

from wpdc_gwcs import build_wcs
from wpdc_gwcs.exceptions import FileFormatError, InputError, WPDCWarning
from wpdc_gwcs.export import FORMAT_VERSION, FORMS, make_form
from wpdc_gwcs.io import OutputExistsError, read, read_wcs, write
from wpdc_gwcs.io.any_wcs import read_any
from wpdc_gwcs.io.asdf import _loaded
from wpdc_gwcs.io.integrity import content_sum
from wpdc_gwcs.lookup import ResidualMap
from wpdc_gwcs.models import LookupTable, PVPolynomial, project, pv_terms
from wpdc_gwcs.solution import Calibration, DistortionSolution


def make_calibration(
    *,
    n=2048,
    scale=0.3,
    roll=25.0,
    crval=(294.6, 35.1),
    amplitude=20.0,
    table="cubic",
    degree=3,
    seed=1,
    field=False,
):
    """A calibration with a distortion of some `amplitude` px and a table of some 0.1 px."""
    rng = np.random.default_rng(seed)
    nx, ny = n, n + 16
    px, angle = scale / 3600, np.radians(roll)
    cd = px * np.array([[-np.cos(angle), np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    terms = pv_terms(degree)
    total = terms.own + terms.other
    coefficients = rng.normal(size=(2, len(total))) * amplitude * px / (px * n / 2) ** total / 4
    coefficients[:, 1] += 1.0
    pv = PVPolynomial.from_coefficients(coefficients, degree=degree)
    x, y = np.linspace(-0.5, nx - 0.5, 12), np.linspace(-0.5, ny - 0.5, 13)
    dx, dy = rng.normal(size=(2, 13, 12)) * 0.1
    lookup_table = LookupTable(x, y, dx, dy, method=table) if table else None
    solution = DistortionSolution(
        detector="NE",
        image_shape=(ny, nx),
        crpix=np.array([(nx - 1) / 2 + 0.1, (ny - 1) / 2 - 0.2]),
        cd=cd,
        crval=np.array(crval, float),
        pv=pv,
        lookup_table=lookup_table,
        table_sigma=None if lookup_table is None else np.full((3, 13, 12), 0.01),
        residual_map=ResidualMap.from_residuals(
            *rng.uniform(0, n, (2, 50)),
            *rng.normal(size=(2, 50)),
            x_err=0.1,
            y_err=0.1,
            image_shape=(ny, nx),
        ),
        statistics={"n_stars": np.int64(50), "sigma": np.array([0.1, 0.2])},
        settings={"weight": "exp-sqrt", "r0": 4000.0, "lut": None},
        provenance={"time": "2026-01-01T00:00:00", "inputs": ("a.fits", "b.fits")},
    )
    turn = np.eye(2) + rng.normal(size=(2, 2)) * 1e-4
    return Calibration(
        frame="e00",
        solution=solution,
        crval=np.minimum(np.array(crval) + 0.001, [360.0, 90.0]),
        cd=turn @ cd,
        field=LookupTable(np.linspace(x[0], x[-1], 4), y[::4], *rng.normal(size=(2, 4, 4)) * 0.01)
        if field
        else None,
        sigma=rng.uniform(0.01, 0.02, (3, 17, 17)),
        color_shift=rng.normal(size=(2, 3)) * [0.01, 1e-6, 1e-6],
        reference_color=0.85,
        statistics={"rms_mas": np.float64(12.5)},
        settings={"refine": "attitude"},
        provenance={"frame": "e00.fits"},
    )


@pytest.fixture
def calibration():
    return make_calibration()


def grid(calibration, n=41):
    ny, nx = calibration.solution.image_shape
    x, y = np.meshgrid(np.linspace(-0.5, nx - 0.5, n), np.linspace(-0.5, ny - 0.5, n))
    return x.ravel(), y.ravel()


def distance(calibration, sky):
    """Greatest distance in px of other sky positions of the grid."""
    planes = [project(*s, calibration.crval) for s in (sky, calibration.wcs(*grid(calibration)))]
    return np.hypot(*np.linalg.solve(calibration.cd, np.subtract(*planes))).max()


def astropy_wcs(path, hdus=True):
    with warnings.catch_warnings(), fits.open(path) as opened:
        warnings.simplefilter("ignore")
        return WCS(opened[0].header, opened if hdus else None)


# --- ASDF ---------------------------------------------------------------------------------------


def test_calibration_asdf_round_trip(tmp_path, calibration):
    path = tmp_path / "e00.wcs.asdf"
    assert write(calibration, path) is None
    back = read(path)
    assert isinstance(back, Calibration)
    x, y = grid(calibration)
    np.testing.assert_array_equal(back.wcs(x, y), calibration.wcs(x, y))
    np.testing.assert_array_equal(back.cd, calibration.cd)
    np.testing.assert_array_equal(back.sigma, calibration.sigma)
    np.testing.assert_array_equal(back.color_shift, calibration.color_shift)
    assert back.reference_color == 0.85
    assert back.field is None
    assert back.frame == "e00"
    assert back.solution.detector == "NE"
    assert back.solution.image_shape == (2064, 2048)
    np.testing.assert_array_equal(
        back.solution.lookup_table.dx, calibration.solution.lookup_table.dx
    )
    np.testing.assert_array_equal(back.solution.table_sigma, calibration.solution.table_sigma)
    assert back.solution.residual_map is None  # the solution's own file has it
    assert back.statistics == {"rms_mas": 12.5}
    assert back.solution.settings == calibration.solution.settings
    assert back.solution.provenance["inputs"] == ("a.fits", "b.fits")
    assert os.listdir(tmp_path) == ["e00.wcs.asdf"]


@pytest.mark.parametrize("table", [None, "linear", "cubic"])
def test_field_of_the_exposure(tmp_path, table):
    """It is kept apart from the table of the instrument, and is in every WCS of the frame."""
    calibration = make_calibration(table=table, field=True)
    write(calibration, tmp_path / "a.wcs.asdf")
    back = read(tmp_path / "a.wcs.asdf")
    np.testing.assert_array_equal(back.field.dx, calibration.field.dx)
    assert (back.solution.lookup_table is None) == (table is None)
    x, y = grid(calibration)
    np.testing.assert_array_equal(back.wcs(x, y), calibration.wcs(x, y))
    plain = make_calibration(table=table)
    assert 0.01 < distance(calibration, plain.wcs(x, y)) < 0.1
    assert distance(calibration, read_wcs(tmp_path / "a.wcs.asdf")(x, y)) < 2e-4
    write(calibration, tmp_path / "a.fits")
    assert distance(calibration, read_wcs(tmp_path / "a.fits")(x, y)) < 2e-3


def test_solution_asdf_round_trip(tmp_path, calibration):
    path = tmp_path / "NE.solution.asdf"
    write(calibration.solution, path)
    back = read(path)
    assert isinstance(back, DistortionSolution)
    assert back.residual_map == calibration.solution.residual_map
    x, y = grid(calibration)
    np.testing.assert_array_equal(back.wcs(x, y), calibration.solution.wcs(x, y))
    # Merging goes on where it stopped.
    assert (back.residual_map + back.residual_map).n_stars == 100


@pytest.mark.parametrize("table", [None, "linear", "cubic"])
def test_stock_wcs_in_the_file(tmp_path, table):
    calibration = make_calibration(table=table)
    write(calibration, tmp_path / "a.wcs.asdf")
    with asdf.open(tmp_path / "a.wcs.asdf", lazy_load=False, memmap=False) as file:
        wcs = file["wcs"]
        assert type(wcs).__module__.startswith("gwcs.")
        # Nothing in the file needs this package: neither a tag nor a recorded extension.
        used = str(file.tree.get("history", {}))
    assert "wpdc" not in used
    text = (tmp_path / "a.wcs.asdf").read_bytes().split(b"\n...")[0].decode()
    assert not [line for line in text.splitlines() if "!" in line and "wpdc" in line.split("!")[1]]
    assert distance(calibration, wcs(*grid(calibration))) < 2e-4
    assert write(calibration, tmp_path / "stock.asdf", format="stock") < 2e-4
    stock = read_wcs(tmp_path / "stock.asdf")
    assert distance(calibration, stock(*grid(calibration))) < 2e-4
    with pytest.raises(FileFormatError, match="must have a 'wpdc' tree"):
        read(tmp_path / "stock.asdf")


@pytest.mark.parametrize("table", [None, "linear", "cubic"])
def test_files_satisfy_the_schemas_of_asdf(tmp_path, table):
    # Which are not looked at when our files are written, but whenever they are read.
    calibration = make_calibration(table=table)
    write(calibration, tmp_path / "a.wcs.asdf")
    write(calibration.solution, tmp_path / "a.solution.asdf")
    write(calibration, tmp_path / "a.stock.asdf", format="stock")
    with asdf.config_context() as config:
        config.validate_on_read = True
        for name in ("a.wcs.asdf", "a.solution.asdf", "a.stock.asdf"):
            with asdf.open(tmp_path / name) as file:
                file.validate()
        content = (tmp_path / "a.wcs.asdf").read_bytes()
        assert b"offset: -" in content
        (tmp_path / "b.asdf").write_bytes(content.replace(b"offset: -", b"offset: x", 1))
        with pytest.raises(asdf.ValidationError):
            asdf.open(tmp_path / "b.asdf")


@pytest.mark.parametrize("table", ["linear", "cubic"])
def test_the_stock_wcs_outlives_its_file(tmp_path, table):
    calibration = make_calibration(table=table)
    write(calibration, tmp_path / "a.wcs.asdf")
    with asdf.open(tmp_path / "a.wcs.asdf") as file:
        wcs = file["wcs"]
    sky = wcs(100.0, 200.0)
    assert np.hypot(*np.subtract(sky, calibration.wcs(100.0, 200.0))) < 1e-9
    assert np.allclose(wcs.invert(*sky), (100.0, 200.0), rtol=0, atol=1e-2)


def edited(path, tmp_path, edit):
    """A file with other values, and a sum that agrees with them."""
    with asdf.open(path, lazy_load=False, memmap=False) as file:
        tree = _loaded(file.tree["wpdc"])
        del tree["content_sum"]
        edit(tree)
        tree["content_sum"] = content_sum(tree)
        asdf.AsdfFile({"wpdc": tree}).write_to(tmp_path / "edited.asdf")
    return tmp_path / "edited.asdf"


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("format_version", "2.0.0", "must not be newer than 1.x, got 2.0.0"),
        ("format_version", "new", "must be like 1.2.0, got 'new'"),
        ("kind", "map", "must be 'solution', 'calibration' or 'camera', got 'map'"),
        ("cd", [[1.0, 2.0]], r"cd must have the shape \(2, 2\)"),
        ("cd", [[1e-4, 2e-4], [2e-4, 4e-4]], "cd must have an inverse"),
        ("cd", "none", "damaged 'wpdc' tree"),
        ("crval", [1.0, float("nan")], "crval must be finite"),
        ("crval", [1.0, 91.0], "crval must be RA and Dec"),
        ("sigma", [[1.0]], r"sigma must have the shape \(3, None, None\)"),
        ("solution", None, "damaged 'wpdc' tree"),
    ],
)
def test_bad_trees(tmp_path, calibration, key, value, message):
    write(calibration, tmp_path / "a.asdf")
    path = edited(tmp_path / "a.asdf", tmp_path, lambda tree: tree.update({key: value}))
    with pytest.raises(FileFormatError, match=f"edited.asdf.*{message}"):
        read(path)


@pytest.mark.parametrize("key", ["frame", "crval", "solution"])
def test_missing_entries(tmp_path, calibration, key):
    write(calibration, tmp_path / "a.asdf")
    path = edited(tmp_path / "a.asdf", tmp_path, lambda tree: tree.pop(key))
    with pytest.raises(FileFormatError, match=key):
        read(path)


def test_bad_table_in_a_tree(tmp_path, calibration):
    write(calibration, tmp_path / "a.asdf")

    def spoil(tree):
        tree["solution"]["lookup_table"]["dx"] = np.full((13, 12), np.nan)

    with pytest.raises(FileFormatError, match="dx must be finite"):
        read(edited(tmp_path / "a.asdf", tmp_path, spoil))


@pytest.mark.parametrize("part", [0.02, 0.3, 0.5, 0.8, 0.95, 0.999])
def test_truncated_asdf(tmp_path, calibration, part):
    write(calibration, tmp_path / "a.asdf")
    data = (tmp_path / "a.asdf").read_bytes()
    (tmp_path / "b.asdf").write_bytes(data[: int(len(data) * part)])
    with pytest.raises(FileFormatError, match=r"b.asdf: "):
        read(tmp_path / "b.asdf")


def test_a_small_file_with_blocks(tmp_path):
    """All of it fits into the buffer of a stream, below which asdf reads."""
    shift, scale = models.Shift(-5.0), models.Scale(1e-4)
    sky = models.Pix2Sky_TAN() | models.RotateNative2Celestial(1.0, 2.0, 180.0)
    frames = cf.Frame2D(name="detector"), cf.CelestialFrame(reference_frame=ICRS(), name="sky")
    wcs = GWCS([(frames[0], shift & shift | scale & scale | sky), (frames[1], None)])
    wcs.pixel_shape = (10, 10)
    tree = {"wcs": wcs, "more": np.arange(3.0)}
    asdf.AsdfFile(tree).write_to(tmp_path / "a.asdf")
    state = (tmp_path / "a.asdf").stat()
    assert state.st_size < getattr(state, "st_blksize", 8192)
    assert read_wcs(tmp_path / "a.asdf")(5.0, 5.0) == pytest.approx((1.0, 2.0))
    found = read_any(tmp_path / "a.asdf")
    assert found.wcs(5.0, 5.0) == pytest.approx((1.0, 2.0))


def test_no_asdf_of_ours(tmp_path):
    asdf.AsdfFile({"a": 1}).write_to(tmp_path / "a.asdf")
    with pytest.raises(FileFormatError, match="must have a 'wpdc' tree"):
        read(tmp_path / "a.asdf")
    with pytest.raises(FileFormatError, match="must have a 'wcs'"):
        read_wcs(tmp_path / "a.asdf")


def test_odd_values_are_refused_by_name(tmp_path, calibration):
    calibration = replace(calibration, settings={"filter": object()})
    with pytest.raises(TypeError, match=r"settings\['filter'\] must be made of plain values"):
        write(calibration, tmp_path / "a.asdf")
    assert os.listdir(tmp_path) == []


# --- FITS -------------------------------------------------------------------------------------


@pytest.mark.parametrize("table", [None, "linear", "cubic"])
@pytest.mark.parametrize("degree", [1, 3, 5])
def test_fits_round_trip(tmp_path, table, degree):
    calibration = make_calibration(table=table, degree=degree)
    path = tmp_path / "e00.fits"
    assert write(calibration, path) is None
    back = read(path)
    x, y = grid(calibration)
    np.testing.assert_array_equal(back.wcs(x, y), calibration.wcs(x, y))
    np.testing.assert_array_equal(read_wcs(path)(x, y), calibration.wcs(x, y))
    assert (back.frame, back.solution.detector) == ("e00", "NE")
    assert back.solution.image_shape == (2064, 2048)
    np.testing.assert_array_equal(back.solution.crval, calibration.solution.crval)


def test_fits_from_the_keywords_alone(tmp_path, calibration):
    """What another writer of the keywords would give: the attitude is in the polynomial."""
    write(calibration, tmp_path / "a.fits")
    with fits.open(tmp_path / "a.fits") as hdus:
        fits.HDUList([h for h in hdus if h.name != "WPDC_INSTRUMENT"]).writeto(
            tmp_path / "b.fits", checksum=True
        )
    back = read(tmp_path / "b.fits")
    assert distance(calibration, back.wcs(*grid(calibration))) < 1e-9
    np.testing.assert_array_equal(back.cd, back.solution.cd)
    np.testing.assert_array_equal(back.cd, calibration.cd)
    # Edited keywords count, not what the table of the instrument still says.
    with fits.open(tmp_path / "a.fits") as hdus:
        hdus[0].header["PV1_0"] += 1e-4
        hdus.writeto(tmp_path / "c.fits", checksum=True)
    assert distance(calibration, read(tmp_path / "c.fits").wcs(*grid(calibration))) > 1.0


def test_fits_table_is_as_the_paper_has_it(tmp_path, calibration):
    write(calibration, tmp_path / "a.fits")
    rows = Table.read(tmp_path / "a.fits", hdu="WPDC_LUT")
    table = calibration.solution.lookup_table
    assert rows.colnames == ["X_GRID", "Y_GRID", "DX_LUT", "DY_LUT"]
    assert len(rows) == 12 * 13
    assert rows["X_GRID"][0] == 0.5  # the outer edge of the first pixel, counted from one
    assert rows["X_GRID"][1] == table.x_grid[1] + 1
    np.testing.assert_array_equal(rows["DX_LUT"], table.dx.ravel())


def test_fits_header(tmp_path, calibration):
    write(calibration, tmp_path / "a.fits")
    header = fits.getheader(tmp_path / "a.fits")
    assert header["CTYPE1"], header["CTYPE2"] == ("RA---TPV", "DEC--TPV")
    assert (header["RADESYS"], header["CUNIT1"]) == ("ICRS", "deg")
    for i in (1, 2):
        for j in (1, 2):
            assert header[f"CD{i}_{j}"] == calibration.cd[i - 1, j - 1]  # all 17 digits
    history = "\n".join(header["HISTORY"])
    assert "wpdc_gwcs" in history
    assert "weight = exp-sqrt" in history
    assert "refine = attitude" in history
    # The PV part, for any reader of TPV.
    plain = make_calibration(table=None)
    got = astropy_wcs(tmp_path / "a.fits").all_pix2world(*grid(calibration), 0)
    assert distance(plain, got) < 1e-6


@settings(deadline=None, max_examples=15)
@given(
    st.floats(0, 360),
    st.floats(0, 360),
    st.sampled_from([-90.0, -89.9, -30.0, 0.0, 60.0, 89.99, 90.0]),
    st.integers(0, 1000),
    st.floats(0, 50),
)
def test_keywords_say_the_same_to_astropy(tmp_path_factory, roll, ra, dec, seed, amplitude):
    calibration = make_calibration(
        roll=roll, crval=(ra, dec), seed=seed, amplitude=amplitude, table=None
    )
    # A nominal pointing beyond the pole is none.
    crval = np.array([ra, dec])
    calibration = Calibration("a", calibration.solution, crval=crval, cd=calibration.cd)
    path = tmp_path_factory.mktemp("a") / "a.fits"
    write(calibration, path)
    assert distance(calibration, astropy_wcs(path).all_pix2world(*grid(calibration), 0)) < 1e-6
    assert distance(calibration, read(path).wcs(*grid(calibration))) < 1e-9


@pytest.mark.parametrize("crval", [(0.0001, 0.0), (120.0, 89.95), (200.0, -60.0)])
@pytest.mark.parametrize("table", [None, "linear", "cubic"])
def test_cpdis_is_what_plain_astropy_sees(tmp_path, crval, table):
    calibration = make_calibration(crval=crval, amplitude=100.0, table=table)
    worst = write(calibration, tmp_path / "a.fits", format="cpdis")
    assert worst < 1e-3
    rng = np.random.default_rng(0)
    ny, nx = calibration.solution.image_shape
    x, y = rng.uniform(-0.5, nx - 0.5, 20000), rng.uniform(-0.5, ny - 0.5, 20000)
    planes = [
        project(*sky, calibration.crval)
        for sky in (
            astropy_wcs(tmp_path / "a.fits").all_pix2world(x, y, 0),
            calibration.wcs(x, y),
        )
    ]
    error = np.hypot(*np.linalg.solve(calibration.cd, np.subtract(*planes))).max()
    assert error < 1.2 * worst + 1e-6
    assert f"{worst:.3g} px" in str(fits.getheader(tmp_path / "a.fits")["HISTORY"])
    # The way back is exact.
    for back in (read(tmp_path / "a.fits").wcs, read_wcs(tmp_path / "a.fits")):
        np.testing.assert_array_equal(back(x, y), calibration.wcs(x, y))


def test_cpdis_of_others_is_not_read_in_part(tmp_path, calibration):
    write(calibration, tmp_path / "a.fits", format="cpdis")
    with fits.open(tmp_path / "a.fits") as hdus:
        del hdus[0].header["WPDC*"]
        fits.HDUList([h for h in hdus if "WPDC" not in h.name]).writeto(tmp_path / "b.fits")
    with pytest.raises(FileFormatError, match="without foreign look-up tables"):
        read(tmp_path / "b.fits")
    starting = read_wcs(tmp_path / "b.fits")
    assert starting.cpdis1 is not None
    assert distance(calibration, starting.pixel_to_world_values(*grid(calibration))) < 1e-3
    with pytest.raises(FileFormatError, match="HDUList is required"):
        read_wcs(fits.getheader(tmp_path / "b.fits"))


@pytest.mark.parametrize("form", ["fits", "cpdis"])
def test_a_file_that_ends_between_two_hdus(tmp_path, calibration, form):
    """To FITS it is whole; without its tables the WCS would be another one."""
    write(calibration, tmp_path / "a.fits", format=form)
    content = (tmp_path / "a.fits").read_bytes()
    with fits.open(tmp_path / "a.fits") as hdus:
        ends = [hdu.fileinfo()["datLoc"] + hdu.fileinfo()["datSpan"] for hdu in hdus]
    assert ends[-1] == len(content)
    for end in ends[:-1]:
        # Zeros behind the end are what the standard calls special records.
        for rest in (b"", bytes(2880)):
            (tmp_path / "b.fits").write_bytes(content[:end] + rest)
            with pytest.raises(FileFormatError, match="b.fits: "):
                read(tmp_path / "b.fits")
    if form == "fits":
        fits.getheader(tmp_path / "a.fits").totextfile(tmp_path / "a.hdr")
        with pytest.raises(FileFormatError, match="tables WPDC_... that its keyword WPDCTAB"):
            read(tmp_path / "a.hdr")


def test_cpdis_says_when_it_cannot(tmp_path, monkeypatch, calibration):
    monkeypatch.setattr("wpdc_gwcs.export.cpdis._MOST_NODES", 10)
    with pytest.warns(WPDCWarning, match="cannot be made dense enough"):
        worst = write(calibration, tmp_path / "a.fits", format="cpdis")
    assert worst > 1e-3


def test_head_is_ascii_and_all_of_it(tmp_path, calibration):
    calibration = replace(calibration, settings={"observer": "Gärtner"})
    worst = write(calibration, tmp_path / "a.head")
    assert 0.05 < worst < 1.0  # a table as rough as noise
    text = (tmp_path / "a.head").read_bytes()
    assert text.isascii()
    lines = text.decode().splitlines()
    assert all(len(line) == 80 for line in lines)
    assert lines[-1].rstrip() == "END"
    found = distance(calibration, read(tmp_path / "a.head").wcs(*grid(calibration)))
    assert 0.9 * worst < found < 1.01 * worst
    # Without a table, the polynomial is what it was.
    plain = make_calibration(table=None)
    assert write(plain, tmp_path / "b.head") < 1e-6
    assert distance(plain, read(tmp_path / "b.head").wcs(*grid(plain))) < 1e-9


def smooth_calibration(degree, *, n=2048, amplitude=40.0, seed=3):
    """A cubic and a table that together are a polynomial of the given degree."""
    whole = make_calibration(n=n, degree=degree, amplitude=amplitude, table=None, seed=seed)
    solution = whole.solution
    ny, nx = solution.image_shape
    nodes = [np.linspace(-0.5, size - 0.5, 50) for size in (nx, ny)]
    x, y = np.meshgrid(*nodes)
    terms = pv_terms(3)
    cubic = PVPolynomial.from_coefficients(
        solution.pv.coefficients[:, : len(terms.index)], degree=3
    )
    offset = np.array([x.ravel(), y.ravel()]) - solution.crpix[:, None]
    u = solution.cd @ offset
    left = np.linalg.solve(solution.cd, np.subtract(cubic(*u), solution.pv(*u)))
    table = LookupTable(*nodes, *left.reshape(2, *x.shape))
    return replace(whole, solution=replace(solution, pv=cubic, lookup_table=table))


@pytest.mark.parametrize("form", ["tpv", "head"])
@pytest.mark.parametrize("degree", [5, 7])
def test_tpv_has_the_whole_mapping(tmp_path, form, degree):
    """A distortion that is a polynomial comes out as one, though it came as cubic and table."""
    calibration = smooth_calibration(degree)
    path = tmp_path / ("a.head" if form == "head" else "a.fits")
    worst = write(calibration, path, format=form)
    assert worst < (1e-3 if degree == 5 else 5e-3)  # what the spline of the table leaves
    header = read(path)
    assert header.solution.pv.degree == degree
    x, y = grid(calibration, 97)
    found = distance_at(calibration, header.wcs(x, y), x, y)
    assert found < 1.1 * worst + 1e-9
    # The cubic alone is off by pixels, and `fits` says so to those who do not read its table.
    made = make_form(calibration, "fits")
    assert made.deviation is None
    assert made.keywords_deviation > make_form(calibration, "tpv", degree=3).deviation > 1.0


def distance_at(calibration, sky, x, y):
    """Greatest distance in px of other sky positions of some pixels."""
    planes = [project(*s, calibration.crval) for s in (sky, calibration.wcs(x, y))]
    return np.hypot(*np.linalg.solve(calibration.cd, np.subtract(*planes))).max()


@pytest.mark.parametrize("form", ["tpv", "sip", "fits", "cpdis"])
def test_degree_is_as_asked_for(tmp_path, form):
    calibration = smooth_calibration(5, amplitude=10.0)
    worst = {n: write(calibration, tmp_path / f"{n}.fits", format=form, degree=n) for n in (3, 5)}
    header = fits.getheader(tmp_path / "5.fits")
    if form == "sip":
        assert header["A_ORDER"] == 5
    else:
        assert "PV1_22" in header
        assert "PV1_24" not in header
        assert "PV1_12" not in fits.getheader(tmp_path / "3.fits")
    assert worst[5] < 1e-3
    assert (worst[3] > 0.1) == (form in ("tpv", "sip"))
    if form in ("fits", "cpdis"):
        back = read(tmp_path / "5.fits").wcs(*grid(calibration))
        assert distance(calibration, back) < 1e-3
    for bad in (0, 10):
        with pytest.raises(ValueError, match=f"degree must be from .* got {bad}"):
            write(calibration, tmp_path / "b.fits", format=form, degree=bad)
    assert not (tmp_path / "b.fits").exists()


def test_degree_has_no_meaning_for_tables(tmp_path, calibration):
    for form in ("tab", "stock", "asdf"):
        with pytest.raises(ValueError, match="degree must be None"):
            write(calibration, tmp_path / "a", format=form, degree=3)


def test_reference_point_far_from_the_detector(tmp_path):
    """As in a mosaic: the powers about it are large and cancel."""
    calibration = make_calibration(amplitude=5.0, table="cubic")
    solution = replace(calibration.solution, crpix=np.array([-9000.0, 12000.0]))
    calibration = replace(calibration, solution=solution)
    worst = write(calibration, tmp_path / "a.fits", format="tpv")
    x, y = grid(calibration)
    found = distance_at(calibration, read(tmp_path / "a.fits").wcs(x, y), x, y)
    assert found < 1.05 * worst
    assert worst < 0.5


@pytest.mark.parametrize("crval", [(0.0001, 0.0), (200.0, -60.0)])
@pytest.mark.parametrize("table", [None, "cubic"])
def test_tab_is_what_wcslib_reads(tmp_path, crval, table):
    calibration = make_calibration(crval=crval, amplitude=100.0, table=table)
    worst = write(calibration, tmp_path / "a.fits", format="tab")
    assert worst < 1e-3
    wcs = astropy_wcs(tmp_path / "a.fits")
    rng = np.random.default_rng(0)
    ny, nx = calibration.solution.image_shape
    x, y = rng.uniform(-0.5, nx - 0.5, 20000), rng.uniform(-0.5, ny - 0.5, 20000)
    assert distance_at(calibration, wcs.all_pix2world(x, y, 0), x, y) < 1.1 * worst
    back = np.array(wcs.wcs_world2pix(*wcs.wcs_pix2world(x[:50], y[:50], 0), 0))
    np.testing.assert_allclose(back, [x[:50], y[:50]], atol=1e-4)


def test_tab_says_that_it_has_no_pole(tmp_path):
    calibration = make_calibration(n=256, crval=(10.0, 89.999), scale=3.0, table=None)
    with pytest.warns(WPDCWarning, match="readers deviate by up to"):
        assert write(calibration, tmp_path / "a.fits", format="tab") > 1.0


@pytest.mark.parametrize("form", ["tpv", "sip", "head"])
def test_headers_without_an_image_know_its_size(tmp_path, calibration, form):
    """Readers such as esutil, sip_tpv and wcstools want NAXIS1 and NAXIS2."""
    path = tmp_path / ("a.head" if form == "head" else "a.fits")
    write(calibration, path, format=form)
    if form == "head":
        header = fits.Header.fromtextfile(path)
    else:
        with fits.open(path, checksum=True) as hdus:  # warnings are errors
            hdus.verify("exception")
            header = hdus[0].header.copy()
            assert not hdus[0].data.any()
            assert header["DATASUM"] == "0"
        assert path.stat().st_size % 2880 == 0
    assert [header[k] for k in ("NAXIS", "NAXIS1", "NAXIS2", "WCSAXES")] == [2, 2048, 2064, 2]
    assert WCS(header).array_shape == (2064, 2048)
    assert read_wcs(path).array_shape == (2064, 2048)


def test_head_for_galsim(tmp_path):
    galsim = pytest.importorskip("galsim")
    calibration = make_calibration(table=None)
    write(calibration, tmp_path / "a.head")
    wcs = galsim.FitsWCS(str(tmp_path / "a.head"), text_file=True)
    x, y = grid(calibration)
    sky = np.degrees(wcs._radec(x + 1, y + 1))
    assert distance(calibration, sky) < 1e-6


def test_head_for_swarp(tmp_path, resample):
    """SWarp resamples an image of its own x (or y): every value says where it was taken from.

    It works in single precision: the ramp starts anew every few pixels.  And it inverts PV by a
    fit, hence the small distortion: at 5 px the fit is off by 6e-6 px at the corners.
    """
    period = 4
    calibration = make_calibration(n=512, table=None, amplitude=2.0)
    ny, nx = calibration.solution.image_shape
    deviations = []
    for axis in (0, 1):
        ramp = np.broadcast_to(np.arange(nx), (ny, nx)) if axis == 0 else np.arange(ny)[:, None]
        pixels = np.broadcast_to(ramp % period, (ny, nx)).astype(np.float32)
        fits.writeto(tmp_path / "a.fits", pixels, overwrite=True)
        write(calibration, tmp_path / "a.head", overwrite=True)
        values, sky = resample(tmp_path / "a.fits")
        place = np.array(calibration.wcs.invert(*sky))
        expected = place[axis] % period
        # Not between the last value of the ramp and the first, nor at the edge of the image.
        inside = (place > 20).all(axis=0) & (place < 490).all(axis=0) & (expected < period - 1)
        assert inside.sum() > 1e5
        deviations.append(np.abs(values - expected)[inside].max())
    assert max(deviations) < 1e-6


def test_sip(tmp_path):
    calibration = make_calibration(amplitude=50.0, table=None)
    worst = write(calibration, tmp_path / "a.fits", format="sip")
    assert worst < 1e-4
    wcs = astropy_wcs(tmp_path / "a.fits")
    assert wcs.wcs.ctype[0] == "RA---TAN-SIP"
    assert distance(calibration, wcs.all_pix2world(*grid(calibration), 0)) <= 1.01 * worst + 1e-6
    # The inverse polynomials are what viewers use.
    x, y = grid(calibration)
    origin = wcs.wcs.crpix[:, None] - 1
    u = np.array(wcs.wcs_world2pix(*calibration.wcs(x, y), 0)) - origin
    shift = [polynomial.polyval2d(*u, c) for c in (wcs.sip.ap, wcs.sip.bp)]
    assert np.hypot(*(u + shift + origin - [x, y])).max() < 0.05
    with pytest.raises(FileFormatError, match="must be TAN or TPV .*got 'RA---TAN-SIP'"):
        read(tmp_path / "a.fits")
    starting = read_wcs(tmp_path / "a.fits")
    assert distance(calibration, starting.pixel_to_world_values(x, y)) <= 1.01 * worst + 1e-6


def test_sip_tells_what_it_cannot(tmp_path, calibration):
    worst = write(calibration, tmp_path / "a.fits", format="sip")
    assert 1e-3 < worst < 0.5
    assert f"{worst:.3g} px" in "".join(fits.getheader(tmp_path / "a.fits")["HISTORY"])


def test_solution_stands_about_its_pointing(tmp_path, calibration):
    solution = calibration.solution
    write(solution, tmp_path / "a.fits")
    back = read(tmp_path / "a.fits")
    x, y = grid(calibration)
    np.testing.assert_array_equal(back.wcs(x, y), solution.wcs(x, y))
    assert write(solution, tmp_path / "b.fits", format="cpdis") < 1e-3


def spoiled_fits(tmp_path, calibration, edit):
    write(calibration, tmp_path / "a.fits", overwrite=True)
    with fits.open(tmp_path / "a.fits") as hdus:
        edit(hdus)
        hdus.writeto(tmp_path / "b.fits", overwrite=True, checksum=True)
    return tmp_path / "b.fits"


class TestBadFits:
    def test_unequal_spacing(self, tmp_path, calibration):
        def edit(hdus):
            x = hdus["WPDC_LUT"].data["X_GRID"]
            x[x == np.unique(x)[3]] += 1.0

        with pytest.raises(FileFormatError, match=r"b.fits\[WPDC_LUT\]: x_grid must be .*equally"):
            read(spoiled_fits(tmp_path, calibration, edit))

    def test_nan_nodes(self, tmp_path, calibration):
        def edit(hdus):
            hdus["WPDC_LUT"].data["DY_LUT"][5] = np.nan

        with pytest.raises(FileFormatError, match="dy must be finite at every node; 1"):
            read(spoiled_fits(tmp_path, calibration, edit))

    def test_incomplete_grid(self, tmp_path, calibration):
        def edit(hdus):
            hdus["WPDC_LUT"].data = hdus["WPDC_LUT"].data[:-1]

        with pytest.raises(FileFormatError, match="full grid.*got 155 rows"):
            read(spoiled_fits(tmp_path, calibration, edit))

    def test_shuffled_grid(self, tmp_path, calibration):
        def edit(hdus):
            hdus["WPDC_LUT"].data = hdus["WPDC_LUT"].data[::-1].copy()

        with pytest.raises(FileFormatError, match="x running fastest"):
            read(spoiled_fits(tmp_path, calibration, edit))

    def test_missing_column(self, tmp_path, calibration):
        def edit(hdus):
            hdus["WPDC_LUT"].columns.del_col("DX_LUT")

        with pytest.raises(FileFormatError, match="column DX_LUT is missing"):
            read(spoiled_fits(tmp_path, calibration, edit))

    def test_newer_version(self, tmp_path, calibration):
        def edit(hdus):
            hdus[0].header["WPDCVERS"] = "2.0"

        with pytest.raises(FileFormatError, match="must not be newer than 1.x, got 2.0"):
            read(spoiled_fits(tmp_path, calibration, edit))

    @pytest.mark.parametrize("part", [0.01, 0.2, 0.7, 0.9])
    def test_truncated(self, tmp_path, calibration, part):
        write(calibration, tmp_path / "a.fits")
        data = (tmp_path / "a.fits").read_bytes()
        (tmp_path / "b.fits").write_bytes(data[: int(len(data) * part)])
        with pytest.raises(FileFormatError, match=r"b.fits: truncated file"):
            read(tmp_path / "b.fits")

    def test_no_header(self, tmp_path):
        fits.writeto(tmp_path / "a.fits", np.zeros((2, 2)))
        with pytest.raises(FileFormatError, match="must hold a header with CTYPE1"):
            read(tmp_path / "a.fits")

    @pytest.mark.parametrize(
        ("cards", "message"),
        [
            ({"CRPIX1": 1e30}, "CRPIX must be within 1e.09 px, got 1e.30"),
            ({"CD1_1": 1e-4, "CD1_2": 0.0, "CD2_1": 0.0, "CD2_2": 1e-11}, "b.fits: .*(CD|cd)"),
            ({"PV1_1": 0.0, "PV2_1": 0.0}, "PV terms must not collapse all pixels to a line"),
            ({"PV1_1": 0.0, "PV2_1": 1.0}, "PV terms must not collapse all pixels to a line"),
        ],
    )
    @pytest.mark.parametrize("reader", [read, read_any])
    def test_what_is_no_wcs(self, tmp_path, reader, cards, message):
        header = fits.Header({"CTYPE1": "RA---TPV", "CTYPE2": "DEC--TPV"})
        for name, value in {"CRVAL": 10.0, "CRPIX": 5.0}.items():
            header[f"{name}1"] = header[f"{name}2"] = value
        header["CD1_1"] = header["CD2_2"] = 1e-4
        header.update(cards)
        fits.writeto(tmp_path / "b.fits", np.zeros((9, 9)), header)
        with pytest.raises(FileFormatError, match=message):
            reader(tmp_path / "b.fits")

    def test_several_headers(self, tmp_path, calibration):
        write(calibration, tmp_path / "a.fits", format="tpv")
        header = fits.getheader(tmp_path / "a.fits")
        images = [fits.ImageHDU(np.zeros((2, 2)), header, name=n) for n in ("A", "B")]
        fits.HDUList([fits.PrimaryHDU(), *images]).writeto(tmp_path / "b.fits")
        for reader in (read, read_wcs):
            with pytest.raises(FileFormatError, match="has 2 WCS headers; choose one"):
                reader(tmp_path / "b.fits")
        # The image says its own shape.
        assert read(f"{tmp_path / 'b.fits'}[B]").solution.image_shape == (2, 2)
        assert read_wcs(f"{tmp_path / 'b.fits'}[1]").pixel_shape == (2, 2)


# --- one way in, one way out --------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("no.asdf", None, "must be a readable file: No such file"),
        ("a.asdf", b"", "must not be empty"),
        ("a.fits", b"hello", "must begin with 'SIMPLE  ='"),
        ("a.head", b"hello\nworld\n", "must hold a header with CTYPE1"),
        ("a.fits.gz", b"\x1f\x8bxxxxxxxxx", "damaged gzip file"),
    ],
)
@pytest.mark.parametrize("reader", [read, read_wcs])
def test_unreadable(tmp_path, reader, name, content, message):
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(FileFormatError, match=f"{name}: .*{message}"):
        reader(tmp_path / name)


def test_format_by_ending_and_by_name(tmp_path, calibration):
    with pytest.raises(ValueError, match="format must be one of asdf, fits, .*got 'png'"):
        write(calibration, tmp_path / "a.asdf", format="png")
    with pytest.raises(ValueError, match="got None for .*a.xyz"):
        write(calibration, tmp_path / "a.xyz")
    with pytest.raises(TypeError, match="must be a Calibration or a DistortionSolution, got dict"):
        write({}, tmp_path / "a.fits")
    write(Table({"x": [1.0]}), tmp_path / "t.ecsv")
    with pytest.raises(ValueError, match="written as 'ecsv', got the format 'fits'"):
        write(Table({"x": [1.0]}), tmp_path / "t.fits")
    assert sorted(os.listdir(tmp_path)) == ["t.ecsv"]


@pytest.mark.parametrize("format", ["asdf", *FORMS, "stock"])
def test_existing_files_are_kept(tmp_path, calibration, format):
    path = tmp_path / "a.out"
    path.write_text("precious")
    with pytest.raises(OutputExistsError, match="a.out: file exists"):
        write(calibration, path, format=format)
    with pytest.raises(InputError):
        write(calibration, path, format=format)
    with pytest.raises(FileExistsError):
        write(calibration, path, format=format)
    assert path.read_text() == "precious"
    write(calibration, path, format=format, overwrite=True)
    assert path.read_bytes() != b"precious"
    assert os.listdir(tmp_path) == ["a.out"]


@pytest.mark.parametrize("format", ["asdf", "fits"])
@pytest.mark.parametrize("error", [KeyboardInterrupt, OSError("disk full")])
def test_nothing_is_left_of_a_write_that_fails(tmp_path, calibration, monkeypatch, format, error):
    (tmp_path / "a.out").write_text("precious")
    target = {"asdf": "asdf.AsdfFile.write_to", "fits": "astropy.io.fits.HDUList.writeto"}[format]

    def half(self, target, **options):
        if hasattr(target, "write"):
            target.write(b"half")
        else:
            target.write_bytes(b"half")
        raise error

    monkeypatch.setattr(target, half)
    raised = KeyboardInterrupt if error is KeyboardInterrupt else InputError
    with pytest.raises(raised):
        write(calibration, tmp_path / "a.out", format=format, overwrite=True)
    assert os.listdir(tmp_path) == ["a.out"]
    assert (tmp_path / "a.out").read_text() == "precious"


ODD_NAMES = ["run#2", "a?b", "a;b", "a%41", "a\tb", "a\nb", "~", " ", "é", "*"]


# What writes fits and asdf writes the others, for which fits take most of the time.
@pytest.mark.parametrize(
    ("format", "name"),
    [
        *itertools.product(["asdf", "fits", "head"], ODD_NAMES),
        *itertools.product(["cpdis", "sip", "stock"], ["run#2"]),
    ],
)
def test_names_are_names_and_nothing_else(tmp_path, calibration, format, name, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for other in ("run", "a", "aA"):
        (tmp_path / other).write_text("precious")
    before = set(os.listdir(tmp_path))
    for path in (f"{name}.out", os.path.join(name, "a.out")):
        os.makedirs(os.path.join(".", name), exist_ok=True)
        write(calibration, path, format=format)
        if format in ("asdf", "fits"):
            np.testing.assert_array_equal(read(path).cd, calibration.cd)
    assert set(os.listdir(tmp_path)) == before | {name, f"{name}.out"}
    assert os.listdir(tmp_path / name) == ["a.out"]
    assert all((tmp_path / other).read_text() == "precious" for other in ("run", "a", "aA"))


def test_a_flipped_bit_is_found_or_changes_nothing(tmp_path, calibration, rng):
    x, y = grid(calibration, n=9)
    for name in ("a.asdf", "a.fits"):
        write(calibration, tmp_path / name)
        data = (tmp_path / name).read_bytes()
        truth = read(tmp_path / name).wcs(x, y)
        found = 0
        for bit in rng.integers(8 * len(data), size=40):
            bad = bytearray(data)
            bad[bit // 8] ^= 1 << (bit % 8)
            (tmp_path / "b").write_bytes(bad)
            try:
                same = read(tmp_path / "b").wcs(x, y)
            except InputError:
                found += 1
            else:
                np.testing.assert_array_equal(same, truth)
        # How much of an ASDF file is read, and so checked, depends on the version of asdf.
        assert found > 0


def test_a_table_that_astropy_leaves_out_is_missed(tmp_path, calibration):
    write(calibration, tmp_path / "a.fits")
    data = (tmp_path / "a.fits").read_bytes()
    at = data.index(b"NAXIS1", data.index(b"XTENSION", data.index(b"XTENSION") + 80))
    (tmp_path / "b.fits").write_bytes(data[: at + 31] + bytes(129) + data[at + 160 :])
    with pytest.raises(FileFormatError, match=r"b.fits: damaged FITS file: HDU 2 cannot be read"):
        read(tmp_path / "b.fits")


def test_a_number_that_still_reads_as_one_is_found(tmp_path, calibration):
    write(calibration, tmp_path / "a.asdf")
    data = (tmp_path / "a.asdf").read_bytes()
    for old, new in [(b"294.6", b"294.5"), (b"lookup_table", b"lookup_tabel")]:
        assert old in data
        (tmp_path / "b.asdf").write_bytes(data.replace(old, new))
        # The schemas of the oldest asdf miss the name before the sum is compared.
        reason = "do not agree with their 'content_sum'|is a required property"
        with pytest.raises(FileFormatError, match=reason):
            read(tmp_path / "b.asdf")


@pytest.mark.parametrize("form", ["fits", "tpv", "cpdis"])
def test_a_digit_of_a_header_of_ours_is_found(tmp_path, calibration, form):
    write(calibration, tmp_path / "a.fits", format=form)
    data = (tmp_path / "a.fits").read_bytes()
    at = data.index(b".", data.index(b"CRVAL1")) + 3
    digit = b"1" if data[at : at + 1] != b"1" else b"2"
    (tmp_path / "b.fits").write_bytes(data[:at] + digit + data[at + 1 :])
    with pytest.raises(FileFormatError, match="HDU 0 must agree with its CHECKSUM and DATASUM"):
        read(tmp_path / "b.fits")


@pytest.mark.parametrize("keyword", ["WPDCVERS", "WPDCTAB"])
@pytest.mark.parametrize("form", ["fits", "cpdis"])
@pytest.mark.parametrize("reader", [read, read_any, read_wcs])
def test_damage_to_our_keywords_is_found(tmp_path, calibration, reader, form, keyword):
    """It would be a header of others, whose polynomial is all there is."""
    write(calibration, tmp_path / "a.fits", format=form)
    data = (tmp_path / "a.fits").read_bytes()
    at = data.index(f"{keyword:<8}=".encode())
    for k in (*range(len(keyword)), 8, 11):
        changed = bytes([data[at + k] ^ 1])
        (tmp_path / "b.fits").write_bytes(data[: at + k] + changed + data[at + k + 1 :])
        with pytest.raises(FileFormatError, match=r"b\.fits"):
            reader(tmp_path / "b.fits")


def test_a_later_minor_version_opens(tmp_path, calibration):
    def later(tree):
        tree |= {"format_version": "1.99.0", "news": [1, 2]}

    write(calibration, tmp_path / "a.asdf")
    back = read(edited(tmp_path / "a.asdf", tmp_path, later))
    np.testing.assert_array_equal(back.cd, calibration.cd)


@pytest.mark.parametrize(
    "tree",
    [
        "".join(f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]\n" for i in range(1, 12)),
        "a: &a [*a]\n",
        "a: [" + "0, " * 3_000_000 + "0]\n",
        "a: " + "[" * 5000 + "]" * 5000 + "\n",
        "- " * 5000 + "a\n",
        "a: [1, 2\n",
        "a: \x07\n",
    ],
    ids=["aliases", "itself", "long", "deep", "deep block", "open", "control character"],
)
def test_trees_that_stand_for_too_much(tmp_path, tree):
    head = "#ASDF 1.0.0\n#ASDF_STANDARD 1.6.0\n%YAML 1.1\n--- \n"
    first = "a0: &a0 [x]\n" if "a1:" in tree else ""
    (tmp_path / "a.asdf").write_text(f"{head}{first}{tree}...\n")
    with pytest.raises(FileFormatError, match=r"a.asdf: "):
        read(tmp_path / "a.asdf")


def test_blocks_that_stand_for_too_much(tmp_path):
    """A petabyte, compressed."""
    asdf.AsdfFile({"wpdc": np.zeros(1000)}).write_to(
        tmp_path / "a.asdf", all_array_compression="zlib"
    )
    data = bytearray((tmp_path / "a.asdf").read_bytes())
    at = data.index(b"\xd3BLK") + 6 + 8 + 16
    data[at : at + 8] = (1 << 50).to_bytes(8)
    (tmp_path / "a.asdf").write_bytes(data)
    with pytest.raises(FileFormatError, match="must hold at most 4 GB, hold 1048576.0"):
        read(tmp_path / "a.asdf")


def test_older_files_keep_opening():
    """A file of every released format version."""
    folder = os.path.join(os.path.dirname(__file__), "data")
    names = [n for n in sorted(os.listdir(folder)) if n.startswith("calibration-")]
    assert f"calibration-{FORMAT_VERSION}.asdf" in names
    for name in names:
        calibration = read(os.path.join(folder, name))
        x, y = grid(calibration, n=5)
        assert np.isfinite(calibration.wcs(x, y)).all()
        twin = build_wcs(
            crpix=calibration.solution.crpix,
            cd=calibration.cd,
            crval=calibration.crval,
            pv=calibration.solution.pv,
            pv_cd=calibration.solution.cd,
            lookup_table=calibration.lookup_table,
        )
        np.testing.assert_array_equal(twin(x, y), calibration.wcs(x, y))
        # Uncertainties came with version 1.1.0.
        known = calibration.uncertainty(x, y)[0]
        assert np.isfinite(known).all() != name.endswith("-1.0.0.asdf")
