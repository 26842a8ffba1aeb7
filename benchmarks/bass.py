"""Fields simulated from real 90Prime headers: reference points off the chip, a cubic, and a table.

    python benchmarks/bass.py [--exposures 4] [--stars 2500] [--r0 2000]

The TPV headers of BASS (``wcs_headers/legacysurvey/90prime`` under WPDC_GWCS_DATA or
../shared/data) are of small cut-outs.  Each is put on a chip of 4032 x 4096 px beside its reference
point, as 90Prime's four chips stand about theirs, and is the truth: stars are drawn on the chip and
taken to the sky by ``astropy.wcs``, their positions measured with errors of 0.02 to 0.1 px (8 to 45
mas), and ``calibrate`` starts from the header with its pointing off by 3 arcsec.  The reference
point becomes the source nearest to the chip's center (``reference_point="nearest-source"``).

Printed are the standard deviations of RA and Dec of the calibrated WCS against the header, in mas,
on a grid over the chip: cubic alone with the weight exp-sqrt, and with a look-up table; the limits
are the figures of the paper (its section 4.2) for the cubic.
"""

import argparse
import os
import sys
import time
import warnings
from pathlib import Path

import numpy as np

SHAPE = (4096, 4032)
GAP = (184, 60)  # px between the reference point and the nearest corner of the chip
LIMIT = (5.5, 10.0)


def find_headers():
    root = Path(__file__).resolve().parent.parent
    data = Path(os.environ.get("WPDC_GWCS_DATA") or root.parent / "shared" / "data")
    found = sorted((data / "wcs_headers" / "legacysurvey" / "90prime").glob("*.fits"))
    if not found:
        sys.exit(f"no headers found under {data} (set WPDC_GWCS_DATA)")
    return found


def chip_of(path):
    """The header's WCS on a whole chip, and the degree of its polynomial."""
    from dataclasses import replace

    from wpdc_gwcs.io.headers import read_headers
    from wpdc_gwcs.io.tan import parse_tan

    tan = parse_tan(next(h for h in read_headers(path) if h["CTYPE1"].endswith("TPV")))
    crpix = [-g if c < 0 else n + g for c, g, n in zip(tan.crpix, GAP, SHAPE[::-1])]
    return replace(tan, crpix=np.array(crpix, float), image_shape=SHAPE)


def simulate(tan, n_exposures, n_stars, rng):
    """Frames and the reference catalog; the truth of each frame is an `astropy.wcs.WCS`."""
    from dataclasses import replace

    from astropy.table import QTable, vstack

    from wpdc_gwcs.frame import Frame

    frames, truths, catalogs = [], [], []
    for k in range(n_exposures):
        # Far enough apart for each exposure to have its own stars.
        crval = tan.crval + [k * 1.0 / np.cos(np.radians(tan.crval[1])), 0.0]
        truth = replace(tan, crval=crval).to_wcs()
        x, y = (rng.uniform(-0.5, n - 0.5, n_stars) for n in SHAPE[::-1])
        ra, dec = truth.all_pix2world(x, y, 0)
        flux = 10 ** rng.uniform(2.5, 5.0, n_stars)
        error = np.clip(0.1 * np.sqrt(10**2.5 / flux), 0.02, None)
        seen = rng.uniform(size=n_stars) > 0.05
        sources = QTable(
            {"x": x + rng.normal(size=n_stars) * error, "y": y + rng.normal(size=n_stars) * error,
             "x_err": error, "y_err": error, "flux": flux, "snr": 1 / error}
        )[seen]  # fmt: skip
        catalogs.append(
            QTable({"ra": ra, "dec": dec, "phot_g_mean_mag": 25 - 2.5 * np.log10(flux)})
        )
        start = replace(tan, crval=crval + rng.normal(0, 3 / 3600, 2)).to_wcs()
        frames.append(
            Frame(
                name=f"e{k}", detector="ccd", image_shape=SHAPE, wcs=start, source=f"e{k}",
                load_sources=lambda sources=sources: sources,
            )
        )  # fmt: skip
        truths.append(truth)
    catalog = vstack(catalogs)
    catalog["ra"].unit = catalog["dec"].unit = "deg"
    return frames, truths, catalog


def scatter(calibration, truth, n=101):
    """Standard deviations of RA cos Dec and of Dec against the truth over the chip, mas."""
    x, y = (a.ravel() for a in np.meshgrid(*(np.linspace(0, m - 1, n) for m in SHAPE[::-1])))
    ra, dec = calibration.wcs(x, y)
    true_ra, true_dec = truth.all_pix2world(x, y, 0)
    return (
        np.std((ra - true_ra) * np.cos(np.radians(true_dec))) * 3.6e6,
        np.std(dec - true_dec) * 3.6e6,
    )


def main():
    from wpdc_gwcs import calibrate, read_catalog
    from wpdc_gwcs.calibration import Settings

    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--exposures", type=int, default=4)
    parser.add_argument("--stars", type=int, default=2500, help="on the chip in each exposure")
    parser.add_argument("--r0", type=float, default=2000.0)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    print(f"limit for a cubic header: {LIMIT[0]} / {LIMIT[1]} mas")
    print(f"{'header':38s} {'degree':>6s} {'reference point':>16s} {'anchored':>12s} "
          f"{'cubic RA/Dec':>14s} {'+ table':>13s} {'s':>5s}")  # fmt: skip
    rows = []
    for k, path in enumerate(find_headers()):
        tan = chip_of(path)
        rng = np.random.default_rng([options.seed, k])
        frames, truths, catalog = simulate(tan, options.exposures, options.stars, rng)
        catalog = read_catalog(catalog)
        row, start = [], time.perf_counter()
        for lut in ("none", "auto"):
            settings = Settings(reference_point="nearest-source", r0=options.r0, lut=lut)
            run = calibrate(frames, catalog, settings=settings)
            for name, error in run.failures.items():
                print(f"{path.stem} {name}: {error}")
            found = [scatter(c, t) for c, t in zip(run.calibrations, truths)]
            row += list(np.sqrt(np.mean(np.square(found), axis=0)))
        crpix = run.calibrations[0].solution.crpix
        rows.append((tan.pv.degree, *row))
        print(f"{path.stem:38s} {tan.pv.degree:6d} {tan.crpix[0]:8.0f}{tan.crpix[1]:8.0f} "
              f"{crpix[0]:6.0f}{crpix[1]:6.0f} {row[0]:6.2f} /{row[1]:6.2f} "
              f"{row[2]:6.2f} /{row[3]:5.2f} {time.perf_counter() - start:5.1f}",
              flush=True)  # fmt: skip
    rows = np.array(rows)
    for degree in np.unique(rows[:, 0]):
        worst = rows[rows[:, 0] == degree, 1:].max(axis=0)
        print(f"worst of degree {degree:.0f}: cubic {worst[0]:.2f} / {worst[1]:.2f}, "
              f"with table {worst[2]:.2f} / {worst[3]:.2f} mas")  # fmt: skip


if __name__ == "__main__":
    main()
