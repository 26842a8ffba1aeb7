"""One exposure with few stars: what is delivered, how far off it is, and whether its errors say so.

    python benchmarks/few_stars.py [--seeds 1 2 ...] [--stars 15 25 ...] [--layout all half ...]

Fields are drawn here, one frame for each seed: a distortion (radial about a point off the axis, a
polynomial of degree 2 to 6, long waves with tangential decentering, or an arctangent as of a
fisheye), 20 to 200 px at the worst corner but at most 8 % of local scale, on detectors from 128 x
4000 to 9216 x 9232 px of 0.05 to 1 arcsec per px, anywhere on the sky, every fifth frame at a pole,
at any roll.  The header is a plain TAN, right at the center but for some arcsec, 0.1 deg and 0.2 %.
"stars" are the stars that source list and catalog have in common, measured with errors of 0.01 to
0.1 px; a fifth as many sources are spurious, a fifth of the catalog's stars on the detector have
no source, and the catalog goes on beyond the detector.  In the layouts half, edge, band and
corner it ends at the border of that part of the detector, and with it the common stars.

Errors are those of the delivered WCS on a grid of 41 x 41 over the whole detector, in undistorted
px.  "error" and "sigma" are medians over the frames of the root mean square over the grid, "e/s"
is the root mean square of error over ``calibration.uncertainty``: 1 is right.  "off" counts frames
called solved that are more than 0.5 px off over more than 10 % of the detector, "no match" those of
the failed ones that had no pairs to solve, "wrong" wrong pairs.  Of the partial layouts, "empty" is
the part without stars, "< 3 s" the share of its errors below three sigma, each axis for itself, and
"hull" the convex hull of the stars.  At the end each requirement, and whether it is met.
"""

import argparse
import logging
import warnings
from concurrent.futures import ProcessPoolExecutor
from functools import cached_property
from multiprocessing import get_context

import numpy as np
from astropy.table import Table
from astropy.wcs import WCS
from scipy.spatial import Delaunay

LAYOUTS = ("all", "half", "edge", "band", "corner")
SHAPES = ((2048, 2048), (4096, 2048), (9232, 9216), (4000, 128))  # (ny, nx)
EPOCH = 2016.0
CATALOG_ERROR = 0.2  # mas
STRETCH = 0.08  # greatest change of the local scale and rotation
ENOUGH = 15  # common stars that must do
OFF = (0.5, 0.1)  # px, share of the detector
N_GRID = 41


# Distortions: functions of px from the center over half the diagonal, to within a factor


def radial(rng):
    center, share = rng.uniform(-0.3, 0.3, 2), rng.uniform(-1, 1)

    def move(u, v):
        a, b = u - center[0], v - center[1]
        r2 = a**2 + b**2
        return (r2 + share * r2**2) * np.array([a, b])

    return move


def polynomial(rng):
    degree = rng.integers(2, 7)
    powers = np.array([(n - q, q) for n in range(2, degree + 1) for q in range(n + 1)])
    factors = rng.normal(size=(2, len(powers))) * 0.5 ** (powers.sum(axis=1) - 2)
    return lambda u, v: np.tensordot(factors, [u**p * v**q for p, q in powers], axes=1)


def waves(rng):
    n = 4
    size = rng.normal(size=(2, n))
    k = 2 * np.pi / rng.uniform(2, 5, n)  # two half diagonals are the whole one
    turn, phase = rng.uniform(0, 2 * np.pi, (2, n))
    p, q = rng.normal(size=2)

    def move(u, v):
        angle = np.multiply.outer(u, k * np.cos(turn)) + np.multiply.outer(v, k * np.sin(turn))
        r2 = u**2 + v**2
        decentering = [
            p * (r2 + 2 * u**2) + 2 * q * u * v,
            q * (r2 + 2 * v**2) + 2 * p * u * v,
        ]
        return np.moveaxis(np.sin(angle + phase) @ size.T, -1, 0) + decentering

    return move


def fisheye(rng):
    center, reach = rng.uniform(-0.2, 0.2, 2), rng.uniform(0.2, 0.9)

    def move(u, v):
        a, b = u - center[0], v - center[1]
        r = np.hypot(a, b)
        # What was seen at the angle r stands at its tangent on the plane.
        angle = np.maximum(reach * np.minimum(r, 1.5), 1e-9)
        return (np.tan(angle) / angle - 1) * np.array([a, b])

    return move


KINDS = (radial, polynomial, waves, fisheye)


class Field:
    """The truth of one frame, its source list and its catalog."""

    def __init__(self, seed, stars, layout="all", *, errors=True):
        rng = np.random.default_rng([seed, stars, LAYOUTS.index(layout)])
        self.kind = KINDS[seed % len(KINDS)]
        self.shape = SHAPES[(seed // len(KINDS)) % len(SHAPES)]
        self.center = 0.5 * (np.array(self.shape[::-1]) - 1)
        self.half_diagonal = float(np.hypot(*self.center))
        self._draw_distortion(rng)
        self._draw_sky(rng, seed)
        self._draw_part(rng, layout)
        self._draw_stars(rng, stars, errors)

    def _draw_distortion(self, rng):
        self._raw, self._origin, self._factor = self.kind(rng), np.zeros((2, 3)), 1.0
        step = 1e-3
        at = np.array([[0, step, 0], [0, 0, step]])
        value = self._raw(*at)
        # The header is right at the center, in place, scale and rotation.
        self._origin = np.column_stack([value[:, 0], (value[:, 1:] - value[:, :1]) / step])
        amplitude = np.exp(rng.uniform(np.log(20), np.log(200)))
        x, y = self.grid
        corner = np.hypot(*self.displacement(x, y)).max()
        slopes = [
            (self.displacement(x + i, y + j) - self.displacement(x, y)) for i, j in ((1, 0), (0, 1))
        ]
        stretch = np.linalg.norm(np.array(slopes), axis=(0, 1)).max()
        self._factor = min(amplitude / corner, STRETCH / stretch)
        self.corner = corner * self._factor

    def _draw_sky(self, rng, seed):
        scale = np.exp(rng.uniform(np.log(0.05), np.log(1.0))) / 3600
        dec = np.degrees(np.arcsin(rng.uniform(-1, 1)))
        if seed % 5 == 0:
            dec = rng.choice([-1, 1]) * (90 - rng.uniform(0, 0.2))
        crpix = self.center * rng.uniform(0.9, 1.1, 2)
        if rng.uniform() < 0.25:  # off the detector, as of a chip in a mosaic
            crpix = rng.choice([-0.1, 1.1], 2) * self.shape[::-1]
        crval, roll = np.array([rng.uniform(0, 360), dec]), rng.uniform(0, 360)
        cd = scale * turn(roll) @ np.diag([rng.choice([-1, 1]), 1])
        self.tan = tan_wcs(crpix, crval, cd)
        place = np.ravel(self.tan.wcs_pix2world(*self.center, 0))
        # The header's error is that of the center, also where its reference point is far off.
        here = self._local_cd(place)
        wrong = turn(rng.normal(0, 0.1)) @ here * (1 + rng.normal(0, 0.002))
        off = rng.normal(0, 3, 2) / 3600 @ np.linalg.inv(here).T
        self.header = tan_wcs(self.center + off, place, wrong)

    def _local_cd(self, place):
        """CD matrix of the center on its own tangent plane: near a pole north turns quickly."""
        plane = tan_wcs([0.0, 0.0], place, np.eye(2))
        step = np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])
        at = plane.wcs_world2pix(self.tan.wcs_pix2world(self.center + step, 0), 0)
        return 0.5 * np.column_stack([at[0] - at[1], at[2] - at[3]])

    def _draw_part(self, rng, layout):
        low, axis, side = rng.uniform(-0.8, 0.2), rng.integers(2), rng.choice([-1, 1], 2)

        def covered(x, y):
            t = (np.array([x, y]) - self.center[:, None]) / (self.center[:, None] + 0.5)
            return {
                "all": np.ones(t.shape[1], bool),
                "half": side[0] * t[axis] > 0,
                "edge": np.abs(t).max(axis=0) > 0.8,
                "band": (t[axis] > low) & (t[axis] < low + 0.6),
                "corner": (side[:, None] * t > 0).all(axis=0),
            }[layout]

        self.covered = covered

    def _draw_places(self, rng, n, reach=1.0, *, beside=0.0):
        """Places of the catalog's part up to ``reach`` detectors, none up to ``beside``."""
        x, y = np.empty((2, 0))
        while x.size < n:
            t = rng.uniform(-reach, reach, (2, 8 * n))
            t = t[:, np.abs(t).max(axis=0) >= beside]
            new = self.center[:, None] + t * (self.center[:, None] + 0.4)
            new = new[:, self.covered(*new)]
            x, y = np.append(x, new[0]), np.append(y, new[1])
        return x[:n], y[:n]

    def _draw_stars(self, rng, n, errors):
        lost, spurious = round(0.2 * n), round(0.2 * n)
        reach = 1.5
        on_detector = self._draw_places(rng, n + lost)
        around = self._draw_places(rng, round((n + lost) * (reach**2 - 1)), reach, beside=1.0)
        x, y = np.concatenate([on_detector, around], axis=1)
        mag = draw_magnitudes(rng, x.size)
        ra, dec = self.sky(x, y)
        error = CATALOG_ERROR / 3.6e6
        self.x, self.y = x[:n], y[:n]
        order = rng.permutation(x.size)
        dec_read = dec + rng.normal(0, error, x.size)
        ra_read = ra + rng.normal(0, error, x.size) / np.cos(np.radians(dec))
        self.catalog = Table(
            {"ra": ra_read, "dec": dec_read, "phot_g_mean_mag": 16 + mag,
             "ra_error": np.full(x.size, CATALOG_ERROR),
             "dec_error": np.full(x.size, CATALOG_ERROR),
             "ref_epoch": np.full(x.size, EPOCH)},
            units={"ra": "deg", "dec": "deg", "ra_error": "mas", "dec_error": "mas"},
        )[order]  # fmt: skip
        self.row = np.argsort(order)[:n]  # of the common stars in the catalog

        mag = np.append(mag[:n], draw_magnitudes(rng, spurious))
        sigma = 0.01 * 10 ** (mag / 5)
        xs, ys = (
            np.append(a, rng.uniform(0, m - 1, spurious))
            for a, m in zip((self.x, self.y), self.shape[::-1])
        )
        flux = 1e5 * 10 ** (-0.4 * (mag + rng.normal(0, 0.05, mag.size)))
        sources = Table(
            {"x": xs + sigma * rng.normal(size=xs.size), "y": ys + sigma * rng.normal(size=xs.size),
             "flux": flux}
        )  # fmt: skip
        if errors:
            sources["x_err"], sources["y_err"], sources["snr"] = sigma, sigma, 1.6 / sigma
        order = rng.permutation(len(sources))
        self.sources = sources[order]
        self.true = np.where(order < n, self.row[np.minimum(order, n - 1)], -1)

    @cached_property
    def grid(self):
        x, y = np.meshgrid(*(np.linspace(0, m - 1, N_GRID) for m in self.shape[::-1]))
        return x.ravel(), y.ravel()

    def displacement(self, x, y):
        u, v = (np.array([x, y]) - self.center[:, None]) / self.half_diagonal
        # Far beyond the detector no polynomial means anything.
        u, v = np.clip(u, -1.2, 1.2), np.clip(v, -1.2, 1.2)
        linear = self._origin @ [np.ones_like(u), u, v]
        return self._factor * (self._raw(u, v) - linear)

    def undistort(self, x, y):
        return np.array([x, y]) + self.displacement(x, y)

    def sky(self, x, y):
        return self.tan.wcs_pix2world(*self.undistort(x, y), 0)

    def error(self, wcs):
        """Error of a WCS on the grid, (2, N) undistorted px."""
        x, y = self.grid
        return np.array(self.tan.wcs_world2pix(*wcs(x, y), 0)) - self.undistort(x, y)

    def frame(self):
        from wpdc_gwcs.frame import Frame

        return Frame(
            name="frame", detector="ccd", image_shape=self.shape, wcs=self.header, epoch=EPOCH,
            source="frame", load_sources=lambda: self.sources,
        )  # fmt: skip


def turn(angle):
    c, s = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    return np.array([[c, -s], [s, c]])


def tan_wcs(crpix, crval, cd):
    wcs = WCS(naxis=2)
    wcs.wcs.ctype, wcs.wcs.cunit = ["RA---TAN", "DEC--TAN"], ["deg", "deg"]
    wcs.wcs.crpix, wcs.wcs.crval, wcs.wcs.cd = np.asarray(crpix) + 1, crval, cd
    wcs.wcs.set()
    return wcs


def draw_magnitudes(rng, n):
    """Magnitudes 0 to 5, 0.01 to 0.1 px, more of them faint."""
    return np.log10(1 + rng.uniform(size=n) * (10 ** (0.25 * 5) - 1)) / 0.25


def rms(values):
    return float(np.sqrt(np.mean(np.square(values)))) if np.size(values) else np.nan


def measure(job):
    """Solve one frame and compare it with the truth."""
    from wpdc_gwcs import read_catalog
    from wpdc_gwcs.calibration import calibrate

    layout, stars, seed, errors = job
    warnings.simplefilter("ignore")
    logging.getLogger("wpdc_gwcs").setLevel(logging.ERROR)  # the reasons are in the summary
    field = Field(seed, stars, layout, errors=errors)
    run = calibrate([field.frame()], read_catalog(field.catalog))
    row = run.summary[0]
    found = {"layout": layout, "stars": stars, "seed": seed, "kind": field.kind.__name__,
             "shape": field.shape, "corner": field.corner, "status": str(row["status"]),
             "reason": str(row["reason"]), "pairs": int(row["n_pairs"])}  # fmt: skip
    if not run.calibrations:
        return found
    calibration = run.calibrations[0]
    matches = calibration.matches
    right = field.true[matches["source_index"]] == np.asarray(matches["catalog_index"])
    error = field.error(calibration.wcs)
    # What the WCS does not map is as wrong as can be, what has no stated error says nothing.
    error = np.where(np.isfinite(error), error, 1e6)
    sigma = np.array(calibration.uncertainty(*field.grid)[:2])
    pull = np.where(sigma > 0, error / sigma, np.inf)
    empty = ~field.covered(*field.grid)
    points = np.column_stack([field.x, field.y])
    hull = Delaunay(points).find_simplex(np.column_stack(field.grid)) >= 0
    return found | {
        "matched": len(matches), "right": int(right.sum()),
        "error": rms(error), "sigma": rms(sigma), "pull": rms(pull),
        "off": float(np.mean(np.hypot(*error) > OFF[0])),
        "empty_error": rms(error[:, empty]), "empty_sigma": rms(sigma[:, empty]),
        "within": float(np.mean(np.abs(pull[:, empty]) < 3)) if empty.any() else np.nan,
        "hull_error": rms(error[:, hull]), "hull_sigma": rms(sigma[:, hull]),
    }  # fmt: skip


def counts(rows):
    return [sum(r["status"] == s for r in rows) for s in ("solved", "degraded", "failed")]


def is_off(row):
    return row["status"] == "solved" and not row["off"] <= OFF[1]


def values(rows, name):
    """What the frames have of it that were delivered."""
    return np.array([r[name] for r in rows if name in r])


def quantile(numbers, q=0.5):
    """Quantile by a number that is there: where no error is stated, the pull is infinite."""
    return float(np.quantile(numbers, q, method="higher")) if len(numbers) else np.nan


def mean(numbers):
    return float(np.mean(numbers)) if len(numbers) else np.nan


def show(number, form):
    """Format a number, or a dash where nothing was delivered."""
    width = int(form.split(".")[0] or 1)
    return f"{'-':>{width}s}" if np.isnan(number) else f"{number:{form}}"


def show_counts(rows):
    unmatched = sum(r["status"] == "failed" and r["pairs"] == 0 for r in rows)
    solved, degraded, failed = counts(rows)
    off = sum(map(is_off, rows))
    return f"{solved:6d} {degraded:8d} {failed:6d} {unmatched:8d} {off:4d}"


COUNTS = f"{'solved':>6s} {'degraded':>8s} {'failed':>6s} {'no match':>8s} {'off':>4s}"


def report_all(rows_of):
    print(
        f"\n{'layout':7s} {'stars':>5s} {COUNTS} {'matched':>7s} {'wrong':>5s} {'error px':>9s} "
        f"{'worst':>8s} {'sigma px':>9s} {'e/s':>6s} {'90 %':>6s}"
    )
    for stars, rows in rows_of.items():
        error, pull = values(rows, "error"), values(rows, "pull")
        wrong = values(rows, "matched") - values(rows, "right")
        print(
            f"{'all':7s} {stars:5d} {show_counts(rows)} "
            f"{show(quantile(values(rows, 'matched')), '7.0f')} {np.sum(wrong):5.0f} "
            f"{show(quantile(error), '9.4f')} {show(quantile(error, 1.0), '8.3f')} "
            f"{show(quantile(values(rows, 'sigma')), '9.4f')} "
            f"{show(quantile(pull), '6.2f')} {show(quantile(pull, 0.9), '6.2f')}"
        )


def hull_ratio(rows):
    return values(rows, "hull_sigma") / values(rows, "hull_error")


def report_parts(rows_of):
    print(
        f"\n{'layout':7s} {'stars':>5s} {COUNTS} {'empty: error':>12s} {'sigma':>9s} {'< 3 s':>7s} "
        f"{'hull: error':>11s} {'sigma':>8s} {'s/e':>6s} {'10 %':>6s} {'90 %':>6s}"
    )
    for (layout, stars), rows in rows_of.items():
        ratio = hull_ratio(rows)
        print(
            f"{layout:7s} {stars:5d} {show_counts(rows)} "
            f"{show(quantile(values(rows, 'empty_error')), '12.4f')} "
            f"{show(quantile(values(rows, 'empty_sigma')), '9.4f')} "
            f"{show(mean(values(rows, 'within')), '7.2%')} "
            f"{show(quantile(values(rows, 'hull_error')), '11.4f')} "
            f"{show(quantile(values(rows, 'hull_sigma')), '8.4f')} {show(quantile(ratio), '6.2f')} "
            f"{show(quantile(ratio, 0.1), '6.2f')} {show(quantile(ratio, 0.9), '6.2f')}"
        )


def check_all(rows_of):
    """Requirements of the whole detector: what was found, and whether that will do."""
    rows = sum(rows_of.values(), [])
    off = sum(map(is_off, rows))
    yield (
        f"solved but off ({OFF[0]} px over {OFF[1]:.0%}): 0 wanted, {off} of {len(rows)}",
        off == 0,
    )
    enough = [r for r in rows if r["stars"] >= ENOUGH]
    refused = counts(enough)[2]
    yield f"refused with {ENOUGH} stars: 0 wanted, {refused} of {len(enough)}", refused == 0
    for name, q, low, high in (("median", 0.5, 0.7, 1.5), ("90 % quantile", 0.9, 0.0, 2.5)):
        found = [quantile(values(r, "pull"), q) for r in rows_of.values()]
        yield (
            f"{name} of e/s: {low:g} to {high:g} wanted, "
            + "  ".join(f"{n}: {show(v, '.2f')}" for n, v in zip(rows_of, found)),
            all(low <= v <= high for v in found),
        )


def check_parts(rows_of):
    """Requirements of the partial layouts, each layout for itself."""
    layouts = {}
    for (layout, _), rows in rows_of.items():
        layouts[layout] = layouts.get(layout, []) + rows
    degraded = {x: counts(rows)[1] for x, rows in layouts.items()}
    yield (
        "degraded: all wanted, "
        + "  ".join(f"{x}: {n} of {len(layouts[x])}" for x, n in degraded.items()),
        all(n == len(layouts[x]) for x, n in degraded.items()),
    )
    within = {x: mean(values(rows, "within")) for x, rows in layouts.items()}
    yield (
        "error < 3 sigma in the empty part: 99 % wanted, "
        + "  ".join(f"{x}: {show(v, '.2%')}" for x, v in within.items()),
        all(v >= 0.99 for v in within.values()),
    )
    ratio = {x: quantile(hull_ratio(rows)) for x, rows in layouts.items()}
    yield (
        "median sigma/error in the hull: 0.5 to 2 wanted, "
        + "  ".join(f"{x}: {show(v, '.2f')}" for x, v in ratio.items()),
        all(0.5 <= v <= 2 for v in ratio.values()),
    )


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", nargs="+", type=int, default=list(range(1, 21)),
                        help="one frame each for every layout and number of stars")  # fmt: skip
    parser.add_argument("--stars", nargs="+", type=int, default=[15, 25, 40, 60, 100, 200])
    parser.add_argument("--part-stars", nargs="+", type=int, default=[25, 60, 200],
                        help="numbers of stars in the layouts other than all")  # fmt: skip
    parser.add_argument("--layout", nargs="+", choices=LAYOUTS, default=list(LAYOUTS))
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--no-errors", action="store_true", help="sources without stated errors")
    parser.add_argument("--frames", action="store_true", help="a line for each frame")
    options = parser.parse_args()
    cells = {
        (layout, stars): []
        for layout in options.layout
        for stars in (options.stars if layout == "all" else options.part_stars)
    }
    jobs = [(*cell, seed, not options.no_errors) for cell in cells for seed in options.seeds]
    with ProcessPoolExecutor(options.jobs, mp_context=get_context("spawn")) as pool:
        for row in pool.map(measure, jobs):
            cells[row["layout"], row["stars"]].append(row)
            if options.frames:
                print_frame(row)
    whole = {stars: rows for (layout, stars), rows in cells.items() if layout == "all"}
    parts = {cell: rows for cell, rows in cells.items() if cell[0] != "all"}
    checks = []
    if whole:
        report_all(whole)
        checks += check_all(whole)
    if parts:
        report_parts(parts)
        checks += check_parts(parts)
    print()
    for line, met in checks:
        print(f"{'ok' if met else 'MISSED':6s}  {line}")


def print_frame(row):
    ny, nx = row["shape"]
    line = (
        f"{row['layout']:6s} {row['stars']:4d} {row['seed']:4d} {row['kind']:10s} "
        f"{nx:5d} x {ny:5d} {row['corner']:5.0f} px  {row['status']:8s} "
    )
    if "error" in row:
        line += (
            f"{row['right']:4d}/{row['matched']:4d} {row['error']:9.4f} {row['sigma']:8.4f} "
            f"{row['pull']:7.2f} {row['off']:5.0%} "
        )
    print(line + row["reason"], flush=True)


if __name__ == "__main__":
    main()
