"""Frames: images, source lists and tables, and every kind of input that is none."""

import contextlib
import gzip
import os
import pickle
import warnings

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table, vstack
from astropy.wcs import WCS
from astropy.wcs.utils import proj_plane_pixel_scales
from hypothesis import given, settings
from hypothesis import strategies as st

from wpdc_gwcs.exceptions import FrameError, InputError, WPDCWarning
from wpdc_gwcs.io import read_frames
from wpdc_gwcs.io.sources import standardize_sources


def tan_header(**cards):
    header = fits.Header()
    header["CTYPE1"], header["CTYPE2"] = "RA---TAN", "DEC--TAN"
    header["CRPIX1"], header["CRPIX2"] = 30.5, 20.5
    header["CRVAL1"], header["CRVAL2"] = 150.0, 2.0
    header["CD1_1"], header["CD1_2"] = -1e-4, 0.0
    header["CD2_1"], header["CD2_2"] = 0.0, 1e-4
    header.update(cards)
    return header


PIXELS = np.arange(40 * 60, dtype=np.int16).reshape(40, 60)


def write_image(path, data=PIXELS, **cards):
    fits.writeto(path, data, tan_header(**cards))
    return path


# --- images -------------------------------------------------------------------------------------


def test_image(tmp_path):
    cards = {
        "DETECTOR": "NE",
        "GAIN": 1.5,
        "SATURATE": 6e4,
        "FILTER": "J",
        "EXPTIME": 20.0,
        "MJD-OBS": 57388.5,
    }
    (frame,) = read_frames(write_image(tmp_path / "a.b.fits", **cards))
    assert (frame.name, frame.detector, frame.image_shape) == ("a.b", "NE", (40, 60))
    assert (frame.gain, frame.saturation) == (1.5, 6e4)
    assert frame.epoch == pytest.approx(2016.0, abs=1e-3)
    assert frame.source == str(tmp_path / "a.b.fits")
    assert frame.meta["filter"] == "J"
    image = frame.load_image()
    assert image.dtype == np.float32
    assert image.dtype.isnative
    np.testing.assert_array_equal(image, PIXELS)
    # One pixel is 1-based in the header and 0-based here.
    assert frame.wcs.pixel_to_world_values(29.5, 19.5) == pytest.approx((150.0, 2.0))
    # Frames travel to other processes.
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(frame)).load_image(), PIXELS)


@pytest.mark.parametrize("dtype", ["u1", "i2", "u2", "i4", "i8", "f4", "f8"])
@pytest.mark.parametrize("compressed", [None, "fz", "gz"])
def test_pixel_types(tmp_path, dtype, compressed):
    data = PIXELS.astype(dtype)
    if dtype == "u1":
        data = (PIXELS % 250).astype(dtype)
    path = tmp_path / f"a.fits{'.' + compressed if compressed else ''}"
    if compressed == "fz":
        if dtype == "i8":
            pytest.skip("no RICE for 64-bit integers")
        method = "GZIP_1" if dtype[0] == "f" else "RICE_1"
        options = {"quantize_level": 0} if dtype[0] == "f" else {}
        hdu = fits.CompImageHDU(data, tan_header(), compression_type=method, **options)
        fits.HDUList([fits.PrimaryHDU(), hdu]).writeto(path)
    else:
        write_image(path, data)
    (frame,) = read_frames(path)
    assert frame.name == "a"
    image = frame.load_image()
    assert image.dtype == (np.float32 if data.dtype.itemsize <= 2 or dtype == "f4" else np.float64)
    np.testing.assert_array_equal(image, data)


@pytest.mark.parametrize("scaled", [None, "unsigned", "float"])
def test_blank_pixels_are_nan(tmp_path, scaled):
    raw = PIXELS.copy()
    raw[3, 4] = -32768
    header = tan_header(BLANK=-32768)
    if scaled:
        header["BSCALE"], header["BZERO"] = (1.0, 32768.0) if scaled == "unsigned" else (0.5, 10.0)
    # Raw bytes, so that nothing is scaled on the way.
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        text = fits.Header(
            [("SIMPLE", True), ("BITPIX", 16), ("NAXIS", 2), ("NAXIS1", 60), ("NAXIS2", 40)]
        )
        text.extend(header, strip=False)
        body = raw.astype(">i2").tobytes()
        body += b"\0" * (-len(body) % 2880)
        (tmp_path / "a.fits").write_bytes(text.tostring().encode() + body)
    image = read_frames(tmp_path / "a.fits")[0].load_image()
    assert np.isnan(image[3, 4])
    assert np.isnan(image).sum() == 1
    scale, zero = (1.0, 32768.0) if scaled == "unsigned" else (0.5, 10.0) if scaled else (1, 0)
    assert image[0, 5] == 5 * scale + zero


def multi_extension(path, names=("A1", "B2"), primary=(), **cards):
    first = fits.PrimaryHDU()
    first.header.update(dict(primary))
    hdus = [first]
    for i, name in enumerate(names):
        image = fits.ImageHDU(PIXELS + i, tan_header(**cards), name=name)
        image.header["CRVAL1"] += 0.1 * i
        hdus.append(image)
    fits.HDUList(hdus).writeto(path)
    return path


def test_multi_extension(tmp_path):
    path = multi_extension(
        tmp_path / "m.fits", primary={"DATE-OBS": "2016-01-01T12:00:00", "FILTER": "g"}.items()
    )
    frames = read_frames(path)
    assert [f.name for f in frames] == ["m_A1", "m_B2"]
    assert [f.detector for f in frames] == ["A1", "B2"]
    assert [f.source for f in frames] == [f"{path}[1]", f"{path}[2]"]
    assert frames[1].epoch == pytest.approx(2016.0, abs=1e-4)
    assert frames[1].meta["filter"] == "g"
    np.testing.assert_array_equal(frames[1].load_image(), PIXELS + 1)
    assert frames[1].wcs.wcs.crval[0] == pytest.approx(150.1)
    for key in ("2", "B2", "b2"):
        (one,) = read_frames(f"{path}[{key}]")
        assert (one.name, one.detector) == ("m_B2", "B2")
        np.testing.assert_array_equal(one.load_image(), PIXELS + 1)


def test_detectors_of_one_file_differ(tmp_path):
    frames = read_frames(multi_extension(tmp_path / "m.fits", DETECTOR="CAM"))
    assert [f.detector for f in frames] == ["CAM_A1", "CAM_B2"]
    frames = read_frames(tmp_path / "m.fits", detector="X", name="n")
    assert [f.detector for f in frames] == ["X_A1", "X_B2"]
    assert [f.name for f in frames] == ["n_A1", "n_B2"]
    frames = read_frames(multi_extension(tmp_path / "s.fits", names=("SCI", "SCI")))
    assert len({f.name for f in frames}) == len({f.detector for f in frames}) == 2


def test_companions_are_no_frames(tmp_path):
    path = multi_extension(tmp_path / "m.fits", names=("SCI", "ERR", "DQ"))
    (frame,) = read_frames(path)
    assert frame.name == "m"
    assert len(read_frames(f"{path}[ERR]")) == 1


def test_extensions_without_wcs_are_left_out(tmp_path):
    path = multi_extension(tmp_path / "m.fits", names=("A", "B", "GUIDE"))
    with fits.open(path, mode="update") as hdus:
        del hdus[3].header["CTYPE1"]
    assert [f.name for f in read_frames(path)] == ["m_A", "m_B"]


def test_names_are_fit_for_files(tmp_path):
    frames = read_frames(multi_extension(tmp_path / "m.fits", names=("H2RG-#60/x", "b c")))
    assert [f.name for f in frames] == ["m_H2RG-_60_X", "m_B_C"]


def test_brackets_in_a_name(tmp_path):
    write_image(tmp_path / "a[1].fits")
    (tmp_path / "b[1]").write_bytes((tmp_path / "a[1].fits").read_bytes())
    assert len(read_frames(tmp_path / "b[1]")) == 1


@pytest.mark.parametrize(
    ("cards", "detector"),
    [
        ({"DETECTOR": "D1", "CCDNAME": "C1"}, "D1"),
        ({"CCDNAME": "C1", "CHIPID": 3}, "C1"),
        ({"CCDNUM": 7}, "7"),
        ({}, "detector"),
    ],
)
def test_detector_of_the_header(tmp_path, cards, detector):
    assert read_frames(write_image(tmp_path / "a.fits", **cards))[0].detector == detector
    assert read_frames(tmp_path / "a.fits", detector="X")[0].detector == "X"


def test_planes_of_one_cube_are_frames_of_their_own(tmp_path):
    header = tan_header(INSTRUME="X", EXPNUM=7)
    cube = np.stack([PIXELS, PIXELS + 1])
    hdus = [fits.PrimaryHDU(), fits.ImageHDU(cube, header, name="A1")]
    other = tan_header(INSTRUME="X", EXPNUM=7, CRVAL2=2.1)
    hdus.append(fits.ImageHDU(cube, other, name="B2"))
    fits.HDUList(hdus).writeto(tmp_path / "a.fits")
    fits.writeto(tmp_path / "b.fits", cube, header)
    fits.writeto(tmp_path / "c.fits", PIXELS, header)
    names = ("a.fits[A1][0]", "a.fits[A1][1]", "a.fits[A1][L]", "a.fits[2][0]", "b.fits[0][1]")
    frames = [read_frames(f"{tmp_path}/{name}")[0] for name in (*names, "c.fits[0][0]")]
    found = [frame.name for frame in frames]
    assert found == ["a_A1_p0", "a_A1_p1", "a_A1_pL", "a_B2_p0", "b_p1", "c"]
    np.testing.assert_array_equal(frames[1].load_image(), PIXELS + 1)
    # One detector is not twice in an exposure.
    assert len({frame.exposure for frame in frames[:3]}) == 3
    assert frames[0].exposure == frames[3].exposure


def test_cube_of_one_plane(tmp_path):
    write_image(tmp_path / "a.fits", PIXELS[None])
    (frame,) = read_frames(tmp_path / "a.fits")
    assert frame.load_image().shape == (40, 60)


def test_other_wcs(tmp_path):
    write_image(tmp_path / "a.fits")
    header = tan_header(CRVAL1=10.0)
    (tmp_path / "a.head").write_text("\n".join([c.image for c in header.cards] + ["END"]))
    for wcs in (tmp_path / "a.head", header, str(tmp_path / "a.head")):
        (frame,) = read_frames(tmp_path / "a.fits", wcs=wcs)
        assert frame.wcs.wcs.crval[0] == 10.0
    # One header for each extension, as SCAMP writes them.
    path = multi_extension(tmp_path / "m.fits")
    (tmp_path / "m.head").write_text(2 * (tmp_path / "a.head").read_text().rstrip() + "\n")
    text = (tmp_path / "a.head").read_text()
    (tmp_path / "m.head").write_text(text + "\n" + text.replace("10.0", "20.0") + "\n")
    frames = read_frames(path, wcs=tmp_path / "m.head")
    assert [f.wcs.wcs.crval[0] for f in frames] == [10.0, 20.0]
    with pytest.raises(FrameError, match="which cannot share one WCS header"):
        read_frames(path, wcs=tmp_path / "a.head")
    with pytest.raises(FrameError, match="must have one WCS header for each of the 1 frames"):
        read_frames(tmp_path / "a.fits", wcs=tmp_path / "m.head")
    with pytest.raises(FrameError, match="none.head: must be a readable file"):
        read_frames(tmp_path / "a.fits", wcs=tmp_path / "none.head")


def test_distorted_headers_are_starting_wcs(tmp_path):
    cards = {f"PV{i}_{j}": float(j == 1) for i in (1, 2) for j in (0, 1, 2, 4, 5, 6, 7, 8, 9, 10)}
    cards |= {"CTYPE1": "RA---TPV", "CTYPE2": "DEC--TPV", "PV1_4": 0.5}
    (frame,) = read_frames(write_image(tmp_path / "a.fits", **cards))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        expected = WCS(fits.getheader(tmp_path / "a.fits")).all_pix2world(3.0, 4.0, 0)
    np.testing.assert_allclose(frame.wcs.pixel_to_world_values(3.0, 4.0), expected, rtol=1e-13)
    cards = {"CTYPE1": "RA---TAN-SIP", "CTYPE2": "DEC--TAN-SIP", "A_ORDER": 2, "B_ORDER": 2}
    write_image(tmp_path / "b.fits", **cards, A_2_0=1e-3)
    assert read_frames(tmp_path / "b.fits")[0].wcs.sip is not None


def test_odd_dates_warn(tmp_path):
    write_image(tmp_path / "a.fits", **{"DATE-OBS": "yesterday"})
    with pytest.warns(WPDCWarning, match="a.fits: dates that make no sense.*yesterday"):
        (frame,) = read_frames(tmp_path / "a.fits")
    assert frame.epoch is None


# --- FITS_LDAC ----------------------------------------------------------------------------------


def sextractor_columns(n=30, seed=0, **extra):
    rng = np.random.default_rng(seed)
    return {
        "XWIN_IMAGE": rng.uniform(1, 60, n),
        "YWIN_IMAGE": rng.uniform(1, 40, n),
        "X_IMAGE": rng.uniform(1, 60, n),
        "Y_IMAGE": rng.uniform(1, 40, n),
        "ERRAWIN_IMAGE": np.full(n, 0.04),
        "ERRBWIN_IMAGE": np.full(n, 0.02),
        "ERRTHETAWIN_IMAGE": np.full(n, 90.0),
        "FLUX_AUTO": rng.uniform(100, 1000, n),
        "FLUXERR_AUTO": np.full(n, 5.0),
        "FLAGS": np.zeros(n, np.int16),
        "ELONGATION": np.full(n, 1.1),
        "FLUX_RADIUS": np.full(n, 1.5),
        **extra,
    }


def ldac_hdus(header, columns, pad=b"\0"):
    cards = [("SIMPLE", True), ("BITPIX", 16), ("NAXIS", 2), ("NAXIS1", 60), ("NAXIS2", 40)]
    full = fits.Header(cards)
    full.extend(header)
    text = "".join(card.image for card in full.cards).encode() + b"END".ljust(80, pad)
    array = np.frombuffer(text, f"S{len(text)}")
    head = fits.BinTableHDU.from_columns(
        [fits.Column("Field Header Card", f"{len(text)}A", array=array)], name="LDAC_IMHEAD"
    )
    head.header["TDIM1"] = f"(80, {len(text) // 80})"
    forms = {"i": "I", "f": "D"}
    objects = fits.BinTableHDU.from_columns(
        [
            fits.Column(
                name,
                (f"{v.shape[1]}" if v.ndim == 2 else "1") + forms[v.dtype.kind],
                array=v,
            )
            for name, v in columns.items()
        ],
        name="LDAC_OBJECTS",
    )
    return [head, objects]


def write_ldac(path, *detectors, pad=b"\0"):
    hdus = [fits.PrimaryHDU()]
    for header, columns in detectors:
        hdus += ldac_hdus(header, columns, pad)
    fits.HDUList(hdus).writeto(path)
    return path


@pytest.mark.parametrize("pad", [b"\0", b" "])
def test_ldac(tmp_path, pad):
    columns = sextractor_columns()
    header = tan_header(**{"DETECTOR": "NE", "DATE-OBS": "2016-01-01T12:00:00"})
    (frame,) = read_frames(write_ldac(tmp_path / "e00.cat", (header, columns), pad=pad))
    assert (frame.name, frame.detector, frame.image_shape) == ("e00", "NE", (40, 60))
    assert frame.load_image is None
    assert frame.epoch == pytest.approx(2016.0, abs=1e-4)
    sources = pickle.loads(pickle.dumps(frame)).load_sources()
    np.testing.assert_array_equal(sources["x"], columns["XWIN_IMAGE"] - 1)
    np.testing.assert_allclose(sources["x_err"], 0.02)  # the long axis stands upright
    np.testing.assert_allclose(sources["y_err"], 0.04)
    np.testing.assert_allclose(sources["snr"], columns["FLUX_AUTO"] / 5.0)
    np.testing.assert_allclose(sources["roundness"], 0.2 / 2.1)
    np.testing.assert_allclose(sources["fwhm"], 3.0)
    assert frame.wcs.wcs.crval[0] == 150.0


def test_ldac_of_several_detectors(tmp_path):
    detectors = [
        (tan_header(EXTNAME=f"C{i}", CRVAL1=150.0 + i), sextractor_columns(seed=i))
        for i in range(3)
    ]
    path = write_ldac(tmp_path / "m.cat", *detectors)
    frames = read_frames(path)
    assert [f.name for f in frames] == ["m_C0", "m_C1", "m_C2"]
    assert [f.wcs.wcs.crval[0] for f in frames] == [150.0, 151.0, 152.0]
    np.testing.assert_array_equal(frames[2].load_sources()["x"], detectors[2][1]["XWIN_IMAGE"] - 1)
    assert read_frames(f"{path}[4]")[0].name == "m_C1"


def test_latin1_in_the_header_of_a_list(tmp_path):
    write_ldac(tmp_path / "a.cat", (tan_header(OBSERVER="Gartner"), sextractor_columns()))
    data = (tmp_path / "a.cat").read_bytes()
    (tmp_path / "a.cat").write_bytes(data.replace(b"Gartner", "Gärtner".encode("latin-1")))
    assert read_frames(tmp_path / "a.cat")[0].wcs.wcs.crval[1] == 2.0


# --- camera and exposure ------------------------------------------------------------------------


def keys_of(path, **options):
    return [(f.camera, f.exposure) for f in read_frames(path, **options)]


NOON = "2016-01-01T12:00:00."


@pytest.mark.parametrize(
    ("cards", "camera", "exposure"),
    [
        ({"INSTRUME": "Suprime-Cam", "EXPNUM": 17}, "SUPRIMECAM", "17"),
        ({"INSTRUME": "SUPRIMECAM ", "TELESCOP": "Subaru", "OBSID": "a.1"}, "SUPRIMECAM", "a.1"),
        ({"TELESCOP": "Bok 2.3m", "DATE-OBS": "2016-01-01T12:00:00"}, "BOK23M", f"{NOON}000"),
        ({"INSTRUME": "C", "DATE-OBS": "2016-01-01", "UT": "12:00:00.5"}, "C", f"{NOON}500"),
        ({"INSTRUME": "C", "MJD-OBS": 57388.5}, "C", f"{NOON}000"),
        # many exposures of a night share the day, and no detail of a placeholder
        ({"INSTRUME": "C", "DATE-OBS": "2016-01-01", "MJD-OBS": 57388.0}, "C", None),
        ({"INSTRUME": "C", "EXPNUM": 0, "OBSID": "unknown"}, "C", None),
        ({"EXPNUM": 17, "DATE-OBS": "2016-01-01T12:00:00"}, None, None),
    ],
)
def test_camera_and_exposure(tmp_path, cards, camera, exposure):
    path = write_image(tmp_path / "a.fits", **cards)
    assert keys_of(path) == [(camera, exposure)]
    assert keys_of(path, camera=False) == [(None, None)]


def test_keyword_of_the_exposure(tmp_path):
    path = write_image(tmp_path / "a.fits", INSTRUME="C", EXPNUM=17, VISIT="v3")
    assert keys_of(path, exposure_keyword="VISIT") == [("C", "v3")]
    with pytest.raises(FrameError, match=r"a\.fits: the header must have the keyword 'SHOT'"):
        read_frames(path, exposure_keyword="SHOT")
    path = write_image(tmp_path / "b.fits", VISIT="v3")
    assert keys_of(path, exposure_keyword="VISIT") == [("camera", "v3")]


def test_detectors_of_one_file_are_one_exposure(tmp_path):
    path = multi_extension(tmp_path / "m.fits")
    assert keys_of(path) == [("camera", str(path))] * 2 == keys_of(f"{path}[1]") * 2
    path = multi_extension(tmp_path / "n.fits", primary={"INSTRUME": "C", "EXPNUM": 4})
    assert keys_of(path) == [("C", "4")] * 2 == keys_of(f"{path}[1]") * 2
    # each detector may write its own time, but not its own number
    times = [f"2016-01-01T12:00:00.{i}" for i in range(2)]
    for name, cards, exposures in (
        ("t", [{"DATE-OBS": t} for t in times], [str(tmp_path / "t.cat")] * 2),
        ("e", [{"EXPNUM": n} for n in (1, 2)], ["1", "2"]),
    ):
        lists = [
            (tan_header(EXTNAME=f"C{i}", INSTRUME="C", **c), sextractor_columns())
            for i, c in enumerate(cards)
        ]
        path = write_ldac(tmp_path / f"{name}.cat", *lists)
        assert keys_of(path) == [("C", e) for e in exposures]


def test_table_of_sources_has_the_keys_of_its_header(tmp_path):
    Table({"x": [1.0, 50.0], "y": [1.0, 30.0]}).write(tmp_path / "s.ecsv")
    header = tan_header(INSTRUME="C", EXPNUM=5, NAXIS1=60, NAXIS2=40)
    header.totextfile(tmp_path / "w.head")
    assert keys_of(tmp_path / "s.ecsv", wcs=tmp_path / "w.head") == [("C", "5")]
    keys = keys_of(tmp_path / "s.ecsv", wcs=tmp_path / "w.head", camera=False)
    assert keys == [(None, None)]


# --- columns ------------------------------------------------------------------------------------


def test_psf_positions_when_they_have_errors():
    columns = sextractor_columns()
    psf = {"XPSF_IMAGE": columns["X_IMAGE"] + 5, "YPSF_IMAGE": columns["Y_IMAGE"] + 5}
    psf |= {"FLUX_PSF": columns["FLUX_AUTO"] * 2, "FLUXERR_PSF": np.full(30, 2.0)}
    sources = standardize_sources(columns | psf)
    np.testing.assert_array_equal(sources["x"], columns["XWIN_IMAGE"] - 1)
    np.testing.assert_array_equal(sources["flux"], columns["FLUX_AUTO"])
    errors = {f"ERR{a}PSF_IMAGE": np.full(30, 0.01) for a in "AB"}
    sources = standardize_sources(columns | psf | errors)
    np.testing.assert_array_equal(sources["x"], psf["XPSF_IMAGE"] - 1)
    np.testing.assert_array_equal(sources["flux"], psf["FLUX_PSF"])
    np.testing.assert_allclose(sources["snr"], columns["FLUX_AUTO"])
    np.testing.assert_allclose(sources["y_err"], 0.01)


def test_isophotal_positions_as_a_last_resort():
    columns = {"X_IMAGE": np.array([1.0]), "Y_IMAGE": np.array([2.0])}
    columns |= {"ERRX2_IMAGE": np.array([0.04]), "ERRY2_IMAGE": np.array([0.09])}
    columns |= {"MAG_AUTO": np.array([25.0])}
    sources = standardize_sources(columns)
    assert sources["x"][0] == 0.0
    assert (sources["x_err"][0], sources["y_err"][0]) == pytest.approx((0.2, 0.3))
    assert sources["flux"][0] == pytest.approx(1.0)
    assert "snr" not in sources.colnames


def test_native_columns_pass():
    table = Table(
        {
            "x": [1.0, np.nan],
            "y": [2.0, 3.0],
            "x_err": [0.1, 0.0],
            "y_err": [0.1, 0.2],
            "flux": [10.0, 20.0],
            "snr": [3.0, 4.0],
            "roundness": [-0.1, 0.2],
            "flags": [0, 3],
            "sharpness": [0.5, 0.6],
            "peak": [1.0, 2.0],
        }
    )
    sources = standardize_sources(table)
    assert len(sources) == 2  # rows stay, so that their numbers do
    assert sources["flags"].tolist() == [0, 3]
    assert sources["roundness"].tolist() == [-0.1, 0.2]
    assert np.isnan(sources["x_err"][1])
    masked = Table(table, masked=True)
    masked["flux"].mask[0] = True
    assert np.isnan(standardize_sources(masked)["flux"][0])


def test_flags_of_sextractor():
    from wpdc_gwcs import detection as d

    columns = sextractor_columns(n=6)
    columns["FLAGS"] = np.array([0, 1, 2, 4, 8, 64], np.int16)
    expected = [0, 0, d.FLAG_BLENDED, d.FLAG_SATURATED, d.FLAG_EDGE, d.FLAG_BAD_PIXEL]
    assert standardize_sources(columns)["flags"].tolist() == expected
    columns["IMAFLAGS_ISO"] = np.array([1, 0, 0, 0, 0, 0], np.int16)
    assert standardize_sources(columns)["flags"][0] == d.FLAG_BAD_PIXEL


def test_apertures_give_the_first():
    columns = {"X_IMAGE": np.array([1.0, 9.0]), "Y_IMAGE": np.ones(2)}
    columns |= {"FLUX_APER": np.array([[1.0, 2.0], [3.0, 4.0]]), "FLUXERR_APER": np.ones((2, 2))}
    assert standardize_sources(columns)["snr"].tolist() == [1.0, 3.0]


# --- tables -------------------------------------------------------------------------------------


@pytest.fixture
def wcs_file(tmp_path):
    header = tan_header(NAXIS1=60, NAXIS2=40, DETECTOR="NE")
    header["DATE-OBS"] = "2016-01-01T12:00:00"
    (tmp_path / "w.head").write_text("\n".join([c.image for c in header.cards] + ["END"]))
    return tmp_path / "w.head"


@pytest.mark.parametrize("suffix", ["ecsv", "csv", "fits", "txt"])
def test_table_of_sources(tmp_path, wcs_file, suffix):
    table = Table({"x": [0.5, 59.0], "y": [1.0, 2.0], "flux": [1.0, 2.0]})
    path = tmp_path / f"s.{suffix}"
    table.write(path, **({"format": "ascii"} if suffix == "txt" else {}))
    (frame,) = read_frames(path, wcs=wcs_file)
    assert (frame.name, frame.detector, frame.image_shape) == ("s", "NE", (40, 60))
    assert frame.epoch == pytest.approx(2016.0, abs=1e-4)
    sources = pickle.loads(pickle.dumps(frame)).load_sources()
    assert sources["x"].tolist() == [0.5, 59.0]
    with pytest.raises(FrameError, match=f"s.{suffix}: a table of sources needs a WCS header"):
        read_frames(path)


def test_one_based_table(tmp_path, wcs_file):
    Table({"X_IMAGE": [1.0], "Y_IMAGE": [2.0]}).write(tmp_path / "s.ecsv")
    (frame,) = read_frames(tmp_path / "s.ecsv", wcs=wcs_file)
    assert frame.load_sources()["y"][0] == 1.0


DAOFIND = """#K IRAF       = NOAO/IRAFV2.16          version    %-23s
#K PROGRAM    = daofind                 task       %-23s
#
#N XCENTER   YCENTER   MAG      SHARPNESS   ID         \\
#U pixels    pixels    #        #           #          \\
#F %-13.3f   %-10.3f   %-9.3f   %-12.3f     %-6d       \\
#
   12.345     20.567   -2.345   0.534       1
   32.345     10.567   -1.345   0.634       2
"""
ALLSTAR = """ NL    NX    NY  LOWBAD HIGHBAD  THRESH     AP1  PH/ADU  RNOISE    FRAD
  1    60    40   -50.0 30000.0   10.00    4.00    1.50    3.00   12.00

     1   12.345   20.567   14.123   0.0123   120.5       4.    1.023    0.012
     2   32.345   10.567   15.123   0.0223   120.5       4.    1.023    0.012
"""
PHOTOMETRY = """ NL    NX    NY  LOWBAD HIGHBAD  THRESH     AP1  PH/ADU  RNOISE    FRAD
  2    60    40   -50.0 30000.0   10.00    4.00    1.50    3.00   12.00


     1   12.345   20.567   14.123
       120.5  4.11  0.02  0.0123

     2   32.345   10.567   15.123
       120.5  4.11  0.02  0.0223
"""
TOLD = "# {}\nx y mag\n12.345 20.567 14.1\n32.345 10.567 15.1\n"


@pytest.mark.parametrize(
    ("text", "first"),
    [
        (DAOFIND, 1),
        (ALLSTAR, 1),
        (PHOTOMETRY, 1),
        (TOLD.format("positions are 1-based"), 1),
        (TOLD.format("pixel coordinates start at 1"), 1),
        (TOLD.format("origin = 1"), 1),
        (TOLD.format("FITS convention: first pixel is (1, 1)"), 1),
        (TOLD.format("made by photutils, zero-indexed"), 0),
        (TOLD.format("origin: 0"), 0),
    ],
)
def test_lists_that_tell_their_first_pixel(tmp_path, wcs_file, text, first):
    (tmp_path / "s.txt").write_text(text)
    (frame,) = read_frames(tmp_path / "s.txt", wcs=wcs_file)
    assert frame.meta["first_pixel"] == str(first)
    sources = frame.load_sources()
    assert sources["x"].tolist() == pytest.approx([12.345 - first, 32.345 - first])
    assert sources["flux"][0] > sources["flux"][1]
    # What is said by hand holds.
    (frame,) = read_frames(tmp_path / "s.txt", wcs=wcs_file, origin=1 - first)
    assert frame.load_sources()["x"][0] == pytest.approx(12.345 - (1 - first))


def test_list_that_tells_nothing(tmp_path, wcs_file):
    (tmp_path / "s.txt").write_text(TOLD.format("four chips, numbered from 1"))
    (frame,) = read_frames(tmp_path / "s.txt", wcs=wcs_file)
    assert frame.meta["first_pixel"] == "0, since nothing tells"
    assert frame.load_sources()["x"][0] == 12.345


@pytest.mark.parametrize(
    ("cards", "first"),
    [
        ({"AN_FILE": "XYLS"}, 1),
        ({"COMMENT": "x, y count from 1"}, 1),
        ({"PIXORIG": 1}, 1),
        ({"ORIGIN": "NOAO-IRAF FITS Image Kernel"}, 0),
        ({}, 0),
    ],
)
def test_fits_lists_that_tell_their_first_pixel(tmp_path, wcs_file, cards, first):
    table = fits.table_to_hdu(Table({"X": [12.5, 30.0], "Y": [20.0, 10.0], "FLUX": [2.0, 1.0]}))
    fits.HDUList([fits.PrimaryHDU(header=fits.Header(cards)), table]).writeto(tmp_path / "s.axy")
    (frame,) = read_frames(tmp_path / "s.axy", wcs=wcs_file)
    assert frame.load_sources()["x"][0] == 12.5 - first
    (frame,) = read_frames(tmp_path / "s.axy", wcs=wcs_file, origin=0)
    assert frame.load_sources()["x"][0] == 12.5


def test_list_of_matches_of_astrometry_net(tmp_path, wcs_file):
    table = fits.table_to_hdu(Table({"field_x": [12.5, 30.0], "field_y": [20.0, 10.0]}))
    fits.HDUList([fits.PrimaryHDU(), table]).writeto(tmp_path / "corr.fits")
    (frame,) = read_frames(tmp_path / "corr.fits", wcs=wcs_file)
    assert frame.load_sources()["x"].tolist() == [11.5, 29.0]


def test_given_by_hand(tmp_path, wcs_file):
    Table({"x": [0.5, 59.0], "y": [1.0, 2.0]}).write(tmp_path / "s.ecsv")
    (frame,) = read_frames(tmp_path / "s.ecsv", wcs=wcs_file, epoch=2001.5, pixel_scale=0.4)
    assert frame.epoch == 2001.5
    assert proj_plane_pixel_scales(frame.wcs)[0] * 3600 == pytest.approx(0.4)
    for options in ({"origin": 2}, {"pixel_scale": 0.0}, {"pixel_scale": float("nan")}):
        with pytest.raises(ValueError, match="must be"):
            read_frames(tmp_path / "s.ecsv", wcs=wcs_file, **options)


@pytest.mark.parametrize("offset", [0.0, 0.02, 0.4])
def test_sources_that_are_there_twice(rng, offset):
    n = 300
    table = Table({"x": rng.uniform(0, 2000, n), "y": rng.uniform(0, 2000, n)})
    table["flux"] = rng.uniform(1, 100, n)
    again = table[100:].copy()
    again["x"] += offset
    with pytest.warns(WPDCWarning, match="200 of 500 rows repeat a source"):
        sources = standardize_sources(vstack([table, again]))
    assert len(sources) == 500
    assert np.flatnonzero(np.isfinite(sources["x"])).tolist() == list(range(n))


@pytest.mark.parametrize(("offset", "warns"), [(0.0, True), (0.01, False)])
def test_chance_neighbors_are_noted_without_a_warning(rng, caplog, offset, warns):
    n = 500
    table = Table({"x": rng.uniform(0, 5000, n), "y": rng.uniform(0, 5000, n)})
    table["x_err"] = table["y_err"] = 0.02
    again = table[:2].copy()
    again["x"] += offset
    expected = pytest.warns(WPDCWarning, match="2 of 502") if warns else contextlib.nullcontext()
    with expected, caplog.at_level("INFO", logger="wpdc_gwcs"):
        sources = standardize_sources(vstack([table, again]))
    assert np.isnan(sources["x"]).sum() == 2
    assert ("2 of 502 rows repeat a source" in caplog.text) is not warns


def test_cells_that_are_no_numbers():
    table = {"x": ["1.0", "bad", "3.0"], "y": [1.0, 2.0, 9.0], "snr": ["a", "b", "c"]}
    with (
        pytest.warns(WPDCWarning, match="1 of 3 rows left out: column 'x' .*'bad' in row 1"),
        pytest.warns(WPDCWarning, match="column 'snr' must be numeric, got 'a': it is left out"),
    ):
        sources = standardize_sources(table)
    np.testing.assert_array_equal(sources["x"], [1.0, np.nan, 3.0])
    assert sources.colnames == ["x", "y"]


@settings(deadline=None, max_examples=100)
@given(
    st.lists(
        st.sampled_from(["x", "Y", "y", "flux", "snr", "FLAGS", "x_err", "y_err", "ELONGATION"]),
        unique=True,
    ),
    st.data(),
)
def test_no_other_error_whatever_the_list(names, data):
    cells = st.one_of(st.floats(), st.integers(-(2**60), 2**60), st.text(max_size=8), st.none())
    table = {
        name: np.array(data.draw(st.lists(cells, min_size=3, max_size=3)), dtype=object)
        for name in names
    }
    with contextlib.suppress(FrameError), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        standardize_sources(table)


def test_table_that_brings_its_header(tmp_path):
    table = fits.table_to_hdu(Table({"x": [0.5, 59.0], "y": [1.0, 2.0]}))
    primary = fits.PrimaryHDU(header=tan_header(IMAGEW=60, IMAGEH=40))
    fits.HDUList([primary, table]).writeto(tmp_path / "s.fits")
    (frame,) = read_frames(tmp_path / "s.fits")
    assert frame.image_shape == (40, 60)


def test_epoch_and_shape_of_the_table(tmp_path):
    header = "\n".join([c.image for c in tan_header().cards] + ["END"])
    (tmp_path / "w.head").write_text(header)
    table = Table({"x": [0.5, 59.2], "y": [1.0, 38.0]})
    table.meta["epoch"] = 2012.5
    table.meta["EXTNAME"] = "C1"
    table.write(tmp_path / "s.ecsv")
    with pytest.warns(WPDCWarning, match="does not tell the shape.*60 x 39 px"):
        (frame,) = read_frames(tmp_path / "s.ecsv", wcs=tmp_path / "w.head")
    assert (frame.epoch, frame.image_shape, frame.detector) == (2012.5, (39, 60), "C1")
    (frame,) = read_frames(tmp_path / "s.ecsv", wcs=tmp_path / "w.head", image_shape=(50, 70))
    assert frame.image_shape == (50, 70)


# --- what is no frame ---------------------------------------------------------------------------


class TestBadInput:
    def test_missing(self, tmp_path):
        with pytest.raises(FrameError, match="no.fits: must be a readable file: No such file"):
            read_frames(tmp_path / "no.fits")
        with pytest.raises(FrameError, match="no.fits: must be a readable file"):
            read_frames(f"{tmp_path / 'no.fits'}[1]")

    def test_folder(self, tmp_path):
        with pytest.raises(FrameError, match="must be a file, is a folder"):
            read_frames(tmp_path)

    @pytest.mark.parametrize("name", ["a.fits", "a.fits.fz", "a.cat", "a.ecsv"])
    def test_empty(self, tmp_path, name):
        (tmp_path / name).write_bytes(b"")
        with pytest.raises(FrameError, match=f"{name}: must not be empty, the file has 0 bytes"):
            read_frames(tmp_path / name)

    @pytest.mark.parametrize("name", ["a.fits", "a.fit", "a.fits.fz"])
    def test_text_named_fits(self, tmp_path, name):
        (tmp_path / name).write_text("hello, world\n" * 10)
        with pytest.raises(FrameError, match=f"{name}: a FITS file must begin .*got 'hello, wo'"):
            read_frames(tmp_path / name)

    @pytest.mark.parametrize("part", [0.05, 0.3, 0.6, 0.9])
    def test_truncated_fz(self, tmp_path, part):
        noise = np.random.default_rng(0).integers(0, 2000, (200, 300)).astype(np.int16)
        hdu = fits.CompImageHDU(noise, tan_header(), compression_type="RICE_1")
        fits.HDUList([fits.PrimaryHDU(), hdu]).writeto(tmp_path / "a.fits.fz")
        data = (tmp_path / "a.fits.fz").read_bytes()
        (tmp_path / "a.fits.fz").write_bytes(data[: int(part * len(data))])
        with pytest.raises(FrameError, match="a.fits.fz: truncated file"):
            read_frames(tmp_path / "a.fits.fz")

    def test_truncated_gz(self, tmp_path):
        write_image(tmp_path / "b.fits")
        data = gzip.compress((tmp_path / "b.fits").read_bytes())
        (tmp_path / "a.fits.gz").write_bytes(data[: len(data) - 20])
        with pytest.raises(FrameError, match="a.fits.gz: damaged FITS file: Compressed file ended"):
            read_frames(tmp_path / "a.fits.gz")

    def test_corrupt_tiles(self, tmp_path):
        noise = np.random.default_rng(0).integers(0, 2000, (200, 300)).astype(np.int32)
        hdu = fits.CompImageHDU(noise, tan_header(), compression_type="GZIP_1")
        fits.HDUList([fits.PrimaryHDU(), hdu]).writeto(tmp_path / "a.fits")
        data = bytearray((tmp_path / "a.fits").read_bytes())
        data[-60000:-3000] = b"\xff" * 57000
        (tmp_path / "a.fits").write_bytes(data)
        (frame,) = read_frames(tmp_path / "a.fits")
        with pytest.raises(FrameError, match=r"a.fits\[1\]: damaged image"):
            frame.load_image()

    def test_file_that_vanishes(self, tmp_path):
        (frame,) = read_frames(write_image(tmp_path / "a.fits"))
        os.unlink(tmp_path / "a.fits")
        with pytest.raises(FrameError, match="a.fits: .*No such file"):
            frame.load_image()

    def test_no_wcs(self, tmp_path):
        fits.writeto(tmp_path / "a.fits", PIXELS)
        with pytest.raises(FrameError, match="a.fits: header must have a celestial WCS"):
            read_frames(tmp_path / "a.fits")

    def test_wcs_of_a_spectrum(self, tmp_path):
        write_image(tmp_path / "a.fits", CTYPE1="WAVE", CTYPE2="LINEAR")
        with pytest.raises(FrameError, match="a.fits: CTYPE1 and CTYPE2 must be a celestial pair"):
            read_frames(tmp_path / "a.fits")

    @pytest.mark.parametrize("key", ["CRVAL1", "CRPIX2", "CD2_1"])
    def test_lost_card(self, tmp_path, key):
        header = tan_header()
        del header[key]
        fits.writeto(tmp_path / "a.fits", PIXELS, header)
        with pytest.raises(FrameError, match=f"a.fits: card {key} is missing"):
            read_frames(tmp_path / "a.fits")

    def test_no_image(self, tmp_path):
        fits.PrimaryHDU(header=tan_header()).writeto(tmp_path / "a.fits")
        with pytest.raises(FrameError, match="must have an image, FITS_LDAC sources or a table"):
            read_frames(tmp_path / "a.fits")
        fits.writeto(tmp_path / "b.fits", np.zeros((3, 4, 5)), tan_header())
        with pytest.raises(FrameError, match=r"is a cube of 3 planes \(5 x 4 x 3 px\).*\[0\]\[2\]"):
            read_frames(tmp_path / "b.fits")

    def test_no_such_extension(self, tmp_path):
        path = multi_extension(tmp_path / "m.fits")
        with pytest.raises(FrameError, match="must be one of 0 PRIMARY, 1 A1, 2 B2, got 'C3'"):
            read_frames(f"{path}[C3]")
        with pytest.raises(FrameError, match=r"m.fits\[0\]: must be an image"):
            read_frames(f"{path}[0]")

    def test_catalog_as_a_frame(self, tmp_path):
        Table({"ra": [1.0], "dec": [2.0]}).write(tmp_path / "ref.fits")
        with pytest.raises(FrameError, match="must have an image"):
            read_frames(tmp_path / "ref.fits")

    def test_list_without_positions(self, tmp_path):
        write_ldac(tmp_path / "a.cat", (tan_header(), {"FLUX_AUTO": np.ones(3)}))
        with pytest.raises(FrameError, match="a.cat: source list must have positions.*FLUX_AUTO"):
            read_frames(tmp_path / "a.cat")

    def test_list_without_header(self, tmp_path):
        hdus = ldac_hdus(tan_header(), sextractor_columns())
        fits.HDUList([fits.PrimaryHDU(), hdus[1]]).writeto(tmp_path / "a.cat")
        with pytest.raises(FrameError, match="LDAC_OBJECTS must follow LDAC_IMHEAD"):
            read_frames(tmp_path / "a.cat")

    def test_table_without_positions(self, tmp_path, wcs_file):
        Table({"a": [1.0]}).write(tmp_path / "s.ecsv")
        with pytest.raises(FrameError, match="s.ecsv: table of sources must have columns 'x'"):
            read_frames(tmp_path / "s.ecsv", wcs=wcs_file)

    def test_positions_that_are_no_numbers(self, tmp_path, wcs_file):
        Table({"x": ["a"], "y": [1.0]}).write(tmp_path / "s.ecsv")
        with pytest.raises(FrameError, match="s.ecsv: column 'x' must be numeric, got 'a'"):
            read_frames(tmp_path / "s.ecsv", wcs=wcs_file)

    def test_garbage(self, tmp_path, wcs_file):
        (tmp_path / "s.ecsv").write_bytes(bytes(range(1, 256)) * 9)
        with pytest.raises(FrameError, match="s.ecsv: must be FITS, ASDF or a table, is another"):
            read_frames(tmp_path / "s.ecsv", wcs=wcs_file)
        (tmp_path / "s.ecsv").write_bytes(b"# %ECSV 1.0\n# ---\n" * 9 + bytes(range(1, 256)))
        with pytest.raises(FrameError, match="s.ecsv: neither FITS nor a readable table"):
            read_frames(tmp_path / "s.ecsv", wcs=wcs_file)

    def test_all_are_input_errors_of_one_line(self, tmp_path):
        for name, data in {"a.fits": b"", "b.fits": b"hello", "c.gz": b"\x1f\x8b\x08"}.items():
            (tmp_path / name).write_bytes(data)
            with pytest.raises(InputError) as caught:
                read_frames(tmp_path / name)
            assert "\n" not in str(caught.value)
            assert name in str(caught.value)


def test_interrupt_passes(tmp_path, monkeypatch):
    write_image(tmp_path / "a.fits")

    def interrupt(*args, **kwargs):
        raise KeyboardInterrupt

    monkeypatch.setattr("astropy.io.fits.open", interrupt)
    with pytest.raises(KeyboardInterrupt):
        read_frames(tmp_path / "a.fits")


# --- real frames --------------------------------------------------------------------------------


def test_wircam(shared_data):
    path = shared_data / "wircam" / "wircam_J_1325839p.fits.fz"
    (frame,) = read_frames(path)
    assert (frame.name, frame.detector) == ("wircam_J_1325839p", "WIRCam")
    assert frame.image_shape == (2048, 2048)
    assert (frame.gain, frame.saturation) == (3.8, 65535.0)
    # MJD-OBS = 55779.3906902, 20 s
    assert frame.epoch == pytest.approx(2000 + (55779.3906902 - 51544.5) / 365.25, abs=1e-5)
    image = frame.load_image()
    assert (image.shape, image.dtype) == ((2048, 2048), np.float32)
    np.testing.assert_array_equal(image[:100, :100], fits.getdata(path, 1)[:100, :100])


def test_truncated_wircam(shared_data, tmp_path):
    path = shared_data / "wircam" / "wircam_J_1325839p.fits.fz"
    data = path.read_bytes()
    (tmp_path / "a.fits.fz").write_bytes(data[: len(data) // 2])
    with pytest.raises(FrameError, match="a.fits.fz: truncated file: HDU 1 must have"):
        read_frames(tmp_path / "a.fits.fz")


def test_hst_with_its_lookup_tables(shared_data):
    folder = shared_data / "wcs_headers" / "conformance" / "astropy"
    (frame,) = read_frames(folder / "dist_lookup.fits.gz")
    assert frame.image_shape == (100, 100)
    assert frame.wcs.cpdis1 is not None
    assert frame.load_image().shape == (100, 100)
