"""Files as such: kinds, completeness, writing in one step."""

import bz2
import gzip
import os
import stat

import numpy as np
import pytest
from astropy.io import fits

from wpdc_gwcs.exceptions import CatalogError, FileFormatError, FrameError, InputError
from wpdc_gwcs.io.files import (
    OutputExistsError,
    atomic_path,
    check_complete,
    check_output,
    file_kind,
    make_folder,
    open_fits,
    stem_of,
)


@pytest.mark.parametrize(
    ("name", "stem"),
    [
        ("a.fits", "a"),
        ("dir.fits/a.fits.fz", "a"),
        ("a.b.FITS.gz", "a.b"),
        ("e00.cat", "e00"),
        ("plain", "plain"),
        (".fits", ".fits"),
    ],
)
def test_stem(name, stem):
    assert stem_of(name) == stem


@pytest.fixture
def image(tmp_path):
    path = tmp_path / "a.fits"
    data = np.arange(120 * 130, dtype=np.int16).reshape(120, 130)
    hdus = [fits.PrimaryHDU(), fits.ImageHDU(data), fits.ImageHDU(data.astype(float))]
    fits.HDUList(hdus).writeto(path)
    return path


@pytest.mark.parametrize("compress", [gzip.compress, bz2.compress, bytes])
def test_kinds(tmp_path, image, compress):
    path = tmp_path / "a.dat"
    path.write_bytes(compress(image.read_bytes()))
    assert file_kind(path) == "fits"
    check_complete(path)
    with open_fits(path) as hdus:
        assert len(hdus) == 3
    path.write_bytes(compress(b"# a table\n"))
    assert file_kind(path) == "text"
    path.write_bytes(compress(b""))
    if compress is bytes:
        with pytest.raises(FileFormatError, match="must not be empty"):
            file_kind(path)


@pytest.mark.parametrize(
    ("start", "what"),
    [
        (b"\xff\xd8\xff\xe0\x00\x10JFIF", "a JPEG picture"),
        (b"\x89PNG\r\n\x1a\n", "a PNG picture"),
        (b"II*\0\x08\0\0\0", "a TIFF or raw picture"),
        (b"PK\x03\x04\x14", "a ZIP archive"),
        (b"%PDF-1.7\n", "a PDF"),
        (b"\x93NUMPY\x01\0v\0", "another binary file"),
        (b"\x7fELF\x02\x01", "another binary file"),
    ],
)
@pytest.mark.parametrize("name", ["a.dat", "a.fits"])
@pytest.mark.parametrize("compress", [gzip.compress, bytes])
def test_a_file_of_another_kind_is_called_what_it_is(tmp_path, start, what, name, compress):
    path = tmp_path / name
    path.write_bytes(compress(start + bytes(500)))
    with pytest.raises(FileFormatError, match=f"must be FITS, ASDF or a table, is {what}"):
        file_kind(path)


def test_noise_is_no_text(tmp_path):
    (tmp_path / "a.dat").write_bytes(b"Data that go on " + bytes(range(1, 256)))
    with pytest.raises(FileFormatError, match="is another binary file"):
        file_kind(tmp_path / "a.dat")


@pytest.mark.parametrize(
    "start",
    [b"\x89HDF\r\n\x1a\n\0", b"PAR1\x15\x04", "x y".encode("utf-16"), b"\xef\xbb\xbfx y\n"]
    + ["étoiles\n".encode("latin-1"), b"CTYPE1  = 'RA---TAN'\0\0\0", b"\tx\ty\r\n"],
)
def test_tables_and_text_of_any_kind_are_read_on(tmp_path, start):
    (tmp_path / "a.dat").write_bytes(start)
    assert file_kind(tmp_path / "a.dat") == "text"


def test_a_header_alone_is_text(tmp_path):
    header = "SIMPLE  =                    T".ljust(80) + "END".ljust(80)
    (tmp_path / "a.hdr").write_text(header)
    assert file_kind(tmp_path / "a.hdr") == "text"
    (tmp_path / "a.dat").write_text(header[:80] + "\n" + header[80:])
    assert file_kind(tmp_path / "a.dat") == "text"


@pytest.mark.parametrize("error", [FrameError, CatalogError])
def test_error_is_that_of_the_caller(tmp_path, error):
    with pytest.raises(error, match=r"no.fits: must be a readable file: No such file"):
        file_kind(tmp_path / "no.fits", error=error)
    with pytest.raises(error, match="must be a file, is a folder"):
        file_kind(tmp_path, error=error)


def test_every_truncation_is_found(image):
    data = image.read_bytes()
    with fits.open(image) as hdus:
        ends = [h.fileinfo()["datLoc"] + h.size for h in hdus]
        starts = [h.fileinfo()["hdrLoc"] for h in hdus[1:]]
    last = ends[-1]
    # Where an HDU is complete and the next has not begun, nobody can tell.
    gaps = list(zip(ends, starts, strict=False))
    for length in range(100, last, 1009):
        if any(end <= length <= start for end, start in gaps):
            continue
        image.write_bytes(data[:length])
        with pytest.raises(FrameError, match="a.fits: truncated file"):
            check_complete(image, error=FrameError)
    # Without the padding nothing is missing.
    image.write_bytes(data[:last])
    check_complete(image)


@pytest.mark.parametrize("ending", [".fz", ".gz"])
def test_truncated_compressed(tmp_path, ending):
    data = np.random.default_rng(1).integers(0, 1000, (300, 300)).astype(np.int16)
    path = tmp_path / f"a.fits{ending}"
    if ending == ".fz":
        hdu = fits.CompImageHDU(data, compression_type="RICE_1")
        fits.HDUList([fits.PrimaryHDU(), hdu]).writeto(path)
    else:
        fits.writeto(path, data)
    check_complete(path)
    content = path.read_bytes()
    for part in (0.1, 0.3, 0.6, 0.9, 0.97):
        path.write_bytes(content[: int(len(content) * part)])
        with pytest.raises(FileFormatError, match=r"a.fits.*(truncated|damaged)"):
            check_complete(path)


def test_what_follows_the_last_hdu_is_skipped(image):
    image.write_bytes(image.read_bytes() + b"tape marks".ljust(2880))
    check_complete(image)


def test_random_bytes_behind_simple(tmp_path):
    (tmp_path / "a.fits").write_bytes(b"SIMPLE  =" + bytes(range(256)) * 40)
    with pytest.raises(FileFormatError, match="a.fits"), open_fits(tmp_path / "a.fits"):
        pass


def test_atomic_write(tmp_path):
    path = tmp_path / "a.txt"
    with atomic_path(path) as temporary:
        temporary.write_text("one")
        assert temporary.parent == tmp_path
        assert temporary.suffix == ".txt"
        assert not path.exists()
    assert path.read_text() == "one"
    assert os.listdir(tmp_path) == ["a.txt"]
    # Permissions are those of any new file.
    (tmp_path / "b.txt").write_text("")
    modes = [stat.S_IMODE(os.stat(tmp_path / n).st_mode) for n in ("a.txt", "b.txt")]
    assert modes[0] == modes[1]


@pytest.mark.parametrize("error", [KeyboardInterrupt, ValueError, SystemExit, MemoryError])
def test_atomic_write_leaves_nothing(tmp_path, error):
    path = tmp_path / "a.txt"
    path.write_text("precious")
    with pytest.raises(error):  # noqa: PT012
        with atomic_path(path, overwrite=True) as temporary:
            temporary.write_text("half")
            raise error
    assert path.read_text() == "precious"
    assert os.listdir(tmp_path) == ["a.txt"]


def test_a_file_that_appears_meanwhile_is_kept(tmp_path):
    path = tmp_path / "a.txt"
    with pytest.raises(OutputExistsError, match="a.txt: file exists"):  # noqa: PT012
        with atomic_path(path) as temporary:
            temporary.write_text("ours")
            path.write_text("theirs")
    assert path.read_text() == "theirs"
    assert os.listdir(tmp_path) == ["a.txt"]


def test_bad_places(tmp_path):
    (tmp_path / "a.txt").write_text("")
    with pytest.raises(OutputExistsError, match="file exists and is kept"):
        check_output(tmp_path / "a.txt", overwrite=False)
    check_output(tmp_path / "a.txt", overwrite=True)
    with pytest.raises(InputError, match="the output must be a file, is a folder"):
        check_output(tmp_path, overwrite=True)
    with pytest.raises(InputError, match="folder must exist, found no"):
        check_output(tmp_path / "no" / "a.txt", overwrite=False)


def test_folder_that_cannot_be_written_to(tmp_path, monkeypatch):
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    with pytest.raises(InputError, match="folder must be writable"):
        check_output(tmp_path / "a.txt", overwrite=False)


def test_make_folder(tmp_path):
    make_folder(tmp_path / "a" / "b")
    make_folder(tmp_path / "a" / "b")
    assert (tmp_path / "a" / "b").is_dir()
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="file: the output folder must be a folder, is a file"):
        make_folder(tmp_path / "file")
    with pytest.raises(InputError, match="the output folder must be writable"):
        make_folder(tmp_path / "file" / "inside")
    with pytest.raises(InputError, match="the output folder must be writable: .*null"):
        make_folder("a\0b")


def test_disk_errors_name_the_file(tmp_path):
    with pytest.raises(InputError, match="a.txt: cannot be written: No space left"):
        with atomic_path(tmp_path / "a.txt"):
            raise OSError(28, "No space left on device")
