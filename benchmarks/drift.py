"""How often a changed look-up table is found, and how often an unchanged one is called changed.

    python benchmarks/drift.py [--trials 40] [--seeds 1 2 3 4 5]

For each seed a solution is made of some exposures of one camera of the laboratory (``truth.py``,
``field.py``; see ``solution.py``); then other exposures of the same camera, of another part of the
sky, are solved against it, attitudes only, and tested with ``detect_drift``.  A change is 0.05 px
over a quarter of the detector: the same everywhere in it, a gradient, a bump, or a ripple.  "area"
is the share of the changed part in the cells named, "false area" the share of the unchanged part
in them; "found" is the amplitude that is reported for a change of the size "true", both in px over
the cells that are named.
"""

import argparse
import time

import numpy as np
from solution import find_lab, simulate, solve

SIZE = 0.05
QUARTERS = ("corner", "strip", "centre", "band")
SHAPES = ("constant", "gradient", "bump", "ripple")


def change(x, y, half, *, quarter, turn, shape, angle):
    """Change of the table at places in units of half the detector, -1 to 1; (2, N) px."""
    a, b = x / half[0] - 1.0, y / half[1] - 1.0
    for _ in range(turn):
        a, b = -b, a
    if quarter == "corner":
        inside, s, t = (a > 0) & (b > 0), 2 * a - 1, 2 * b - 1
    elif quarter == "strip":
        inside, s, t = a > 0.5, 4 * a - 3, b
    elif quarter == "centre":
        inside, s, t = np.maximum(abs(a), abs(b)) < 0.5, 2 * a, 2 * b
    else:
        inside, s, t = abs(a - 0.25) < 0.25, 4 * a - 1, b
    size = {
        "constant": np.ones_like(s),
        "gradient": 0.5 * (1 + s),
        "bump": np.exp(-2.0 * (s**2 + t**2)),
        "ripple": np.sin(np.pi * s),
    }[shape]
    size = SIZE * np.where(inside, size, 0.0)
    return np.array([np.cos(angle) * size, np.sin(angle) * size]), inside


def seeing(rng, x, y, n=8):
    """Waves of random direction and phase, both axes, of rms 1."""
    length, turn, phase = rng.uniform(1000, 4000, n), *rng.uniform(0, 2 * np.pi, (2, n))
    amplitude = rng.normal(size=(2, n)) * np.sqrt(2 / n)
    k = 2 * np.pi / length
    return amplitude @ np.sin(
        np.outer(k * np.cos(turn), x) + np.outer(k * np.sin(turn), y) + phase[:, None]
    )


def matches_of(result):
    from astropy.table import Table

    return [
        Table({"x": e.x, "y": e.y, "dx": f.dx, "dy": f.dy, "x_err": f.x_err, "y_err": f.y_err,
               "used": f.used})
        for e, f in result
    ]  # fmt: skip


class Camera:
    """A stored solution and noise-free pairs of other exposures of the same camera."""

    def __init__(self, case, seed, n_stored, n_pool=8):
        truths, exposures = simulate(case, seed, n=n_stored)
        self.truth = truths[0]
        self.solution = solve(truths, exposures).solution
        self.half = 0.5 * np.array([self.truth.nx, self.truth.ny])
        truths, self.pool = simulate(
            case, seed, n=n_pool, density=60.0, sky_seed=seed * 1000 + 13, dither=60.0, noise=False
        )
        self.truths = truths

    def trial(self, rng, n, changed, turbulence=0.0):
        from dataclasses import replace

        from wpdc_gwcs.evaluation import detect_drift

        exposures = []
        for k in rng.choice(len(self.pool), n, replace=False):
            e = self.pool[k]
            move = changed(e.x, e.y)[0] if changed else np.zeros((2, len(e.x)))
            move = move - turbulence * seeing(rng, e.x, e.y)
            x, y = np.array([e.x, e.y]) - move + rng.normal(size=(2, len(e.x))) * [e.x_err, e.y_err]
            keep = rng.uniform(size=len(x)) < 0.9
            exposures.append(
                replace(e, x=x[keep], y=y[keep], ra=e.ra[keep], dec=e.dec[keep],
                        x_err=e.x_err[keep], y_err=e.y_err[keep])
            )  # fmt: skip
        result = solve(self.truths, exposures, solution=self.solution)
        return detect_drift(self.solution, matches_of(zip(exposures, result.exposures)))


def judge(drift, changed, truth):
    """Shares of changed and unchanged area named, and reported and true amplitude there."""
    x, y = (
        a.ravel()
        for a in np.meshgrid(np.linspace(0, truth.nx - 1, 129), np.linspace(0, truth.ny - 1, 129))
    )
    true, inside = changed(x, y)
    named = np.zeros(x.size, bool)
    for c in drift.cells[drift.cells["changed"]]:
        box = [c[k].value for k in ("x_min", "x_max", "y_min", "y_max")]
        named |= (x >= box[0]) & (x < box[1]) & (y >= box[2]) & (y < box[3])
    amplitude = np.sqrt(np.mean(np.sum(true[:, named] ** 2, axis=0))) if named.any() else np.nan
    return named[inside].mean(), named[~inside].mean(), drift.amplitude, amplitude


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--trials", type=int, default=40, help="of each kind for each seed")
    parser.add_argument("--seeds", nargs="+", type=int, default=[1, 2, 3, 4, 5])
    parser.add_argument("--cases", nargs="+", default=["smooth-dense", "fine-dense"])
    parser.add_argument("--stored", nargs="+", type=int, default=[25, 5],
                        help="exposures behind the stored solution")  # fmt: skip
    parser.add_argument("--exposures", nargs="+", type=int, default=[5])
    parser.add_argument("--turbulence", type=float, default=0.0, metavar="PX",
                        help="rms of waves that differ between exposures")  # fmt: skip
    parser.add_argument("--cells", action="store_true", help="show what false alarms consist of")
    options = parser.parse_args()
    find_lab()
    print(f"{'case':13s} {'stored':>6s} {'tested':>6s}  {'change':9s} {'trials':>6s} "
          f"{'alarms':>7s} {'area':>5s} {'false':>6s} "
          f"{'found':>8s} {'true':>8s} {'s':>5s}")  # fmt: skip
    for case in options.cases:
        for stored in options.stored:
            cameras = [Camera(case, seed, stored) for seed in options.seeds]
            for n in options.exposures:
                for shape in (None, *SHAPES):
                    report(case, stored, n, shape, cameras, options)


def report(case, stored, n, shape, cameras, options):
    rng = np.random.default_rng(n)
    alarms, found, start = [], [], time.perf_counter()
    per_camera = []
    for camera in cameras:
        mine = []
        trials = options.trials if shape is None else -(-options.trials // len(SHAPES))
        for k in range(trials):
            options_k = {"quarter": QUARTERS[k % 4], "turn": int(rng.integers(4)), "shape": shape,
                         "angle": rng.uniform(0, 2 * np.pi)}  # fmt: skip

            def changed(x, y, options_k=options_k, camera=camera):
                return change(x, y, camera.half, **options_k)

            drift = camera.trial(rng, n, None if shape is None else changed, options.turbulence)
            mine.append(drift.drifted)
            if shape is not None:
                found.append(judge(drift, changed, camera.truth))
            elif drift.drifted and options.cells:
                drift.cells[:3].pprint(max_width=-1)
        alarms += mine
        per_camera.append(int(np.sum(mine)))
    seconds = (time.perf_counter() - start) / len(alarms)
    line = f"{case:13s} {stored:6d} {n:6d}  {shape or 'none':9s} {len(alarms):6d} "
    line += f"{np.mean(alarms):7.1%} "
    if found:
        line += "{:5.0%} {:6.1%} {:8.4f} {:8.4f} ".format(*np.nanmean(found, axis=0))
    else:
        line += " " * 31
    print(f"{line}{seconds:5.2f}  {per_camera}", flush=True)


if __name__ == "__main__":
    main()
