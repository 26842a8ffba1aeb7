"""What `wpdc show` says and draws of any file; truth are the files that the tests write."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table

from wpdc_gwcs import calibrate, pictures, simulate, write
from wpdc_gwcs.cli.app import run
from wpdc_gwcs.cli.contents import contents_of
from wpdc_gwcs.cli.hints import hint_of
from wpdc_gwcs.io import read_truth, write_simulation
from wpdc_gwcs.io.files import stem_of


@pytest.fixture(scope="module")
def sky():
    return simulate(3, image_shape=(512, 512), density=60.0, distortion=5.0, seed=3)


@pytest.fixture(scope="module")
def folder(sky, tmp_path_factory):
    """A simulation, a run with failed frames in ``run``, and files of no use in ``odd``."""
    folder = tmp_path_factory.mktemp("show")
    write_simulation(sky, folder, images=(0,), sources="ldac")
    frames = [e.frame() for e in sky.exposures[1:]]
    few = frames[0].load_sources()[:4]
    bad = replace(frames[0], name="few-stars-of-a-long-name", load_sources=few.copy)
    calibrate([bad, *frames], sky.reference, output=folder / "run")
    odd = folder / "odd"
    (odd / "empty").mkdir(parents=True)
    texts = {
        "page.html": "<!DOCTYPE html>\n<html><table><tr><th>a<th>b<tr><td>1<td>2</table></html>",
        "xhtml.html": '<?xml version="1.0"?>\n<!DOCTYPE html>\n<html><body>no</body></html>',
        "a.json": '[{"x": 1}]',
        "t.txt": "hello world this is\nsome text nothing else\n",
        "one.txt": "just words\n",
        "broken.head": "CRPIX1 = garbage\n",
        "no-positions.csv": "a,b\n1,2\n3,4\n",
        "words.csv": "name,remark\na,b\n",
    }
    for name, text in texts.items():
        (odd / name).write_text(text, encoding="utf-8")
    Table({"a": [1.0, 2.0], "b": [3.0, 4.0]}).write(odd / "no-positions.fits")
    return folder


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("odd/page.html", "is an HTML page; open it in a browser"),
        ("odd/xhtml.html", "is an HTML page; open it in a browser"),
        ("run/manifest.json", "is a JSON file, the manifest of a run; try: wpdc show {folder}/run"),
        ("odd/a.json", "is a JSON file"),
        ("odd/t.txt", "is a text without columns"),
        ("odd/one.txt", "is a text without columns"),
        ("odd/words.csv", "is a text without columns"),
        ("odd/broken.head", "must hold a header with CTYPE1, CRVAL1, ...; found none"),
        ("odd/empty", "is an empty folder"),
    ],
)
def test_what_is_of_no_use_is_told_by_its_content(folder, capsys, name, words):
    assert run(["show", str(folder / name)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.endswith(words.format(folder=folder))


@pytest.mark.parametrize("name", ["odd/no-positions.fits", "odd/no-positions.csv"])
def test_a_table_without_positions(folder, name):
    lines = dict(contents_of(str(folder / name)).lines)
    assert lines["table"] == "2 rows"
    assert lines["columns"] == "a, b"


def test_a_hint_is_never_the_command_that_failed(folder, capsys):
    """Not in `wpdc show`, whatever it is given; elsewhere it is a good hint."""
    for path in sorted(folder.rglob("*")):
        run(["show", str(path)])
        assert f"try: wpdc show {path}" not in capsys.readouterr().err
    message = "a b.fits: must have an image, FITS_LDAC sources or a table with positions, has 1"
    assert hint_of(message, "calibrate") == "wpdc show 'a b.fits', which says what it is"
    assert hint_of(message, "show") is None


def test_the_truth_of_a_simulation(folder, sky, tmp_path):
    found = contents_of(str(folder / "truth.asdf"))
    lines = dict(found.lines)
    assert lines["frames"].startswith("3: 1 image, 2 lists")
    truth = read_truth(folder).frames["sim-01"]
    x, y = np.meshgrid(np.linspace(0, 511, 30), np.linspace(0, 511, 30))
    u, v = truth.distortion.undistort(x.ravel(), y.ravel())
    most = np.hypot(u - x.ravel(), v - y.ravel()).max()
    np.testing.assert_allclose(float(lines["sim"].split()[-2]), most, atol=0.05)
    (axes,) = found.draw().axes
    assert [text.get_text() for text in axes.texts][0] == "sim"
    assert axes.get_title(loc="left").endswith(f"at most {most:.3g} px")


def test_a_wcs_of_stock_models_and_no_picture_of_it(folder, tmp_path, capsys):
    from wpdc_gwcs import read

    calibration = read(next((folder / "run").glob("*.wcs.asdf")))
    write(calibration, tmp_path / "stock.asdf", format="stock")
    assert run(["show", str(tmp_path / "stock.asdf"), "--output", str(tmp_path / "a.png")]) == 2
    told = capsys.readouterr()
    ra, dec = calibration.wcs(255.5, 255.5)
    assert f"512 x 512 px about RA {ra:.5f} Dec {dec:.5f} deg" in told.out
    assert "there is no picture of such a file" in told.err


def test_a_folder_is_counted(folder, tmp_path):
    lines = dict(contents_of(str(folder)).lines)
    counts = lines["folder"].split(", ")
    assert set(counts) == {
        "1 image", "2 FITS_LDAC lists", "1 catalog", "3 truth tables", "2 folders", "truth.asdf",
    }  # fmt: skip
    assert "summary.ecsv" in lines["results"]
    for k in range(5):
        (tmp_path / f"{k}.log").write_text("words")
    (tmp_path / ".hidden").touch()
    shutil.copy(folder / "sim-01.fits", tmp_path / "sim-01.weight.fits")
    (tmp_path / "cut.fits").write_bytes((folder / "sim-01.fits").read_bytes()[:5000])
    lines = dict(contents_of(str(tmp_path)).lines)
    expected = {"1 weight map", "1 damaged FITS file", "5 other files"}
    assert set(lines["folder"].split(", ")) == expected


def test_texts_are_aligned_whatever_the_names(folder, capsys):
    assert run(["show", str(folder / "run")]) == 0
    lines = capsys.readouterr().out.splitlines()
    name = "few-stars-of-a-long-name"
    assert max(len(line.split("  ")[0]) for line in lines) > 20
    for line in lines:
        assert line[len(name)] == " "
        assert line[len(name) + 1] != " "


def test_failed_frames_have_no_place_on_the_axis_of_the_scatter(folder):
    summary = Table.read(folder / "run" / "summary.ecsv")
    failed = [k + 1 for k, status in enumerate(summary["status"]) if status == "failed"]
    (axes,) = pictures.draw_summary(summary).axes
    (points,) = axes.lines
    assert set(points.get_xdata()) == set(range(1, len(summary) + 1)) - set(failed)
    assert (points.get_ydata() > 0).all()
    assert points.get_ydata().max() < axes.get_ylim()[1]
    (across,) = axes.collections
    assert [segment[0, 0] for segment in across.get_segments()] == failed
    labels = [text.get_text() for text in axes.get_legend().get_texts()]
    assert labels == ["2 solved", "1 failed"]
    # Without any residuals there is no scale.
    (axes,) = pictures.draw_summary(summary[summary["status"] == "failed"]).axes
    assert not axes.lines
    assert len(axes.get_yticks()) == 0


def counts_in(axes):
    texts = [text.get_text() for text in axes.get_legend().get_texts()]
    return {text.split(" ", 1)[1]: int(text.split()[0]) for text in texts}


def test_the_counts_of_the_picture_are_those_of_a_run(folder, sky, tmp_path, capsys):
    """Faint, flagged and trailed sources are left out, as `wpdc explain` tells of the file."""
    path = tmp_path / "list.ldac"
    with fits.open(folder / "sim-02.ldac") as hdus:
        table = hdus["LDAC_OBJECTS"].data
        table["FLUXERR_AUTO"][:50] = table["FLUX_AUTO"][:50] / 4
        table["FLAGS"][60:67] = 4
        hdus.writeto(path)
    n = len(table)
    (axes,) = contents_of(str(path)).draw().axes
    assert counts_in(axes) == {"left out": 57, "used": n - 57}
    run(["explain", str(path), "--catalog", str(folder / "sim-reference.fits")])
    assert f"{n - 57} of {n} sources used" in capsys.readouterr().out
    # The same in a table.
    stars = Table({"x": [1.0, 2.0, 3.0], "y": [1.0, 2.0, 3.0], "snr": [5.0, 20.0, 30.0]})
    stars["flags"] = [0, 1, 0]
    write(stars, tmp_path / "stars.ecsv")
    found = contents_of(str(tmp_path / "stars.ecsv"))
    assert dict(found.lines)["sources"].startswith("2 of 3 sources left out: ")
    (axes,) = found.draw().axes
    assert counts_in(axes) == {"left out": 2, "used": 1}


def test_the_picture_of_a_catalog(tmp_path, capsys):
    rng = np.random.default_rng(1)
    path = tmp_path / "c.csv"
    stars = Table({"ra": 10 + rng.uniform(0, 0.001, 50), "dec": 20 + rng.uniform(0, 0.001, 50)})
    stars.write(path)
    assert run(["catalog", "info", str(path)]) == 0
    assert "with motion" not in capsys.readouterr().out
    figure = contents_of(str(path)).draw()
    (axes,) = figure.axes
    figure.canvas.draw()
    boxes = [label.get_window_extent() for label in axes.get_xticklabels() if label.get_text()]
    inside = sorted(
        (b for b in boxes if b.x1 > axes.bbox.x0 and b.x0 < axes.bbox.x1), key=lambda b: b.x0
    )
    assert len(inside) > 1
    assert all(one.x1 < other.x0 for one, other in zip(inside, inside[1:], strict=False))
    stars["phot_g_mean_mag"] = 15.0
    stars.write(path, overwrite=True)
    assert len(contents_of(str(path)).draw().axes) == 2
    run(["catalog", "info", str(path)])
    assert "with motion" in capsys.readouterr().out


def test_arrows_end_inside_the_axes(folder):
    """Those of a frame and those of a focal plane; the key is above them, and on the page."""
    frame = next((folder / "run").glob("*.wcs.asdf"))
    for path in (frame, folder / "truth.asdf"):
        figure = contents_of(str(path)).draw()
        figure.canvas.draw()
        axes = figure.axes[0]
        quiver = next(c for c in axes.collections if hasattr(c, "scale_units"))
        steps = np.column_stack([quiver.U, quiver.V]) / quiver.scale
        ends = quiver.get_offsets() + steps
        for at, (low, high) in zip(ends.T, (axes.get_xlim(), axes.get_ylim()), strict=True):
            assert low < at.min()
            assert at.max() < high
        key = next(a for a in axes.get_children() if type(a).__name__ == "QuiverKey")
        _, place = axes.transAxes.transform((key.X, key.Y))
        height = key.text.get_window_extent().height / 2
        assert axes.get_window_extent().y1 < place - height
        assert place + height < figure.bbox.height


def text_of(path):
    return "\n".join(" ".join(line) for line in contents_of(str(path)).lines)


def test_an_image_and_the_origin_of_its_wcs(folder, sky, tmp_path):
    from wpdc_gwcs import read
    from wpdc_gwcs.io.embed import write_into

    image, pixels = folder / "sim-01.fits", sky.exposures[0].render()
    scale = np.sqrt(abs(np.linalg.det(sky.exposures[0].linear_wcs.wcs.cd))) * 3600
    told = text_of(image)
    assert f"{scale:.3g} arcsec / px" in told
    assert f"{512 * scale / 60:.3g} arcmin x {512 * scale / 60:.3g} arcmin" in told
    assert "RA---TAN, DEC--TAN" in told
    assert "wpdc_gwcs" not in told
    calibration = read(next((folder / "run").glob("*.wcs.asdf")))
    write_into(calibration, image, form="tpv", output=tmp_path / "out.fits")
    told = text_of(tmp_path / "out.fits")
    assert "RA---TPV, DEC--TPV" in told
    assert "WCS by wpdc_gwcs" in told
    assert " as tpv, good to " in told
    # A detector without a name has none, instead of the word for it.
    header = sky.exposures[0].header.copy()
    assert "detector sim" in text_of(image)
    del header["DETECTOR"]
    fits.writeto(tmp_path / "unnamed.fits", pixels, header)
    assert "detector" not in text_of(tmp_path / "unnamed.fits")


def test_a_list_of_sources(folder, sky):
    told = text_of(folder / "sim-02.ldac")
    n = len(fits.getdata(folder / "sim-02.ldac", "LDAC_OBJECTS"))
    assert f"none of {n} sources left out by default" in told
    assert "columns used: x, y, x_err, y_err, flux, snr" in told


SEXTRACTOR = """\
#   1 NUMBER          Running object number
#   2 XWIN_IMAGE      Windowed position estimate along x    [pixel]
#   3 YWIN_IMAGE      Windowed position estimate along y    [pixel]
1 100.5 200.5
2 300.5 250.5
"""
DAOPHOT = """\
 NL    NX    NY  LOWBAD HIGHBAD  THRESH     AP1  PH/ADU  RNOISE    FRAD
  1  2048  4096   100.0 30000.0   10.00    3.00    2.00    3.00    4.00

     1   100.50   200.50   15.000   0.010
     2   300.50   250.50   16.000   0.010
"""


@pytest.mark.parametrize("text", [SEXTRACTOR, DAOPHOT])
def test_lists_of_other_programs(tmp_path, text):
    (tmp_path / "a.cat").write_text(text)
    found = contents_of(str(tmp_path / "a.cat"))
    lines = dict(found.lines)
    assert "of 2 sources" in lines["sources"]
    assert lines["first pixel"] == "1"
    assert found.draw().axes[0].has_data()


def test_weight_maps_and_masks_are_no_images_of_stars(folder, tmp_path):
    header = fits.getheader(folder / "sim-01.fits")
    weight = np.ones((512, 512), np.float32)
    weight[:128] = 0
    fits.writeto(tmp_path / "sim-01.weight.fits", weight, header)
    assert "image none beside it" in text_of(tmp_path / "sim-01.weight.fits")
    shutil.copy(folder / "sim-01.fits", tmp_path)
    fits.writeto(tmp_path / "bad_mask.fits", (weight == 0).astype(np.int16))
    told = text_of(tmp_path / "sim-01.weight.fits")
    assert "weight map of 512 x 512 px" in told
    assert "zero 25.0 % of the pixels" in told
    assert "image sim-01.fits, with which it is used" in told
    told = text_of(tmp_path / "bad_mask.fits")
    assert "mask of 512 x 512 px" in told
    assert "zero 75.0 %" in told
    figure = contents_of(str(tmp_path / "sim-01.weight.fits")).draw()
    np.testing.assert_array_equal(figure.axes[0].images[0].get_array(), weight)


def test_units_of_axes_are_in_brackets(folder):
    for name in ("run", "truth.asdf", "sim-02.ldac", "sim-reference.fits"):
        for axes in contents_of(str(folder / name)).draw().axes:
            assert "(" not in axes.get_xlabel() + axes.get_ylabel()


def test_the_fixtures_are_what_they_claim(folder):
    """A manifest is JSON whose first entry is the run, as its recognition assumes."""
    manifest = json.loads((folder / "run" / "manifest.json").read_text())
    assert next(iter(manifest)) == "run"
    assert stem_of("sim-01.weight.fits") == "sim-01.weight"
