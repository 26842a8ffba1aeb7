"""One frame from its image to its WCS, stage by stage, beside SExtractor and SCAMP.

    python benchmarks/frame.py                      # all four frames, some minutes
    python benchmarks/frame.py 2048 4096 --runs 5   # some, median of five runs
    python benchmarks/frame.py --keep DIR           # frames are made once and kept there

Frames are simulated (``wpdc_gwcs.simulate``): a survey frame of 9216 x 9232 px with 16,000 stars
and 2,600 galaxies, one of that size with a star cluster, 4096 x 4096 px and 2048 x 2048 px.  Each
program is run by itself, ours as ``wpdc calibrate`` runs, theirs with windowed positions and a
cubic; CPU seconds (user and system), wall seconds and peak memory are those of the system for the
process and its children, errors those of the WCS on a grid against the truth, less their mean.

SExtractor (``source-extractor`` or ``sex``) and SCAMP are left out where they are not installed,
SCAMP also without the laboratory's writer of its catalogs (``scamp.py`` under WPDC_GWCS_LAB or
../shared/lab).
"""

import argparse
import compileall
import contextlib
import itertools
import json
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from importlib.util import find_spec
from pathlib import Path

FRAMES = {
    "csst": {"image_shape": (9232, 9216), "density": 124, "distortion": 200.0},
    "cluster": {"image_shape": (9232, 9216), "density": 42, "distortion": 200.0},
    "4096": {"image_shape": (4096, 4096), "density": 224, "distortion": 80.0},
    "2048": {"image_shape": (2048, 2048), "density": 224, "distortion": 40.0},
}
# Stars per square arcmin at the center of the cluster, its core and tidal radii in arcsec.
CLUSTER = (600.0, 45.0, 300.0)
SKY = {"galaxies": 20.0, "cosmic_rays": 400}
SCALE = 0.074  # arcsec

COLUMNS = """NUMBER X_IMAGE Y_IMAGE XWIN_IMAGE YWIN_IMAGE ERRAWIN_IMAGE ERRBWIN_IMAGE
ERRTHETAWIN_IMAGE FLUX_AUTO FLUXERR_AUTO MAG_AUTO FLAGS FLAGS_WIN FLUX_RADIUS ELONGATION SNR_WIN
FLUX_MAX FWHM_IMAGE""".split()


def simulation_of(name, seed):
    """The same simulation every time, without its image."""
    from astropy import units as u

    from wpdc_gwcs import simulate
    from wpdc_gwcs.simulation import KingCluster

    options = {"fwhm": 1.8, "psf_variation": 0.1, "slope": 0.2, "magnitudes": (17.0, 24.0)}
    options |= {"reference_limit": 21.5, "limit_snr": 12.0, "spurious": 0.0, "lost": 0.0}
    if name == "cluster":
        central, core, tidal = CLUSTER
        options["cluster"] = KingCluster(central, core * u.arcsec, tidal * u.arcsec)
    return simulate(1, seed=seed, detector=name, pixel_scale=SCALE * u.arcsec,
                    **options, **FRAMES[name])  # fmt: skip


def make(name, seed, folder):
    """Write a frame and its reference catalog."""
    from wpdc_gwcs.simulation import write_simulation

    write_simulation(simulation_of(name, seed), folder, images=(0,), overwrite=True, **SKY)


def run(frame, reference, output, began):
    """Calibrate a frame as the command does; prints CPU and wall seconds of its stages."""
    from wpdc_gwcs.__main__ import main, prepare

    prepare()
    import wpdc_gwcs.io  # noqa: F401  What the command imports later would count as reading.
    from wpdc_gwcs import calibrate  # noqa: F401
    from wpdc_gwcs.cli import calibrate as command

    marks = [("import", 0.0, float(began))]

    def mark(stage):
        marks.append((stage, time.process_time(), time.time()))

    def hear(stage, done, total):
        if total == 0:
            mark(stage)

    mark("reading")

    # Where the command shows its progress.
    command.progress_bar = lambda **_: contextlib.nullcontext(hear)
    sys.argv = ["wpdc", "calibrate", frame, "--catalog", reference, "--output", output]
    try:
        with contextlib.redirect_stdout(sys.stderr):
            main()
    except SystemExit as end:
        if end.code:
            raise
    mark("")
    stages = {}
    for (stage, *first), (_, *last) in itertools.pairwise(marks):
        spent = stages.setdefault(stage, [0.0, 0.0])
        for k in range(2):
            spent[k] += last[k] - first[k]
    print(json.dumps(stages))


def judge(name, seed, wcs, head):
    """Print the rms error in px of a WCS file of ours, or of a header of SCAMP."""
    import numpy as np
    from astropy.io import fits
    from astropy.wcs import WCS

    import wpdc_gwcs

    if head:
        lines = Path(wcs).read_text(encoding="latin1").splitlines()
        cards = [c for c in lines if c[:8].strip() not in ("HISTORY", "COMMENT", "END")]
        found = WCS(fits.Header([fits.Card.fromstring(card) for card in cards]))
    else:
        found = wpdc_gwcs.read(wcs).wcs
    *_, dx, dy = simulation_of(name, seed).exposures[0].wcs_error(found)
    print(json.dumps(float(np.hypot(np.std(dx), np.std(dy)))))


def timed(command, cwd=None, errors=None):
    """Run a command: what it prints, its CPU and wall seconds and peak memory in GB.

    Of a process as small as this one: the peak of a child begins with that of its parent.
    """
    began = time.perf_counter()
    with tempfile.TemporaryFile("w+") as out:
        process = subprocess.Popen(list(map(str, command)), cwd=cwd, stdout=out, stderr=errors)
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        out.seek(0)
        text = out.read()
    if process.returncode:
        sys.exit(f"{command[0]} ended with {process.returncode}")
    return {
        "text": text,
        "cpu": usage.ru_utime + usage.ru_stime,
        "wall": time.perf_counter() - began,
        "peak": usage.ru_maxrss / 2**20,
    }


def ask(*arguments):
    """Have a process of its own do a part of this script."""
    return timed([sys.executable, __file__, *arguments])


def ours(name, seed, files, folder):
    """One run of ours: figures, with those of the stages."""
    output = folder / "out"
    result = ask("--run", files["frame"], files["reference"], output, str(time.time()))
    (wcs,) = output.glob("*.wcs.asdf")
    stages = json.loads(result.pop("text"))
    error = json.loads(ask("--judge", name, str(seed), wcs, "")["text"])
    shutil.rmtree(output)
    return result | {"stages": stages, "error": error}


def theirs(name, seed, files, folder):
    """One run of SExtractor, and of SCAMP where it is there; None for what is not."""
    sextractor = shutil.which("source-extractor") or shutil.which("sex")
    if sextractor is None:
        return None, None
    (folder / "win.param").write_text("\n".join(COLUMNS) + "\n")
    # A pyramid, and no more stars than ours can tell: the threshold of 5 sigma after smoothing.
    (folder / "conv").write_text("CONV NORM\n1 2 1\n2 4 2\n1 2 1\n")
    (folder / "nnw").write_text("NNW\n")
    options = {"PARAMETERS_NAME": "win.param", "CATALOG_NAME": "win.cat", "FILTER_NAME": "conv"}
    options |= {"CATALOG_TYPE": "FITS_LDAC", "DETECT_THRESH": 1.875, "ANALYSIS_THRESH": 1.875}
    options |= {"DETECT_MINAREA": 3, "DEBLEND_MINCONT": 0.002, "PHOT_APERTURES": 6}
    options |= {"MEMORY_BUFSIZE": 2048, "MEMORY_OBJSTACK": 20000, "MEMORY_PIXSTACK": 3000000}
    options |= {"GAIN_KEY": "GAIN", "SATUR_KEY": "SATURATE", "VERBOSE_TYPE": "QUIET"}
    flat = [part for key, value in options.items() for part in (f"-{key}", value)]
    extracted = timed(
        [sextractor, files["frame"], "-c", "/dev/null", *flat], folder, subprocess.DEVNULL
    )
    if files["scamp"] is None or shutil.which("scamp") is None:
        return extracted, None
    options = {"ASTREF_CATALOG": "FILE", "ASTREFCAT_NAME": files["scamp"]}
    options |= {"ASTREFCENT_KEYS": "X_WORLD,Y_WORLD", "ASTREFMAG_KEY": "MAG"}
    options |= {"ASTREFERR_KEYS": "ERRA_WORLD,ERRB_WORLD,ERRTHETA_WORLD", "DISTORT_DEGREES": 3}
    cross = 1.2 * FRAMES[name]["distortion"] * SCALE + 1.0
    options |= {"CROSSID_RADIUS": f"{cross:.1f}", "POSITION_MAXERR": 0.5, "POSANGLE_MAXERR": 1}
    options |= {"PIXSCALE_MAXERR": 1.05, "SOLVE_PHOTOM": "N", "CHECKPLOT_TYPE": "NONE"}
    options |= {"WRITE_XML": "N", "VERBOSE_TYPE": "QUIET", "SN_THRESHOLDS": "10,100"}
    options |= {"FWHM_THRESHOLDS": "0,100", "ELLIPTICITY_MAX": 0.5}
    flat = [part for key, value in options.items() for part in (f"-{key}", value)]
    solved = timed(["scamp", "win.cat", "-c", "/dev/null", *flat], folder, subprocess.DEVNULL)
    answer = ask("--judge", name, str(seed), folder / "win.head", "head")
    return extracted, solved | {"error": json.loads(answer["text"])}


def write_scamp_reference(reference, path):
    """Write the reference for SCAMP, by the laboratory; False where that is not there."""
    lab = Path(os.environ.get("WPDC_GWCS_LAB") or Path(__file__).parents[2] / "shared" / "lab")
    if not (lab / "scamp.py").exists():
        return False
    code = "import sys; sys.path.insert(0, sys.argv[1]); import scamp; from astropy.table import "
    code += "QTable; scamp.write_reference(sys.argv[3], QTable.read(sys.argv[2]))"
    timed([sys.executable, "-W", "ignore", "-c", code, lab, reference, path])
    return True


def middle(runs, key):
    return statistics.median(run[key] for run in runs)


def report(name, runs):
    """Print the figures of a frame: medians of the runs."""
    mine, extracted, solved = zip(*runs, strict=True)
    names = list(dict.fromkeys(stage for run in mine for stage in run["stages"]))
    print(f"\n{name}: {' x '.join(map(str, FRAMES[name]['image_shape'][::-1]))} px")
    print(f"  {'':12s} {'CPU s':>7s} {'wall s':>7s}")
    for stage in names:
        cpu, wall = (
            statistics.median(run["stages"].get(stage, (0.0, 0.0))[k] for run in mine)
            for k in range(2)
        )
        print(f"  {stage:12s} {cpu:7.2f} {wall:7.2f}")
    table = [("wpdc", mine)]
    table += [("SExtractor", extracted)] if extracted[0] else []
    table += [("SCAMP", solved)] if solved[0] else []
    print(f"  {'':12s} {'CPU s':>7s} {'wall s':>7s} {'peak GB':>8s} {'rms px':>8s}")
    for label, these in table:
        error = f"{middle(these, 'error'):8.4f}" if "error" in these[0] else ""
        print(f"  {label:12s} {middle(these, 'cpu'):7.2f} {middle(these, 'wall'):7.2f} "
              f"{middle(these, 'peak'):8.2f} {error}")  # fmt: skip
    if not extracted[0]:
        return
    until = names.index("matching")
    cpu, wall = (
        statistics.median(
            sum(run["stages"].get(stage, (0.0, 0.0))[k] for stage in names[:until]) / peer[key]
            for run, peer in zip(mine, extracted, strict=True)
        )
        for k, key in enumerate(("cpu", "wall"))
    )
    print(f"  image to list: {cpu:.2f} x the CPU of SExtractor, {wall:.2f} x its wall", end="")
    if solved[0]:
        both = statistics.median(
            run["cpu"] / (one["cpu"] + two["cpu"])
            for run, one, two in zip(mine, extracted, solved, strict=True)
        )
        print(f"; image to WCS: {both:.2f} x the CPU of both", end="")
    print(flush=True)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("frames", nargs="*", metavar="FRAME", help=", ".join(FRAMES))
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--keep", type=Path, help="folder in which frames are kept")
    parser.add_argument("--make", nargs=3, help=argparse.SUPPRESS)
    parser.add_argument("--run", nargs=4, help=argparse.SUPPRESS)
    parser.add_argument("--judge", nargs=4, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.make:
        return make(options.make[0], int(options.make[1]), options.make[2])
    if options.run:
        return run(*options.run)
    if options.judge:
        name, seed, *rest = options.judge
        return judge(name, int(seed), *rest)
    if wrong := set(options.frames) - set(FRAMES):
        parser.error(f"no frame {', '.join(sorted(wrong))}: there are {', '.join(FRAMES)}")
    # An installed package is compiled; to do it anew each time takes a tenth of a small frame.
    compileall.compile_dir(Path(find_spec("wpdc_gwcs").origin).parent, quiet=1)
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        kept = options.keep or folder
        kept.mkdir(parents=True, exist_ok=True)
        for name in options.frames or FRAMES:
            files = {
                "frame": kept / f"{name}-01.fits",
                "reference": kept / f"{name}-reference.fits",
            }
            files = {key: path.resolve() for key, path in files.items()}
            if not all(path.exists() for path in files.values()):
                ask("--make", name, str(options.seed), kept)
            cat = folder / f"{name}.ref.cat"
            files["scamp"] = cat if write_scamp_reference(files["reference"], cat) else None
            case = name, options.seed, files, folder
            report(name, [(ours(*case), *theirs(*case)) for _ in range(options.runs)])


if __name__ == "__main__":
    main()
