"""The result folder of a run: checked names, and complete sets of files."""

import itertools
import json
import os
import shutil
import stat
import tempfile
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

from astropy.table import Table

from wpdc_gwcs.calibration.journal import find_journals, read_journal, write_entry
from wpdc_gwcs.calibration.manifest import files_of, read_manifest
from wpdc_gwcs.calibration.names import check_distinct, file_stem, names_of, superseded_name
from wpdc_gwcs.calibration.staging import (
    FRAME_SUFFIXES,
    MANIFEST,
    REMOVED,
    SUMMARY,
    clean,
    lock,
    put_in_place,
)
from wpdc_gwcs.calibration.summary import summarize
from wpdc_gwcs.exceptions import InputError
from wpdc_gwcs.threads import one_blas_thread

__all__ = ["ERRORS", "Outcome", "ResultFolder", "with_files"]

#: File with the details of internal errors.
ERRORS = "errors.log"
# The manifest and the summary are rewritten whenever they have grown by this fraction: ten times
# while they grow by a factor of 2.6, however large they are.
_SHARE = 0.1
# More detectors than any camera has.
_ALL = 1 << 30


@dataclass(frozen=True, eq=False)
class Outcome:
    """Results of frames that are solved together.

    Parameters
    ----------
    calibrations : list of Calibration
        Calibrations of the solved frames.
    solutions, superseded : dict
        Solution of each detector, and the stored one that no longer holds.
    failures : dict
        Errors by frame name.
    cameras : list of Camera
        Cameras of the detectors that were solved together.
    rows : list of dict
        Rows of the summary, one for each frame.
    n_fields : int
        How many frames have a field of their own.
    files : dict
        Bytes by file name, by frame name, of the frames whose files a worker has made.
    """

    calibrations: list = field(default_factory=list)
    solutions: dict = field(default_factory=dict)
    superseded: dict = field(default_factory=dict)
    failures: dict = field(default_factory=dict)
    cameras: list = field(default_factory=list)
    rows: list = field(default_factory=list)
    n_fields: int = 0
    files: dict = field(default_factory=dict)


class ResultFolder:
    """Files of one run; a context manager, within which no other run writes into the folder.

    Parameters
    ----------
    folder : path-like
        The folder; made if needed.
    overwrite : bool, optional
        Whether files may be replaced.
    resume : bool, optional
        Whether to keep the results of a run with the same inputs and settings.

    Raises
    ------
    InputError
        If the folder cannot be written to, or another run is writing into it.
    """

    def __init__(self, folder, *, overwrite=False, resume=False):
        self.folder = Path(folder)
        self._overwrite = overwrite
        self._resume = resume
        self._manifest = None
        self._done = set()  # frames that the resumed run has done
        self._mine = set()  # files that may be replaced
        self._rows = {}
        self._n_written = 0  # rows of the summary that is there
        self._shared = {}  # files of several frames that are there, and of how many detectors
        self._names = {}  # first frame of a group to the files that the group may write
        self._inputs = set()
        self._loaded = {}  # results of detectors and cameras that have been read
        self._lock = None

    def __enter__(self):
        from wpdc_gwcs.io.files import make_folder

        make_folder(self.folder)
        try:
            with tempfile.TemporaryFile(dir=self.folder):
                pass
        except OSError as err:
            raise InputError(
                f"{self.folder}: the output folder must be writable: {err.strerror or err}"
            ) from err
        self._lock = lock(self.folder)
        try:
            self._tidy()
        except BaseException:
            self._release()
            raise
        return self

    def __exit__(self, kind, error, traceback):
        if isinstance(error, KeyboardInterrupt):
            # For the message of the command that is interrupted.
            error.has_results = bool(self._rows)
        try:
            self._tidy()
        finally:
            self._release()

    def _tidy(self):
        """Complete interrupted writes, and merge the journals into manifest and summary."""
        clean(self.folder)
        for run, journal in find_journals(self.folder).items():
            path = self.folder / MANIFEST
            manifest = read_manifest(path) if path.exists() else None
            if manifest is not None and manifest.run == run:
                states, new = read_journal(journal)
                rows = _read_rows(self.folder / SUMMARY, run) | new
                _write_state(self.folder, manifest.with_states(states), rows)
            journal.unlink()

    def _release(self):
        if self._lock is not None:
            os.close(self._lock)

    def earlier_groups(self):
        """Return the groups of frames that the run to resume has solved together.

        Returns
        -------
        list of set of str
            Their names; empty without such a run.

        Raises
        ------
        FileFormatError
            If its manifest is damaged.
        """
        path = self.folder / MANIFEST
        return read_manifest(path).groups() if self._resume and path.exists() else []

    def check(self, groups, *, inputs=()):
        """Check all file names before the work.

        Parameters
        ----------
        groups : list of list of Frame
            Frames that are solved together.
        inputs : list of Path, optional
            Other input files that must not be replaced.

        Raises
        ------
        InputError
            If two results have the same file, if a file exists and may not be replaced, or if an
            input would be replaced.
        """
        cameras = {}
        for group in groups:
            self._names[group[0].name] = names_of(group, cameras)
        check_distinct(self._names.values())
        frames = [frame for group in groups for frame in group]
        files = [*inputs, *(file for frame in frames for file in files_of(frame))]
        self._inputs = {os.path.realpath(file) for file in files}
        if not self._resume:
            self._check_free(groups)

    def _check_free(self, groups):
        names = [n for g in groups if not self.is_done(g) for n in self._names[g[0].name]]
        for name in [*names, SUMMARY, MANIFEST]:
            self._require_free(name)

    def begin(self, groups, plan):
        """Begin or resume a run.

        Parameters
        ----------
        groups : list of list of Frame
            Frames that are solved together.
        plan : Manifest
            The run.

        Returns
        -------
        Manifest
            The run, with the identity of the resumed one.

        Raises
        ------
        InputError
            If the run to resume has other settings, or if a file of its remaining frames exists
            and may not be replaced.
        """
        self._manifest = plan
        if self._resume:
            if (self.folder / MANIFEST).exists():
                self._continue(read_manifest(self.folder / MANIFEST), groups)
            self._check_free(groups)
        return self._manifest

    def _require_free(self, name):
        """Raise an error if a file of the folder exists and may not be replaced."""
        path = self.folder / name
        try:
            mode = path.stat().st_mode
        except FileNotFoundError:
            return
        except (OSError, ValueError) as err:
            reason = getattr(err, "strerror", None) or err
            raise InputError(f"{path}: cannot be written: {reason}") from err
        if not stat.S_ISREG(mode):
            what = "a folder" if stat.S_ISDIR(mode) else "no file"
            raise InputError(f"{path}: is {what}, and a file of this name would be written")
        if os.path.realpath(path) in self._inputs:
            raise InputError(f"{path}: is an input, and a file of this name would be written")
        if not (self._overwrite or name in self._mine):
            raise InputError(f"{path}: file exists, and is replaced only with --overwrite")

    def _continue(self, earlier, groups):
        """Take over the results of an earlier run with the same settings."""
        plan = self._manifest
        found = earlier.differences(plan)
        if found and self._overwrite:
            return
        if found:
            raise InputError(
                f"{self.folder}: a run must be resumed with the same choices: {'; '.join(found)}; "
                "to start over: --overwrite"
            )
        rows = _read_rows(self.folder / SUMMARY, earlier.run)
        states = {}
        for group in groups:
            members = {frame.name for frame in group}
            if not earlier.is_same(plan, members):
                continue
            self._mine |= set(self._names[group[0].name])
            written = {name for n in members for name in earlier.frames[n].get("files", ())}
            if all(earlier.is_done(n) and n in rows for n in members) and all(
                (self.folder / name).is_file() for name in written
            ):
                self._done |= members
                states |= {n: earlier.frames[n] for n in members}
                self._rows |= {n: rows[n] for n in members}
        self._mine |= {SUMMARY, MANIFEST}
        others = self._others(earlier, groups, rows)
        self._rows = {name: rows[name] for name in others} | self._rows
        self._manifest = plan.after(earlier, others).with_states(
            {
                n: {key: state[key] for key in ("state", "error", "files")}
                for n, state in states.items()
            }
        )
        files = {name for n in {*others, *states} for name in earlier.frames[n]["files"]}
        self._shared = {n: _ALL for n in files if not n.endswith(FRAME_SUFFIXES)}
        if earlier.solution is not None and not earlier.update:
            # The same for all files of its detector.
            self._mine |= set(self._shared)

    def _others(self, earlier, groups, rows):
        """Frames of an earlier run that are not given now and are kept."""
        given = {frame.name for group in groups for frame in group}
        written = {name for g in groups if not self.is_done(g) for name in self._names[g[0].name]}
        if earlier.solution is not None and not earlier.update:
            written = {name for name in written if name.endswith(FRAME_SUFFIXES)}
        others = set()
        for names in earlier.groups():
            files = {name for n in names for name in earlier.frames[n].get("files") or ()}
            if (
                names.isdisjoint(given)
                and files.isdisjoint(written)
                and all(earlier.is_done(n) and n in rows for n in names)
            ):
                others |= names
        return others

    def is_done(self, group):
        """Return whether the resumed run has done these frames.

        Parameters
        ----------
        group : list of Frame
            Frames that are solved together.

        Returns
        -------
        bool
            True if `load` can read their results.
        """
        return group[0].name in self._done

    def load(self, group, *, keep=True):
        """Read the results of finished frames.

        Parameters
        ----------
        group : list of Frame
            Frames for which `is_done` is true.
        keep : bool, optional
            Whether to return calibrations, or only to check that their files are complete.

        Returns
        -------
        Outcome
            Outcome as written.

        Raises
        ------
        InputError
            If a file is damaged, or of another run.
        """
        run, states = self._manifest.run, self._manifest.frames
        outcome = Outcome(rows=[self._rows[frame.name] for frame in group])
        for row in outcome.rows:
            if row["status"] == "failed":
                error = self._manifest.failure_of(row["frame"], row["reason"])
                outcome.failures[row["frame"]] = error
        for name in dict.fromkeys(n for frame in group for n in states[frame.name]["files"]):
            path = self.folder / name
            if name.endswith(".wcs.asdf"):
                stem = name.removesuffix(".wcs.asdf")
                tables = {
                    kind: self.folder / f"{stem}.{kind}.ecsv"
                    for kind in ("sources", "matches")
                    if f"{stem}.{kind}.ecsv" in states[stem]["files"]
                }
                if keep or not all(_looks_complete(p, run) for p in (path, *tables.values())):
                    calibration = _read_frame(path, tables, run)
                    outcome.calibrations.extend([calibration] if keep else [])
            elif name.endswith(".solution.asdf"):
                found = self._read_shared(name)
                current = name == f"{file_stem(found.detector)}.solution.asdf"
                kind = outcome.solutions if current else outcome.superseded
                kind[found.detector] = found
            elif name.endswith(".camera.asdf"):
                outcome.cameras.append(self._read_shared(name))
        return outcome

    def _read_shared(self, name):
        """Read a file of a detector or a camera, which the frames of many groups share."""
        from wpdc_gwcs.io import read

        if name not in self._loaded:
            self._loaded[name] = read(self.folder / name)
        return self._loaded[name]

    def write(self, group, outcome, workers):
        """Write the outcome of some frames completely or not at all.

        Parameters
        ----------
        group : list of Frame
            The frames.
        outcome : Outcome
            Their results.
        workers : Workers
            Workers for the files of the frames.

        Raises
        ------
        InputError
            If a file cannot be written, or has appeared in the meantime.
        """
        part = self.folder / f".{self._manifest.run}.part"
        try:
            # Remains of an earlier group that could not be written.
            shutil.rmtree(part, ignore_errors=True)
            part.mkdir()
            files, shared = self._write_into(part, group, outcome, workers)
            states = {
                row["frame"]: {
                    "state": row["status"],
                    "error": type(outcome.failures[row["frame"]]).__name__
                    if row["frame"] in outcome.failures
                    else None,
                    "files": [*files[row["frame"]], *shared],
                }
                for row in outcome.rows
            }
            new = {row["frame"]: row for row in outcome.rows}
            rows = self._rows | new
            manifest = self._manifest.with_states(states)
            n_written = self._n_written
            if len(rows) - n_written > _SHARE * n_written:
                _write_state(part, manifest, rows)
                n_written = len(rows)
            else:
                write_entry(part, states, new)
            for path in part.iterdir():
                if path.name != REMOVED:
                    self._require_free(path.name)
            part.rename(part.with_suffix(".done"))
        except InputError as err:
            # Do not name the hidden folder, which is removed.
            raise InputError(str(err).replace(str(part), str(self.folder))) from err
        except OSError as err:
            raise InputError(f"{self.folder}: cannot be written to: {err.strerror or err}") from err
        self._manifest, self._rows, self._n_written = manifest, rows, n_written
        self._mine |= {path.name for path in part.with_suffix(".done").iterdir()}
        put_in_place(part.with_suffix(".done"), self.folder)

    def _write_into(self, part, group, outcome, workers):
        """Write results into a folder: files of each frame, and shared files."""
        from wpdc_gwcs.io import atomic_path, write

        run = self._manifest.run
        files = {frame.name: [] for frame in group}
        written = workers.map(partial(_write_frame, part, run), outcome.calibrations)
        for calibration, names in zip(outcome.calibrations, written, strict=True):
            files[calibration.frame] = names
        for frame, made in outcome.files.items():
            for name, content in made.items():
                with atomic_path(part / name) as temporary:
                    temporary.write_bytes(content)
            files[frame] = list(made)
        # Shared files; with a stored solution they are the same in all batches.
        shared = {f"{file_stem(s.detector)}.solution.asdf": s for s in outcome.solutions.values()}
        shared |= {superseded_name(s): s for s in outcome.superseded.values()}
        camera_name = next(
            (name for name in self._names[group[0].name] if name.endswith(".camera.asdf")), None
        )
        for k, camera in enumerate(outcome.cameras):
            of = {d: f"{file_stem(d)}.solution.asdf" for d in camera.detectors}
            name = camera_name if k == 0 else f"{file_stem(group[0].name)}-{k + 1}.camera.asdf"
            shared[name] = replace(camera, files=of)
        for name, one in shared.items():
            n_detectors = len(getattr(one, "detectors", (one,)))
            if n_detectors > self._shared.get(name, 0):
                write(_of_run(one, run), part / name)
                self._shared[name] = n_detectors
        # Files of an earlier run for a frame that now fails, or has no sources, would seem to be
        # from this run.
        removed = [
            frame.name + suffix
            for frame in group
            for suffix in FRAME_SUFFIXES
            if frame.name + suffix not in files[frame.name]
        ]
        (part / REMOVED).write_text(json.dumps(removed), encoding="utf-8")
        return files, list(shared)

    def log(self, name, error):
        """Append the details of an internal error to a file.

        Parameters
        ----------
        name : str
            Name of the frame.
        error : InternalError
            The error with its details.

        Returns
        -------
        Path
            The file.
        """
        path = self.folder / ERRORS
        with path.open("a", encoding="utf-8", errors="backslashreplace") as file:
            file.write(f"{self._manifest.run} {name}: {error}\n{error.details}\n")
        return path


def with_files(outcome, run):
    """Make the files of frames, for a process that has no tables to make them from.

    Parameters
    ----------
    outcome : Outcome
        Results of the frames.
    run : str
        Identity of the run.

    Returns
    -------
    Outcome
        The same with the bytes of the files in place of the calibrations.
    """
    files = {}
    with tempfile.TemporaryDirectory(prefix="wpdc-") as folder:
        for calibration in outcome.calibrations:
            paths = [Path(folder) / name for name in _write_frame(Path(folder), run, calibration)]
            files[calibration.frame] = {path.name: path.read_bytes() for path in paths}
            # The folder needs no more room than a frame.
            for path in paths:
                path.unlink()
    return replace(outcome, calibrations=[], files=files)


def _looks_complete(path, run):
    """Whether a file is of a run and has its end, without the time that reading it takes."""
    data = path.read_bytes()
    if path.suffix == ".asdf":
        text, _, blocks = data.partition(b"\n...\n")
        return f"run: {run}".encode() in text and b"#ASDF BLOCK INDEX" in blocks
    # The metadata of a table are comments before its rows.
    comments = itertools.takewhile(lambda line: line.startswith(b"#"), data.splitlines())
    return any(f"run: {run}".encode() in line for line in comments) and data.endswith(b"\n")


def _read_frame(path, tables, run):
    """Read the WCS and the tables of a frame; raise an error if one is of another run."""
    from wpdc_gwcs.io import read, read_table

    found = read(path)
    tables = {kind: read_table(table) for kind, table in tables.items()}
    runs = [found.provenance.get("run"), *(table.meta.get("run") for table in tables.values())]
    if any(one != run for one in runs):
        raise InputError(f"{path}: must come from the same run as its tables ({run}), does not")
    return replace(found, **tables)


@one_blas_thread
def _write_frame(folder, run, calibration):
    """Write the tables and the WCS of a frame; returns the names of the files."""
    from wpdc_gwcs.io import write, write_table

    names = []
    for kind in ("sources", "matches"):
        table = getattr(calibration, kind)
        if table is not None:
            names.append(f"{calibration.frame}.{kind}.ecsv")
            # The folder is new: what is there is of a process that has died.
            write_table(_of_run(table, run), folder / names[-1], overwrite=True)
    names.append(f"{calibration.frame}.wcs.asdf")
    write(_of_run(calibration, run), folder / names[-1], overwrite=True)
    return names


def _of_run(result, run):
    """Add the identity of the run to a result or table."""
    if isinstance(result, Table):
        marked = result.copy(copy_data=False)
        marked.meta["run"] = run
        return marked
    return replace(result, provenance={**result.provenance, "run": run})


def _write_state(folder, manifest, rows):
    """Write the summary and the manifest, each atomically."""
    from wpdc_gwcs.io import atomic_path, write_table

    done = [rows[name] for name in manifest.frames if name in rows]
    write_table(summarize(done, manifest.run), folder / SUMMARY, overwrite=True)
    with atomic_path(folder / MANIFEST, overwrite=True) as temporary:
        temporary.write_text(manifest.to_json(), encoding="utf-8")


def _read_rows(path, run):
    """Rows of the summary by frame; none if it is from another run."""
    from wpdc_gwcs.io import read_table

    if not path.exists():
        return {}
    table = read_table(path)
    if table.meta.get("run") != run:
        return {}
    rows = [dict(zip(table.colnames, row.as_void().tolist(), strict=True)) for row in table]
    return {row["frame"]: row for row in rows}
