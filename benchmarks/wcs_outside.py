"""What other programs make of an exported WCS, in px, beside the deviation that was printed.

Run from the root of the project::

    python benchmarks/wcs_outside.py                  # made up, 40 and 200 px of distortion
    python benchmarks/wcs_outside.py a.wcs.asdf ...   # calibrations of one's own

What is printed stands beside what is found: ``swarp*`` is the deviation in SWarp that is told with
``tpv`` and ``head``.  Images of three kinds get the WCS by ``--into``; then reproject and SWarp
resample them.  A reader that is not installed is left out: astropy and galsim, esutil,
starlink-pyast, reproject (PyPI), SWarp, sky2xy and xy2sky (Debian: swarp, wcstools).
"""

import argparse
import contextlib
import shutil
import subprocess
import tempfile
import warnings
from pathlib import Path

import numpy as np
from astropy.io import fits
from astropy.nddata import CCDData, Cutout2D
from astropy.wcs import WCS, WcsError

from wpdc_gwcs import DistortionSolution, read
from wpdc_gwcs.export import FORMS
from wpdc_gwcs.io.embed import write_into
from wpdc_gwcs.io.fits import write_form
from wpdc_gwcs.models import LookupTable, PVPolynomial, project, pv_terms


def make_solution(n, scale, corner, degree, seed=1):
    """Build a cubic and a table that together are a polynomial, of `corner` px at the corners."""
    rng = np.random.default_rng(seed)
    cd = scale / 3600 * np.array([[-1.0, 0.02], [0.02, 1.0]])
    half = scale / 3600 * n / 2

    def random(degree, low):
        terms = pv_terms(degree)
        total = terms.own + terms.other
        coefficients = rng.normal(size=(2, len(total))) * 3.0 ** (low - total) / half ** (total - 1)
        coefficients[:, total < low] = 0.0
        return coefficients

    whole = random(degree, 2)
    corners = half * np.array([[-1, 1, 1, -1], [-1, -1, 1, 1]])
    size = np.hypot(*PVPolynomial.from_coefficients(whole, degree=degree)(*corners)).max()
    whole *= corner * scale / 3600 / size
    whole[:, 1] += 1.0
    whole = PVPolynomial.from_coefficients(whole, degree=degree)
    cubic = PVPolynomial.from_coefficients(
        whole.coefficients[:, : len(pv_terms(3).index)], degree=3
    )
    nodes = np.linspace(-0.5, n - 0.5, 50)
    x, y = np.meshgrid(nodes, nodes)
    u = cd @ (np.array([x.ravel(), y.ravel()]) - (n - 1) / 2)
    dx, dy = np.linalg.solve(cd, np.subtract(cubic(*u), whole(*u))).reshape(2, 50, 50)
    return DistortionSolution(
        detector=f"{corner:g} px, degree {degree}",
        image_shape=(n, n),
        crpix=np.full(2, (n - 1) / 2),
        cd=cd,
        crval=np.array([150.0, 2.2]),
        pv=cubic,
        lookup_table=LookupTable(nodes, nodes, dx, dy),
    )


def deviation(obj, x, y, sky):
    """Greatest distance from the exact WCS, px."""
    planes = [project(*s, obj.crval) for s in (sky, obj.wcs(x, y))]
    return float(np.hypot(*np.linalg.solve(obj.cd, np.subtract(*planes))).max())


def read_astropy(path, x, y):
    """Read by astropy.wcs."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        if path.suffix == ".head":
            return WCS(fits.Header.fromtextfile(path)).all_pix2world(x, y, 0)
        with fits.open(path) as hdus:
            return WCS(hdus[0].header, hdus).all_pix2world(x, y, 0)


def read_galsim(path, x, y):
    """Read by GalSim's own TPV and SIP."""
    import galsim

    wcs = galsim.FitsWCS(str(path), text_file=path.suffix == ".head")
    if type(wcs).__name__ != "GSFitsWCS":
        return None
    return np.degrees(wcs._radec(x + 1, y + 1))


def read_ast(path, x, y):
    """Read by Starlink's AST."""
    from starlink import Ast

    if path.suffix == ".head":
        header = fits.Header.fromtextfile(path)
    else:
        header = fits.getheader(path)
    channel = Ast.FitsChan()
    for card in header.cards:
        if card.keyword not in ("HISTORY", "COMMENT", ""):
            channel.putfits(card.image, False)
    channel.clear("Card")
    frames = channel.read()
    return np.degrees(frames.tran([x + 1, y + 1]))


def read_esutil(path, x, y):
    """Read by esutil."""
    import esutil

    if path.suffix == ".head":
        header = fits.Header.fromtextfile(path)
    else:
        header = fits.getheader(path)
    return esutil.wcsutil.WCS(header).image2sky(x + 1, y + 1)


def read_wcstools(path, x, y):
    """Read by xy2sky of wcstools; it prints 1e-5 deg, so a coarse check."""
    if path.suffix == ".head" or shutil.which("xy2sky") is None:
        return None
    points = "\n".join(f"{a + 1} {b + 1}" for a, b in zip(x, y, strict=True))
    with tempfile.NamedTemporaryFile("w", suffix=".txt") as file:
        file.write(points + "\n")
        file.flush()
        command = ["xy2sky", "-d", "-n", "8", str(path), f"@{file.name}"]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    rows = [line.split()[:2] for line in done.stdout.splitlines() if line.strip()]
    return np.array(rows, float).T if len(rows) == len(x) else None


PERIOD = 4  # px, of the ramps that are resampled: their values tell where they come from


_LARGEST = 4096  # px, of the images that are resampled by reproject, which takes its time
_THINNED = 5  # reproject resamples every so many pixels


def ramp(shape, axis):
    """Image whose values are the pixels along an axis, over and over again."""
    ny, nx = shape
    values = np.arange(nx)[np.newaxis] if axis == 0 else np.arange(ny)[:, np.newaxis]
    return np.broadcast_to(values % PERIOD, (ny, nx)).astype(np.int16)


def errors_of(values, place, axis, shape):
    """Differences of resampled values from those of the pixels they should come from."""
    ny, nx = shape
    expected = place[axis] % PERIOD
    good = (expected > 0.5) & (expected < PERIOD - 1.5)
    good &= (place > 1).all(axis=0) & (place[0] < nx - 2) & (place[1] < ny - 2)
    return np.where(good, values - expected, np.nan)


def greatest(errors):
    """Greatest distance; `None` where nothing was resampled."""
    return float(np.nanmax(np.hypot(*errors))) if errors else None


def run_swarp(folder, name):
    """Resample an image with SWarp: values, and where they are on the sky."""
    options = {
        "SUBTRACT_BACK": "N",
        "RESAMPLING_TYPE": "BILINEAR",
        "PROJECTION_ERR": "0.0",
        "FSCALASTRO_TYPE": "NONE",
        "WRITE_XML": "N",
        "VERBOSE_TYPE": "QUIET",
    }
    arguments = [a for key, value in options.items() for a in (f"-{key}", value)]
    program = shutil.which("SWarp") or shutil.which("swarp")
    command = [program, name, "-c", "/dev/null", *arguments]
    subprocess.run(command, cwd=folder, check=True, capture_output=True)
    values = fits.getdata(folder / "coadd.fits")
    weights = fits.getdata(folder / "coadd.weight.fits")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        out = WCS(fits.getheader(folder / "coadd.fits"))
    v, u = np.nonzero(weights > 0.99 * weights.max())
    step = max(1, len(v) // 2_000_000)
    v, u = v[::step], u[::step]
    return values[v, u], out.all_pix2world(u, v, 0)


def read_swarp(obj, path):
    """Resample ramps with SWarp: where their values come from, against the exact WCS."""
    if shutil.which("SWarp") is None and shutil.which("swarp") is None:
        return None
    shape = getattr(obj, "solution", obj).image_shape
    worst = []
    with tempfile.TemporaryDirectory() as folder:
        folder = Path(folder)
        for axis in (0, 1):
            header = None if path.suffix == ".head" else fits.getheader(path)
            image = ramp(shape, axis).astype(np.float32)
            fits.PrimaryHDU(image, header).writeto(folder / "a.fits", overwrite=True)
            if path.suffix == ".head":
                shutil.copy(path, folder / "a.head")
            values, sky = run_swarp(folder, "a.fits")
            worst.append(errors_of(values, np.array(obj.wcs.invert(*sky)), axis, shape))
    return greatest(worst)


def make_image(kind, path, image, header):
    """Write an image in a file of some kind; give the name of its extension."""
    if kind == "compressed":
        hdus = [fits.PrimaryHDU(), fits.CompImageHDU(image, header, compression_type="RICE_1")]
    elif kind == "multi":
        hdus = [fits.PrimaryHDU(), fits.ImageHDU(image[:64, :64], header, name="A")]
        hdus += [fits.ImageHDU(image, header, name="B")]
        hdus += [fits.BinTableHDU.from_columns([fits.Column("x", "D", array=np.arange(9.0))])]
    else:
        hdus = [fits.PrimaryHDU(image, header)]
    fits.HDUList(hdus).writeto(path, overwrite=True, checksum=kind == "multi")
    return {"plain": 0, "compressed": 1, "multi": 2}[kind]


def bytes_of_others(path, number):
    """Bytes of all HDUs but one and the tables of the WCS."""
    found = []
    with fits.open(path, disable_image_compression=True) as hdus:
        for k, hdu in enumerate(hdus):
            ours = hdu.name.startswith(("WPDC_", "WCSDVARR", "WCS-TAB"))
            info = hdu.fileinfo()
            if k != number and not ours:
                with open(path, "rb") as file:
                    file.seek(info["hdrLoc"])
                    found.append(file.read(info["datLoc"] + info["datSpan"] - info["hdrLoc"]))
    return found


def into_images(obj):
    """Print what reproject and SWarp make of images with the WCS in them, px."""
    shape = getattr(obj, "solution", obj).image_shape
    old = WCS(naxis=2)
    old.wcs.ctype = ["RA---TAN-SIP", "DEC--TAN-SIP"]
    old.wcs.crval, old.wcs.crpix, old.wcs.cd = obj.crval, [7.0, 9.0], np.asarray(obj.cd) * 1.1
    old = old.to_header(relax=True)
    old["A_ORDER"], old["B_ORDER"], old["A_2_0"], old["B_0_2"] = 2, 2, 1e-5, -2e-5
    target = WCS(naxis=2)
    target.wcs.ctype = ["RA---TAN", "DEC--TAN"]
    target.wcs.crval, target.wcs.cd = obj.crval, _THINNED * np.asarray(obj.cd)
    target.wcs.crpix = np.asarray(getattr(obj, "solution", obj).crpix) / _THINNED + 1
    thinned = tuple(n // _THINNED for n in shape)
    try:
        from reproject import reproject_interp
    except ImportError:
        reproject_interp = None
    v, u = np.indices(thinned).reshape(2, -1)
    place = np.array(obj.wcs.invert(*target.all_pix2world(u, v, 0)))
    print(f"\n{'--into':24}{'printed':>10}{'reproject':>10}{'swarp*':>10}{'SWarp':>10}  other HDUs")
    for kind in ("plain", "compressed", "multi"):
        for form in ("tpv", "sip", "cpdis", "tab"):
            found, swarp = [], []
            with tempfile.TemporaryDirectory() as folder:
                path = Path(folder) / "a.fits"
                for axis in (0, 1):
                    number = make_image(kind, path, ramp(shape, axis), old)
                    before = bytes_of_others(path, number)
                    made = write_into(obj, f"{path}[{number}]", form=form)
                    same = "the same" if bytes_of_others(path, number) == before else "CHANGED"
                    if reproject_interp:
                        values, _ = reproject_interp(path, target, shape_out=thinned, hdu_in=number)
                        found.append(errors_of(values[v, u], place, axis, shape))
                    if form == "tpv" and shutil.which("SWarp"):
                        values, sky = run_swarp(Path(folder), f"a.fits[{number}]")
                        at = np.array(obj.wcs.invert(*sky))
                        swarp.append(errors_of(values, at, axis, shape))
            cells = [made.deviation, greatest(found), made.swarp_deviation, greatest(swarp)]
            print(f"{kind:12}{form:12}" + "".join(map(cell, cells)) + f"  {same}")


def cell(value):
    """One cell of a table."""
    return f"{'' if value is None else format(value, '.2g'):>10}"


def cutouts(obj):
    """Print what is left of each form in cut-outs and files of astropy, px."""
    ny, nx = getattr(obj, "solution", obj).image_shape
    x0, x1, y0, y1 = nx // 8, nx // 2, ny // 2, ny - ny // 8
    rng = np.random.default_rng(1)
    x, y = rng.uniform(x0, x1, 2000), rng.uniform(y0, y1, 2000)
    data = np.broadcast_to(np.float32(0), (ny, nx))
    titles = ("whole", "Cutout2D", "CCDData", "written", "header")
    print(f"\n{'astropy':10}" + "".join(f"{title:>10}" for title in titles))
    for form in ("tpv", "sip", "cpdis", "tab"):
        wcs = obj.to_astropy_wcs(form)
        image = CCDData(np.array(data), wcs=wcs, unit="adu")
        middle, size = ((x0 + x1) // 2, (y0 + y1) // 2), (y1 - y0, x1 - x0)

        def written(image=image):
            with tempfile.TemporaryDirectory() as folder:
                image.write(Path(folder) / "a.fits")
                return CCDData.read(Path(folder) / "a.fits").wcs

        cut = Cutout2D(data, middle, size, wcs=wcs)
        cases = (
            (lambda wcs=wcs: wcs, (0, 0)),
            (lambda cut=cut: cut.wcs, cut.origin_original),
            (lambda image=image: image[y0:y1, x0:x1].wcs, (x0, y0)),
            (written, (0, 0)),
            (lambda wcs=wcs: WCS(wcs.to_header(relax=True)), (0, 0)),
        )
        row = []
        for make, (dx, dy) in cases:
            try:
                found = make().all_pix2world(x - dx, y - dy, 0)
                row.append(f"{deviation(obj, x, y, found):.2g}")
            except (ValueError, AttributeError, WcsError):
                row.append("none")
        print(f"{form:10}" + "".join(f"{cell:>10}" for cell in row))


def main():
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("files", nargs="*", type=Path)
    parser.add_argument("--no-swarp", action="store_true")
    arguments = parser.parse_args()
    objects = [(path.name, read(path)) for path in arguments.files]
    if not objects:
        for corner, degree, n in ((40.0, 5, 2048), (200.0, 7, 9216)):
            solution = make_solution(n, 0.3 if n < 4096 else 0.074, corner, degree)
            objects.append((solution.detector, solution))
    readers = {
        "astropy": read_astropy,
        "galsim": read_galsim,
        "AST": read_ast,
        "esutil": read_esutil,
        "wcstools": read_wcstools,
    }
    titles = [*readers, "swarp*", "SWarp"]
    for name, obj in objects:
        print(f"\n{name}")
        print(f"{'format':8}{'printed':>10}" + "".join(f"{r:>10}" for r in titles))
        shape = getattr(obj, "solution", obj).image_shape
        rng = np.random.default_rng(0)
        x, y = (rng.uniform(-0.5, n - 0.5, 20_000) for n in shape[::-1])
        edge = np.linspace(-0.5, 1.0, 200)
        x[:200], y[:200] = (shape[1] - 0.5) * np.abs(edge), -0.5
        x[200:204] = [-0.5, shape[1] - 0.5, -0.5, shape[1] - 0.5]
        y[200:204] = [-0.5, -0.5, shape[0] - 0.5, shape[0] - 0.5]
        with tempfile.TemporaryDirectory() as folder:
            for form in FORMS:
                path = Path(folder) / ("a.head" if form == "head" else f"{form}.fits")
                made = write_form(obj, path, form=form)
                printed = made.keywords_deviation if form == "fits" else made.deviation
                row = [printed]
                for label, reader in readers.items():
                    pick = slice(200, 1200) if label == "wcstools" else slice(None)
                    found = None
                    if form not in ("cpdis", "tab") or label == "astropy":
                        # What is not installed, and what a reader does not know.
                        with contextlib.suppress(ImportError, KeyError, RuntimeError, ValueError):
                            found = reader(path, x[pick], y[pick])
                    row.append(None if found is None else deviation(obj, x[pick], y[pick], found))
                swarp = form in ("tpv", "head", "fits") and not arguments.no_swarp
                row += [made.swarp_deviation, read_swarp(obj, path) if swarp else None]
                print(f"{form:8}" + "".join(map(cell, row)))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            if max(shape) <= _LARGEST:
                into_images(obj)
            cutouts(obj)


if __name__ == "__main__":
    main()
