"""A survey against a stored solution: batch by batch, in constant memory, one growing summary."""

import gc
import json
import os
import pickle
import re
import threading
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
from astropy.modeling import CompoundModel
from astropy.table import Table, vstack

from wpdc_gwcs import Settings, calibrate, read
from wpdc_gwcs.calibration import batches as batches_module
from wpdc_gwcs.calibration import results as results_module
from wpdc_gwcs.calibration import run as run_module
from wpdc_gwcs.calibration import solving as solving_module
from wpdc_gwcs.calibration.batches import batches_of
from wpdc_gwcs.calibration.journal import add_to_journal, find_journals, journal_of, read_journal
from wpdc_gwcs.calibration.manifest import read_manifest
from wpdc_gwcs.calibration.results import ResultFolder
from wpdc_gwcs.calibration.solving import Batch
from wpdc_gwcs.calibration.workers import Task, Workers
from wpdc_gwcs.cli.app import run as command
from wpdc_gwcs.cli.inputs import expand_paths
from wpdc_gwcs.exceptions import CatalogError, ClusterError, InputError, WPDCError, without_frames
from wpdc_gwcs.frame import Frame
from wpdc_gwcs.io import read_frames, read_table
from wpdc_gwcs.simulation import simulate, write_simulation


def frame_of(exposure, detector):
    return Frame(
        name=f"e{exposure}-{detector}", detector=detector, image_shape=(100, 100), wcs=None,
        source=f"e{exposure}-{detector}", load_sources=Table, camera="cam", exposure=str(exposure),
    )  # fmt: skip


@pytest.fixture(scope="module")
def survey():
    return [frame_of(e, d) for e in range(40) for d in "ab"]


class TestBatches:
    def names(self, groups):
        return [[frame.name for frame in group] for group in groups]

    def test_exposures_of_known_detectors_come_in_even_batches(self, survey):
        groups = batches_of(survey, Settings(), solution={"a": 1, "b": 1})
        assert [len(group) for group in groups] == [26, 26, 28]
        assert [f for group in groups for f in group] == survey

    @pytest.mark.parametrize(
        ("settings", "options"),
        [
            (Settings(), {}),
            (Settings(), {"solution": {"a": 1}}),
            (Settings(), {"solution": {"a": 1, "b": 1}, "update": True}),
            (Settings(free_stars=True), {"solution": {"a": 1, "b": 1}}),
            (Settings(method="paper"), {"solution": {"a": 1, "b": 1}}),
        ],
    )
    def test_what_has_more_in_common_stays_together(self, survey, settings, options):
        assert len(batches_of(survey, settings, **options)) == 1

    def test_those_of_an_earlier_run_stay_as_they_were(self, survey):
        first = batches_of(survey[:20], Settings(), solution={"a": 1, "b": 1})
        earlier = [{f.name for f in group} for group in first] + [{"another", survey[30].name}]
        groups = batches_of(survey, Settings(), solution={"a": 1, "b": 1}, earlier=earlier)
        assert self.names(groups)[0] == self.names(first)[0]
        assert sorted(sum(self.names(groups), [])) == sorted(f.name for f in survey)


@pytest.fixture(scope="module")
def simulation():
    return simulate(6, image_shape=(512, 512), density=100, distortion=4, seed=3)


@pytest.fixture(scope="module")
def inputs(simulation, tmp_path_factory):
    """Frames, the reference, and a solution of the first two of them."""
    folder = tmp_path_factory.mktemp("input")
    files = write_simulation(simulation, folder, images=(), sources="ldac")
    frames = [read_frames(p)[0] for p in files["frames"]]
    calibrate(frames[:2], files["reference"], output=folder / "stored")
    return frames, files["reference"], read(folder / "stored/sim.solution.asdf"), folder


@pytest.fixture
def pairs(monkeypatch):
    """Two exposures are a batch."""
    monkeypatch.setattr(batches_module, "_MOST_EXPOSURES", 2)


class Stopped(BaseException):
    """What nobody catches."""


def stop_after(monkeypatch, n):
    """End a run at its (n + 1)th solution, as a killed program does: nothing is tidied."""
    true, calls = solving_module.solve_camera, []

    def stopping(*args, **options):
        calls.append(1)
        if len(calls) > n:
            raise Stopped
        return true(*args, **options)

    monkeypatch.setattr(solving_module, "solve_camera", stopping)
    monkeypatch.setattr(ResultFolder, "__exit__", lambda self, *_: os.close(self._lock))


def test_batches_are_written_as_they_are_solved(inputs, pairs, tmp_path, monkeypatch):
    frames, reference, stored, _ = inputs
    # Else so few frames are in the manifest at once.
    monkeypatch.setattr(results_module, "_SHARE", 10.0)
    with monkeypatch.context() as patch:
        stop_after(patch, 2)
        with pytest.raises(Stopped):
            calibrate(frames, reference, solution=stored, output=tmp_path)
    assert len(list(tmp_path.glob("*.wcs.asdf"))) == 4
    ((_, journal),) = find_journals(tmp_path).items()
    assert len(read_table(tmp_path / "summary.ecsv")) == 2
    # The program was killed while it wrote a line.
    text = journal.read_text()
    journal.write_text(text[: len(text) // 2])
    states, rows = read_journal(journal)
    assert states == rows == {}
    journal.write_text(text + '{"states": {')
    with ResultFolder(tmp_path):
        pass
    assert not find_journals(tmp_path)
    assert len(read_table(tmp_path / "summary.ecsv")) == 4
    states = [f["state"] for f in read_manifest(tmp_path / "manifest.json").frames.values()]
    assert states == ["solved"] * 4 + ["pending"] * 2

    run = calibrate(frames, reference, solution=stored, output=tmp_path, resume=True)
    assert run.resumed == tuple(f.name for f in frames[:4])
    assert list(run.summary["frame"]) == [f.name for f in frames]
    assert not [p for p in tmp_path.iterdir() if p.name.startswith(".")]
    summary = read_table(tmp_path / "summary.ecsv")
    assert list(summary["frame"]) == [f.name for f in frames]
    whole = calibrate(frames, reference, solution=stored)
    for name in ("sigma_dx", "rms_mas", "n_matched", "purity"):
        np.testing.assert_array_equal(run.summary[name], whole.summary[name])


def test_the_manifest_is_not_written_with_every_batch(inputs, pairs, tmp_path, monkeypatch):
    frames, reference, stored, _ = inputs
    copies = [replace(f, name=f"{f.name}-{k}") for k in range(4) for f in frames]  # 12 batches
    written = []
    true = results_module._write_state
    monkeypatch.setattr(
        results_module, "_write_state", lambda *a: (written.append(len(a[2])), true(*a))
    )
    monkeypatch.setattr(results_module, "_SHARE", 1.0)
    calibrate(copies, reference, solution=stored, output=tmp_path, keep=False)
    # It doubles each time, and is whole at the end.
    assert written == [2, 6, 14, 24]
    assert len(read_table(tmp_path / "summary.ecsv")) == 24


def test_a_survey_grows_night_by_night(inputs, pairs, tmp_path):
    frames, reference, stored, folder = inputs
    arguments = ["--catalog", str(reference), "--output", str(tmp_path), "--resume", "-q"]
    arguments += ["--solution", str(folder / "stored/sim.solution.asdf")]
    night = [str(f.source) for f in frames]
    assert command(["calibrate", *night[:3], *arguments]) == 0
    first = (tmp_path / f"{frames[0].name}.wcs.asdf").read_bytes()
    assert command(["calibrate", *night[3:], *arguments]) == 0
    summary = read_table(tmp_path / "summary.ecsv")
    assert list(summary["frame"]) == [f.name for f in frames]
    manifest = json.loads((tmp_path / "manifest.json").read_text())
    assert [f["state"] for f in manifest["frames"].values()] == ["solved"] * 6
    assert len({f["group"] for f in manifest["frames"].values()}) == 4
    assert len(manifest["inputs"]) == 7
    assert (tmp_path / f"{frames[0].name}.wcs.asdf").read_bytes() == first
    # All of them once more: nothing is left to do, in whatever order.
    run = calibrate(
        frames[::-1], reference, solution=stored, output=tmp_path, resume=True, keep=False
    )
    assert len(run.resumed) == 6
    assert run.calibrations == ()


def test_other_frames_stay_only_where_their_files_do(inputs, tmp_path):
    frames, reference, *_ = inputs
    calibrate(frames[:2], reference, output=tmp_path)
    with pytest.raises(InputError, match=r"sim\.solution\.asdf: file exists"):
        calibrate(frames[2:4], reference, output=tmp_path, resume=True)
    calibrate(frames[2:4], reference, output=tmp_path, resume=True, overwrite=True)
    assert list(read_table(tmp_path / "summary.ecsv")["frame"]) == [f.name for f in frames[2:4]]


def test_no_more_is_in_hand_than_keeps_the_workers_busy(inputs, pairs, monkeypatch):
    frames, reference, stored, _ = inputs
    copies = [replace(f, name=f"{f.name}-{k}") for k in range(4) for f in frames]
    solved, most = [], []
    true = solving_module.solve_camera

    def counting(group, *args, **options):
        solved.extend(group)
        return true(group, *args, **options)

    monkeypatch.setattr(solving_module, "solve_camera", counting)

    class Pool(ThreadPoolExecutor):
        n_workers = 2
        n_submitted = 0

        def submit(self, *args):
            Pool.n_submitted += 1
            most.append(Pool.n_submitted - len(solved))
            return super().submit(*args)

    with Pool(2) as pool:
        run = calibrate(copies, reference, solution=stored, executor=pool)
    assert len(run.calibrations) == Pool.n_submitted == 24
    # Twice as many as workers, a batch more, and that which is being solved.
    assert max(most) <= 2 * 2 + 2 + 2


def contents(folder):
    """Data of all tables and WCS of a folder."""
    found = {}
    for path in sorted(folder.iterdir()):
        if path.name.endswith(".wcs.asdf"):
            one = read(path)
            found[path.name] = [*one.wcs(100.0, 200.0), *one.cd.ravel()]
        elif path.name.endswith((".matches.ecsv", ".sources.ecsv")):
            table = read_table(path)
            found[path.name] = np.concatenate([np.asarray(c, float) for c in table.itercols()])
    return found


class Pool(ThreadPoolExecutor):
    """Threads that count what they solve, and may fail to."""

    n_workers = 2
    problem = None

    def __init__(self):
        super().__init__(2)
        self.n_solved = 0
        self.largest = 0

    def submit(self, function, item):
        if isinstance(item, Batch | Task):
            self.largest = max(self.largest, len(pickle.dumps(item)))
        if function is not solving_module.solve_or_fail:
            return super().submit(function, item)
        self.n_solved += 1
        if self.problem is None:
            return super().submit(function, item)
        future = Future()
        future.set_exception(self.problem)
        return future


@pytest.fixture(scope="module")
def alone(inputs, tmp_path_factory):
    """What a single process finds, batch by batch."""
    frames, reference, stored, _ = inputs
    folder = tmp_path_factory.mktemp("alone")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(batches_module, "_MOST_EXPOSURES", 2)
        run = calibrate(frames, reference, solution=stored, output=folder, keep=False)
    return run, contents(folder)


def the_same(run, folder, alone):
    expected, data = alone
    found = contents(folder)
    assert list(found) == list(data)
    for name, values in data.items():
        np.testing.assert_allclose(found[name], values, rtol=1e-12, atol=1e-12, err_msg=name)
    for name in ("frame", "status", "n_sources", "n_matched"):
        assert list(run.summary[name]) == list(expected.summary[name])
    np.testing.assert_allclose(run.summary["sigma_dx"], expected.summary["sigma_dx"], rtol=1e-9)
    # A residual map is most of a stored solution; only its file has it.
    for name, solution in expected.solutions.items():
        for there in (run.solutions[name], read(folder / f"{name}.solution.asdf")):
            np.testing.assert_array_equal(there.residual_map.sums, solution.residual_map.sums)
            np.testing.assert_array_equal(there.lookup_table.dx, solution.lookup_table.dx)
    states = read_manifest(folder / "manifest.json").frames
    assert all(states[name]["state"] == "solved" for name in expected.summary["frame"])


@pytest.mark.parametrize("problem", [None, OSError("no room"), ClusterError("all are gone")])
def test_batches_are_solved_by_workers_or_else_here(inputs, pairs, tmp_path, alone, problem):
    frames, reference, stored, _ = inputs
    with Pool() as pool:
        pool.problem = problem
        run = calibrate(
            frames, reference, solution=stored, output=tmp_path, executor=pool, keep=False
        )
    assert pool.n_solved == 3
    (solution,) = run.solutions.values()
    assert pool.largest < len(pickle.dumps(solution.residual_map))
    the_same(run, tmp_path, alone)
    assert not list(tmp_path.glob(".*.part"))


def test_batches_are_solved_by_processes(inputs, pairs, tmp_path, alone, monkeypatch):
    frames, reference, stored, _ = inputs
    monkeypatch.setattr(solving_module, "_solve", None)  # of this process
    run = calibrate(frames, reference, solution=stored, output=tmp_path, jobs=2, keep=False)
    the_same(run, tmp_path, alone)


def test_what_is_done_is_only_looked_at(inputs, pairs, tmp_path, monkeypatch):
    """To go on with a survey does not take the time of reading thousands of results."""
    frames, reference, stored, _ = inputs
    options = {"solution": stored, "output": tmp_path, "keep": False}
    calibrate(frames, reference, **options)
    read_again, read_frame = [], results_module._read_frame
    monkeypatch.setattr(
        results_module, "_read_frame", lambda *a: read_again.append(a[0].name) or read_frame(*a)
    )
    again = calibrate(frames, reference, resume=True, **options)
    assert len(again.resumed) == len(frames)
    assert not read_again
    damaged = tmp_path / f"{frames[1].name}.wcs.asdf"
    damaged.write_bytes(damaged.read_bytes()[: damaged.stat().st_size // 2])
    with pytest.raises(WPDCError, match=re.escape(damaged.name)):
        calibrate(frames, reference, resume=True, **options)
    assert read_again == [damaged.name]


def test_the_end_of_workers_cancels_what_they_have_not_begun():
    with Pool() as pool:
        with Workers(1, pool) as workers:
            until = threading.Event()
            futures = [workers.start(wait_for, until) for _ in range(2)]
            futures += [workers.start(wait_for, until) for _ in range(5)]
        assert all(future.cancelled() for future in futures[2:])
        until.set()
    assert all(future.result() for future in futures[:2])


def wait_for(event):
    return event.wait(10.0)


def test_what_is_kept_is_solved_here(inputs, pairs, tmp_path):
    frames, reference, stored, _ = inputs
    with Pool() as pool:
        run = calibrate(frames[:3], reference, solution=stored, output=tmp_path, executor=pool)
    assert pool.n_solved == 0
    assert len(run.calibrations) == 3


def test_calibrations_are_left_to_the_files_only_where_there_are_any(inputs):
    frames, reference, *_ = inputs
    with pytest.raises(ValueError, match="keep=False needs output"):
        calibrate(frames[:1], reference, keep=False)


def test_batches_that_are_written_leave_the_memory(inputs, pairs, tmp_path, monkeypatch):
    """Models refer to their parameters and back, which reference counts alone never free."""
    frames, reference, stored, _ = inputs
    true, alive = ResultFolder.write, []

    def counting(folder, *args):
        alive.append(sum(isinstance(one, CompoundModel) for one in gc.get_objects()))
        true(folder, *args)

    monkeypatch.setattr(ResultFolder, "write", counting)
    monkeypatch.setattr(run_module, "_FRAMES_PER_SEARCH", 2)
    gc.collect()
    gc.disable()
    try:
        calibrate(frames, reference, solution=stored, output=tmp_path / "out", keep=False)
    finally:
        gc.enable()
    assert len(alive) == 3
    assert len(set(alive)) == 1


def test_a_stored_solution_stays_that_of_its_own_frames(inputs, tmp_path):
    frames, reference, stored, _ = inputs
    run = calibrate(frames[3:], reference, solution=stored, output=tmp_path)
    assert run.solutions["sim"].provenance["inputs"] == stored.provenance["inputs"]


def test_kept_errors_hold_no_arrays():
    try:
        try:
            raise KeyError("inner")
        except KeyError as err:
            raise ValueError("outer") from err
    except ValueError as err:
        kept = without_frames(err)
    assert kept.__traceback__ is kept.__context__ is kept.__cause__ is None
    assert str(kept) == "outer"


def test_an_entry_twice_is_as_good_as_once(tmp_path):
    entry, journal = tmp_path / "entry.json", journal_of(tmp_path, "0123456789ab")
    entry.write_text('{"states": {"a": {"state": "solved"}}, "rows": {"a": {"frame": "a"}}}')
    for _ in range(2):
        add_to_journal(entry, journal)
    assert read_journal(journal) == ({"a": {"state": "solved"}}, {"a": {"frame": "a"}})


class TestPaths:
    @pytest.fixture
    def folder(self, tmp_path, monkeypatch):
        monkeypatch.chdir(tmp_path)
        for name in ("b.fits", "a.fits.fz", "c.cat", "d.txt", ".e.fits", "f[1].fits", "gaia.fits"):
            (tmp_path / name).touch()
        (tmp_path / "night").mkdir()
        (tmp_path / "night" / "g.LDAC").touch()
        return tmp_path

    def test_paths_stay_as_they_are(self, folder):
        given = ["b.fits", "b.fits[SCI]", "nothing.fits", "f[1].fits", "b.fits[1][0]"]
        assert expand_paths(given) == given
        assert expand_paths(["gaia.fits", "b.fits"], without=["./gaia.fits"]) == ["b.fits"]
        assert expand_paths(["gaia.fits"], without=["gaia.fits"]) == ["gaia.fits"]

    def test_folders(self, folder):
        expected = ["./a.fits.fz", "./b.fits", "./c.cat", "./f[1].fits"]
        assert expand_paths(["."], without=["gaia.fits", "gaia"]) == expected
        assert expand_paths([str(folder / "night")]) == [str(folder / "night/g.LDAC")]
        (folder / "empty").mkdir()
        with pytest.raises(InputError, match="empty: the folder has no FITS file"):
            expand_paths(["empty"])
        (folder / "empty/night2").mkdir()
        with pytest.raises(InputError, match=r"; its folders are empty/\*$"):
            expand_paths(["empty"])

    def test_patterns(self, folder):
        assert expand_paths(["?.fits[SCI]"]) == ["b.fits[SCI]"]
        assert expand_paths(["*.f*"], without=["gaia.fits"]) == ["a.fits.fz", "b.fits", "f[1].fits"]
        assert expand_paths(["f[1*"]) == ["f[1].fits"]
        assert expand_paths(["nig*"]) == ["night/g.LDAC"]
        with pytest.raises(InputError, match="x.*: no file matches this pattern"):
            expand_paths(["x*"])
        (folder / "odd*.fits").touch()
        assert expand_paths(["odd*.fits[1]"]) == ["odd*.fits[1]"]

    def test_lists(self, folder):
        (folder / "list").write_bytes(b"# two\nb.fits\n\n  night  \ncaf\xe9.fits\n")
        assert expand_paths(["@list", "c.cat"]) == [
            "b.fits", "night/g.LDAC", "caf\udce9.fits", "c.cat",
        ]  # fmt: skip
        (folder / "@b").touch()
        assert expand_paths(["@b", "@"]) == ["@b", "@"]
        for name, text, message in (
            ("none", None, "@none: the list of files must be readable: No such file"),
            ("empty.txt", b"# nothing\n", "the list names no files"),
            ("x.fits", b"\0\1", "must be a text file with one path per line"),
        ):
            if text is not None:
                (folder / name).write_bytes(text)
            with pytest.raises(InputError, match=message):
                expand_paths([f"@{name}"])


class Archive:
    """A catalog that is given in parts, as an archive does."""

    def __init__(self, path, identity="archive 1"):
        self.table, self.identity, self.asked = Table.read(path), identity, []

    def __str__(self):
        return "archive"

    def stars_of(self, region):
        self.asked.append(len(region.ra))
        return self.table[region.contains(self.table["ra"], self.table["dec"])]


def test_a_run_with_an_archive_reads_what_each_batch_covers(inputs, pairs, tmp_path, monkeypatch):
    frames, reference, stored, _ = inputs
    archive = Archive(reference)
    with monkeypatch.context() as patch:
        stop_after(patch, 1)
        with pytest.raises(Stopped):
            calibrate(frames, archive, solution=stored, output=tmp_path)
    assert archive.asked == [2, 2]
    run = calibrate(frames, archive, solution=stored, output=tmp_path, resume=True)
    assert run.resumed == tuple(f.name for f in frames[:2])
    # What is done needs no stars.
    assert archive.asked == [2, 2, 2, 2]
    whole = calibrate(frames, reference, solution=stored)
    np.testing.assert_array_equal(run.summary["rms_mas"], whole.summary["rms_mas"])
    again = Archive(reference, "archive 2")
    with pytest.raises(InputError, match="another catalog"):
        calibrate(frames, again, solution=stored, output=tmp_path, resume=True)


def test_an_archive_that_is_lost_ends_the_run_when_what_was_begun_is_done(inputs, pairs, tmp_path):
    frames, reference, stored, _ = inputs

    class Lost(Archive):
        def stars_of(self, region):
            if len(self.asked) == 2:
                raise CatalogError("the archive does not answer")
            return super().stars_of(region)

    with (
        ThreadPoolExecutor(2) as pool,
        pytest.raises(CatalogError, match="does not answer"),
    ):
        calibrate(frames, Lost(reference), solution=stored, output=tmp_path, executor=pool)
    assert len(read_table(tmp_path / "summary.ecsv")) == 4
    run = calibrate(frames, Archive(reference), solution=stored, output=tmp_path, resume=True)
    assert len(run.resumed) == 4
    assert list(run.summary["status"]) == ["solved"] * 6


def test_resume_with_a_file_of_which_a_part_is_read(inputs, tmp_path, monkeypatch):
    frames, reference, *_ = inputs
    monkeypatch.setattr("wpdc_gwcs.catalogs.pieces._LARGE", 0)
    # Half of the stars are elsewhere.
    table = Table.read(reference)
    far = table.copy()
    far["dec"] = -far["dec"]
    path = tmp_path / "all.fits"
    vstack([table, far]).write(path)
    two = [replace(f, detector=d) for f, d in zip(frames[:4], "aabb", strict=True)]
    with monkeypatch.context() as patch:
        stop_after(patch, 1)
        with pytest.raises(Stopped):
            calibrate(two, path, output=tmp_path / "out")
    manifest = read_manifest(tmp_path / "out/manifest.json")
    assert set(manifest.catalog) == {"part_of"}
    run = calibrate(two, path, output=tmp_path / "out", resume=True)
    assert run.resumed == tuple(f.name for f in two[:2])
    whole = calibrate(two, reference)
    for name in ("rms_mas", "n_matched"):
        np.testing.assert_array_equal(run.summary[name], whole.summary[name])
    # The part of other frames is of the same catalog; another file is another one.
    more = [*two, *(replace(f, detector="c") for f in frames[4:])]
    assert len(calibrate(more, path, output=tmp_path / "out", resume=True).resumed) == 4
    os.utime(path, (1, 1))
    with pytest.raises(InputError, match="another catalog"):
        calibrate(two, path, output=tmp_path / "out", resume=True)
