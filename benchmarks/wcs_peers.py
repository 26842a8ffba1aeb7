"""What other packages make of our gwcs, beside what they make of the same WCS of stock models.

Run from the root of the project::

    python benchmarks/wcs_peers.py            # each package that is installed
    python benchmarks/wcs_peers.py --gwcs     # gwcs' own tests with our class in place of theirs

A row says ``same`` where both give the same numbers, ``better`` where ours works and stock does
not, ``WORSE`` where stock works and ours does not.  Packages (PyPI): reproject, drizzle,
matplotlib, photutils, ndcube, stcal, tweakwcs, dask.  The last rows write files as the pipelines of
JWST and Roman do, and convert them.
"""

import argparse
import contextlib
import importlib
import io
import re
import subprocess
import sys
import tempfile
import warnings
from pathlib import Path

import asdf
import numpy as np
from astropy import units as u
from astropy.io import fits
from astropy.wcs import WCS
from wcs_outside import make_solution

from wpdc_gwcs import build_wcs, to_stock_wcs
from wpdc_gwcs.cli.app import run
from wpdc_gwcs.models import project

SHAPE = (300, 300)
OUT_SHAPE = (320, 330)
PLUGIN = """
import sys
import gwcs, gwcs.wcs
from wpdc_gwcs.wcs import DetectorWCS
stock = gwcs.wcs.WCS
for name, module in list(sys.modules.items()):
    if name.startswith("gwcs") and getattr(module, "WCS", None) is stock:
        module.WCS = DetectorWCS
"""


def make_wcs(**keywords):
    """Ours, with 6 px of distortion in a cubic and a table."""
    solution = make_solution(SHAPE[0], 0.3, 6.0, 5)
    return build_wcs(
        crpix=solution.crpix,
        cd=solution.cd,
        crval=solution.crval,
        pv=solution.pv,
        lookup_table=solution.lookup_table,
        image_shape=SHAPE,
        **keywords,
    )


def target():
    """A plain WCS to resample to."""
    out = WCS(naxis=2)
    out.wcs.ctype = ["RA---TAN", "DEC--TAN"]
    out.wcs.crval, out.wcs.crpix = [150.0, 2.2], [160.0, 150.0]
    out.wcs.cd = np.diag([-0.3, 0.3]) / 3600
    out.array_shape = OUT_SHAPE
    return out


DATA = np.random.default_rng(0).normal(size=SHAPE)


def reproject_of(wcs, how):
    module = importlib.import_module("reproject")
    function = getattr(module, f"reproject_{how}")
    return function((DATA, wcs), target(), shape_out=OUT_SHAPE)[0]


def reproject_onto(wcs):
    from reproject import reproject_interp

    plain = np.random.default_rng(0).normal(size=OUT_SHAPE)
    return reproject_interp((plain, target()), wcs, shape_out=SHAPE)[0]


def reproject_mosaic(wcs):
    from reproject import reproject_interp
    from reproject.mosaicking import find_optimal_celestial_wcs, reproject_and_coadd

    out, shape = find_optimal_celestial_wcs([(DATA, wcs)])
    found = reproject_and_coadd(
        [(DATA, wcs)], out, shape_out=shape, reproject_function=reproject_interp
    )
    return found[0]


def drizzle(wcs):
    from drizzle.resample import Drizzle
    from drizzle.utils import calc_pixmap

    drizzled = Drizzle(out_shape=OUT_SHAPE)
    pixmap = calc_pixmap(wcs, target(), shape=SHAPE)
    drizzled.add_image(DATA.astype("f4"), exptime=1.0, pixmap=pixmap)
    return drizzled.out_img


def wcs_axes(wcs):
    import matplotlib

    matplotlib.use("agg")
    import matplotlib.pyplot as plt

    figure = plt.figure()
    axes = figure.add_subplot(projection=wcs)
    axes.imshow(DATA)
    axes.coords.grid(True)
    figure.canvas.draw()
    labels = [axes.coords[name].default_label for name in ("ra", "dec")]
    plt.close(figure)
    return labels == ["ra", "dec"]


def apertures(wcs):
    from photutils.aperture import CircularAperture, SkyCircularAperture, aperture_photometry

    sky = SkyCircularAperture(wcs.pixel_to_world([50.0, 150.0], [60.0, 200.0]), r=1.5 * u.arcsec)
    sums = aperture_photometry(DATA, sky, wcs=wcs)["aperture_sum"]
    back = CircularAperture([(10, 10)], 3).to_sky(wcs).r.to_value("arcsec")
    return np.array([*sky.to_pixel(wcs).positions.ravel(), *sums, back])


def ndcube(wcs):
    from ndcube import NDCube

    cube = NDCube(DATA, wcs=wcs)
    part = cube.crop(wcs.pixel_to_world(30, 40), wcs.pixel_to_world(90, 100))
    sky = cube[10:50, 20:80].axis_world_coords()[0]
    return np.array([*part.data.shape, sky.ra.deg[3, 4], sky.dec.deg[3, 4]])


def s_region(wcs):
    from stcal.alignment.util import compute_s_region_imaging

    text = compute_s_region_imaging(wcs, shape=SHAPE)
    return np.array([float(word) for word in text.split()[2:]])


def scale(wcs):
    from stcal.alignment.util import compute_fiducial, compute_scale

    return np.array([compute_scale(wcs, (150.0, 2.2)), *compute_fiducial([wcs])])


def tweak(wcs):
    from tweakwcs import JWSTWCSCorrector

    corrector = JWSTWCSCorrector(wcs, {"v2_ref": 100.0, "v3_ref": -400.0, "roll_ref": 33.0})
    corrector.set_correction(matrix=np.eye(2), shift=[0.5, -0.3])
    shifted = corrector.wcs
    planes = [project(*one(100.0, 100.0), (150.0, 2.2)) for one in (shifted, wcs)]
    back = shifted.invert(*shifted(100.0, 100.0))
    return np.array([np.hypot(*np.subtract(*planes)) * 3600, *back])


def dask_arrays(wcs):
    import dask.array as da

    x = da.linspace(0, 99, 100)
    return np.array(wcs(x, x))


def asdf_way(wcs):
    file = io.BytesIO()
    asdf.AsdfFile({"wcs": wcs}).write_to(file)
    file.seek(0)
    with asdf.open(file, lazy_load=False) as opened:
        return np.array(opened["wcs"]([1.0, 250.0], [2.0, 10.0]))


CHECKS = {
    "reproject_interp": lambda w: reproject_of(w, "interp"),
    "reproject_adaptive": lambda w: reproject_of(w, "adaptive"),
    "reproject_exact": lambda w: reproject_of(w, "exact"),
    "reproject onto it": reproject_onto,
    "reproject mosaicking": reproject_mosaic,
    "drizzle": drizzle,
    "WCSAxes": wcs_axes,
    "photutils apertures": apertures,
    "ndcube": ndcube,
    "stcal s_region": s_region,
    "stcal scale, fiducial": scale,
    "tweakwcs corrector": tweak,
    "dask arrays": dask_arrays,
    "ASDF": asdf_way,
}


def outcome(check, wcs):
    """Numbers, or the error."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            return check(wcs)
        except ModuleNotFoundError:
            return None
        except Exception as problem:  # noqa: BLE001  What goes wrong is what is asked for.
            return problem


def compare():
    """Print a row for each package; the number of those that are worse."""
    worse = 0
    ours, with_v2v3 = make_wcs(), make_wcs(v2v3=(100.0, -400.0, 33.0))
    for name, check in CHECKS.items():
        mine = with_v2v3 if name == "tweakwcs corrector" else ours
        found = outcome(check, mine)
        stock = outcome(check, to_stock_wcs(ours))
        if found is None:
            verdict = "not installed"
        elif isinstance(found, Exception):
            verdict = "both fail" if isinstance(stock, Exception) else "WORSE"
            verdict += f": {type(found).__name__}: {str(found)[:60]}"
            worse += verdict.startswith("WORSE")
        elif isinstance(stock, Exception):
            verdict = f"better: stock has {type(stock).__name__}: {str(stock)[:60]}"
        else:
            same = np.allclose(found, stock, rtol=1e-5, atol=1e-3, equal_nan=True)
            finite = np.isfinite(found).sum() - np.isfinite(stock).sum()
            verdict = "same" if same else f"other numbers, {finite:+d} finite ones"
            worse += not same and finite < 0
        print(f"{name:24}{verdict}")
    return worse


def pipelines():
    """Print how trees of the pipelines of JWST and Roman are converted."""
    ours, stock = make_wcs(), to_stock_wcs(make_wcs())
    x, y = np.random.default_rng(1).uniform(0, SHAPE[0] - 1, (2, 500))
    with tempfile.TemporaryDirectory() as folder:
        folder = Path(folder)
        tree = {"roman": {"meta": {"wcs": stock, "exposure": {"type": "WFI"}}, "data": DATA}}
        asdf.AsdfFile(tree).write_to(folder / "roman.asdf")
        asdf.AsdfFile({"meta": {"wcs": stock}}).write_to(folder / "jwst.asdf")
        content = np.frombuffer((folder / "jwst.asdf").read_bytes(), np.uint8)
        column = fits.Column("ASDF_METADATA", f"{len(content)}B", array=[content])
        extension = fits.BinTableHDU.from_columns([column], name="ASDF")
        science = fits.ImageHDU(DATA.astype("f4"), target().to_header(), name="SCI")
        fits.HDUList([fits.PrimaryHDU(), science, extension]).writeto(folder / "jwst.fits")
        for name in ("roman.asdf", "jwst.asdf", "jwst.fits"):
            for form in ("tpv", "sip"):
                out = folder / "out.fits"
                command = ["convert", folder / name, "--to", form, "--output", out, "--overwrite"]
                said = io.StringIO()
                with contextlib.redirect_stdout(said), warnings.catch_warnings():
                    warnings.simplefilter("ignore")
                    status = run([str(part) for part in command])
                    sky = WCS(fits.getheader(out)).all_pix2world(x, y, 0)
                planes = [project(*one, (150.0, 2.2)) for one in (sky, ours(x, y))]
                worst = np.hypot(*np.subtract(*planes)).max() * 3600 / 0.3
                told = re.search(r"deviation ([^ ]+) px", said.getvalue())
                told = told[1] if told else "-"
                print(
                    f"convert {name:12}{form:4}status {status}, told {told} px, is {worst:.2g} px"
                )


def gwcs_tests():
    """Run the tests of gwcs, with their class and with ours."""
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "ours_for_stock.py").write_text(PLUGIN)
        for name, plugin in (("stock", []), ("ours", ["-p", "ours_for_stock"])):
            command = [sys.executable, "-m", "pytest", "--pyargs", "gwcs.tests", "-q", *plugin]
            path = [folder, *filter(None, sys.path)]
            done = subprocess.run(
                [*command, "-p", "no:cacheprovider", "-W", "ignore"],
                cwd=folder, env={"PYTHONPATH": ":".join(path), "PATH": "/usr/bin:/bin"},
                capture_output=True, text=True, check=False,
            )  # fmt: skip
            failed = [line for line in done.stdout.splitlines() if line.startswith("FAILED")]
            print(f"gwcs' tests, {name}: {done.stdout.strip().splitlines()[-1]}")
            print("".join(f"    {line[:150]}\n" for line in failed), end="")


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--gwcs", action="store_true", help="run the tests of gwcs")
    if parser.parse_args().gwcs:
        gwcs_tests()
        return 0
    worse = compare()
    pipelines()
    return 1 if worse else 0


if __name__ == "__main__":
    sys.exit(main())
