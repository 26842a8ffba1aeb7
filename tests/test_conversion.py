"""Any WCS in; truth is the given WCS itself, point by point."""

import io
import re

import asdf
import numpy as np
import pytest
from astropy.coordinates import Galactic
from astropy.io import fits
from astropy.modeling.models import Mapping, Polynomial2D, Shift
from astropy.wcs import WCS
from gwcs import WCS as GWCS
from gwcs import coordinate_frames as cf
from test_io_formats import make_calibration
from test_wcs import camera_wcs

from wpdc_gwcs import Calibration, fit_wcs, read, write
from wpdc_gwcs.cli.app import run
from wpdc_gwcs.exceptions import InputError, WPDCWarning
from wpdc_gwcs.io.any_wcs import read_any
from wpdc_gwcs.models import project
from wpdc_gwcs.wcs import to_stock_wcs


def tan_wcs(*ctype, crval=(120.0, 30.0), scale=1e-4, shape=(300, 400)):
    wcs = WCS(naxis=2)
    wcs.wcs.ctype = ctype
    wcs.wcs.crval, wcs.wcs.cdelt = crval, [-scale, scale]
    wcs.wcs.crpix = [180.0, 120.0]
    wcs.array_shape = shape
    return wcs


def distance(calibration, given, n=5000):
    """Greatest distance from the given WCS at random pixels, px."""
    ny, nx = getattr(calibration, "solution", calibration).image_shape
    rng = np.random.default_rng(8)
    x, y = rng.uniform(0, nx - 1, n), rng.uniform(0, ny - 1, n)
    truth = given.pixel_to_world(x, y).icrs
    planes = [
        project(*sky, calibration.crval)
        for sky in ((truth.ra.deg, truth.dec.deg), calibration.wcs(x, y))
    ]
    return np.hypot(*np.linalg.solve(calibration.cd, np.subtract(*planes))).max()


def check(given, **options):
    calibration = fit_wcs(given, **options)
    assert isinstance(calibration, Calibration)
    worst = calibration.statistics["conversion_deviation"]
    assert worst < 1e-3
    assert distance(calibration, given) < 1.1 * worst + 1e-7
    return calibration


@pytest.mark.parametrize(
    "ctype",
    [
        ("RA---TAN", "DEC--TAN"),
        ("RA---ZEA", "DEC--ZEA"),
        ("DEC--SIN", "RA---SIN"),
        ("GLON-AIT", "GLAT-AIT"),
    ],
)
def test_projections_and_frames(ctype):
    crval = (30.0, 120.0) if ctype[0] == "DEC--SIN" else (120.0, 30.0)
    calibration = check(tan_wcs(*ctype, crval=crval))
    assert calibration.solution.image_shape == (300, 400)
    assert calibration.lookup_table is None


@pytest.mark.parametrize("crval", [(120.0, 30.0), (0.0, 89.99), (359.9, -45.0)])
def test_stock_gwcs(crval):
    given = camera_wcs(crval, 30.0)
    calibration = check(to_stock_wcs(given))
    assert calibration.lookup_table.dx.shape == (50, 50)
    assert calibration.solution.image_shape == given.array_shape


def test_gwcs_of_other_models_and_frame():
    """A pipeline as telescopes have it: degree 5, galactic, a box narrower than the image."""
    rng = np.random.default_rng(2)
    centered = Shift(-250.0) & Shift(-200.0)
    terms = {
        f"c{i}_{j}": rng.normal() * 250.0 ** (1 - i - j) * 0.02
        for i in range(6)
        for j in range(6 - i)
        if i + j > 1
    }
    sky = to_stock_wcs(camera_wcs((200.0, 10.0), table=None)).pipeline[1].transform
    model = (
        centered
        | (
            Mapping((0, 1, 0, 1))
            | Polynomial2D(5, c1_0=1.0, **terms) & Polynomial2D(5, c0_1=1.0, **terms)
        )
        | Shift(4607.5) & Shift(4615.5)
        | sky
    )
    given = GWCS(
        [
            (cf.Frame2D(name="detector"), model),
            (cf.CelestialFrame(reference_frame=Galactic(), name="sky"), None),
        ]
    )
    given.bounding_box = ((10.0, 489.0), (3.0, 400.0))
    given.pixel_shape = (500, 410)
    calibration = fit_wcs(given)
    assert given.bounding_box is not None
    assert calibration.statistics["conversion_deviation"] < 1e-3
    given.bounding_box = None
    assert distance(calibration, given) < 1e-3


@pytest.mark.parametrize("form", ["sip", "cpdis", "tab", "tpv"])
def test_astropy_wcs(form):
    source = make_calibration(amplitude=30.0)
    check(source.to_astropy_wcs(form))


def test_ast():
    ast = pytest.importorskip("starlink.Ast")
    source = make_calibration(table=None)
    channel = ast.FitsChan()
    for card in source.to_header().cards:
        channel.putfits(card.image, False)
    channel.clear("Card")
    frames = channel.read()
    calibration = fit_wcs(frames, image_shape=(2064, 2048))
    assert distance(calibration, source.wcs) < 1e-3


def test_what_is_not_smooth_is_told():
    given = camera_wcs(table="linear", shape=(900, 900), corner=200.0)
    jagged = given.get_transform("detector", "undistorted").lookup_table
    jagged.displacement = np.random.default_rng(0).normal(size=jagged.displacement.value.shape)
    with pytest.warns(WPDCWarning, match=r"the converted WCS deviates by up to 0\.\d+ px"):
        calibration = fit_wcs(given)
    worst = calibration.statistics["conversion_deviation"]
    assert 0.8 * worst < distance(calibration, given, 100_000) < 1.2 * worst


def test_what_is_refused():
    with pytest.raises(TypeError, match="shared interface of Astropy .* got int"):
        fit_wcs(5)
    with pytest.raises(ValueError, match="image_shape must be given"):
        fit_wcs(WCS(tan_wcs("RA---TAN", "DEC--TAN").to_header()))
    with pytest.raises(ValueError, match="two pixel axes and two of the sky, got 3 and 3"):
        fit_wcs(WCS(naxis=3), image_shape=(3, 3))
    with pytest.raises(ValueError, match="wcs must lead to the sky"):
        fit_wcs(WCS(naxis=2), image_shape=(3, 3))
    with pytest.raises(ValueError, match="must be two numbers of 2 or more"):
        fit_wcs(tan_wcs("RA---TAN", "DEC--TAN"), image_shape=(1, 3))
    with pytest.raises(ValueError, match="must have a value everywhere on the image.* at x"):
        fit_wcs(tan_wcs("RA---AIT", "DEC--AIT", crval=(0.0, 0.0), scale=1.0))


# --- files --------------------------------------------------------------------------------------


def files_with_a_wcs(folder):
    """Files of all kinds, each with the WCS that it holds."""
    source = make_calibration(n=256, amplitude=10.0)
    stock = to_stock_wcs(source.wcs)
    asdf.AsdfFile({"meta": {"deep": {"wcs": stock}}, "data": np.zeros(3)}).write_to(
        folder / "deep.asdf"
    )
    yield "deep.asdf", stock
    # As the pipeline of JWST has it: a tree in an extension.
    stream = io.BytesIO()
    asdf.AsdfFile({"meta": {"wcs": stock}}).write_to(stream)
    data = np.frombuffer(stream.getvalue(), np.uint8)
    column = fits.Column("ASDF_METADATA", f"{len(data)}B", array=data[np.newaxis])
    image = fits.ImageHDU(np.zeros((272, 256), np.uint8), source.to_header("sip"), name="SCI")
    tree = fits.BinTableHDU.from_columns([column], name="ASDF")
    fits.HDUList([fits.PrimaryHDU(), image, tree]).writeto(folder / "jwst.fits")
    yield "jwst.fits", stock
    yield "jwst.fits[SCI]", WCS(image.header)
    for form in ("fits", "cpdis", "tpv", "head", "sip", "tab", "asdf", "stock"):
        name = f"{form}.{'asdf' if form in ('asdf', 'stock') else 'x'}"
        write(source, folder / name, format=form)
        if form in ("head", "tpv", "sip"):
            given = WCS(source.to_header("sip" if form == "sip" else "tpv"))
        else:
            given = source.wcs
        yield name, given
    write(source.solution, folder / "a.solution.asdf")
    yield "a.solution.asdf", source.solution.wcs


def test_files(tmp_path, capsys):
    for name, given in files_with_a_wcs(tmp_path):
        found = read_any(tmp_path / name)
        assert distance(found, given) < 1.1e-3, name
        out = tmp_path / "out.asdf"
        command = ["convert", str(tmp_path / name), "--to", "asdf", "--output", str(out)]
        assert run([*command, "--overwrite"]) == 0, name
        said = capsys.readouterr().out
        assert re.search(r"out.asdf: read (exactly|to \S+ px), written as asdf$", said.strip())
        assert distance(read(out), given) < 1.1e-3, name


def test_size_where_the_file_does_not_tell(tmp_path, capsys):
    path, out = tmp_path / "a.hdr", tmp_path / "o.head"
    tan_wcs("RA---SIN", "DEC--SIN").to_header().totextfile(path)
    command = ["convert", str(path), "--to", "head", "--output", str(out)]
    assert run(command) == 2
    assert "a.hdr: the size of the image must be given" in capsys.readouterr().err
    assert run([*command, "--size", "400", "300"]) == 0
    assert fits.Header.fromtextfile(out)["NAXIS2"] == 300
    tan_wcs("RA---TAN", "DEC--TAN").to_header().totextfile(tmp_path / "b.hdr")
    command[1] = str(tmp_path / "b.hdr")
    assert run([*command, "--overwrite"]) == 2
    assert "b.hdr: the size of the image must be given" in capsys.readouterr().err
    assert run([*command, "--overwrite", "--size", "400", "300", "--degree", "1"]) == 0
    for wrong, message in (
        (["--to", "tnx"], "--to must be one of asdf, fits"),
        (["--size", "1", "300"], "--size must be two numbers of 2 or more, got 1 300"),
        (["--degree", "9", "--size", "9", "9"], "degree must be from 1 to 7 for TPV, got 9"),
    ):
        capsys.readouterr()
        assert run([*command, "--overwrite", *wrong]) == 2
        error = capsys.readouterr().err.strip()
        assert message in error
        assert "\n" not in error


def test_files_without_one_wcs(tmp_path):
    stock = to_stock_wcs(camera_wcs(table=None))
    asdf.AsdfFile({"a": {"wcs": stock}, "b": {"wcs": stock}}).write_to(tmp_path / "two.asdf")
    asdf.AsdfFile({"a": [1, {"b": 2}]}).write_to(tmp_path / "none.asdf")
    (tmp_path / "bad.asdf").write_bytes(b"#ASDF 1.0.0\n%YAML 1.1\n--- {[\n...\n")
    for name, message in (
        ("two.asdf", r"two.asdf: must have one WCS, has 2: a.wcs, b.wcs"),
        ("none.asdf", r"none.asdf: must have a WCS that gwcs can open"),
        ("bad.asdf", r"bad.asdf: "),
        ("two.asdf[1]", "only FITS and text files have extensions"),
        ("absent.fits", "must be a readable file"),
    ):
        with pytest.raises(InputError, match=message):
            read_any(tmp_path / name)
