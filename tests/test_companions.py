"""What goes with an image: masks, weights, sections, planes, and units of the pixels."""

import numpy as np
import pytest
from astropy.io import fits

from wpdc_gwcs.exceptions import FrameError, WPDCWarning
from wpdc_gwcs.io import read_files, read_frames

SHAPE = (200, 240)


def header(**cards):
    result = fits.Header()
    result["CTYPE1"], result["CTYPE2"] = "RA---TAN", "DEC--TAN"
    result["CRPIX1"], result["CRPIX2"] = 120.5, 100.5
    result["CRVAL1"], result["CRVAL2"] = 150.0, 2.0
    result["CD1_1"], result["CD2_2"] = -1e-4, 1e-4
    result.update(cards)
    return result


@pytest.fixture
def sky(rng):
    return rng.normal(100, 5, SHAPE).astype("f4")


@pytest.fixture
def hot(rng):
    return rng.random(SHAPE) < 0.01


def write(path, sky, primary=None, **planes):
    hdus = [fits.PrimaryHDU(header=fits.Header(primary or {})), fits.ImageHDU(sky, header())]
    hdus[1].name = planes.pop("science", "SCI")
    for name, data in planes.items():
        data, cards = data if isinstance(data, tuple) else (data, {})
        hdus.append(fits.ImageHDU(data, header(**cards), name=name.replace("_", ".")))
    fits.HDUList(hdus).writeto(path)
    return path


@pytest.mark.parametrize(
    ("science", "mask", "others"),
    [
        ("SCI", "DQ", ["ERR", "SAMP", "TIME"]),
        ("DATA", "BADPIXELMAP", ["STDEV"]),
        ("A1.SCI", "A1_FLG", ["A1_RMS"]),
        ("IMAGE", "MSK", ["WGT"]),
        ("FLUX", "QUALITY", ["IVAR", "EXPMAP"]),
        ("CHIP", "THING", ["COUNTERPART"]),
    ],
)
def test_companions_are_used_and_are_no_frames(tmp_path, sky, hot, science, mask, others):
    planes = {mask: (hot * 16).astype("i2")} | dict.fromkeys(others, np.full(SHAPE, 2, "f4"))
    (frame,) = read_frames(write(tmp_path / "a.fits", sky, science=science, **planes))
    np.testing.assert_array_equal(frame.load_image(), sky)
    np.testing.assert_array_equal(frame.load_mask(), hot)


def test_class_of_an_extension_counts(tmp_path, sky, hot):
    planes = {"EXTRA": (hot.astype("u1"), {"HDUCLAS2": "QUALITY", "HDUCLAS3": "MASKZERO"})}
    (frame,) = read_frames(write(tmp_path / "a.fits", sky, science="", **planes))
    np.testing.assert_array_equal(frame.load_mask(), hot)


def test_detectors_keep_their_own_masks(tmp_path, sky, hot):
    hdus = [fits.PrimaryHDU()]
    for k in (1, 2):
        for name, data in (("SCI", sky), ("DQ", np.roll(hot, k, axis=0).astype("i2"))):
            hdus.append(fits.ImageHDU(data, header(CRPIX1=300.0 * k), name=name, ver=k))
    fits.HDUList(hdus).writeto(tmp_path / "a.fits")
    frames = read_frames(tmp_path / "a.fits")
    assert len(frames) == 2
    for k, frame in enumerate(frames, start=1):
        np.testing.assert_array_equal(frame.load_mask(), np.roll(hot, k, axis=0))


def test_detectors_of_one_coarse_wcs_are_frames(tmp_path, sky):
    hdus = [fits.PrimaryHDU(), *(fits.ImageHDU(sky, header(), name=f"im{k}") for k in (1, 2, 3))]
    fits.HDUList(hdus).writeto(tmp_path / "a.fits")
    assert len(read_frames(tmp_path / "a.fits")) == 3


class TestBits:
    def mask_of(self, path, sky, values, primary=None, cards=None, **options):
        sky = sky.copy()
        path = write(path, sky, primary=primary, DQ=(values, cards or {}))
        return read_frames(path, **options)[0].load_mask()

    def test_bits_of_good_pixels_say_nothing(self, tmp_path, sky, hot):
        sky[hot] += 500
        values = hot.astype("i4") * 16
        values[:, :40] |= 8192
        np.testing.assert_array_equal(self.mask_of(tmp_path / "a.fits", sky, values), hot)

    def test_large_areas_without_sky_are_bad(self, tmp_path, sky):
        sky[:, :40] = 0
        values = np.zeros(SHAPE, "i4")
        values[:, :40] = 8192
        assert self.mask_of(tmp_path / "a.fits", sky, values)[:, :40].all()

    def test_bits_of_sources_are_not_bad(self, tmp_path, sky, hot):
        values = hot.astype("i4")
        for x in range(10, 230, 20):
            sky[95:102, x : x + 7] += 100
            values[94:103, x - 1 : x + 8] |= 64
        found = self.mask_of(tmp_path / "a.fits", sky, values)
        assert found.sum() < 1.1 * hot.sum()

    def test_named_planes(self, tmp_path, sky, hot):
        values = hot.astype("i4") * 2
        values[50:150] |= 32
        cards = {"MP_BAD": 1, "HIERARCH MP_DETECTED": 5}
        found = self.mask_of(tmp_path / "a.fits", sky, values, cards=cards)
        np.testing.assert_array_equal(found, hot)

    def test_lowest_bit_of_those_that_sum_up(self, tmp_path, sky, hot):
        values = hot.astype("i4") | 4
        found = self.mask_of(tmp_path / "a.fits", sky, values, primary={"TELESCOP": "JWST"})
        np.testing.assert_array_equal(found, hot)

    def test_ones_for_the_good(self, tmp_path, sky, hot):
        found = self.mask_of(tmp_path / "a.fits", sky, (~hot).astype("u1"))
        np.testing.assert_array_equal(found, hot)

    def test_chosen_bits(self, tmp_path, sky, hot):
        values = hot.astype("i4") * 4
        values[0] |= 1
        found = self.mask_of(tmp_path / "a.fits", sky, values, mask_bits=1)
        assert found.sum() == SHAPE[1]
        assert found[0].all()

    def test_all_bad_is_left_aside(self, tmp_path, sky):
        values = np.full(SHAPE, 2, "i4")
        values[0] = 1
        with pytest.warns(WPDCWarning, match="marks all pixels as bad"):
            assert not self.mask_of(tmp_path / "a.fits", sky, values).any()


@pytest.mark.parametrize(
    ("name", "value"), [("WHT", 4.0), ("VAR", 0.25), ("ERR", 0.5), ("X_RMS", 5e-31)]
)
def test_noise_becomes_a_weight(tmp_path, sky, hot, name, value):
    values = np.full(SHAPE, value)
    values[:100] *= 2.0
    values[hot] = 0
    (frame,) = read_frames(write(tmp_path / "a.fits", sky, **{name: values}))
    weight = frame.load_weight()
    assert (weight[hot] == 0).all()
    ratio = np.median(weight[:100][~hot[:100]]) / np.median(weight[100:][~hot[100:]])
    assert ratio == pytest.approx({"WHT": 2, "VAR": 1 / 2}.get(name, 1 / 4))


def test_noise_that_was_never_filled_in(tmp_path, sky):
    (frame,) = read_frames(write(tmp_path / "a.fits", sky, ERR=np.zeros(SHAPE, "f4")))
    with pytest.warns(WPDCWarning, match="ERR|error must be positive, is so for 0.0%"):
        assert frame.load_weight() is None


def test_separate_files(tmp_path, sky, hot):
    path = write(tmp_path / "a.fits", sky, DQ=np.zeros(SHAPE, "i2"))
    fits.writeto(tmp_path / "bad.fits", hot.astype("u1"))
    write(tmp_path / "both.fits", sky, HITS=hot.astype("u1"), RMS=np.full(SHAPE, 3, "f4"))
    for mask in (tmp_path / "bad.fits", f"{tmp_path}/both.fits[HITS]"):
        (frame,) = read_frames(path, mask=mask, weight_map=f"{tmp_path}/both.fits[RMS]")
        np.testing.assert_array_equal(frame.load_mask(), hot)
        np.testing.assert_allclose(frame.load_weight(), 1)
    fits.writeto(tmp_path / "small.fits", hot[:50].astype("u1"))
    with pytest.raises(
        FrameError, match=r"mask must have the shape .*\(200, 240\).*, has \(50, 240"
    ):
        read_frames(path, mask=tmp_path / "small.fits")


@pytest.mark.parametrize(
    ("section", "columns"),
    [("[21:220,1:200]", 200), ("[21:260,1:200]", None), ("[1:240,1:200]", None), ("x", None)],
)
def test_only_what_has_seen_the_sky(tmp_path, sky, section, columns):
    fits.writeto(tmp_path / "a.fits", sky, header(DATASEC=section))
    (frame,) = read_frames(tmp_path / "a.fits")
    if columns is None:
        assert frame.load_mask is None
    else:
        assert (~frame.load_mask()).sum() == columns * SHAPE[0]
        assert not frame.load_mask()[:, 20:220].any()


class TestPlanes:
    def test_colors_are_measured_together(self, tmp_path, sky):
        cube = np.stack([sky, 2 * sky, 4 * sky])
        fits.writeto(tmp_path / "a.fits", cube, header(CTYPE3="RGB"))
        (frame,) = read_frames(tmp_path / "a.fits")
        np.testing.assert_allclose(frame.load_image(), 7 * sky, rtol=1e-6)

    def test_a_plane_is_chosen(self, tmp_path, sky):
        cube = np.stack([sky, 2 * sky, 4 * sky, 8 * sky])
        path = tmp_path / "a.fits"
        fits.writeto(path, cube, header(CTYPE3="VELO"))
        with pytest.raises(FrameError, match=r"cube of 4 planes along VELO .*a.fits\[0\]\[3\]"):
            read_frames(path)
        np.testing.assert_array_equal(read_frames(f"{path}[0][2]")[0].load_image(), 4 * sky)
        np.testing.assert_allclose(
            read_frames(f"{path}[0][L]")[0].load_image(), 15 * sky, rtol=1e-6
        )
        with pytest.raises(FrameError, match="plane must be 0 to 3 or L, got 4"):
            read_frames(f"{path}[0][4]")


@pytest.mark.parametrize(
    ("cards", "gain"),
    [
        ({"GAIN": 1.5}, 1.5),
        ({"GAIN": 1.5, "BUNIT": "adu"}, 1.5),
        ({"GAIN": 1.5, "BUNIT": "ELECTRONS"}, 1.0),
        ({"CCDGAIN": 2.0, "BUNIT": "electron/s", "EXPTIME": 30.0}, 30.0),
        ({"CCDGAIN": 2.0, "BUNIT": "counts s**-1", "EXPTIME": 30.0}, 60.0),
        ({"GAIN": 2.0, "BUNIT": "DN/s"}, None),
        ({"GAIN": 2.0, "BUNIT": "MJy/sr"}, None),
        ({"GAIN": 2.0, "BUNIT": "counts"}, 2.0),
        ({"GAIN": 2.0, "BUNIT": "whatever"}, 2.0),
        ({}, None),
    ],
)
def test_gain_is_that_of_the_unit(tmp_path, sky, cards, gain):
    fits.writeto(tmp_path / "a.fits", sky, header(**cards))
    assert read_frames(tmp_path / "a.fits")[0].gain == gain


def write_file(path, data, **cards):
    fits.PrimaryHDU(data, header(**cards)).writeto(path)
    return str(path)


@pytest.mark.parametrize(
    ("frame", "other", "role"),
    [
        ("x.fits", "x.weight.fits", "weight"),
        ("x.fits", "x_mask.fits", "mask"),
        ("x.fits", "bpm_x.fits", "mask"),
        ("n1.image.fits", "n1.invvar.fits", "weight"),
        ("c4d_1_ooi_g.fits", "c4d_1_ood_g.fits", "mask"),
        ("c4d_1_ooi_g.fits", "c4d_1_oow_g.fits", "weight"),
        ("x.fits", "x_bad_pixel_map.fits", "mask"),
        ("x-7.fits", "x-7-rms.fits", "error"),
        ("x.fits", "x_conf.fits", "weight"),
    ],
)
@pytest.mark.parametrize("order", [1, -1])
def test_maps_in_files_beside_are_no_frames(tmp_path, sky, hot, frame, other, role, order):
    data = (hot * 4).astype("i2") if role == "mask" else np.where(hot, 0, 2).astype("f4")
    paths = [write_file(tmp_path / frame, sky), write_file(tmp_path / other, data)]
    alone = write_file(tmp_path / "y.fits", sky)
    frames = read_files([*paths[::order], alone])
    assert sorted(f.source for f in frames) == sorted([paths[0], alone])
    found = next(f for f in frames if f.source == paths[0])
    assert found.inputs == (paths[1],)
    bad = found.load_mask() if role == "mask" else found.load_weight() == 0
    np.testing.assert_array_equal(bad, hot)
    assert next(f for f in frames if f.source == alone).load_mask is None


@pytest.mark.parametrize(
    ("other", "cards"),
    [
        ("x_mask.fits", {"CRVAL1": 151.0}),
        ("x_weight.fits", {"DATE-OBS": "2020-01-02"}),
        ("x_std.fits", {}),
        ("x_2.fits", {}),
    ],
)
def test_other_exposures_are_frames_whatever_their_names(tmp_path, sky, other, cards):
    day = {"DATE-OBS": "2020-01-01"}
    one = write_file(tmp_path / "x.fits", sky, **day)
    two = write_file(tmp_path / other, sky, **(day | cards))
    assert [f.source for f in read_files([one, two])] == [one, two]


def test_maps_of_several_detectors_and_those_that_are_given(tmp_path, sky, hot):
    def camera(name, planes):
        hdus = [fits.PrimaryHDU()]
        for k, data in enumerate(planes, start=1):
            hdus.append(fits.ImageHDU(data, header(CRPIX1=300.0 * k), name=f"N{k}"))
        fits.HDUList(hdus).writeto(tmp_path / name)
        return str(tmp_path / name)

    masks = [np.roll(hot, k, axis=0).astype("u1") for k in (0, 1)]
    paths = [camera("x.fits", [sky, sky + 1]), camera("x.flag.fits", masks)]
    frames = read_files(paths)
    assert len(frames) == 2
    for frame, mask in zip(frames, masks, strict=True):
        np.testing.assert_array_equal(frame.load_mask(), mask > 0)
    none = camera("none.fits", [0 * masks[0], 0 * masks[1]])
    for frame in read_files(paths, mask=none):
        assert not frame.load_mask().any()
        assert frame.inputs == (none,)


def test_a_mask_without_its_frame_is_left_to_the_user(tmp_path, sky):
    alone = write_file(tmp_path / "x.weight.fits", sky)
    assert [f.source for f in read_files([alone])] == [alone]
