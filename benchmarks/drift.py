"""How often a changed look-up table is found, and how often an unchanged one is called changed.

    python benchmarks/drift.py [--trials 40] [--seeds 1 2 3 4 5]
    python benchmarks/drift.py --update [--seeds 1 2 3 4 5]
    python benchmarks/drift.py --update-alarms [--trials 100] [--seeds 1 2 3 4 5]

For each seed a solution is made of some exposures of one camera of the laboratory (``truth.py``,
``field.py``; see ``solution.py``); then other exposures of the same camera, of another part of the
sky, are solved against it, attitudes only, and tested with ``detect_drift``.  A change is 0.05 px
over a quarter of the detector: the same everywhere in it, a gradient, a bump, or a ripple.  "area"
is the share of the changed part in the cells named, "false area" the share of the unchanged part
in them; "found" is the amplitude that is reported for a change of the size "true", both in px over
the cells that are named.

With ``--update`` a camera of its own is solved from 8 exposures; a wave of half the detector's
length and 0.18 px amplitude is added to it or not, and up to 6 new exposures update the stored
solution, together or one after the other.  "stored", "updated", "all" are root mean square errors
of the map (both axes, px): of the stored solution, of the updated one, of all exposures solved
together; "ratio" is that of the last two, "moved" says how often a change was found.
"""

import argparse
import dataclasses
import time

import numpy as np
from solution import find_lab, simulate, solve

SIZE = 0.05
QUARTERS = ("corner", "strip", "center", "band")
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
    elif quarter == "center":
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


SIDE = 2048
WAVE = 0.18


class Simulated:
    """A camera with smooth distortion and finer structure; its exposures have turbulence."""

    cd = np.array([[-2e-5, 3e-7], [3e-7, 2e-5]])

    def __init__(self, rng, *, stars, turbulence, noise=0.03):
        self.rng, self.stars, self.turbulence, self.noise = rng, stars, turbulence, noise
        self.wave = None
        self.angle, self.phase, self.toward = rng.uniform(0, 2 * np.pi, 3)
        self.fine = rng.uniform(0, 2 * np.pi, 4)

    def change(self):
        """Let a wave of half the detector's length run over it from now on."""
        self.wave = WAVE

    def displacement(self, x, y):
        u, v = 2 * x / SIDE - 1, 2 * y / SIDE - 1
        r = u * u + v * v
        dx = 4 * u * r + 0.8 * u * v + 0.5 * u**3 * v**2
        dy = 4 * v * r - 0.5 * u * u - 0.4 * u**5
        dx = dx + 0.05 * np.sin(5 * u + self.fine[0]) * np.sin(4 * v + self.fine[1])
        dy = dy + 0.05 * np.sin(4 * u + self.fine[2]) * np.sin(5 * v + self.fine[3])
        if self.wave is not None:
            k = 2 * np.pi * (np.cos(self.angle) * u + np.sin(self.angle) * v)
            size = self.wave * np.sin(k + self.phase)
            dx, dy = dx + np.cos(self.toward) * size, dy + np.sin(self.toward) * size
        return np.array([dx, dy])

    def expose(self, n):
        from wpdc_gwcs.models import deproject
        from wpdc_gwcs.solve import Exposure

        out = []
        for k in range(n):
            crval = 40.0 + 0.01 * self.rng.normal(size=2)
            x, y = self.rng.uniform(0, SIDE - 1, (2, self.stars))
            place = self.displacement(x, y) + np.array([x, y]) - 0.5 * (SIDE - 1)
            place += self.turbulence * seeing(self.rng, x, y)
            cd = self.cd * (1 + 1e-5 * self.rng.normal())
            ra, dec = deproject(*(cd @ place), crval)
            x, y = np.array([x, y]) + self.noise * self.rng.normal(size=(2, self.stars))
            error = np.full(self.stars, self.noise)
            out.append(Exposure(f"e{k}", x, y, ra, dec, crval, self.cd, error, error))
        return out

    def error(self, solution, n=41):
        """Root mean square of the error of the distortion, both axes, without a linear part."""
        x, y = (a.ravel() for a in np.meshgrid(*[np.linspace(0, SIDE - 1, n)] * 2))
        found = np.array(solution.undistort(x, y))
        true = self.displacement(x, y) + [x, y]
        rows = np.stack([np.ones_like(x), *found], axis=1)
        rest = true.T - rows @ np.linalg.lstsq(rows, true.T, rcond=None)[0]
        return float(np.sqrt(np.mean(np.sum(rest**2, axis=1))))


def solve_simulated(exposures, **options):
    from wpdc_gwcs.solve import solve as solve_camera

    return solve_camera(exposures, image_shape=(SIDE, SIDE), **options).solution


def updates(options):
    """Table of the errors of the map before and after updates, and of the alarms."""
    print(f"{'stars':>5s} {'px':>5s} {'change':7s} {'new':>6s} {'stored':>8s} {'updated':>8s} "
          f"{'all':>8s} {'ratio':>6s} {'moved':>7s} {'s':>5s}")  # fmt: skip
    for stars, turbulence in ((300, 0.03), (2000, 0.0)):
        for changed in (True, False):
            rows = {}
            for seed in options.seeds:
                one_camera(seed, stars, turbulence, changed, rows)
            for new, values in rows.items():
                stored, updated, together, moved, seconds = np.array(values, float).T
                whole = "" if np.isnan(together).any() else (
                    f"{np.mean(together):8.4f} {np.mean(updated / together):6.3f}")  # fmt: skip
                print(f"{stars:5d} {turbulence:5.2f} {'wave' if changed else 'none':7s} {new:>6s} "
                      f"{np.mean(stored):8.4f} {np.mean(updated):8.4f} {whole:15s} "
                      f"{int(moved.sum()):3d}/{len(moved):3d} {seconds.mean():5.1f}",
                      flush=True)  # fmt: skip


def false_alarms(options):
    """How often an unchanged camera moves, from one and from six new exposures."""
    print(f"{'stars':>5s} {'px':>5s} {'new':>4s}  moved without a change")
    for stars, turbulence in ((300, 0.03), (2000, 0.0)):
        moved = {1: [], 6: []}
        for seed in options.seeds:
            camera = Simulated(np.random.default_rng(seed), stars=stars, turbulence=turbulence)
            stored = solve_simulated(camera.expose(8))
            for n, found in moved.items():
                for _ in range(-(-options.trials // len(options.seeds))):
                    updated = solve_simulated(camera.expose(n), solution=stored, update=True)
                    found.append(updated.statistics["updates"][-1]["process_noise"] > 0)
        for n, found in moved.items():
            print(
                f"{stars:5d} {turbulence:5.2f} {n:4d}  {sum(found):3d}/{len(found):3d}", flush=True
            )


def one_camera(seed, stars, turbulence, changed, rows):
    camera = Simulated(np.random.default_rng(seed), stars=stars, turbulence=turbulence)
    old = camera.expose(8)
    stored = solve_simulated(old)
    if changed:
        camera.change()
    new = camera.expose(6)
    before = camera.error(stored)

    def row(name, solution, n, seconds, together=np.nan):
        found = [u["process_noise"] > 0 for u in solution.statistics["updates"][-n:]]
        rows.setdefault(name, []).append(
            (before, camera.error(solution), together, any(found), seconds)
        )

    for n in (1, 6):
        start = time.perf_counter()
        updated = solve_simulated(new[:n], solution=stored, update=True)
        seconds = time.perf_counter() - start
        together = np.nan if changed else camera.error(
            solve_simulated([*old, *(dataclasses.replace(e, name="n" + e.name) for e in new[:n])])
        )  # fmt: skip
        row(str(n), updated, 1, seconds, together)
    start, one = time.perf_counter(), stored
    for e in new:
        one = solve_simulated([e], solution=one, update=True)
    row("6 x 1", one, 6, time.perf_counter() - start)


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
    parser.add_argument("--update", action="store_true",
                        help="how well --update follows a wave, no laboratory")  # fmt: skip
    parser.add_argument("--update-alarms", action="store_true",
                        help="how often --update moves a camera that has not changed")  # fmt: skip
    options = parser.parse_args()
    if options.update:
        updates(options)
        return
    if options.update_alarms:
        false_alarms(options)
        return
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
