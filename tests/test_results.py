"""The result folder: whole sets or none, whatever happens to the run; what is done stays done."""

import gc
import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.table import Table, vstack
from astropy.wcs import WCS

from wpdc_gwcs import Settings, calibrate, read
from wpdc_gwcs.calibration import match_frame
from wpdc_gwcs.calibration import results as results_module
from wpdc_gwcs.calibration import run as run_module
from wpdc_gwcs.calibration import solving as solving_module
from wpdc_gwcs.calibration.cluster import cluster_executor
from wpdc_gwcs.calibration.manifest import frame_sum, read_manifest
from wpdc_gwcs.calibration.results import ResultFolder
from wpdc_gwcs.cli.app import run as command
from wpdc_gwcs.exceptions import ClusterError, FileFormatError, InputError, InternalError
from wpdc_gwcs.io import read_frames, read_table
from wpdc_gwcs.simulation import simulate, write_simulation


@pytest.fixture(scope="module")
def simulation():
    return simulate(3, image_shape=(512, 512), density=100, distortion=4, seed=3)


@pytest.fixture(scope="module")
def inputs(simulation, tmp_path_factory):
    """Paths of three source lists and of the reference."""
    folder = tmp_path_factory.mktemp("input")
    files = write_simulation(simulation, folder, images=(), sources="ldac")
    return files["frames"], files["reference"]


def frames_of(paths, detectors=("one", "two", "two")):
    """Frames of two detectors."""
    return [read_frames(p, detector=d)[0] for p, d in zip(paths, detectors, strict=True)]


@pytest.fixture
def frames(inputs):
    return frames_of(inputs[0])


def check_sets(folder):
    """Every set of a frame is whole and of one run; the runs by frame."""
    runs = {}
    for path in sorted(folder.glob("*.wcs.asdf")):
        stem = path.name.removesuffix(".wcs.asdf")
        found = {read(path).provenance["run"]}
        found |= {read_table(t).meta["run"] for t in folder.glob(f"{stem}.*.ecsv")}
        assert (folder / f"{stem}.matches.ecsv").exists()
        assert len(found) == 1, path
        (runs[stem],) = found
    assert not [p for p in folder.iterdir() if p.name.startswith(".")]
    return runs


def numbers_of(folder):
    """What must be the same however a result came about."""
    found = {}
    for path in folder.glob("*.wcs.asdf"):
        one = read(path)
        found[path.name] = [*one.crval, *one.cd.ravel(), *one.solution.pv.coefficients.ravel()]
    for path in folder.glob("*.matches.ecsv"):
        table = read_table(path)
        found[path.name] = np.concatenate([table["dx"], table["dy"]]).tolist()
    return found


def test_all_files_of_a_run_are_of_it(frames, inputs, tmp_path):
    run = calibrate(frames, inputs[1], output=tmp_path)
    names = {"manifest.json", "summary.ecsv", "one.solution.asdf", "two.solution.asdf"}
    for frame in frames:
        names |= {f"{frame.name}.wcs.asdf", f"{frame.name}.matches.ecsv"}
    assert {p.name for p in tmp_path.iterdir()} == names
    assert set(check_sets(tmp_path).values()) == {run.run_id}
    assert read(tmp_path / "one.solution.asdf").provenance["run"] == run.run_id
    summary = Table.read(tmp_path / "summary.ecsv")
    assert summary.meta["run"] == run.run_id
    assert list(summary["frame"]) == [f.name for f in frames]
    manifest = json.loads((tmp_path / "manifest.json").read_text())
    assert manifest["run"] == run.run_id
    assert [f["state"] for f in manifest["frames"].values()] == ["solved"] * 3
    assert manifest["settings"]["n_grid"] == 50
    assert manifest["software"]["numpy"] == np.__version__
    by_path = {i["path"]: i for i in manifest["inputs"]}
    for path in [*inputs[0], inputs[1]]:
        assert by_path[str(path)]["size"] == Path(path).stat().st_size


def test_python_and_command_line_write_the_same(frames, inputs, tmp_path):
    paths, reference = inputs
    calibrate(iter(frames[:1]), Table.read(reference), output=tmp_path / "python")
    arguments = ["--catalog", str(reference), "--output", str(tmp_path / "shell"), "-q"]
    assert command(["calibrate", str(paths[0]), "--detector", "one", *arguments]) == 0
    assert numbers_of(tmp_path / "python") == numbers_of(tmp_path / "shell")
    names = [sorted(p.name for p in (tmp_path / n).iterdir()) for n in ("python", "shell")]
    assert names[0] == names[1]


def test_tables_of_another_run_are_not_evaluated(frames, inputs, tmp_path, capsys):
    calibrate(frames[:1], inputs[1], output=tmp_path)
    path = tmp_path / f"{frames[0].name}.matches.ecsv"
    path.write_text(re.sub(r"run: \w+", "run: another", path.read_text()))
    assert command(["evaluate", str(tmp_path)]) == 2
    assert "must come from the same run as" in capsys.readouterr().err


def test_one_frame_takes_any_catalog(frames, inputs):
    matched = [match_frame(frames[0], c) for c in (inputs[1], Table.read(inputs[1]))]
    np.testing.assert_array_equal(*(m.reference["catalog_index"] for m in matched))


class Stopped(BaseException):
    """What nobody catches."""


def stop_at(monkeypatch, detector):
    """Stop a run when it comes to a detector, as a signal would."""
    true = solving_module.solve_camera

    def stopping(group, *args, **options):
        if group[0].detector == detector:
            raise Stopped
        return true(group, *args, **options)

    monkeypatch.setattr(solving_module, "solve_camera", stopping)


def test_a_stop_loses_only_what_was_in_work(frames, inputs, tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        stop_at(patch, "two")
        with pytest.raises(Stopped):
            calibrate(frames, inputs[1], output=tmp_path / "a")
    (done,) = check_sets(tmp_path / "a").items()
    assert done[0] == frames[0].name
    states = {n: f["state"] for n, f in read_manifest(tmp_path / "a/manifest.json").frames.items()}
    assert list(states.values()) == ["solved", "pending", "pending"]
    assert len(read_table(tmp_path / "a/summary.ecsv")) == 1
    before = (tmp_path / "a" / f"{done[0]}.wcs.asdf").read_bytes()

    run = calibrate(frames, inputs[1], output=tmp_path / "a", resume=True)
    assert run.resumed == (frames[0].name,)
    assert [c.frame for c in run.calibrations] == [f.name for f in frames]
    assert list(run.summary["status"]) == ["solved"] * 3
    assert set(check_sets(tmp_path / "a").values()) == {done[1]} == {run.run_id}
    assert (tmp_path / "a" / f"{done[0]}.wcs.asdf").read_bytes() == before
    whole = calibrate(frames, inputs[1], output=tmp_path / "b")
    assert numbers_of(tmp_path / "a") == numbers_of(tmp_path / "b")
    for name in ("sigma_dx", "rms_mas", "n_matched", "purity"):
        np.testing.assert_array_equal(run.summary[name], whole.summary[name])
    assert run.summary.colnames == whole.summary.colnames
    assert [run.summary[n].unit for n in run.summary.colnames] == [
        whole.summary[n].unit for n in run.summary.colnames
    ]
    for c, d in zip(run.calibrations, whole.calibrations, strict=True):
        np.testing.assert_array_equal(c.matches["dx"], d.matches["dx"])

    again = calibrate(frames, inputs[1], output=tmp_path / "a", resume=True)
    assert len(again.resumed) == 3


def test_resume_says_what_differs(frames, inputs, tmp_path, simulation):
    calibrate(frames, inputs[1], output=tmp_path)
    other = Table.read(inputs[1])[:-1]
    for options, message in (
        ({"settings": Settings(n_grid=20)}, "n_grid 50, now 20; to start over: --overwrite"),
        ({"catalog": other}, "another catalog"),
    ):
        options = {"catalog": inputs[1], **options}
        with pytest.raises(InputError, match=message):
            calibrate(frames, output=tmp_path, resume=True, **options)
        run = calibrate(frames, output=tmp_path, resume=True, overwrite=True, **options)
        assert run.resumed == ()
        assert set(check_sets(tmp_path).values()) == {run.run_id}
    run = calibrate(frames, other, output=tmp_path, resume=True)
    assert len(run.resumed) == 3


def test_changed_inputs_are_not_left_out(inputs, tmp_path):
    paths = []
    for path in inputs[0]:
        paths.append(tmp_path / path.name)
        paths[-1].write_bytes(path.read_bytes())
    out = tmp_path / "out"
    calibrate(frames_of(paths), inputs[1], output=out)
    os.utime(paths[0], (1e9, 1e9))
    with pytest.raises(InputError, match="file exists, and is replaced only with --overwrite"):
        calibrate(frames_of(paths), inputs[1], output=out, resume=True)
    run = calibrate(frames_of(paths), inputs[1], output=out, resume=True, overwrite=True)
    assert run.resumed == tuple(p.stem for p in paths[1:])
    # What is gone is made again, of the same inputs without asking.
    (out / f"{paths[1].stem}.wcs.asdf").unlink()
    run = calibrate(frames_of(paths), inputs[1], output=out, resume=True)
    assert run.resumed == (paths[0].stem,)
    check_sets(out)


def test_what_goes_with_an_image_is_part_of_its_input(tmp_path):
    wcs = WCS(naxis=2)
    wcs.wcs.ctype, wcs.wcs.crval, wcs.wcs.cdelt = ["RA---TAN", "DEC--TAN"], [10, 20], [-1e-4, 1e-4]
    path, mask, weight = (tmp_path / name for name in ("cube.fits", "mask.fits", "weight.fits"))
    cube = fits.PrimaryHDU(np.zeros((2, 20, 30), np.float32), wcs.to_header())
    cube.writeto(path)
    for name in (mask, weight):
        fits.PrimaryHDU(np.ones((20, 30), np.int16)).writeto(name)

    def sum_of(plane=0, **options):
        return frame_sum(read_frames(f"{path}[0][{plane}]", **options)[0])

    masked = sum_of(mask=mask)
    assert masked == sum_of(mask=mask) is not None
    others = [
        sum_of(),
        sum_of(1),
        sum_of("L"),
        sum_of(mask=mask, mask_bits=2),
        sum_of(weight_map=weight),
        sum_of(mask=mask, weight_map=weight),
    ]
    assert len({masked, *others}) == 7
    os.utime(mask, (1, 1))
    assert sum_of(mask=mask) not in {masked, *others}
    # Nor is it replaced by a result.
    frame = read_frames(f"{path}[0][0]", mask=mask)[0]
    os.rename(mask, tmp_path / "summary.ecsv")
    frame = replace(frame, inputs=(str(tmp_path / "summary.ecsv"),))
    with pytest.raises(InputError, match="summary.ecsv: is an input"):
        calibrate(frame, SkyCoord([10], [20], unit="deg"), output=tmp_path, overwrite=True)


def test_failures_are_remembered(inputs, tmp_path):
    frames = frames_of(inputs[0])
    empty = replace(frames[0], load_sources=lambda: frames[1].load_sources()[:0])
    first = calibrate([empty, *frames[1:]], inputs[1], output=tmp_path)
    again = calibrate([empty, *frames[1:]], inputs[1], output=tmp_path, resume=True)
    assert len(again.resumed) == 3
    (a,), (b,) = first.failures.values(), again.failures.values()
    assert (type(a), str(a)) == (type(b), str(b))


def boom():
    raise ZeroDivisionError("of a\nkind")


@pytest.mark.parametrize("jobs", [1, 2])
def test_what_nobody_foresaw_is_the_failure_of_one_frame(frames, inputs, tmp_path, jobs):
    frames = [replace(frames[0], load_sources=boom), *frames[1:]]
    run = calibrate(frames, inputs[1], output=tmp_path, jobs=jobs)
    (error,) = run.failures.values()
    assert isinstance(error, InternalError)
    assert str(error) == "internal error: ZeroDivisionError: of a kind"
    assert list(run.summary["status"]) == ["failed", "solved", "solved"]
    text = (tmp_path / "errors.log").read_text()
    assert f"{run.run_id} {frames[0].name}: internal error" in text
    assert "in boom" in text
    # Another try may succeed.
    assert len(calibrate(frames, inputs[1], output=tmp_path, resume=True).resumed) == 2


def test_what_nobody_foresaw_in_a_solution(frames, inputs, tmp_path, monkeypatch):
    monkeypatch.setattr(solving_module, "_camera_of", None)
    monkeypatch.setattr(solving_module, "solve_camera", lambda group, *a, **o: boom())
    run = calibrate(frames, inputs[1], output=tmp_path)
    assert len(run.failures) == 3
    assert all(isinstance(error, InternalError) for error in run.failures.values())
    assert not list(tmp_path.glob("*.wcs.asdf"))


def die(marker, once):
    """End the process, every time or the first time."""
    if not (once and os.path.exists(marker)):
        Path(marker).write_text("")
        os.kill(os.getpid(), signal.SIGKILL)
    return Table.read(marker + ".fits")


@pytest.mark.parametrize("once", [True, False])
def test_a_process_that_dies_has_a_second_try(frames, inputs, tmp_path, once):
    marker = str(tmp_path / "died")
    frames[0].load_sources().write(marker + ".fits")
    frames[0] = replace(frames[0], load_sources=partial(die, marker, once))
    run = calibrate(frames, inputs[1], jobs=2)
    assert list(run.summary["status"]) == ["solved" if once else "failed", "solved", "solved"]
    if not once:
        message = "internal error: its process died 2 times, exit status -9"
        assert message in str(run.failures[frames[0].name])


def test_paths_are_no_frames(inputs):
    with pytest.raises(TypeError, match="as read_frames gives, got PosixPath|WindowsPath|str"):
        calibrate([inputs[0][0]], inputs[1])


def test_frames_that_cannot_travel(frames, inputs):
    frames[0] = replace(frames[0], load_sources=lambda: None)
    run = calibrate(frames, inputs[1], jobs=2)
    assert "cannot be handed to another process" in str(run.failures[frames[0].name])
    assert len(run.calibrations) == 2


@pytest.fixture
def distributed():
    """Dask, whose cut connections are collected here instead of in a later test."""
    module = pytest.importorskip("distributed")
    yield module
    # The thread of its event loop ends soon after the last client and cluster are closed.
    for thread in threading.enumerate():
        if thread.name.startswith("IO loop"):
            thread.join(1)
    gc.collect()


# A peer that is gone leaves sockets that Dask does not close.
dask_leaves_sockets = pytest.mark.filterwarnings("ignore:unclosed:ResourceWarning")


@pytest.mark.parametrize("kind", ["threads", "processes"])
def test_executors(frames, inputs, kind):
    pool = {
        "threads": partial(ThreadPoolExecutor, 2),
        "processes": partial(ProcessPoolExecutor, 2, mp_context=get_context("spawn")),
    }[kind]()
    with pool:
        run = calibrate(frames, inputs[1], executor=pool)
    check_same(run, calibrate(frames, inputs[1]))


@dask_leaves_sockets
def test_executor_of_dask(frames, inputs, distributed):
    with (
        distributed.LocalCluster(n_workers=1, processes=False, dashboard_address=":0") as cluster,
        distributed.Client(cluster) as client,
    ):
        run = calibrate(frames, inputs[1], executor=client.get_executor())
    check_same(run, calibrate(frames, inputs[1]))


def check_same(run, truth):
    for a, b in zip(run.calibrations, truth.calibrations, strict=True):
        # The header WCS loses its last digits on the way.
        np.testing.assert_allclose(a.cd, b.cd, rtol=0, atol=1e-17)
        np.testing.assert_array_equal(a.matches["catalog_index"], b.matches["catalog_index"])


def test_a_frame_is_handed_only_its_part_of_the_catalog(frames, inputs):
    whole = Table.read(inputs[1])
    far = whole.copy()
    far["dec"] = -far["dec"]
    handed = []

    class Here(ThreadPoolExecutor):
        def submit(self, call, task):
            handed.append(len(task.catalog))
            return super().submit(call, task)

    with Here(1) as pool:
        calibrate(frames, vstack([whole, far]), executor=pool)
    assert max(handed) <= len(whole)


@dask_leaves_sockets
def test_a_scheduler_without_workers_is_given_up(inputs, tmp_path, capsys, distributed):
    arguments = ["calibrate", str(inputs[0][0]), "--catalog", str(inputs[1])]
    arguments += ["--output", str(tmp_path / "out"), "--scheduler-timeout", "2"]
    with distributed.LocalCluster(
        n_workers=0, processes=False, dashboard_address=":0", protocol="tcp", host="127.0.0.1"
    ) as cluster:
        began = time.monotonic()
        assert command([*arguments, "--scheduler", cluster.scheduler_address]) == 2
        assert time.monotonic() - began < 15
        lines = capsys.readouterr().err.splitlines()
        assert "the Dask scheduler has no worker yet; waiting at most 2 s" in lines[0]
        assert lines[1:] == [
            f"wpdc: error: --scheduler {cluster.scheduler_address}: must have a worker within 2 s, "
            f"has none; try: dask worker {cluster.scheduler_address}, on machines that see the "
            "files"
        ]
    assert command([*arguments, "--scheduler", "tcp://127.0.0.1:1"]) == 2
    assert "no Dask scheduler answers there" in capsys.readouterr().err


@dask_leaves_sockets
@pytest.mark.parametrize("gone", ["workers", "scheduler"])
def test_a_cluster_that_is_lost_ends_the_run(frames, inputs, tmp_path, distributed, gone):
    cluster = distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, dashboard_address=":0", host="127.0.0.1"
    )
    # The first frame is done, the second one ends all, and the third one waits.
    # A cluster that is closed ends its workers, and then the scheduler.
    stop, timeout = (cluster.close, 60.0) if gone == "scheduler" else (partial(cluster.scale, 0), 2)
    stopped = threading.Event()

    def watch(stage, done, total):
        if stage == "match" and done == 1:
            stop()
            stopped.set()

    slow = [frames[0], *(replace(f, load_sources=partial(time.sleep, 60)) for f in frames[1:])]
    began = time.monotonic()
    with (
        cluster,
        pytest.raises(ClusterError, match="--resume") as caught,
        cluster_executor(cluster.scheduler_address, timeout) as pool,
    ):
        calibrate(slow, inputs[1], executor=pool, output=tmp_path, progress=watch)
    assert stopped.is_set()
    assert time.monotonic() - began < 40
    said = "the scheduler is gone" if gone == "scheduler" else "none came back within 2 s"
    assert said in str(caught.value)
    assert set(check_sets(tmp_path)) == {frames[0].name}
    # The slow ones are other frames, but what is done needs not be done again.
    again = calibrate([slow[0], *frames[1:]], inputs[1], output=tmp_path, resume=True)
    assert again.resumed == (frames[0].name,)
    assert list(again.summary["status"]) == ["solved"] * 3


@pytest.mark.parametrize("moment", ["part", "done"])
def test_a_run_that_was_killed_is_completed_by_the_next(
    frames, inputs, tmp_path, monkeypatch, moment
):
    """Killed while it wrote, or while files got their names: all of a set, or nothing."""
    first = calibrate(frames, inputs[1], output=tmp_path)
    with monkeypatch.context() as patch:
        # As if killed: nothing is cleaned.
        patch.setattr(ResultFolder, "__exit__", lambda self, *_: os.close(self._lock))

        def stopping(done, folder):
            if moment == "part":
                raise Stopped
            names = sorted(os.listdir(done))
            os.replace(done / names[1], folder / names[1])
            raise Stopped

        if moment == "part":
            patch.setattr(results_module, "_write_state", lambda *a: stopping(None, None))
        else:
            patch.setattr(results_module, "put_in_place", stopping)
        with pytest.raises(Stopped):
            calibrate(frames, inputs[1], output=tmp_path, overwrite=True)
    assert [p for p in tmp_path.iterdir() if p.name.startswith(".")]
    with ResultFolder(tmp_path):
        pass
    runs = check_sets(tmp_path)
    assert len(runs) == 3
    if moment == "part":
        assert set(runs.values()) == {first.run_id}
    else:
        assert runs[frames[0].name] != first.run_id == runs[frames[1].name]
    again = calibrate(frames, inputs[1], output=tmp_path, resume=True)
    assert len(set(check_sets(tmp_path).values())) == 1
    # What is not ours stays.
    others = [tmp_path / ".film.part", tmp_path / ".0123456789ab.party", tmp_path / ".x.done"]
    for other in others:
        other.mkdir()
    with ResultFolder(tmp_path):
        pass
    assert all(other.exists() for other in others)
    assert len(again.resumed) == (3 if moment == "part" else 1)


def test_one_run_at_a_time(frames, inputs, tmp_path):
    pytest.importorskip("fcntl")
    with ResultFolder(tmp_path), pytest.raises(InputError, match="another run is writing to"):
        calibrate(frames, inputs[1], output=tmp_path)
    calibrate(frames[:1], inputs[1], output=tmp_path)


def test_names_are_checked_before_the_work(frames, inputs, tmp_path, monkeypatch):
    monkeypatch.setattr(run_module, "Workers", None)

    def refused(message, frames=frames, **options):
        with pytest.raises(InputError, match=message):
            calibrate(frames, inputs[1], output=tmp_path / "out", **options)

    both = [replace(f, detector=d) for f, d in zip(frames, ("a/b", "a b", "c"), strict=True)]
    refused("detector 'a/b' and detector 'a b' would both write a_b.solution.asdf", both)
    long = [replace(frames[0], name="x" * 250 + "long")]
    refused("long.wcs.asdf: cannot be written: File name too long", long)
    (tmp_path / "out" / "summary.ecsv").mkdir(parents=True)
    refused("summary.ecsv: is a folder", overwrite=True)
    (tmp_path / "out" / "summary.ecsv").rmdir()
    os.mkfifo(tmp_path / "out" / "one.solution.asdf")
    refused("one.solution.asdf: is no file", overwrite=True)
    os.unlink(tmp_path / "out" / "one.solution.asdf")
    source = tmp_path / "out" / "summary.ecsv"
    source.write_text("")
    refused("summary.ecsv: is an input", [replace(frames[0], source=str(source))], overwrite=True)
    catalog = tmp_path / "out" / "one.solution.asdf"
    Table.read(inputs[1]).write(catalog, format="fits")
    with pytest.raises(InputError, match="one.solution.asdf: is an input"):
        calibrate(frames, catalog, output=tmp_path / "out", overwrite=True)


def test_damaged_manifest(frames, inputs, tmp_path):
    for text in ("", "{", "[]", '{"run": 1}', "{" * 100000):
        (tmp_path / "manifest.json").write_text(text)
        with pytest.raises(FileFormatError, match="manifest.json: not a manifest of a run"):
            calibrate(frames, inputs[1], output=tmp_path, resume=True)


@pytest.mark.parametrize("name", ["a#b?c;d%41 ~", "two\nlines\tand", "caf\udce9", "é"])
def test_odd_names_of_frames_and_folders(inputs, tmp_path, name):
    frame = tmp_path / f"{name}.cat"
    frame.write_bytes(inputs[0][0].read_bytes())
    out = tmp_path / name
    arguments = ["--catalog", str(inputs[1]), "--output", str(out)]
    assert command(["calibrate", str(frame), *arguments]) == 0
    ((stem, _),) = check_sets(out).items()
    assert list(Table.read(out / "summary.ecsv")["frame"]) == [stem]
    assert read(out / f"{stem}.wcs.asdf").frame == stem
    assert command(["evaluate", str(out), "-q"]) == 0
    assert command(["calibrate", str(frame), *arguments, "--resume"]) == 0


WPDC = [sys.executable, "-m", "wpdc_gwcs"]


def processes_of(group):
    """Processes of a group that are alive."""
    found = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = path.read_text().rsplit(")", 1)[1].split()
        except OSError:
            continue
        if int(fields[2]) == group and fields[0] != "Z":
            found.append(int(path.parent.name))
    return found


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="needs /proc")
@pytest.mark.parametrize(
    ("number", "to_all"),
    [(signal.SIGTERM, False), (signal.SIGKILL, False), (signal.SIGINT, True)],
    ids=["SIGTERM", "SIGKILL", "Ctrl-C"],
)
def test_signals_end_all_processes_quietly(inputs, tmp_path, number, to_all):
    paths, reference = inputs
    out = tmp_path / "out"
    arguments = [*map(str, paths), "--catalog", str(reference), "--output", str(out)]
    assert command(["calibrate", *arguments, "-q"]) == 0
    runs = check_sets(out)
    slow = tmp_path / "slow.py"
    slow.write_text(
        "import signal, time, wpdc_gwcs.calibration.workers as workers\n"
        "true = workers.measure_sources\n"
        "def slowly(*args):\n"
        "    time.sleep(60)\n"
        "    return true(*args)\n"
        "workers.measure_sources = slowly\n"
        "if __name__ == '__main__':\n"
        # A shell that runs the tests in the background has it ignored.
        "    signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "    from wpdc_gwcs.__main__ import main\n"
        "    main()\n"
    )
    with subprocess.Popen(
        [sys.executable, str(slow), "calibrate", *arguments, "--overwrite", "--jobs", "2"],
        stderr=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,
    ) as process:
        until = time.monotonic() + 60
        while len(processes_of(process.pid)) < 4 and time.monotonic() < until:
            time.sleep(0.1)  # the program, the tracker of resources, and two workers
        time.sleep(0.5)
        began = time.monotonic()
        (os.killpg if to_all else os.kill)(process.pid, number)
        # Workers hold its pipes, which end with the last of them.
        output, errors = process.communicate(timeout=10)
        assert time.monotonic() - began < 10
    assert process.returncode == (-9 if number == signal.SIGKILL else 128 + number)
    expected = (
        "" if number == signal.SIGKILL else "wpdc: error: interrupted; nothing has been written\n"
    )
    assert errors == expected
    assert output == ""
    until = time.monotonic() + 5
    while processes_of(process.pid) and time.monotonic() < until:
        time.sleep(0.1)
    assert processes_of(process.pid) == []
    assert check_sets(out) == runs


def test_an_interrupt_tells_whether_there_are_results(inputs, tmp_path, monkeypatch, capsys):
    paths, reference = inputs
    out = tmp_path / "out"
    arguments = [*map(str, paths), "--catalog", str(reference), "--output", str(out), "-q"]
    true = ResultFolder.write

    def interrupt(*given, **options):
        raise KeyboardInterrupt

    def write_and_interrupt(self, *given):
        true(self, *given)
        raise KeyboardInterrupt

    for write, message in (
        (interrupt, "nothing has been written"),
        (write_and_interrupt, "files already written are complete; continue with --resume"),
    ):
        monkeypatch.setattr(ResultFolder, "write", write)
        assert command(["calibrate", *arguments]) == 130
        assert capsys.readouterr().err == f"wpdc: error: interrupted; {message}\n"
        assert len(list(out.glob("*.wcs.asdf"))) == (0 if write is interrupt else 3)
    # Before the run itself.
    monkeypatch.setattr("wpdc_gwcs.io.read_files", interrupt)
    assert command(["calibrate", *arguments, "--overwrite"]) == 130
    assert capsys.readouterr().err == "wpdc: error: interrupted; nothing has been written\n"


def test_a_full_disk_leaves_nothing(inputs, tmp_path):
    """The limit of the size of files stands for it."""
    paths, reference = inputs
    code = (
        "import resource, sys; resource.setrlimit(resource.RLIMIT_FSIZE, (20000, 20000));"
        "from wpdc_gwcs.cli.app import run; sys.exit(run(sys.argv[1:]))"
    )
    out = tmp_path / "out"
    # The measurement of coverage could not write its own files either.
    environment = {k: v for k, v in os.environ.items() if not k.startswith("COV")}
    done = subprocess.run(
        [sys.executable, "-c", code, "calibrate", str(paths[0]), "--catalog", str(reference),
         "--output", str(out)],
        capture_output=True, text=True, env=environment, check=False,
    )  # fmt: skip
    assert done.returncode == 2
    assert f"{out}/sim-" in done.stderr
    assert "cannot be written: File too large" in done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert list(out.iterdir()) == []


@pytest.mark.parametrize("locale", ["C", "POSIX"])
def test_a_locale_without_letters(inputs, tmp_path, locale):
    frame = os.fsencode(tmp_path) + b"/caf\xe9.cat"
    with open(frame, "wb") as file:
        file.write(inputs[0][0].read_bytes())
    environment = {**os.environ, "LC_ALL": locale, "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    done = subprocess.run(
        [*WPDC, "calibrate", frame, "--catalog", str(inputs[1]), "--output", str(tmp_path / "é")],
        capture_output=True, env=environment, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert done.stderr == b""
    assert (tmp_path / "é" / "caf%E9.wcs.asdf").exists()
