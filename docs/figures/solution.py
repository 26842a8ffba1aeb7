"""Measure and draw the figures of the page about the method.

    python docs/figures/solution.py [degrees half field errors]

Exposures of one detector of 4096 x 4096 px with a distortion of 60 px are simulated, some of them
with turbulence, the true pairs are solved, and the solutions are compared with the truth on a grid
over the whole detector.  Writes ``solution_*.png`` into ``docs/images`` and prints the numbers.
"""

import argparse
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from astropy import units as u
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from numpy.polynomial.legendre import legvander
from scipy.interpolate import RectBivariateSpline

from wpdc_gwcs import Calibration, simulate
from wpdc_gwcs.solve import Exposure
from wpdc_gwcs.solve import solve as solve_exposures

IMAGES = Path(__file__).resolve().parent.parent / "images"
SIDE = 4096
CENTER = (2047.5, 2047.5)
EXTENT = (-0.5, SIDE - 0.5, -0.5, SIDE - 0.5)
BLUE, ORANGE, GREEN, GRAY = "#0072B2", "#D55E00", "#009E73", "#555555"


class Turbulence:
    """Displacement by the atmosphere: gradient of a potential with the spectrum of von Karman."""

    def __init__(self, rms, scale, seed):
        n, box = 384, 3.0 * SIDE
        k = 2 * np.pi * np.fft.fftfreq(n, box / n)
        kx, ky = np.meshgrid(k, k)
        square = kx**2 + ky**2
        square[0, 0] = np.inf
        power = (1 + square * (scale / (2 * np.pi)) ** 2) ** (-11 / 6) / square
        noise = np.fft.fft2(np.random.default_rng(seed).normal(size=(n, n)))
        potential = noise * np.sqrt(power)
        fields = np.array([np.fft.ifft2(1j * a * potential).real for a in (kx, ky)])
        fields *= rms / np.sqrt(np.mean(fields**2))
        at = np.arange(n) * box / n - SIDE
        self._splines = [RectBivariateSpline(at, at, field) for field in fields]

    def __call__(self, x, y):
        return np.array([s(y, x, grid=False) for s in self._splines])


def make(n, density, seed, *, rms=0.0, scale=1500.0, waves=0.05):
    """Simulated exposures, their pairs, and the turbulence of each."""
    sky = simulate(
        n, image_shape=(SIDE, SIDE), pixel_scale=0.15 * u.arcsec, density=density, distortion=60.0,
        waves=waves, dither=40 * u.arcsec, seed=seed, spurious=0.0, centroid_floor=0.02,
    )  # fmt: skip
    air = [Turbulence(rms, scale, [seed, k]) if rms else (lambda x, y: np.zeros((2, len(x))))
           for k in range(n)]  # fmt: skip
    exposures = []
    for e, move in zip(sky.exposures, air):
        s = e.sources[np.asarray(e.sources["reference_index"]) >= 0]
        x, y = (np.asarray(s[c], float) for c in "xy")
        dx, dy = move(x, y)
        inside = np.all((np.array([x + dx, y + dy]) > -0.5), axis=0)
        inside &= np.all(np.array([x + dx, y + dy]) < SIDE - 0.5, axis=0)
        r = sky.reference[np.asarray(s["reference_index"])]
        header = e.header
        columns = {
            "x": x + dx, "y": y + dy, "ra": np.asarray(r["ra"], float),
            "dec": np.asarray(r["dec"], float),
            "x_err": np.hypot(np.asarray(s["x_err"]), np.asarray(r["ra_error"], float) / 150),
            "y_err": np.hypot(np.asarray(s["y_err"]), np.asarray(r["dec_error"], float) / 150),
        }  # fmt: skip
        exposures.append(
            Exposure(
                e.name, **{name: column[inside] for name, column in columns.items()},
                crval=(header["CRVAL1"], header["CRVAL2"]),
                cd=np.array([[header[f"CD{i}_{j}"] for j in (1, 2)] for i in (1, 2)]),
            )
        )  # fmt: skip
    return sky, exposures, air


def select(exposure, keep):
    """Leave some pairs of an exposure."""
    names = ("x", "y", "ra", "dec", "x_err", "y_err")
    return replace(exposure, **{name: getattr(exposure, name)[keep] for name in names})


def solve(exposures, **options):
    return solve_exposures(exposures, image_shape=(SIDE, SIDE), crpix=CENTER, **options)


def calibration(result, k):
    fit = result.exposures[k]
    solution = result.solution if fit.pv is None else replace(result.solution, pv=fit.pv)
    return Calibration(fit.name, solution, fit.crval, fit.cd, field=fit.field, sigma=fit.sigma)


def error(sky, air, result, k, n_grid=61):
    """Grid, and error ``(2, N)`` of a delivered WCS with the turbulence as part of the truth."""
    x, y, dx, dy = sky.exposures[k].wcs_error(calibration(result, k).wcs, n_grid=n_grid)
    return x, y, np.array([dx, dy]) + air[k](x, y)


def total(values):
    """Root mean square of the length of the vectors."""
    return float(np.sqrt(np.mean(np.sum(values**2, axis=0))))


def draw_degrees():
    """Learned standard deviations of the degrees of one exposure, against the true ones."""
    sky, (full,), _ = make(1, 20.0, 1, waves=0.0)
    degrees = np.arange(2, 8)
    figure = Figure(figsize=(6.0, 3.9), layout="constrained")
    axes = figure.subplots()
    true = true_sizes(sky.exposures[0], degrees)
    axes.plot(degrees, true, "o-", color=GRAY, lw=5, ms=9, alpha=0.4, label="true coefficients")
    print("true sizes", true.round(3))
    rng = np.random.default_rng(1)
    for n, color, style in ((30, ORANGE, "^--"), (100, GREEN, "s-."), (len(full.x), BLUE, "o-")):
        keep = np.sort(rng.permutation(len(full.x))[:n])
        sizes = solve([select(full, keep)]).solution.statistics["learned"]["polynomial"]
        axes.plot(degrees, sizes, style, color=color, ms=5, label=f"learned from {n} stars")
        print(f"{n} stars: {np.round(sizes, 3)}")
    axes.set_yscale("log")
    axes.set_ylim(1e-3, 30)
    axes.annotate("no terms of\ndegree 7", (7, 1.1e-3), (5.1, 2.2e-3), color=GRAY, fontsize=9,
                  arrowprops={"arrowstyle": "->", "color": GRAY})  # fmt: skip
    axes.set_xlabel("degree of the polynomial")
    axes.set_ylabel("standard deviation of a coefficient [px]")
    axes.grid(alpha=0.3)
    axes.legend(frameon=False, loc="lower left")
    return figure


def true_sizes(exposure, degrees):
    """Root mean square of the Legendre coefficients of a simulated distortion, by degree."""
    x, y = (a.ravel() for a in np.meshgrid(*(np.linspace(0, SIDE - 1, 81),) * 2))
    moved = np.array(exposure.distortion.undistort(x, y)) - [x, y]
    u, v = (2 * (a - CENTER[0]) / SIDE for a in (x, y))
    last = degrees[-1] + 3
    p, q = legvander(u, last), legvander(v, last)
    orders = [(n - j, j) for n in range(last + 1) for j in range(n + 1)]
    columns = np.stack([p[:, i] * q[:, j] for i, j in orders], axis=1)
    coefficients = np.linalg.lstsq(columns, moved.T, rcond=None)[0]
    order = np.sum(orders, axis=1)
    return np.array([np.sqrt(np.mean(coefficients[order == n] ** 2)) for n in degrees])


def draw_half():
    """Error and stated uncertainty where only half of the detector has stars."""
    sky, (full,), air = make(1, 20.0, 3, waves=0.0)
    left = np.flatnonzero(full.x < SIDE / 2)
    exposure = select(full, np.sort(np.random.default_rng(1).permutation(left)[:200]))
    result = solve([exposure])
    x, y, off = error(sky, air, result, 0)
    sigma = np.array(calibration(result, 0).uncertainty(x, y)[:2])
    for name, part in (("left", x < SIDE / 2), ("right", x >= SIDE / 2)):
        share = np.mean(np.abs(off[:, part]) < 2 * sigma[:, part])
        print(f"half, {name}: error {total(off[:, part]):.3f} px rms, stated "
              f"{total(sigma[:, part]):.3f}, {share:.0%} within two sigma")  # fmt: skip
    figure = Figure(figsize=(9.0, 4.2), layout="constrained")
    panels = figure.subplots(1, 2, sharey=True)
    for axes, values, name in zip(panels, (off, sigma), ("true error", "stated uncertainty")):
        size = np.hypot(*values).reshape(61, 61)
        image = axes.imshow(
            size, origin="lower", extent=EXTENT, cmap="viridis", norm=LogNorm(0.005, 10)
        )
        lines = axes.contour(
            x.reshape(61, 61), y.reshape(61, 61), size, levels=(0.1, 1), colors="w",
            linewidths=0.8,
        )  # fmt: skip
        axes.clabel(lines, fmt="%g px", fontsize=8)
        axes.plot(exposure.x, exposure.y, ".", color="w", ms=2.5)
        axes.set_title(name, fontsize=10)
        axes.set_xlabel("x [px]")
    panels[0].set_ylabel("y [px]")
    figure.colorbar(image, ax=panels, label="px", extend="both", ticks=(0.01, 0.1, 1, 10))
    return figure


def draw_field():
    """Field of one of four exposures: truth, what was found, and what is left."""
    sky, exposures, air = make(4, 60.0, 5, rms=0.05, scale=4000.0)
    result = solve(exposures)
    x, y, off = error(sky, air, result, 0)
    true = air[0](x, y)
    found = true - off
    print(f"field: true {total(true):.4f} px rms, left {total(off):.4f} px, "
          f"{len(exposures[0].x)} stars, {result.exposures[0].statistics['field']}")  # fmt: skip
    figure = Figure(figsize=(9.6, 3.4), layout="constrained")
    panels = figure.subplots(1, 3, sharey=True)
    step = (slice(None, None, 4),) * 2
    for axes, values, name in zip(panels, (true, found, off), ("truth", "found", "difference")):
        square = [a.reshape(61, 61) for a in (x, y, *values)]
        image = axes.imshow(
            np.hypot(*square[2:]), origin="lower", extent=EXTENT, cmap="viridis", vmin=0,
            vmax=0.12,
        )  # fmt: skip
        axes.quiver(
            *(a[step] for a in square), color="w", angles="xy", scale_units="xy", scale=0.0003,
            width=0.004,
        )  # fmt: skip
        axes.set_title(f"{name}, {total(values):.3f} px rms", fontsize=10)
        axes.set_xlabel("x [px]")
        axes.set_xticks((0, 2000, 4000))
    panels[0].set_ylabel("y [px]")
    figure.colorbar(image, ax=panels, label="displacement [px]", extend="max", shrink=0.9)
    return figure


NUMBERS = (1, 2, 4, 8)
KINDS = (
    ("auto", "fields by evidence (auto)", BLUE, "o-"),
    ("attitude", "six numbers (attitude)", GREEN, "^-."),
    ("pv", "own polynomials (pv, the paper's)", ORANGE, "s--"),
)


def draw_errors():
    """Error of the delivered WCS by number of exposures, without and with turbulence."""
    figure = Figure(figsize=(9.0, 3.9), layout="constrained")
    panels = figure.subplots(1, 2, sharey=True)
    cases = ((0.0, "no turbulence"), (0.05, "turbulence of 0.05 px along each axis"))
    for axes, (rms, title) in zip(panels, cases):
        for refine, label, color, style in KINDS:
            found = []
            for n in NUMBERS:
                sky, exposures, air = make(n, 20.0, 2, rms=rms)
                result = solve(exposures, refine=refine)
                off = [error(sky, air, result, k)[2] for k in range(n)]
                found.append(total(np.concatenate(off, axis=1)))
                print(f"{title}: {refine}, {n} exposures: {found[-1]:.4f} px", flush=True)
            axes.plot(NUMBERS, found, style, color=color, label=label)
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.set_xticks(NUMBERS, [str(n) for n in NUMBERS])
        ticks = (0.005, 0.01, 0.02, 0.05, 0.1)
        axes.set_yticks(ticks, [f"{t:g}" for t in ticks])
        axes.minorticks_off()
        axes.grid(alpha=0.3)
        axes.set_title(title, fontsize=10)
        axes.set_xlabel("exposures of 2000 stars each")
    panels[0].set_ylabel("error of the WCS, rms [px]")
    panels[0].legend(frameon=False, fontsize="small")
    return figure


def main():
    figures = {"degrees": draw_degrees, "half": draw_half, "field": draw_field,
               "errors": draw_errors}  # fmt: skip
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("figures", nargs="*", help=f"which of {', '.join(figures)}; all by default")
    chosen = parser.parse_args().figures or list(figures)
    for name in chosen:
        save = partial(figures[name]().savefig, dpi=90)
        save(IMAGES / f"solution_{name}.png")


if __name__ == "__main__":
    main()
