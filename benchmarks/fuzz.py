"""Damaged and impossible inputs of every kind: one line and an exit status, or the same numbers.

Bits are flipped, bytes cut, put in and doubled, values of headers, trees and tables replaced by
what nobody means, options given all sorts of values.  The command line has to answer each with a
result, or with one line that begins ``wpdc: error:``; a WCS file that still opens must give the
same positions.  Run as ``python benchmarks/fuzz.py [CASES] [SEED]``.
"""

import bz2
import contextlib
import faulthandler
import gzip
import io
import lzma
import os
import re
import shutil
import signal
import socket
import sys
import tempfile
import time
import traceback
from collections import Counter
from pathlib import Path

import numpy as np
from astropy.io import fits
from astropy.table import Table

from wpdc_gwcs import read, simulate, write
from wpdc_gwcs.calibration import calibrate
from wpdc_gwcs.cli.app import run
from wpdc_gwcs.io import read_frames
from wpdc_gwcs.simulation import write_simulation

LONGEST = 20.0  # s of this process, whatever else the machine does
SCALE = 0.3  # arcsec / px
SAME = 1e-9  # px, what a WCS may be off by where the file is still accepted
ODD_VALUES = ["nan", "inf", "-inf", "1e400", "1e30", "-1e30", "0", "-1", "1e-300", "''", "null",
              "true", "[]", "{}", "abc", "9" * 20, "1e23", "0x7f", "é", "~", "*"]  # fmt: skip
ODD_CARDS = ["1E30", "-1E30", "NaN", "'text'", "0.0", "T", "1.2.3", "", "1E400", "'unclosed",
             "(1.0, 2.0)", "99999999999999999999", "-5", "1E-300", "\x00\x01"]  # fmt: skip
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
    return {
        "image": image, "ldac": ldac, "table": table, "header": folder / "start.hdr",
        "catalog": files["reference"], "wcs": wcs, "fits": folder / "a.fits",
        "cpdis": folder / "a.cpdis.fits",
        "solution": next((folder / "out").glob("*.solution.asdf")),
        "matches": next((folder / "out").glob("*.matches.ecsv")),
        "summary": folder / "out" / "summary.ecsv", "manifest": folder / "out" / "manifest.json",
        "folder": folder / "out",
    }  # fmt: skip


# --- damage -------------------------------------------------------------------------------------


def flip(data, rng):
    data = bytearray(data)
    for bit in rng.integers(8 * len(data), size=rng.choice([1, 1, 1, 5])):
        data[bit // 8] ^= 1 << (bit % 8)
    return bytes(data)


def cut(data, rng):
    return data[: int(rng.integers(len(data)))]


def put_in(data, rng):
    at = int(rng.integers(len(data)))
    return data[:at] + rng.bytes(int(rng.integers(1, 50))) + data[at:]


def take_out(data, rng):
    at = int(rng.integers(len(data)))
    return data[:at] + data[at + int(rng.integers(1, 200)) :]


def double(data, rng):
    a, b = sorted(int(i) for i in rng.integers(len(data), size=2))
    return data[:b] + data[a : min(b, a + 3000)] + data[b:]


def blank(data, rng):
    at, n = int(rng.integers(len(data))), int(rng.integers(1, 500))
    return data[:at] + bytes(min(n, len(data) - at)) + data[at + n :]


def other_value(data, rng):
    """Another value for one of the numbers in the text of a file."""
    places = list(re.finditer(rb"(?<=[\s:,\[\"])-?\d+(\.\d+)?([eE][-+]?\d+)?", data[:40000]))
    if not places:
        return flip(data, rng)
    place = places[int(rng.integers(len(places)))]
    value = str(rng.choice(ODD_VALUES)).encode()
    return data[: place.start()] + value + data[place.end() :]


def other_line(data, rng):
    """A line that is missing, twice there, or has a name that is spelt otherwise."""
    lines = data.split(b"\n")
    k = int(rng.integers(min(len(lines), 300)))
    how = rng.integers(4)
    if how == 0:
        del lines[k]
    elif how == 1:
        lines.insert(k, lines[k])
    elif how == 2:
        lines[k] = lines[k].replace(b"a", b"e", 1)
    else:
        lines[k] = b" " + lines[k]
    return b"\n".join(lines)


def other_card(data, rng):
    """Another value for one of the cards of a FITS header."""
    starts = [i for i in range(0, min(len(data), 28800), 80) if data[i + 8 : i + 10] == b"= "]
    if not starts:
        return flip(data, rng)
    wcs = [i for i in starts if re.match(rb"C(TYPE|RVAL|RPIX|D|UNIT)|NAXIS|BITPIX|PV", data[i:])]
    i = int(rng.choice(wcs if wcs and rng.uniform() < 0.7 else starts))
    value = str(rng.choice(ODD_CARDS)).encode("latin-1")
    return data[: i + 10] + value.rjust(20).ljust(70)[:70] + data[i + 80 :]


def other_bytes(data, rng):
    """Nothing, noise, or the beginning of something else."""
    starts = [b"", b"\0" * 5000, b"#ASDF 1.0.0\n%YAML 1.1\n--- \n", b"SIMPLE  =", b"\x1f\x8b",
              b"BZh9", b"%PDF-1.5", b"<?xml version='1.0'?><VOTABLE>", b"\xff\xfe",
              b"# %ECSV 1.0\n",
              b"SIMPLE  =                    T".ljust(80) * 40]  # fmt: skip
    return starts[int(rng.integers(len(starts)))] + rng.bytes(int(rng.integers(0, 4000)))


ANY = [flip, cut, put_in, take_out, double, blank, other_bytes]
DAMAGE = {
    "wcs": [*ANY, other_value, other_value, other_line, other_line],
    "solution": [*ANY, other_value, other_line],
    "fits": [*ANY, other_card, other_card],
    "cpdis": [*ANY, other_card],
    "image": [*ANY, other_card, other_card, other_card],
    "ldac": [*ANY, other_card],
    "table": [*ANY, other_value, other_line],
    "header": [*ANY, other_line, other_card],
    "catalog": [*ANY, other_card, other_card],
    "matches": [*ANY, other_value, other_line],
    "summary": [*ANY, other_value, other_line],
    "manifest": [*ANY, other_value, other_line],
}


def odd_image(path, rng):
    """Images that are no sky: sizes, values and types."""
    shape = [(1, 1), (1, 300), (0, 5), (3, 3), (2, 64, 64), (64,), (64, 64)][int(rng.integers(7))]
    values = [0.0, np.nan, np.inf, 1e38, -1e30, 5.0][int(rng.integers(6))]
    data = np.full(shape, values, [np.float32, np.float64][int(rng.integers(2))])
    if rng.uniform() < 0.3:
        data = rng.integers(-30000, 30000, shape).astype(np.int16)
    header = fits.getheader(path)
    fits.writeto(path, data, header, overwrite=True, output_verify="ignore")


def odd_table(path, rng):
    """Catalogs with values that are none."""
    table = Table.read(path)
    name = str(rng.choice(table.colnames))
    odd = [np.nan, np.inf, -1e308, 1e5, 0.0, -91.0][int(rng.integers(6))]
    rows = rng.uniform(size=len(table)) < rng.choice([0.1, 1.0])
    how = int(rng.integers(4))
    if how == 0:
        table[name] = np.where(rows, odd, np.asarray(table[name], float))
    elif how == 1:
        table.remove_column(name)
    elif how == 2:
        table[name] = np.array(["text"] * len(table))
    else:
        table = table[: int(rng.integers(0, 4))]
    table.write(path, overwrite=True)


# What nobody means, by what it is made of.
ODD = {
    "place": ["image", "table", "catalog", "header", "wcs", "fits", "solution", "config", "mask",
              "weight-map"],
    "archive": ["image", "catalog", "fits"],
    "tree": ["wcs", "solution"],
    "list": ["table"],
}  # fmt: skip


def odd_place(folder, name, rng):
    """What is there and is no file of the kind: a folder, a pipe, a device, a link to itself."""
    path = folder / f"odd-{name}.fits"
    kind = str(rng.choice(["folder", "pipe", "socket", "loop", "nothing", "device", "endless"]))
    if kind == "folder":
        path.mkdir()
    elif kind == "pipe":
        os.mkfifo(path)
    elif kind == "socket":
        with contextlib.closing(socket.socket(socket.AF_UNIX)) as server:
            server.bind(os.path.relpath(path))
    elif kind in ("loop", "nothing"):
        path.symlink_to(path if kind == "loop" else folder / "nothing")
    else:
        return Path("/dev/null" if kind == "device" else "/dev/zero")
    return path


def odd_archive(data, rng):
    """Compressed once or twice, cut, with a wrong sum, or far larger than it looks."""
    packed = gzip.compress(data)
    return [
        packed[: int(rng.integers(1, len(packed)))],
        packed + b"more" * 100,
        packed[:-8] + bytes(8),
        gzip.compress(packed),
        gzip.compress(b""),
        gzip.compress(data[:5760] + bytes(100_000_000)),
        bz2.compress(data)[: int(rng.integers(1, 5000))],
        lzma.compress(data)[: int(rng.integers(1, 5000))],
    ][int(rng.integers(8))]


def odd_tree(data, rng):
    """ASDF with tags, types, shapes and sources that are other ones."""
    head, tree = data[: (at := data.index(b"\nwpdc:"))], data[at:]
    old, new = [
        (rb"datatype: float64", b"datatype: complex128"),
        (rb"datatype: float64", b"datatype: [ascii, 9]"),
        (rb"byteorder: little", b"byteorder: big"),
        (rb"source: \d+", b"source: 99"),
        (rb"source: \d+", b"source: -9"),
        (rb"source: \d+", b"source: other.asdf"),
        (rb"shape: \[\d+", b"shape: [-5"),
        (rb"shape: \[\d+", b"shape: [999999999999"),
        (rb"!core/ndarray-1.\d.0", b"!core/complex-1.0.0"),
        (rb"!core/ndarray-1.\d.0", b"!!python/object/apply:os.system"),
        (rb"\nwpdc:", b"\nwpdc: &w {wpdc: *w}\nother:"),
        (rb"\nwpdc:", b"\nwpdc: {$ref: 'http://127.0.0.1:9/a'}\nother:"),
        (rb"format_version: 1", b"format_version: 0"),
    ][int(rng.integers(13))]
    return head + re.sub(old, new, tree, count=1)


def odd_config(rng):
    """TOML that is none, or whose values are of other types."""
    return [
        b"r0 = [1, 2]", b"[r0]\na = 1", b"seed = 2020-01-01", b"seed = true", b"jobs = '2'",
        b"a = " + b"[" * 3000, b"a = " + b"[" * 200 + b"]" * 200, b"seed = 1\nseed = 2",
        b"\xff\xfe", b"\xef\xbb\xbfseed = 1", b"seed = " + b"9" * 5000, b"output = 5",
        b"n-grid = 50.5", b"a.b.c = 1", b"mask-bits = 'x'", b"x = '" + b"a" * 10_000_000 + b"'",
        b'detector = "\\u0000"', b"catalog = ['a', 'b']", b"min-snr = nan", b"frames = ['x']",
    ][int(rng.integers(20))]  # fmt: skip


def odd_list(data, rng):
    """ECSV whose header says what no table is."""
    old, new = [
        (b"ECSV 1.0", b"ECSV 9.7"), (b"float64", b"floaty"), (b"float64", b"object"),
        (b"float64", b"complex128"), (b"name: y", b"name: x"),
        (b"# datatype:", b"# delimiter: '@@'\n# datatype:"),
        (b"# datatype:", b"# meta: !!omap [1, 2]\n# datatype:"),
        (b"# datatype:", b"# meta: !!python/object/apply:os.system [x]\n# datatype:"),
        (b"# datatype:", b"# meta: " + b"[" * 5000 + b"\n# datatype:"),
        (b"# datatype:", b"# meta: {__serialized_columns__: 5}\n# datatype:"),
        (b"# -", b"#\t-"),
    ][int(rng.integers(11))]  # fmt: skip
    return data.replace(old, new) if rng.uniform() < 0.9 else data + b"1" * 10_000_000


MAKE = {"archive": odd_archive, "tree": odd_tree, "list": odd_list}


# --- cases --------------------------------------------------------------------------------------


def cases(inputs, work, n, seed):
    """Kind, command, and whether its output must stay as it was."""
    rng = np.random.default_rng(seed)
    kinds = [*DAMAGE, "odd image", "odd catalog", "option", "config", *ODD]
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
        if kind in DAMAGE:
            path = inside.get(kind, copies.get(kind))
            damage = DAMAGE[kind][int(rng.integers(len(DAMAGE[kind])))]
            path.write_bytes(damage(path.read_bytes(), rng))
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
        if kind in ODD:
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
