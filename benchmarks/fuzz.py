"""Damaged and impossible inputs of every kind: one line and an exit status, or the same numbers.

Bits are flipped, bytes cut, put in and doubled, values of headers, trees and tables replaced by
what nobody means, options given all sorts of values.  The command line has to answer each with a
result, or with one line that begins ``wpdc: error:``; a WCS file that still opens must give the
same positions.  Run as ``python benchmarks/fuzz.py [CASES] [SEED]``.
"""

import contextlib
import faulthandler
import io
import os
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter
from pathlib import Path

import numpy as np
from astropy.io import fits
from damage import DAMAGE, MAKE, ODD, ODD_VALUES, odd_config, odd_image, odd_place, odd_table

from wpdc_gwcs import read, simulate, write
from wpdc_gwcs.calibration import calibrate
from wpdc_gwcs.cli.app import run
from wpdc_gwcs.io import read_frames
from wpdc_gwcs.simulation import write_simulation

LONGEST = 20.0  # s of this process, whatever else the machine does
SCALE = 0.3  # arcsec / px
SAME = 1e-9  # px, what a WCS may be off by where the file is still accepted
OPTIONS = {
    "--seed": ["-1", "1e23", "99999999999999999999999", "x", ""],
    "--r0": ["nan", "inf", "0", "-1", "1e-300", "1e300"],
    "--n-grid": ["0", "-1", "1000000000000", "3", "x"],
    "--degree": ["0", "8", "-1", "²", "٣", "auto ", "1e3", "99999999999999999999999"],
    "--threshold": ["nan", "inf", "0", "-1", "1e300"],
    "--min-snr": ["nan", "-1", "inf"],
    "--holdout": ["nan", "-0.1", "1", "inf", "0.9"],
    "--jobs": ["0", "-1", "x", "1e9"],
    "--weight": ["", "é", "nan"],
    "--lut": ["", "maybe"],
    "--refine": ["", "x"],
    "--centroids": ["x", "given"],
    "--reference-point": ["", "x"],
    "--scheduler-timeout": ["nan", "0", "-1", "inf"],
    "--scheduler": ["", "x", "tcp://", "http://127.0.0.1:1", "tcp://127.0.0.1:1"],
    "--exposure-key": ["", "é", "TOOLONGKEYWORD", "A B"],
    "--detector": ["", "a/b", "\n", "..", "é" * 200, "\x00"],
    "--preset": ["", "../x", "x"],
    "--config": ["", ".", "/dev/null", "x"],
    "--output": ["", "/dev/null", "/proc/x", "x" * 300, "\x00"],
    "--catalog": ["", ".", "/dev/null", "x[9]", "\x00", "http://x"],
    "--solution": ["", ".", "/dev/null"],
    "--wcs": ["", ".", "/dev/null"],
}
# What else reads a file of a kind.
_CONVERT = "convert {path} --to {form} --output {work}/new.fits"
OTHERS = {
    "wcs": [_CONVERT, "export {path} --format {form} --output {work}/new.fits",
            "export {path} --into {image} --output {work}/new.fits", "sky2pix {path} 120.0 30.0"],
    "fits": [_CONVERT, "sky2pix {path} 120.0 30.0"],
    "cpdis": [_CONVERT],
    "solution": ["export {path} --format {form} --output {work}/new.fits",
                 "monitor {path} {matches}", "calibrate {ldac} --catalog {catalog} --solution "
                 "{path} --update --output {work}/new"],
    "header": [_CONVERT, "match {table} --wcs {path} --catalog {catalog} --output {work}/new.ecsv"],
    "image": [_CONVERT, "detect {path} --output {work}/new.ecsv"],
    "table": ["match {path} --wcs {header} --catalog {catalog} --output {work}/new.ecsv",
              "pix2sky {wcs} {path}"],
    "catalog": ["match {ldac} --catalog {path} --output {work}/new.ecsv", "sky2pix {wcs} {path}"],
    "matches": ["monitor {solution} {path}", "report {folder} --overwrite"],
}  # fmt: skip


class Hang(BaseException):
    """Longer than anybody waits."""


def make_inputs(folder):
    """Files of every kind that the commands read."""
    simulation = simulate(2, image_shape=(256, 256), density=200, distortion=3, seed=1)
    files = write_simulation(simulation, folder, images=(0,), sources="ldac")
    image, ldac = files["frames"]
    table = folder / "list.ecsv"
    simulation.exposures[1].sources["x", "y", "x_err", "y_err", "flux"].write(table)
    simulation.exposures[1].header.totextfile(folder / "start.hdr")
    found = calibrate(read_frames(ldac), files["reference"], output=folder / "out")
    (calibration,) = found.calibrations
    wcs = folder / "out" / f"{calibration.frame}.wcs.asdf"
    write(calibration, folder / "a.fits")
    write(calibration, folder / "a.cpdis.fits", format="cpdis")
    pair = write_simulation(
        simulate(2, image_shape=(256, 256), density=200, distortion=3, seed=2),
        folder / "pair", images=(0, 1),
    )  # fmt: skip
    for path, detector in zip(pair["frames"], "ab", strict=True):
        fits.setval(path, "DETECTOR", value=detector)
        fits.setval(path, "INSTRUME", value="cam")
        fits.setval(path, "EXPNUM", value=1)
    frames = [frame for path in pair["frames"] for frame in read_frames(path)]
    calibrate(frames, pair["reference"], output=folder / "mosaic")
    return {
        "mosaic": folder / "mosaic", "camera": next((folder / "mosaic").glob("*.camera.asdf")),
        "image": image, "ldac": ldac, "table": table, "header": folder / "start.hdr",
        "catalog": files["reference"], "wcs": wcs, "fits": folder / "a.fits",
        "cpdis": folder / "a.cpdis.fits",
        "solution": next((folder / "out").glob("*.solution.asdf")),
        "matches": next((folder / "out").glob("*.matches.ecsv")),
        "summary": folder / "out" / "summary.ecsv", "manifest": folder / "out" / "manifest.json",
        "folder": folder / "out",
    }  # fmt: skip


# --- cases --------------------------------------------------------------------------------------


def cases(inputs, work, n, seed):
    """Kind, command, and whether its output must stay as it was."""
    rng = np.random.default_rng(seed)
    kinds = [*DAMAGE, "odd image", "odd catalog", "option", "config", *ODD, "into", "commands"]
    weights = np.array([3.0 if kind in ("wcs", "fits") else 1.0 for kind in kinds])
    for _ in range(n):
        kind = str(rng.choice(kinds, p=weights / weights.sum()))
        shutil.rmtree(work, ignore_errors=True)
        work.mkdir()
        copies = {}
        for name, path in inputs.items():
            copies[name] = work / path.name
            (shutil.copytree if path.is_dir() else shutil.copy)(path, copies[name])
        inside = {n: copies["folder"] / inputs[n].name for n in ("matches", "summary", "manifest")}
        inside["camera"] = copies["mosaic"] / inputs["camera"].name
        if kind in DAMAGE:
            path = inside.get(kind, copies.get(kind))
            damage = DAMAGE[kind][int(rng.integers(len(DAMAGE[kind])))]
            path.write_bytes(damage(path.read_bytes(), rng))
        elif kind in ("into", "commands"):
            of = "image" if kind == "into" else str(rng.choice(list(OTHERS)))
            path = inside.get(of, copies.get(of))
            damage = DAMAGE[of][int(rng.integers(len(DAMAGE[of])))]
            path.write_bytes(damage(path.read_bytes(), rng))
            form = str(rng.choice(["tpv", "sip", "cpdis", "fits", "tab"]))
        elif kind == "odd image":
            odd_image(copies["image"], rng)
        elif kind == "odd catalog":
            odd_table(copies["catalog"], rng)
        elif kind in ("archive", "tree", "list"):
            of = str(rng.choice(ODD[kind]))
            copies[of].write_bytes(MAKE[kind](copies[of].read_bytes(), rng))
        elif kind == "place":
            of = str(rng.choice(ODD[kind]))
            copies[of] = odd_place(work, of, rng)
        options = {
            "--catalog": copies["catalog"],
            "--output": work / "new",
            "--centroids": "windowed",
        }
        frame = copies["ldac"]
        keeps = False
        if kind == "into":
            command = ["export", inputs["wcs"], "--into", copies["image"], "--format", form]
            command += ["--output", work / "copy.fits"]
        elif kind == "commands":
            command = [
                str(word).format(
                    path=path, work=work, form=form, **{**inputs, "folder": copies["folder"]}
                )
                for word in OTHERS[of][int(rng.integers(len(OTHERS[of])))].split()
            ]
        elif kind in ODD:
            # The damaged file is asked for by what reads such files.
            frame = copies[of] if of in ("image", "table") else frame
            options |= {f"--{of}": copies[of]} if of in ("catalog", "solution", "config") else {}
            options |= {"--wcs": copies["header"]} if of in ("table", "header") else {}
            frame = copies["table"] if of == "header" else frame
            if of in ("mask", "weight-map"):
                frame, options[f"--{of}"] = copies["image"], copies[of]
            command = ["calibrate", frame]
            if of in ("wcs", "fits"):
                command, keeps = ["pix2sky", copies[of], "100.25", "71.5"], True
        elif kind == "camera":
            command = ["calibrate", inputs["ldac"]]
            options["--solution"] = inside["camera"]
        elif kind in ("wcs", "fits", "cpdis", "solution"):
            command, keeps = ["pix2sky", copies[kind], "100.25", "71.5"], True
        elif kind == "matches":
            command = ["evaluate", copies["folder"], "--no-weights"]
        elif kind == "summary":
            command = ["report", copies["folder"], "--overwrite"]
        elif kind == "manifest":
            options["--output"] = copies["folder"]
            command = ["calibrate", inputs["ldac"], "--resume"]
        else:
            if kind in ("image", "odd image"):
                frame = copies["image"]
            if kind in ("table", "header"):
                frame, options["--wcs"] = copies["table"], copies["header"]
            command = ["calibrate", frame]
        if kind == "option":
            name = str(rng.choice(list(OPTIONS)))
            options[name] = str(rng.choice(OPTIONS[name]))
        elif kind == "config":
            names = [*OPTIONS, "--frames", "--verbose", "--blind", "--report", "--overwrite"]
            name = str(rng.choice(names)).lstrip("-")
            value = str(rng.choice([*ODD_VALUES, "'x'", "[1, 2]", "2020-01-01", "1.5", "{a = 1}"]))
            (work / "c.toml").write_text(f"{name} = {value}\n", encoding="utf-8")
            options["--config"] = work / "c.toml"
            if rng.uniform() < 0.5:
                options.pop(f"--{name}", None)
            if rng.uniform() < 0.3:
                (work / "c.toml").write_bytes(odd_config(rng))
        if command[0] == "calibrate":
            command += [str(x) for pair in options.items() for x in pair]
        yield kind, [str(x) for x in command], keeps


def answer(command):
    """Exit status, output and errors of a command; a traceback or hang in place of the status."""
    out, err = io.StringIO(), io.StringIO()
    signal.setitimer(signal.ITIMER_PROF, LONGEST)
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            status = run(command)
    except Hang:
        status = "hang"
    except BaseException:  # noqa: BLE001
        status = "traceback"
        err.write(traceback.format_exc())
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
    if "Traceback" in err.getvalue() or "internal error" in err.getvalue():
        status = "traceback"
    return status, out.getvalue(), err.getvalue()


def main():
    n = int(sys.argv[1]) if len(sys.argv) > 1 else 1000
    seed = int(sys.argv[2]) if len(sys.argv) > 2 else 1
    faulthandler.enable()

    def ring(number, frame):
        raise Hang

    signal.signal(signal.SIGPROF, ring)
    base = Path(tempfile.mkdtemp())
    (base / "in").mkdir()
    inputs = make_inputs(base / "in")
    os.chdir(base)
    x, y = np.meshgrid(np.linspace(0, 255, 9), np.linspace(0, 255, 9))
    truth = np.array(read(inputs["wcs"]).wcs(x, y))
    counts, slowest = {}, 0.0
    for number, (kind, command, keeps) in enumerate(cases(inputs, base / "work", n, seed)):
        began = time.process_time()
        status, out, err = answer(command)
        slowest = max(slowest, time.process_time() - began)
        lines = [line for line in err.splitlines() if line.startswith("wpdc: error: ")]
        verdict = {0: "accepted", 1: "refused", 2: "refused"}.get(status, str(status))
        if verdict == "refused" and (not lines or len(lines) < len(err.splitlines()) - 3):
            verdict = "no line"
        if verdict == "accepted" and keeps and kind != "solution":
            off = np.array(read(command[1]).wcs(x, y)) - truth
            if not np.abs(off).max() * 3600 / SCALE <= SAME:
                verdict = "changed"
        counts.setdefault(kind, Counter())[verdict] += 1
        if verdict not in ("accepted", "refused"):
            print(
                f"case {number}: {verdict}: {' '.join(command)[:300]!r}\n{err[-1500:]}", flush=True
            )
            shutil.copytree(base / "work", base / f"case{number}", dirs_exist_ok=True)
    verdicts = ["refused", "accepted", "changed", "no line", "traceback", "hang"]
    print(f"{'kind':12s}" + "".join(f"{v:>10s}" for v in verdicts))
    for kind, found in sorted(counts.items()):
        print(f"{kind:12s}" + "".join(f"{found[v]:10d}" for v in verdicts))
    total = sum(counts.values(), Counter())
    print(f"{'all':12s}" + "".join(f"{total[v]:10d}" for v in verdicts))
    print(f"slowest: {slowest:.1f} s")
    return 1 if set(total) - {"refused", "accepted"} else 0


if __name__ == "__main__":
    sys.exit(main())
