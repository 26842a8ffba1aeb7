"""A WCS into the image itself; truth is astropy.wcs, and the bytes that were there before."""

import gzip
import os
import warnings

import numpy as np
import pytest
from astropy.io import fits
from astropy.wcs import WCS
from test_io_formats import distance, grid, make_calibration

from wpdc_gwcs.exceptions import FileFormatError, InputError, WPDCWarning
from wpdc_gwcs.io import read, read_wcs
from wpdc_gwcs.io.checksum import checksum_text, sum_words
from wpdc_gwcs.io.embed import INTO_FORMS, write_into

# Two SIP terms, a plate solution, IRAF's, tables, a wrong pole, and the spellings of old: what a
# header may have of WCSs that it had before.
STALE = {
    "WCSAXES": 2,
    "WCSNAME": "old",
    "CTYPE1": "RA---TAN-SIP",
    "CTYPE2": "DEC--TAN-SIP",
    "CRVAL1": 1.0,
    "CRVAL2": 2.0,
    "CRPIX1": 1.0,
    "CRPIX2": 1.0,
    "PC1_1": 0.5,
    "PC001002": 0.25,
    "CDELT1": 0.1,
    "CDELT2": 0.1,
    "CROTA2": 5.0,
    "CRDER1": 0.1,
    "PV1_3": 5.0,
    "PV2_39": 1.0,
    "A_ORDER": 2,
    "A_2_0": 1e-5,
    "B_ORDER": 2,
    "AP_ORDER": 1,
    "AP_1_0": 1e-5,
    "A_DMAX": 1.0,
    "LONPOLE": 150.0,
    "LATPOLE": 10.0,
    "RADECSYS": "FK4",
    "EQUINOX": 1950.0,
    "AMDX1": 1.0,
    "PPO3": 2.0,
    "PLTRAH": 3,
    "WAT1_001": "wtype=tnx",
    "WCSDIM": 2,
    "PROJP1": 1.0,
}
OTHERS = {"OBJECT": "x", "DETECTOR": "mine", "PCOUNTRY": "no PC", "CD_NAME": "no CD", "A_B": 1.0}


def old_header(**more):
    header = fits.Header()
    for key, value in {**STALE, **OTHERS, **more}.items():
        header[key] = value
    header["HISTORY"] = "precious"
    return header


@pytest.fixture(scope="module")
def calibration():
    return make_calibration(n=128, amplitude=5.0)


@pytest.fixture
def image(calibration, rng):
    ny, nx = calibration.solution.image_shape
    return rng.normal(1000, 30, (ny, nx)).astype(np.float32)


def write_plain(path, image, header, **options):
    fits.PrimaryHDU(image, header).writeto(path, **options)
    return str(path), 0


def write_extensions(path, image, header, **options):
    table = fits.BinTableHDU.from_columns([fits.Column("A", "D", array=np.arange(5.0))], name="T")
    hdus = [
        fits.PrimaryHDU(),
        fits.ImageHDU(image, header, name="ONE"),
        fits.ImageHDU(image + 1, header, name="TWO"),
        table,
    ]
    fits.HDUList(hdus).writeto(path, **options)
    return f"{path}[TWO]", 2


def write_compressed(path, image, header, **options):
    hdus = [fits.PrimaryHDU(), fits.CompImageHDU(image, header, name="SCI")]
    fits.HDUList(hdus).writeto(path, **options)
    return str(path), 1


def write_gzipped(path, image, header, **options):
    write_plain(path, image, header, **options)
    data = path.read_bytes()
    with gzip.open(path, "wb") as file:
        file.write(data)
    return str(path), 0


WRITERS = [write_plain, write_extensions, write_compressed, write_gzipped]


def hdu_bytes(path):
    """The bytes of every HDU of a file, by number."""
    with warnings.catch_warnings(), fits.open(path, disable_image_compression=True) as hdus:
        warnings.simplefilter("ignore")
        places = [hdu.fileinfo() for hdu in hdus]
    data = path.read_bytes()
    if data[:2] == b"\x1f\x8b":
        data = gzip.decompress(data)
    ends = [p["datLoc"] + p["datSpan"] for p in places]
    starts = [p["hdrLoc"] for p in places]
    return [
        (data[s : p["datLoc"]], data[p["datLoc"] : e])
        for s, p, e in zip(starts, places, ends, strict=True)
    ]


@pytest.mark.parametrize("form", INTO_FORMS)
@pytest.mark.parametrize("writer", WRITERS)
def test_the_wcs_is_in_the_image(tmp_path, calibration, image, writer, form):
    path = tmp_path / "a.fits"
    name, number = writer(path, image, old_header(), checksum=True)
    before = hdu_bytes(path)
    made = write_into(calibration, name, form=form)
    assert os.listdir(tmp_path) == ["a.fits"]
    # All is as it was but for one header; tables come behind.
    after = hdu_bytes(path)
    for k, (old, new) in enumerate(zip(before, after, strict=False)):
        assert old[1] == new[1]
        assert (old[0] == new[0]) == (k != number)
    assert len(after) == len(before) + len(made.tables)
    with fits.open(path, checksum=True) as hdus:  # warnings are errors
        hdus.verify("exception")
        header = hdus[number].header
        for key, value in OTHERS.items():
            assert header[key] == value
        assert "precious" in str(header["HISTORY"])
        assert b"CHECKSUM=" in after[number][0]
        left = set(STALE) & set(header)
        assert left <= set(made.header)
        assert all(header[key] == made.header[key] for key in left)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            wcs = WCS(header, hdus)
        found = distance(calibration, wcs.all_pix2world(*grid(calibration), 0))
        worst = made.keywords_deviation if form == "fits" else made.deviation
        assert found < 1.05 * worst + 1e-6
        # SWarp, GalSim and sep take it as an image like any other.
        assert hdus[number].data.shape == image.shape
    if form in ("fits", "cpdis", "tpv"):
        back = read(f"{path}[{number}]") if form == "fits" else read_wcs(f"{path}[{number}]")
        sky = (back.wcs if form == "fits" else back.pixel_to_world_values)(*grid(calibration))
        assert distance(calibration, sky) < 1.05 * made.deviation if made.deviation else 1e-9


def test_again_and_again_it_stays_the_same(tmp_path, calibration, image):
    """Tables of one's own are exchanged, too, and those of another image are left alone."""
    path = tmp_path / "a.fits"
    write_extensions(path, image, fits.Header())
    for name in ("ONE", "TWO"):
        write_into(calibration, f"{path}[{name}]", form="cpdis")
    with fits.open(path) as hdus:
        assert [h.name for h in hdus] == ["PRIMARY", "ONE", "TWO", "T", *4 * ["WCSDVARR"]]
        assert [h.ver for h in hdus[4:]] == [1, 2, 3, 4]
    once = path.read_bytes()
    write_into(calibration, f"{path}[TWO]", form="cpdis")
    assert path.read_bytes() == once
    for form in ("tab", "fits", "tpv"):
        write_into(calibration, f"{path}[TWO]", form=form)
        with fits.open(path) as hdus:
            assert [h.ver for h in hdus if h.name == "WCSDVARR"] == [1, 2]
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                one = WCS(hdus["ONE"].header, hdus)
            assert distance(calibration, one.all_pix2world(*grid(calibration), 0)) < 1e-3
    with fits.open(path) as hdus:
        assert [h.name for h in hdus] == ["PRIMARY", "ONE", "TWO", "T", *2 * ["WCSDVARR"]]
    header = fits.getheader(path, "TWO")
    assert str(header["HISTORY"]).count("WCS by wpdc_gwcs") == 1


def test_two_detectors_in_one_file(tmp_path, image):
    """Each image has the tables of its own."""
    path = tmp_path / "a.fits"
    write_extensions(path, image, fits.Header())
    several = {name: make_calibration(n=128, amplitude=5.0, seed=k) for k, name in enumerate("ab")}
    for name, calibration in zip(("ONE", "TWO"), several.values(), strict=True):
        write_into(calibration, f"{path}[{name}]", form="fits")
    for name, calibration in zip(("ONE", "TWO"), several.values(), strict=True):
        points = grid(calibration)
        np.testing.assert_array_equal(
            read(f"{path}[{name}]").wcs(*points), calibration.wcs(*points)
        )
    write_into(several["a"], f"{path}[ONE]", form="tpv")
    assert read(f"{path}[ONE]").lookup_table is None
    assert read(f"{path}[TWO]").lookup_table is not None


@pytest.mark.parametrize("alternates", ["keep", "remove"])
def test_alternates(tmp_path, calibration, image, alternates):
    more = {"CTYPE1P": "LINEAR", "CRPIX1P": 3.0, "WCSNAMEP": "PHYSICAL", "CD1_1P": 1.0}
    more |= {"CTYPE1O": "RA---TAN-SIP", "CTYPE2O": "DEC--TAN-SIP", "PV1_1O": 0.0}
    path = tmp_path / "a.fits"
    write_plain(path, image, old_header(**more))
    if alternates == "keep":
        with pytest.warns(WPDCWarning, match="alternate WCS O removed: it used the SIP terms"):
            write_into(calibration, path, alternates=alternates)
    else:
        write_into(calibration, path, alternates=alternates)
    header = fits.getheader(path)
    assert not any(key in header for key in more if key.endswith("O"))
    assert all((key in header) == (alternates == "keep") for key in more if key.endswith("P"))


def test_a_copy_and_a_link(tmp_path, calibration, image):
    path, link, copy = (tmp_path / name for name in ("a.fits", "l.fits", "c.fits"))
    write_plain(path, image, old_header())
    before = path.read_bytes()
    write_into(calibration, path, output=copy)
    assert path.read_bytes() == before
    with pytest.raises(InputError, match=r"c.fits: file exists and is kept"):
        write_into(calibration, path, output=copy)
    os.symlink(path, link)
    os.chmod(path, 0o640)
    write_into(calibration, link)
    assert link.is_symlink()
    assert path.read_bytes() == copy.read_bytes()
    assert path.stat().st_mode & 0o777 == 0o640


def test_without_padding_and_with_a_tail(tmp_path, calibration, image):
    path = tmp_path / "a.fits"
    write_plain(path, image, old_header())
    data = path.read_bytes()
    path.write_bytes(data[: -(-image.nbytes % 2880)])
    write_into(calibration, path, form="cpdis")
    with fits.open(path) as hdus:
        assert [h.name for h in hdus] == ["PRIMARY", "WCSDVARR", "WCSDVARR"]
    np.testing.assert_array_equal(fits.getdata(path), image)


def test_what_is_refused(tmp_path, calibration, image):
    plain, several = tmp_path / "a.fits", tmp_path / "b.fits"
    write_plain(plain, image[:-1], old_header())
    write_extensions(several, image, old_header())
    text = tmp_path / "c.fits"
    text.write_text("SIMPLY no FITS")
    for name, message in (
        (plain, r"a.fits: must have the shape of the detector, 128 x 144 px, has 128 x 143"),
        (several, r"b.fits: has 2 images of two axes; choose one with path\[EXT\], EXT one of 0 P"),
        (f"{several}[T]", r"b.fits\[T\]: must be an image of two axes"),
        (f"{several}[SIX]", r"extension must be one of .*'SIX'"),
        (text, "a FITS file must begin with"),
        (tmp_path / "d.fits", "must be a readable file"),
    ):
        before = [path.read_bytes() for path in (plain, several, text)]
        with pytest.raises(InputError, match=message):
            write_into(calibration, name)
        assert before == [path.read_bytes() for path in (plain, several, text)]
        assert sorted(os.listdir(tmp_path)) == ["a.fits", "b.fits", "c.fits"]
    with pytest.raises(ValueError, match="format must be one of tpv"):
        write_into(calibration, plain, form="head")
    with pytest.raises(ValueError, match="alternates must be"):
        write_into(calibration, plain, alternates="drop")


@pytest.mark.parametrize("name", [None, "PRIMARY", "ONE", "TWO"])
def test_only_tables_of_the_wcs_go(tmp_path, calibration, image, name):
    """A -TAB that names no table, or what is none, takes nothing with it."""
    path = tmp_path / "a.fits"
    header = fits.Header({"CTYPE1": "RA---TAB", "CTYPE2": "DEC--TAB"})
    if name is not None:
        header["PS1_0"] = header["PS2_0"] = name
    column = fits.Column("A", "D", array=np.arange(5.0))
    hdus = [fits.PrimaryHDU(image), fits.ImageHDU(image, header, name="ONE")]
    hdus += [fits.ImageHDU(image, name="TWO"), fits.BinTableHDU.from_columns([column])]
    fits.HDUList(hdus).writeto(path)
    before = hdu_bytes(path)
    write_into(calibration, f"{path}[1]")
    after = hdu_bytes(path)
    assert [k for k in range(4) if before[k] != after[k]] == [1]
    assert after[1][1] == before[1][1]


@pytest.mark.parametrize("value", ["''", "'abc'", "'a longer one than any'", "0", "", "'0' / x'y'"])
def test_checksums_of_other_forms(tmp_path, calibration, image, value):
    """Whatever stood there, what stands there then is the sum."""
    path = tmp_path / "a.fits"
    write_plain(path, image, old_header(), checksum=True)
    data = path.read_bytes()
    at = data.index(b"CHECKSUM=")
    path.write_bytes(data[:at] + f"CHECKSUM= {value}".ljust(80).encode() + data[at + 80 :])
    write_into(calibration, path)
    with fits.open(path, checksum=True) as hdus:  # warnings are errors
        assert hdus[0].verify_checksum() == 1
        assert len(hdus[0].header["CHECKSUM"]) == 16


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() != 0, reason="asks for root")
def test_the_owner_stays(tmp_path, calibration, image):
    path = tmp_path / "a.fits"
    write_plain(path, image, old_header())
    os.chown(path, 1234, 2345)
    os.chmod(path, 0o2640)
    write_into(calibration, path)
    state = path.stat()
    assert (state.st_uid, state.st_gid, state.st_mode & 0o7777) == (1234, 2345, 0o2640)


def test_cards_that_nobody_knows_are_found_out(tmp_path, calibration, image, monkeypatch):
    """The file is read back: if a term of the old WCS stayed, nothing is written."""
    path = tmp_path / "a.fits"
    write_plain(path, image, old_header())
    before = path.read_bytes()
    monkeypatch.setattr("wpdc_gwcs.io.embed.is_stale", lambda card, letters: "CD" in card[:2])
    with pytest.raises(FileFormatError, match=r"a.fits: (other cards|damaged header)"):
        write_into(calibration, path)
    assert path.read_bytes() == before
    assert os.listdir(tmp_path) == ["a.fits"]


def test_checksums_are_those_of_astropy(rng):
    for total in rng.integers(0, 2**32, 200):
        text = checksum_text(int(total))
        assert text.isalnum()
        assert len(text) == 16
        # Its words, turned back, bring the sum to minus zero where sixteen zeros stood.
        zeros, value = (sum_words((t[1:] + t[0]).encode()) for t in ("0" * 16, text))
        assert sum_words(b"", int(total) + value + (0xFFFFFFFF - zeros)) in (0, 0xFFFFFFFF)


def test_swarp_takes_it(tmp_path, image, resample):
    """SWarp reads the WCS from the image and puts every pixel where it belongs."""
    calibration = make_calibration(n=128, amplitude=2.0, table=None)
    y, x = np.indices(image.shape)
    path = tmp_path / "a.fits"
    write_plain(path, x.astype(np.float32), old_header())
    write_into(calibration, path)
    values, sky = resample(path)
    place = np.array(calibration.wcs.invert(*sky))
    inside = (place > 5).all(axis=0) & (place < 120).all(axis=0)
    assert inside.sum() > 5000
    assert np.abs(values - place[0])[inside].max() < 1e-3
