"""Measure and draw the figures of the page about the two phases.

    python docs/figures/two_phases.py [--repeat 1]

Exposures of one detector of 4096 x 4096 px with a distortion of 60 px and waves of 0.05 px are
simulated, the true pairs are solved, and the solutions are compared with the truth on a grid over
the whole detector.  Writes ``two_phases_maps.png``, ``two_phases_errors.png`` and
``two_phases_weights.png`` into ``docs/images`` and prints the numbers.
"""

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
from astropy import units as u
from astropy.table import QTable
from matplotlib.figure import Figure

from wpdc_gwcs import Calibration, simulate
from wpdc_gwcs.evaluation import binned_residuals, compare_weights, tabulate_weights
from wpdc_gwcs.plotting import plot_weights
from wpdc_gwcs.solve import Exposure
from wpdc_gwcs.solve import solve as solve_exposures

IMAGES = Path(__file__).resolve().parent.parent / "images"
SHAPE = (4096, 4096)
CENTRE = (2047.5, 2047.5)
BLUE, ORANGE, GREEN = "#0072B2", "#D55E00", "#009E73"


def make(n, density, seed):
    sky = simulate(
        n, image_shape=SHAPE, pixel_scale=0.15 * u.arcsec, density=density, distortion=60.0,
        waves=0.05, dither=40 * u.arcsec, seed=seed, spurious=0.0, centroid_floor=0.02,
    )  # fmt: skip
    exposures = []
    for e in sky.exposures:
        s = e.sources[np.asarray(e.sources["reference_index"]) >= 0]
        r = sky.reference[np.asarray(s["reference_index"])]
        header = e.header
        exposures.append(
            Exposure(
                e.name, np.asarray(s["x"]), np.asarray(s["y"]),
                np.asarray(r["ra"], float), np.asarray(r["dec"], float),
                crval=(header["CRVAL1"], header["CRVAL2"]),
                cd=np.array([[header[f"CD{i}_{j}"] for j in (1, 2)] for i in (1, 2)]),
                x_err=np.hypot(np.asarray(s["x_err"]), np.asarray(r["ra_error"], float) / 150),
                y_err=np.hypot(np.asarray(s["y_err"]), np.asarray(r["dec_error"], float) / 150),
            )
        )  # fmt: skip
    return sky, exposures


def solve(exposures, **options):
    return solve_exposures(exposures, image_shape=SHAPE, crpix=CENTRE, **options)


def calibrations(exposures, result):
    found = []
    for e, f in zip(exposures, result.exposures):
        solution = result.solution if f.pv is None else replace(result.solution, pv=f.pv)
        matches = QTable(
            {"x": e.x, "y": e.y, "x_err": f.x_err, "y_err": f.y_err, "ra": e.ra, "dec": e.dec,
             "dx": f.dx, "dy": f.dy, "used": f.used}
        )  # fmt: skip
        found.append(
            Calibration(
                f.name, solution, f.crval, f.cd, field=f.field, sigma=f.sigma, matches=matches
            )
        )  # fmt: skip
    return found


def map_error(sky, exposures, result):
    """Root mean square error of the delivered WCS over the detector, all exposures, px."""
    square = []
    for exposure, c in zip(sky.exposures, calibrations(exposures, result)):
        dx, dy = exposure.wcs_error(c.wcs, n_grid=61)[2:]
        square.append(np.mean(dx**2 + dy**2))
    return np.sqrt(np.mean(square))


def draw_maps(exposures):
    figure = Figure(figsize=(8.0, 7.2), layout="constrained")
    panels = figure.subplots(2, 2, sharex=True, sharey=True)
    with_table = solve(exposures)
    for row, label, limit in (
        (panels[0], "polynomial alone", None), (panels[1], "with look-up table", 0.02)
    ):  # fmt: skip
        columns = []
        for e, f in zip(exposures, with_table.exposures):
            table = np.zeros((2, len(e.x)))
            if limit is None:
                table = np.array(with_table.solution.lookup_table(e.x, e.y))
            columns.append([a[f.used] for a in (e.x, e.y, f.dx + table[0], f.dy + table[1])])
        x, y, dx, dy = np.concatenate(columns, axis=1)
        maps = binned_residuals(x, y, dx, dy, image_shape=SHAPE)[:2]
        rms = np.sqrt(np.nanmean(maps[0] ** 2 + maps[1] ** 2))
        print(f"{label}: cell means {rms:.4f} px rms, {np.nanmax(np.hypot(*maps)):.3f} px at most")
        limit = limit or float(np.nanpercentile(np.abs(maps), 97))
        for axes, values, name in zip(row, maps, (r"$\Delta X$", r"$\Delta Y$")):
            image = axes.imshow(
                values, origin="lower", extent=(-0.5, 4095.5, -0.5, 4095.5), cmap="RdBu_r",
                vmin=-limit, vmax=limit,
            )  # fmt: skip
            axes.set_title(f"{name}, {label}", fontsize=10)
        figure.colorbar(image, ax=row, label="mean residual [px]", extend="both")
    for axes in panels[1]:
        axes.set_xlabel("x [px]")
    for axes in panels[:, 0]:
        axes.set_ylabel("y [px]")
    return figure


NUMBERS, DENSITIES = (1, 2, 4, 8, 16), (5.0, 20.0, 60.0)
KINDS = (
    ("one instrument, attitudes", {}, BLUE, "o-"),
    ("own polynomials (the paper's)", {"refine": "pv"}, ORANGE, "s--"),
    ("no table", {"lut": "none"}, GREEN, "^:"),
)


def measure_errors(repeat):
    """Stars of an exposure and error of its WCS by kind, density and number of exposures."""
    found = {}
    for density in DENSITIES:
        for n in NUMBERS if density == 20.0 else (8,):
            for seed in range(1, repeat + 1):
                sky, exposures = make(n, density, seed)
                stars = np.mean([len(e.x) for e in exposures])
                for name, options, *_ in KINDS:
                    error = map_error(sky, exposures, solve(exposures, **options))
                    found.setdefault((name, density, n), []).append((stars, error))
    found = {key: np.mean(values, axis=0) for key, values in found.items()}
    for (name, density, n), (stars, error) in found.items():
        print(f"{name:30s} {density:3.0f} / arcmin2 = {stars:5.0f} stars, {n:2d} exposures: "
              f"{error:.4f} px")  # fmt: skip
    return found


def draw_errors(found):
    figure = Figure(figsize=(9.0, 3.9), layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True)
    for name, _, color, style in KINDS:
        error = [found[name, 20.0, n][1] for n in NUMBERS]
        left.plot(NUMBERS, error, style, color=color, label=name)
        stars, error = np.array([found[name, d, 8] for d in DENSITIES]).T
        right.plot(stars, error, style, color=color)
    for axes in (left, right):
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.grid(alpha=0.3)
    left.set_xticks(NUMBERS, [str(n) for n in NUMBERS])
    right.set_xticks([500, 1000, 2000, 6000], ["500", "1000", "2000", "6000"])
    ticks = (0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.4)
    left.set_yticks(ticks, [f"{t:g}" for t in ticks])
    for axes in (left, right):
        axes.minorticks_off()
    left.set_xlabel("exposures of 2000 stars each")
    right.set_xlabel("stars in each of 8 exposures")
    left.set_ylabel("error of the WCS, rms [px]")
    left.legend(frameon=False, fontsize="small", loc="center left", bbox_to_anchor=(0, 0.68))
    return figure


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repeat", type=int, default=1, help="simulations of each kind")
    options = parser.parse_args()
    _, exposures = make(16, 20.0, 1)
    draw_maps(exposures).savefig(IMAGES / "two_phases_maps.png", dpi=90)
    _, exposures = make(8, 20.0, 1)
    results = compare_weights(calibrations(exposures, solve(exposures)))
    columns = ("weight", "table", "sigma_dx", "d80_dx", "sigma_dy", "d80_dy")
    tabulate_weights(results)[columns].pprint()
    plot_weights(results).savefig(IMAGES / "two_phases_weights.png", dpi=80)
    draw_errors(measure_errors(options.repeat)).savefig(IMAGES / "two_phases_errors.png", dpi=90)


if __name__ == "__main__":
    main()
