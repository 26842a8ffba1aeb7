"""What is left of a run that is stopped: signals at any moment of ``--jobs 2`` over old results.

Each trial calibrates the same frames again with ``--overwrite``, is sent SIGKILL, SIGTERM or Ctrl-C
at a random moment, and is then completed by ``--resume``.  Before and after, all sets of files must
be whole and of one run, nothing may be lost, no process may live on, and the numbers must be those
of a run that was never stopped.  Signals go to the program alone or, as of a terminal and of batch
systems, to its processes all at once.  Run as ``python benchmarks/stops.py [TRIALS] [SEED]``.
"""

import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from astropy.io import fits

from wpdc_gwcs import read, simulate
from wpdc_gwcs.io import read_table
from wpdc_gwcs.simulation import write_simulation

WPDC = [sys.executable, "-m", "wpdc_gwcs", "calibrate"]
SIGNALS = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT)
PATIENCE = 10.0  # s, for all processes to end


def make_inputs(folder):
    """Six images, two of each of three detectors, and their reference."""
    simulation = simulate(6, image_shape=(512, 512), density=100, distortion=4, seed=1)
    files = write_simulation(simulation, folder, images=range(6))
    for k, path in enumerate(files["frames"]):
        fits.setval(path, "DETECTOR", value=f"d{k % 3}")
    return files["frames"], files["reference"]


def group_alive(number):
    """Processes of a group that are alive."""
    found = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = path.read_text().rsplit(")", 1)[1].split()
        except OSError:
            continue
        if int(fields[2]) == number and fields[0] != "Z":
            found.append(int(path.parent.name))
    return found


def sets_of(folder):
    """Run of each frame; what is wrong with its set."""
    runs, wrong = {}, []
    for path in sorted(folder.glob("*.wcs.asdf")):
        stem = path.name.removesuffix(".wcs.asdf")
        tables = sorted(folder.glob(f"{stem}.*.ecsv"))
        found = {read(path).provenance["run"], *(read_table(t).meta["run"] for t in tables)}
        if len(found) > 1 or folder / f"{stem}.matches.ecsv" not in tables:
            wrong.append(f"{stem}: {found}")
        runs[stem] = found.pop()
    return runs, wrong


def numbers_of(folder):
    """Positions of a few pixels of each frame, deg."""
    x, y = np.meshgrid([0.0, 256.0, 511.0], [0.0, 256.0, 511.0])
    return {p.name: np.array(read(p).wcs(x, y)) for p in sorted(folder.glob("*.wcs.asdf"))}


def main():
    trials = int(sys.argv[1]) if len(sys.argv) > 1 else 30
    rng = np.random.default_rng(int(sys.argv[2]) if len(sys.argv) > 2 else 1)
    # Where this script runs in the background, Ctrl-C may be ignored, and programs inherit that.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    work = Path(tempfile.mkdtemp())
    frames, reference = make_inputs(work / "in")
    arguments = [*map(str, frames), "--catalog", str(reference), "--jobs", "2"]
    out = work / "out"
    began = time.perf_counter()
    subprocess.run([*WPDC, *arguments, "--output", str(out), "-q"], check=True)
    duration = time.perf_counter() - began
    truth, names = numbers_of(out), {p.name for p in out.iterdir()}
    bad, moments = 0, {s.name: 0 for s in SIGNALS}
    print(f"a whole run takes {duration:.1f} s; {trials} trials")
    for trial in range(trials):
        number = SIGNALS[trial % 3]
        with subprocess.Popen(
            [*WPDC, *arguments, "--output", str(out), "--overwrite", "-q"],
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        ) as process:
            time.sleep(rng.uniform(0.2, 1.05) * duration)
            if process.poll() is None:
                moments[number.name] += 1
                to_all = number == signal.SIGINT or rng.uniform() < 0.5
                stop = os.killpg if to_all else os.kill
                stop(process.pid, number)
            stopped = time.perf_counter()
            errors = process.communicate()[1]
            while group_alive(process.pid) and time.perf_counter() - stopped < PATIENCE:
                time.sleep(0.05)
            seconds = time.perf_counter() - stopped
        problems = []
        if seconds > PATIENCE or group_alive(process.pid):
            problems.append(f"alive after {PATIENCE:g} s")
        if "Traceback" in errors or len(errors.splitlines()) > 1:
            problems.append(f"said {errors!r}")
        if not names <= {p.name for p in out.iterdir()}:
            problems.append(f"lost {names - {p.name for p in out.iterdir()}}")
        problems += sets_of(out)[1]
        subprocess.run([*WPDC, *arguments, "--output", str(out), "--resume", "-q"], check=True)
        runs, wrong = sets_of(out)
        problems += wrong
        if len(set(runs.values())) > 1:
            problems.append(f"{len(set(runs.values()))} runs after --resume")
        if {p.name for p in out.iterdir()} != names:
            problems.append(f"left {sorted({p.name for p in out.iterdir()} ^ names)}")
        now = numbers_of(out)
        largest = max(np.abs(now[n] - truth[n]).max() for n in truth)
        if not largest < 1e-12:
            problems.append(f"other numbers, by {largest:.2g} deg")
        bad += bool(problems)
        print(
            f"{trial + 1:3d} {number.name:8s} ended in {seconds:4.1f} s ",
            "; ".join(problems) or "ok",
            flush=True,
        )
    print(f"{bad} of {trials} trials went wrong; signals that met a run: {moments}")
    shutil.rmtree(work)
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
