"""Positions of detected stars against the truth and the photon limit, and the time they take.

python benchmarks/centroids.py                        stars drawn here, FWHM 1.6 and 3 px
python benchmarks/centroids.py --size 9216 --stars 40000
python benchmarks/centroids.py frame.fits truth.ecsv  any image and table of true x, y, flux
"""

import argparse
import time

import numpy as np
from astropy.io import fits
from astropy.table import Table
from scipy.spatial import KDTree
from scipy.special import erf

from wpdc_gwcs.centroids import build_epsf, fit_centroids
from wpdc_gwcs.detection import detect_sources, subtract_background


def draw(size, n, fwhm, *, gain=1.1, sky=60.0, read=5.0, seed=1):
    """Frame with stars of a core-halo PSF that widens by 12 % towards the corners."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(0, size - 1, (2, n))
    flux = 10 ** rng.uniform(2.8, 5.2, n)
    image = np.zeros((size, size), np.float32)
    width = np.sqrt(max(fwhm**2 - 0.7, 0.5)) / 2.3548
    half = int(6 * fwhm)
    for start in range(0, n, 2000):
        k = slice(start, start + 2000)
        xc, yc = np.rint(x[k]).astype(int), np.rint(y[k]).astype(int)
        r2 = ((2 * x[k] / size - 1) ** 2 + (2 * y[k] / size - 1) ** 2) / 2
        step = np.arange(-half, half + 1)
        stamps = 0
        for share, scale in ((0.82, 1.0), (0.18, 2.1)):
            s = (np.sqrt(2) * width * scale * (1 + 0.12 * r2))[:, None]
            u, v = (xc - x[k])[:, None] + step, (yc - y[k])[:, None] + step
            cx = (erf((u + 0.5) / s) - erf((u - 0.5) / s)) / 2
            cy = (erf((v + 0.5) / s) - erf((v - 0.5) / s)) / 2
            stamps = stamps + share * cy[:, :, None] * cx[:, None, :]
        stamps *= flux[k][:, None, None]
        iy, ix = yc[:, None] + step, xc[:, None] + step
        inside = ((iy >= 0) & (iy < size))[:, :, None] & ((ix >= 0) & (ix < size))[:, None, :]
        index = (iy * size)[:, :, None] + ix[:, None, :]
        np.add.at(image.reshape(-1), index[inside], stamps[inside].astype(np.float32))
    image = rng.poisson((image + sky) * gain) / gain + rng.normal(0, read, image.shape)
    return image.astype(np.float32), Table({"x": x, "y": y, "flux": flux})


def report(image, truth, *, gain, saturation=None):
    began, marks = time.process_time(), []
    background = subtract_background(image)
    marks.append(("background", time.process_time()))
    sources = detect_sources(background, gain=gain, saturation=saturation)
    marks.append(("detection", time.process_time()))
    epsf = build_epsf(background, sources, gain=gain)
    marks.append(("PSF", time.process_time()))
    fitted = fit_centroids(background, sources, epsf, gain=gain)
    marks.append(("fit", time.process_time()))
    clean = np.mean(fitted["flags"] == 0)
    print(f"{len(fitted)} sources, {clean:.0%} clean, FWHM {sources.meta['fwhm']:.2f} px", end="; ")
    for name, mark in marks:
        print(f"{name} {mark - began:.2f} s", end="  ")
        began = mark
    print("\n    flux        N  windowed    PSF  error   pull  pixel phase   chi2")
    distance, index = KDTree(np.column_stack([fitted["x"], fitted["y"]])).query(
        np.column_stack([truth["x"], truth["y"]])
    )
    good = (distance < 1) & (fitted["flags"][index] == 0)
    edges = 10 ** np.arange(2.5, 6.1, 0.5)
    for low, high in zip(edges[:-1], edges[1:]):
        rows = np.flatnonzero(good & (truth["flux"] > low) & (truth["flux"] <= high))
        if len(rows) < 5:
            continue
        k = index[rows]
        d, window, error = (
            np.concatenate(columns)
            for columns in zip(
                *(
                    (
                        fitted[c][k] - truth[c][rows],
                        sources[c][k] - truth[c][rows],
                        fitted[f"{c}_err"][k],
                    )
                    for c in "xy"
                )
            )
        )
        phase = 2 * np.pi * np.concatenate([truth[c][rows] for c in "xy"])
        terms = np.stack([np.sin(phase), np.cos(phase)], axis=1)
        limit = 4 * scatter(d)
        wave = np.linalg.lstsq(terms, np.clip(d, -limit, limit), rcond=None)[0]
        print(
            f"{low:8.0f} {len(rows):8d}  {scatter(window):8.4f} {scatter(d):6.4f} "
            f"{np.median(error):6.4f} {scatter(d / error):6.2f} "
            f"{np.hypot(*wave):12.4f} {np.median(fitted['chi2'][k]):6.2f}"
        )


def scatter(values):
    return 1.4826 * np.median(np.abs(values - np.median(values)))


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("image", nargs="?")
    parser.add_argument("truth", nargs="?")
    parser.add_argument("--size", type=int, default=2048)
    parser.add_argument("--stars", type=int, default=3000)
    parser.add_argument("--gain", type=float, default=1.1)
    args = parser.parse_args()
    if args.image:
        image, header = fits.getdata(args.image, header=True)
        truth = Table.read(args.truth)
        report(image, truth, gain=header.get("GAIN"), saturation=header.get("SATURATE"))
        return
    for fwhm in (1.6, 3.0):
        print(f"\n{args.size} x {args.size} px, {args.stars} stars, FWHM {fwhm} px")
        report(*draw(args.size, args.stars, fwhm, gain=args.gain), gain=args.gain)


if __name__ == "__main__":
    main()
