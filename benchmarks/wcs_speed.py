"""Speed and accuracy of the WCS beside astropy.wcs, the stock gwcs and the memory itself.

Run from the root of the project::

    python benchmarks/wcs_speed.py            # up to 1e7 points, map of 9216 x 9232
    python benchmarks/wcs_speed.py --full     # up to 1e8 points
    python benchmarks/wcs_speed.py --quick    # up to 1e6 points, small map

Every ratio is taken within one process, the two sides in turn, best of several runs.
"""

import argparse
import subprocess
import sys
import tempfile
import time
import warnings
from functools import partial
from pathlib import Path

import numpy as np
from astropy.io import fits
from astropy.wcs import WCS, FITSFixedWarning

from wpdc_gwcs import Calibration, DistortionSolution, kernels, write
from wpdc_gwcs.models import LookupTable, PVPolynomial, project, pv_terms
from wpdc_gwcs.wcs import build_wcs, sky_map, to_stock_wcs

NX, NY = 9216, 9232
SCALE = 0.074 / 3600
CORNER_PX = 200.0


def make_wcs(crval=(120.0, 30.0), roll=10.0, shape=(NY, NX), seed=1):
    """Build a WCS with 200 px of distortion and a 50 x 50 cubic table of 0.1 px."""
    rng = np.random.default_rng(seed)
    ny, nx = shape
    crpix = ((nx - 1) / 2, (ny - 1) / 2)
    c, s = np.cos(np.radians(roll)), np.sin(np.radians(roll))
    cd = SCALE * np.array([[-c, s], [s, c]])
    half = SCALE * nx / 2
    terms = pv_terms(3)
    coefficients = rng.normal(size=(2, 10)) / half ** (terms.own + terms.other - 1.0)
    coefficients[:, terms.own + terms.other < 2] = 0.0
    corners = half * np.array([[-1, 1, 1, -1], [-1, -1, 1, 1]])
    largest = np.hypot(*PVPolynomial.from_coefficients(coefficients)(*corners)).max()
    coefficients *= CORNER_PX * SCALE / largest
    coefficients[:, 1] += 1.0
    x, y = np.linspace(-0.5, nx - 0.5, 50), np.linspace(-0.5, ny - 0.5, 50)
    gx, gy = np.meshgrid(x, y)
    dx, dy = (
        0.1 * np.sin(2 * np.pi * (a * gx + b * gy) / 2000 + phase)
        for a, b, phase in rng.normal(size=(2, 3))
    )
    return build_wcs(
        crpix=crpix,
        cd=cd,
        crval=crval,
        pv=PVPolynomial.from_coefficients(coefficients),
        lookup_table=LookupTable(x, y, dx, dy),
        image_shape=shape,
    )


def make_calibration(wcs):
    """Return the calibration that has this WCS."""
    distortion, sky = (step.transform for step in wcs.pipeline[:-1])
    solution = DistortionSolution(
        "detector",
        wcs.pixel_shape[::-1],
        distortion.crpix.value,
        distortion.cd.value,
        sky.crval.value,
        distortion.pv,
        distortion.lookup_table,
    )
    return Calibration("frame", solution, crval=sky.crval.value, cd=sky.cd.value)


def read_cpdis(calibration):
    """Return what plain astropy.wcs makes of the ``cpdis`` export."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "cpdis.fits")
        write(calibration, path, format="cpdis")
        with fits.open(path) as hdus, warnings.catch_warnings():
            # The headers stand in a file without an image.
            warnings.simplefilter("ignore", FITSFixedWarning)
            return WCS(hdus[0].header, hdus)


def seconds(function, *, budget=1.0, repeat=5):
    """Return the best time of several runs that take about the budget together."""
    best = np.inf
    spent = 0.0
    for run in range(repeat):
        start = time.perf_counter()
        function()
        elapsed = time.perf_counter() - start
        best = min(best, elapsed)
        spent += elapsed
        if spent > budget and run > 0:
            break
    return best


def copy_limit(x, y):
    """Read the inputs and write the outputs, and nothing else."""
    a, b = np.empty_like(x), np.empty_like(y)
    a[:] = x
    b[:] = y
    return a, b


def print_forward(wcs, stock, reference, sizes, rng):
    """Print nanoseconds per point of the forward direction."""
    print("\nforward, ns per point")
    names = ("wcs(x, y)", "no box", "astropy.wcs", "stock gwcs", "copy")
    print(f"{'points':>10} " + " ".join(f"{name:>12}" for name in names) + "    ratios to astropy")
    for n in sizes:
        x, y = rng.uniform(0, NX - 1, n), rng.uniform(0, NY - 1, n)
        runs = [
            lambda x=x, y=y: wcs(x, y),
            lambda x=x, y=y: wcs(x, y, with_bounding_box=False),
            lambda x=x, y=y: reference.all_pix2world(x, y, 0),
            (lambda x=x, y=y: stock(x, y)) if n <= 1_000_000 else None,
            lambda x=x, y=y: copy_limit(x, y),
        ]
        times = [np.nan if run is None else seconds(run) / n * 1e9 for run in runs]
        ratios = f"{times[2] / times[0]:.1f} {times[2] / times[1]:.1f}"
        print(f"{n:>10} " + " ".join(f"{t:>12.1f}" for t in times) + f"    {ratios}")


def print_inverse(wcs, stock, reference, sizes, rng):
    """Print nanoseconds per point of the inverse direction."""
    print("\ninverse, ns per point (astropy.wcs: all_world2pix, tolerance 1e-6)")
    names = ("wcs.invert", "astropy.wcs", "stock gwcs")
    print(f"{'points':>10} " + " ".join(f"{name:>12}" for name in names) + "    ratio to astropy")
    for n in sizes:
        sky = wcs(rng.uniform(0, NX - 1, n), rng.uniform(0, NY - 1, n))
        runs = [
            lambda sky=sky: wcs.invert(*sky),
            lambda sky=sky: reference.all_world2pix(*sky, 0, tolerance=1e-6, maxiter=50),
            (lambda sky=sky: stock.invert(*sky)) if n <= 200_000 else None,
        ]
        times = [np.nan if run is None else seconds(run) / n * 1e9 for run in runs]
        ratio = f"{times[1] / times[0]:.1f}"
        print(f"{n:>10} " + " ".join(f"{t:>12.1f}" for t in times) + f"    {ratio}")


def print_few(calibration, stock, reference, rng):
    """Print microseconds per call of few points."""
    wcs = calibration.wcs
    print("\nfew points, us per call, both ways")
    names = ("wcs", "calibration", "astropy.wcs", "stock gwcs")
    print(f"{'points':>10} " + " ".join(f"{name:>24}" for name in names))
    for n in (1, 10, 100, 1000):
        x, y = rng.uniform(0, NX - 1, n), rng.uniform(0, NY - 1, n)
        if n == 1:
            x, y = float(x[0]), float(y[0])
        sky = wcs(x, y)
        runs = [
            (wcs, (x, y), 100),
            (wcs.invert, sky, 100),
            (calibration.pixel_to_sky, (x, y), 100),
            (calibration.sky_to_pixel, sky, 100),
            (reference.all_pix2world, (x, y, 0), 20),
            (partial(reference.all_world2pix, tolerance=1e-6, maxiter=50), (*sky, 0), 20),
            (stock, (x, y), 2),
            (stock.invert, sky, 2),
        ]
        row = [f"{n:>10}"]
        for function, args, calls in runs:
            each = seconds(lambda f=function, a=args, k=calls: [f(*a) for _ in range(k)]) / calls
            row.append(f"{each * 1e6:>12.1f}")
        print("".join(row))


def print_map(wcs, reference, shape):
    """Print the time of a map of all pixels, and the memory it takes, in a process of its own."""
    ny, nx = shape
    n = ny * nx
    ours = seconds(lambda: sky_map(wcs, image_shape=shape), budget=10.0)
    # astropy.wcs block by block as well: all at once it would need seven times the memory.
    rows = max(1, 2_000_000 // nx)
    out = np.empty((2, ny, nx))
    start = time.perf_counter()
    for first in range(0, ny, rows):
        y, x = np.mgrid[first : min(first + rows, ny), :nx]
        found = reference.all_pix2world(x.ravel(), y.ravel(), 0)
        out[:, first : first + rows] = np.reshape(found, (2, -1, nx))
    theirs = time.perf_counter() - start
    print(f"\nmap of {nx} x {ny}: {ours:.2f} s ({ours / n * 1e9:.1f} ns per pixel)")
    print(f"  astropy.wcs in blocks: {theirs:.2f} s, ratio {theirs / ours:.1f}")
    command = [sys.executable, __file__, "--map-memory", str(ny), str(nx)]
    print("  " + subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip())


def peak_memory():
    """Return the greatest resident size of this process so far, in bytes."""
    # Not from getrusage: there a process starts with the peak of the one that started it.
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmHWM:"):
            return int(line.split()[1]) * 1024
    return 0


def print_map_memory(ny, nx):
    """Print the peak memory of a map, beyond that of the libraries, relative to its outputs."""
    wcs = make_wcs()
    sky_map(wcs, image_shape=(100, 100))
    before = peak_memory()
    ra, dec = sky_map(wcs, image_shape=(ny, nx))
    peak = peak_memory()
    outputs = ra.nbytes + dec.nbytes
    print(
        f"peak memory {peak / 1e6:.0f} MB, of it {before / 1e6:.0f} MB before the map: "
        f"{peak / outputs:.2f} x its outputs ({(peak - before) / outputs:.2f} x without libraries)"
    )


def print_accuracy(wcs, stock, reference, rng):
    """Print how exact the round trip and the other forms of the WCS are."""
    x, y = rng.uniform(-0.5, NX - 0.5, 200_000), rng.uniform(-0.5, NY - 0.5, 200_000)
    x[:1000], x[1000:2000], y[2000:3000], y[3000:4000] = -0.5, NX - 0.5, -0.5, NY - 0.5
    print("\nround trip over the detector with its rim, px")
    worst, lost = 0.0, 0
    for crval in ((0.0, 0.0), (120.0, 30.0), (0.0, 89.9), (33.0, 90.0), (10.0, -90.0)):
        for roll in (0.0, 77.0, 181.0):
            camera = make_wcs(crval, roll)
            found = np.array(camera.invert(*camera(x, y)))
            lost += np.count_nonzero(~np.isfinite(found))
            worst = max(worst, np.nanmax(np.abs(found - [x, y])))
    print(f"  greatest error {worst:.1e}, NaN {lost}")
    sky = wcs.pipeline[1].transform
    to_px = np.linalg.inv(sky.cd.value)
    x, y = x[:20_000], y[:20_000]
    plane = np.array(project(*wcs(x, y), sky.crval.value))
    for name, values in (
        ("stock gwcs", stock(x, y)),
        ("astropy.wcs, cpdis", reference.all_pix2world(x, y, 0)),
    ):
        error = to_px @ (np.array(project(*values, sky.crval.value)) - plane)
        print(f"  {name} against wcs: {np.abs(error).max():.1e} px")
    back = stock.invert(*wcs(x, y), with_bounding_box=False)
    print(f"  stock inverse: {np.abs(np.subtract(back, (x, y))).max():.1e} px")


def main():
    """Print everything."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--full", action="store_true", help="up to 1e8 points (6 GB)")
    parser.add_argument("--quick", action="store_true", help="up to 1e6 points, small map")
    parser.add_argument("--map-memory", nargs=2, type=int, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.map_memory:
        print_map_memory(*options.map_memory)
        return
    print(f"{kernels.implementation} kernels")
    rng = np.random.default_rng(0)
    wcs = make_wcs()
    stock = to_stock_wcs(wcs)
    calibration = make_calibration(wcs)
    reference = read_cpdis(calibration)
    largest = 1_000_000 if options.quick else 100_000_000 if options.full else 10_000_000
    sizes = [1000, 10_000, 100_000, 1_000_000, 2_000_000, 10_000_000, 100_000_000]
    sizes = [n for n in sizes if n <= largest]
    print_forward(wcs, stock, reference, sizes, rng)
    print_inverse(wcs, stock, reference, [1000, 10_000, 200_000, min(largest, 1_000_000)], rng)
    print_few(calibration, stock, reference, rng)
    print_map(wcs, reference, (NY // 8, NX) if options.quick else (NY, NX))
    print_accuracy(wcs, stock, reference, rng)


if __name__ == "__main__":
    main()
