"""How much the error of the paper's literal method depends on the distortion that is drawn.

    python benchmarks/literal.py [--seeds 11 12 13 14 15] [--densities 5 46] [--exposures 25]

One detector of 9216 x 9232 px with a distortion of 200 px, another one for each seed, in dithered
exposures with source lists of 0.02 px at best.  Printed are the errors of the delivered WCS against
the truth over the whole detector, px: rms and median of the literal method, rms of the default.
"""

import argparse
import time
import warnings

import astropy.units as u
import numpy as np


def errors(run, simulation):
    """Lengths of the errors of all frames on a grid, px."""
    truths = {exposure.name: exposure for exposure in simulation.exposures}
    found = [truths[c.frame].wcs_error(c.wcs)[2:] for c in run.calibrations]
    return np.hypot(*np.concatenate(found, axis=1))


def main():
    from wpdc_gwcs import calibrate, simulate
    from wpdc_gwcs.calibration import Settings

    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs="+", default=[11, 12, 13, 14, 15])
    parser.add_argument("--densities", type=float, nargs="+", default=[5.0, 46.0])
    parser.add_argument("--exposures", type=int, default=25)
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    print(f"{'per arcmin2':>11s} {'seed':>5s} {'paper rms':>10s} {'median':>8s} "
          f"{'default rms':>12s} {'CPU s':>6s}")  # fmt: skip
    for density in options.densities:
        rows = []
        for seed in options.seeds:
            start = time.process_time()
            simulation = simulate(
                options.exposures, image_shape=(9232, 9216), pixel_scale=0.074 * u.arcsec,
                distortion=200.0, density=density, centroid_floor=0.02, catalog_errors=False,
                seed=seed,
            )  # fmt: skip
            frames = [exposure.frame() for exposure in simulation.exposures]
            row = []
            for method in ("paper", "wpdc"):
                settings = Settings(method=method, r0=4000.0)
                run = calibrate(frames, simulation.reference, settings=settings)
                length = errors(run, simulation)
                row += [np.sqrt(np.mean(length**2)), np.median(length)]
            rows.append(row)
            print(f"{density:11g} {seed:5d} {row[0]:10.3f} {row[1]:8.3f} {row[2]:12.4f} "
                  f"{time.process_time() - start:6.0f}", flush=True)  # fmt: skip
        low, middle, high = np.percentile(rows, [0, 50, 100], axis=0)
        for name, k in (("paper", 0), ("default", 2)):
            print(f"{density:g} per arcmin2, {name}: rms {low[k]:.4f} to {high[k]:.4f}, "
                  f"median {middle[k]:.4f}")  # fmt: skip


if __name__ == "__main__":
    main()
