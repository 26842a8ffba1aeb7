"""Accuracy, errors, time and memory of the joint solution, from pairs to instrument and attitudes.

    python benchmarks/solution.py [--cases smooth-dense ...] [--seeds 1 2] [--scamp single]
    python benchmarks/solution.py --cases smooth-dense --whole

Fields come from the laboratory that stands beside the project (``truth.py``, ``field.py``,
``judge.py``), found through the environment variable WPDC_GWCS_LAB or as ../shared/lab.  The true
pairs are taken, 0.2 % of them made wrong, and the solution is compared with the truth on a grid
over the whole detector.  Pulls are residuals over predicted errors: of stars held out (20 %, in a
second solution), of the stars in the fit, and of the map itself, its error on the grid over
``calibration.uncertainty``.  Seconds are those of the processor, since other work delays the clock;
"table s" is the time of choosing and building the table, within "s".  SCAMP, where it is installed,
gets the files of the same case (degrees 3 and 5, rms in px).  With --whole nothing of that is done:
``wpdc calibrate`` runs from the catalogs to the WCS files, as often as --runs says, and its CPU and
wall seconds and peak memory are those of the system for the process and its children.
"""

import argparse
import json
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

LIMITS = {
    "smooth-dense": 0.0035,
    "smooth-sparse": 0.0068,
    "fine-dense": 0.0092,
    "fine-sparse": 0.0230,
    "single": 0.0058,
    "single-sparse": 0.0185,
}
NEW_EXPOSURE_LIMIT = 0.010
WRONG = 0.002  # share of wrong pairs
HOLDOUT = 0.2


def find_lab():
    root = Path(__file__).resolve().parent.parent
    lab = Path(os.environ.get("WPDC_GWCS_LAB") or root.parent / "shared" / "lab")
    if not (lab / "judge.py").is_file():
        sys.exit(f"laboratory not found: {lab} (set WPDC_GWCS_LAB to the folder of judge.py)")
    sys.path.insert(0, str(lab))


def pairs(truth, header, sources, ref, name, rng):
    """True pairs of one exposure as the solver takes them, some of them made wrong by a few px."""
    from wpdc_gwcs.solve import Exposure

    true_id = np.asarray(sources["true_id"])
    real = true_id >= 0
    ids = np.asarray(ref["source_id"])
    order = np.argsort(ids)
    row = order[np.searchsorted(ids[order], true_id[real])]
    x, y, x_err, y_err = (np.asarray(sources[c], float)[real] for c in ("x", "y", "x_err", "y_err"))
    wrong = rng.uniform(size=x.size) < WRONG
    x[wrong] += rng.normal(0, 5, wrong.sum())
    y[wrong] += rng.normal(0, 5, wrong.sum())
    return Exposure(
        name, x, y, np.asarray(ref["ra"])[row], np.asarray(ref["dec"])[row],
        crval=(header["CRVAL1"], header["CRVAL2"]),
        cd=np.array([[header["CD1_1"], header["CD1_2"]], [header["CD2_1"], header["CD2_2"]]]),
        x_err=x_err, y_err=y_err,
    )  # fmt: skip


def simulate(case, seed, **changes):
    from field import exposures
    from judge import CASES

    ref, observed = exposures(seed=seed, **{**CASES[case], **changes})
    rng = np.random.default_rng(seed)
    truths = [t for t, _, _ in observed]
    return truths, [pairs(*o, ref, f"e{k:02d}", rng) for k, o in enumerate(observed)]


def solve(truths, exposures, **options):
    from wpdc_gwcs.solve import solve as solve_camera

    truth = truths[0]
    return solve_camera(
        exposures, image_shape=(truth.ny, truth.nx), crpix=(truth.x0, truth.y0), **options
    )


def errors(truths, result, n=101):
    """Errors of every exposure on the grid, (n_exposures, 2, n * n), px."""
    return np.array(
        [grid_error(t, calibration(f, result)[0], n) for t, f in zip(truths, result.exposures)]
    )


def calibration(fit, result):
    from wpdc_gwcs.solution import Calibration

    solution = result.solution if fit.pv is None else replace(result.solution, pv=fit.pv)
    frame = Calibration(fit.name, solution, fit.crval, fit.cd, field=fit.field, sigma=fit.sigma)
    return frame.wcs, frame


def grid_error(truth, wcs, n):
    x, y = truth.grid(n)
    return truth.error_px(*wcs(x, y), x, y)


def rms(error):
    return float(np.sqrt(np.mean(np.sum(error**2, axis=1))))


def pulls(exposures, result, chosen):
    """Residual over predicted error of the chosen stars, wrong pairs left out."""
    values = []
    for e, fit, pick in zip(exposures, result.exposures, chosen):
        _, frame = calibration(fit, result)
        sigma_x, sigma_y, _ = frame.uncertainty(e.x, e.y)
        # A star of the fit has drawn the map toward itself.
        sign = np.where(fit.used, -1.0, 1.0)
        for residual, error, sigma in ((fit.dx, fit.x_err, sigma_x), (fit.dy, fit.y_err, sigma_y)):
            variance = error**2 + sign * sigma**2
            # Where a few stars make the map, their residuals say nothing.
            predicted = np.sqrt(np.where(variance > 0, variance, np.nan))
            values.append((residual / predicted)[pick])
    values = np.concatenate(values)
    return float(np.std(values[np.abs(values) < 5]))


def held_out_pulls(truths, exposures):
    rng = np.random.default_rng(0)
    kept = [rng.uniform(size=len(e.x)) >= HOLDOUT for e in exposures]
    result = solve(truths, [replace(e, use=k) for e, k in zip(exposures, kept)])
    return pulls(exposures, result, [~k for k in kept])


def map_pull(truths, result, error):
    """Error on the grid over the predicted one, root mean square."""
    x, y = truths[0].grid(round(np.sqrt(error.shape[-1])))
    values = [
        e / np.array(calibration(f, result)[1].uncertainty(x, y)[:2])
        for e, f in zip(error, result.exposures)
    ]
    return float(np.sqrt(np.mean(np.square(values))))


class TableClock:
    """Time spent choosing and building tables."""

    def __init__(self):
        from wpdc_gwcs.solve import tables

        self.seconds = 0.0
        for name in ("choose_table", "build_lookup_table"):
            setattr(tables, name, self._timed(getattr(tables, name)))

    def _timed(self, function):
        def run(*args, **options):
            start = time.process_time()
            try:
                return function(*args, **options)
            finally:
                self.seconds += time.process_time() - start

        return run


def new_exposure(seed, result):
    """A shallow exposure of the same camera against a stored solution: attitude only."""
    # Another sky and other noise, the same distortion.
    truths, exposures = simulate(
        "smooth-dense", seed, n=3, density=3.0, sky_seed=seed * 1000 + 7, dither=60.0
    )
    return rms(errors(truths, solve(truths, exposures, solution=result.solution)))


def scamp_beside(case, seed):
    import judge

    with tempfile.TemporaryDirectory() as folder:
        folder = Path(folder).resolve()
        ref, observed, catalogs = judge.build(case, seed, folder)
        return [judge.scamp_beside(ref, observed, catalogs, folder, d)["rms"] for d in (3, 5)]


def whole(case, seed, n_exposures, n_jobs):
    """CPU and wall seconds and peak memory in GB of the command, from catalogs to WCS files."""
    import judge

    if n_exposures is not None:
        judge.CASES[case]["n"] = n_exposures
    with tempfile.TemporaryDirectory() as folder:
        folder = Path(folder).resolve()
        _, observed, catalogs = judge.build(case, seed, folder)
        command = [sys.executable, "-m", "wpdc_gwcs", "calibrate", *catalogs, "--quiet"]
        command += ["--catalog", folder / "ref.fits", "--output", folder / "out", "--jobs", n_jobs]
        # From a small process: the peak of a child begins with that of its parent.
        code = "import json, os, subprocess, sys, time; began = time.perf_counter(); "
        code += "p = subprocess.Popen(sys.argv[1:]); _, status, u = os.wait4(p.pid, 0); "
        code += "wall = time.perf_counter() - began; "
        code += "print(json.dumps([status, u.ru_utime + u.ru_stime, wall, u.ru_maxrss / 2**20]))"
        timer = [sys.executable, "-S", "-E", "-c", code, *map(str, command)]
        answer = subprocess.run(timer, check=True, capture_output=True, text=True).stdout
        status, *figures = json.loads(answer)
        if status or len(list((folder / "out").glob("*.wcs.asdf"))) != len(catalogs):
            sys.exit(f"{case}: not all exposures were solved")
        return figures, [len(sources) for _, _, sources in observed]


def print_whole(options):
    print(f"{'case':14s} {'seed':>4s} {'files':>5s} {'sources':>7s} {'CPU s':>6s} {'wall s':>6s} "
          f"{'GB':>5s}")  # fmt: skip
    for seed in options.seeds:
        for case in options.cases:
            runs = [whole(case, seed, options.exposures, options.jobs) for _ in range(options.runs)]
            cpu, wall, peak = np.median([figures for figures, _ in runs], axis=0)
            sources = runs[0][1]
            print(
                f"{case:14s} {seed:4d} {len(sources):5d} {np.median(sources):7.0f} {cpu:6.1f} "
                f"{wall:6.1f} {peak:5.2f}",
                flush=True,
            )


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", nargs="+", choices=LIMITS, default=list(LIMITS))
    parser.add_argument("--seeds", nargs="+", type=int, default=[1])
    parser.add_argument("--refine", choices=("auto", "attitude", "field", "pv"), default="auto")
    parser.add_argument(
        "--exposures", type=int, metavar="N", help="so many instead of those of the case"
    )
    parser.add_argument("--no-pulls", action="store_true", help="skip the second solution")
    parser.add_argument(
        "--scamp", choices=("none", "single", "all"), default="single", help="run SCAMP beside"
    )
    parser.add_argument(
        "--whole", action="store_true", help="time the command from catalogs to WCS files instead"
    )
    parser.add_argument("--runs", type=int, default=1, help="of --whole, medians are printed")
    parser.add_argument("--jobs", type=int, default=1, help="of --whole")
    options = parser.parse_args()
    find_lab()
    if options.whole:
        return print_whole(options)
    scamp = options.scamp if shutil.which("scamp") else "none"
    if scamp != options.scamp:
        print("scamp is not installed: left out")
    clock = TableClock()
    print(
        f"{'case':14s} {'seed':>4s} {'rms px':>8s} {'limit':>7s} {'median':>7s} {'max':>7s} "
        f"{'<0.01':>6s} {'held':>6s} {'used':>6s} {'map':>6s} {'s':>6s} {'table s':>7s} {'MiB':>6s}"
        "  table"
    )
    found = {}
    for seed in options.seeds:
        for case in options.cases:
            changes = {} if options.exposures is None else {"n": options.exposures}
            truths, exposures = simulate(case, seed, **changes)
            clock.seconds, start = 0.0, time.process_time()
            result = solve(truths, exposures, refine=options.refine)
            seconds, table_seconds = time.process_time() - start, clock.seconds
            memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
            error = errors(truths, result)
            total = np.hypot(error[:, 0], error[:, 1])
            pull = (
                np.nan if options.no_pulls else held_out_pulls(truths, exposures),
                pulls(exposures, result, [f.used for f in result.exposures]),
                map_pull(truths, result, error),
            )
            found.setdefault(case, []).append((rms(error), *pull))
            table = result.solution.statistics["table"]
            line = (
                f"{case:14s} {seed:4d} {rms(error):8.5f} {LIMITS[case]:7.4f} "
                f"{np.median(total):7.4f} {total.max():7.4f} {np.mean(total < 0.01):6.1%} "
                f"{pull[0]:6.3f} {pull[1]:6.3f} {pull[2]:6.3f} {seconds:6.1f} {table_seconds:7.1f} "
                f"{memory:6.0f}  {table['kernel']} {table['epsilon']:g} degree {table['degree']}, "
                f"{table['freedom']:.0f} parameters"
            )
            if scamp == "all" or (scamp == "single" and len(exposures) == 1):
                line += "; SCAMP 3/5: {:.2f} {:.2f}".format(*scamp_beside(case, seed))
            print(line, flush=True)
            if case == "smooth-dense":
                print(
                    f"{' + 3 / arcmin2':14s} {seed:4d} {new_exposure(seed, result):8.5f} "
                    f"{NEW_EXPOSURE_LIMIT:7.4f}",
                    flush=True,
                )
    if len(options.seeds) > 1:
        print(f"\nover {len(options.seeds)} seeds: worst rms, mean pulls")
        for case, rows in found.items():
            held, used, of_map = np.mean(rows, axis=0)[1:]
            print(
                f"{case:19s} {np.max(rows, axis=0)[0]:8.5f} {LIMITS[case]:7.4f} {'':22s} "
                f"{held:6.3f} {used:6.3f} {of_map:6.3f}"
            )


if __name__ == "__main__":
    main()
