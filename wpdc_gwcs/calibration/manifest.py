"""The manifest of a run: inputs, settings and progress."""

import dataclasses
import hashlib
import json
import re
import sys
from dataclasses import dataclass, field
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path

import numpy as np

from wpdc_gwcs import exceptions
from wpdc_gwcs.calibration.start import sky_of
from wpdc_gwcs.catalogs import identity_of
from wpdc_gwcs.exceptions import FileFormatError, FrameFailure, InternalError

__all__ = ["Manifest", "files_of", "frame_sum", "plan_run", "read_manifest"]

_PACKAGES = ("wpdc_gwcs", "numpy", "scipy", "astropy", "gwcs", "asdf", "photutils", "sep")
# Entries that must be the same to resume a run.
_CHOICES = ("software", "settings", "catalog", "solution", "update")


@dataclass(frozen=True, eq=False)
class Manifest:
    """Description of a run and the state of its frames.

    Parameters
    ----------
    run : str
        Identity of the run, which is in all its files.
    created : str
        Start time, UTC.
    software, settings, catalog, solution, update : dict, str, bool
        Versions, options, checksums of the reference catalog and of the stored solutions, and
        whether these are updated.
    inputs : list of dict
        Path, size and time of each input file.
    frames : dict
        For each frame ``detector``, ``camera``, ``exposure``, ``input`` (checksum of its inputs),
        ``group`` (number of its group, which is solved together), ``state`` (``pending``,
        ``solved``, ``degraded`` or ``failed``) and, once it is done, ``error`` (class of the
        failure) and ``files``.
    """

    run: str
    created: str
    software: dict
    settings: dict
    catalog: dict
    solution: str | None
    update: bool
    inputs: list
    frames: dict = field(repr=False)

    def differences(self, other):
        """List the choices of another run that differ from those of this one.

        Parameters
        ----------
        other : Manifest
            The other run.

        Returns
        -------
        list of str
            Differences such as ``n_grid 50, now 20``.
        """
        found = []
        for name in _CHOICES:
            before, now = getattr(self, name), getattr(other, name)
            if before == now:
                continue
            if isinstance(before, dict) and isinstance(now, dict) and name != "catalog":
                for key in sorted({*before, *now}):
                    if before.get(key) != now.get(key):
                        found.append(f"{key} {before.get(key)}, now {now.get(key)}")
            elif name == "update":
                found.append(f"update {before}, now {now}")
            else:
                found.append(f"another {name}")
        return found

    def is_same(self, other, names):
        """Return whether two runs solve the same frames together.

        Parameters
        ----------
        other : Manifest
            The other run.
        names : set of str
            Names of frames that the other run solves together.

        Returns
        -------
        bool
            True if these are the same frames with the same inputs.  False also for frames that are
            not from files, because they cannot be compared.
        """
        if not all(name in self.frames for name in names):
            return False
        numbers = {self.frames[name]["group"] for name in names}
        together = {n for n, frame in self.frames.items() if frame["group"] in numbers}
        return together == names and all(
            self.frames[n]["input"] is not None
            and self.frames[n]["input"] == other.frames[n]["input"]
            for n in names
        )

    def groups(self):
        """Return the groups of frames that are solved together.

        Returns
        -------
        list of set of str
            Names of the frames of each group.
        """
        found = {}
        for name, frame in self.frames.items():
            found.setdefault(frame["group"], set()).add(name)
        return list(found.values())

    def after(self, earlier, names):
        """Return the manifest of a run that continues an earlier one.

        Parameters
        ----------
        earlier : Manifest
            The earlier run, whose identity is kept.
        names : set of str
            Frames that only the earlier run has; they are kept, and come first.

        Returns
        -------
        Manifest
            Manifest with the frames and inputs of both runs.
        """
        kept = {n: frame for n, frame in earlier.frames.items() if n in names}
        first = 1 + max((frame["group"] for frame in kept.values()), default=-1)
        new = {n: {**frame, "group": frame["group"] + first} for n, frame in self.frames.items()}
        inputs = {one["path"]: one for one in earlier.inputs if kept}
        inputs |= {one["path"]: one for one in self.inputs}
        return dataclasses.replace(
            self,
            run=earlier.run,
            created=earlier.created,
            inputs=list(inputs.values()),
            frames=kept | new,
        )

    def with_states(self, states):
        """Return the manifest with new states of some frames.

        Parameters
        ----------
        states : dict
            Changed entries of frames, by name.

        Returns
        -------
        Manifest
            The new manifest.
        """
        frames = {n: {**frame, **states.get(n, {})} for n, frame in self.frames.items()}
        return dataclasses.replace(self, frames=frames)

    def to_json(self):
        """Return the manifest as JSON.

        Returns
        -------
        str
            JSON, indented by two spaces.
        """
        return json.dumps(dataclasses.asdict(self), indent=2) + "\n"

    def failure_of(self, name, reason):
        """Return the error of a failed frame.

        Parameters
        ----------
        name : str
            Name of the frame.
        reason : str
            Message of the error.

        Returns
        -------
        WPDCError
            Error of the class in the manifest.
        """
        kind = getattr(exceptions, str(self.frames[name].get("error")), FrameFailure)
        return kind(reason)

    def is_done(self, name):
        """Return whether a frame is done, so that another try would give the same result.

        Parameters
        ----------
        name : str
            Name of the frame.

        Returns
        -------
        bool
            False for a frame that is pending, or failed with an internal error.
        """
        frame = self.frames[name]
        return frame["state"] != "pending" and frame.get("error") != InternalError.__name__


def plan_run(run_id, groups, *, settings, catalog, catalog_path, solution, update):
    """Make the manifest of a new run.

    Parameters
    ----------
    run_id : str
        Identity of the run.
    groups : list of list of Frame
        Frames that are solved together.
    settings : Settings
        Settings of the run.
    catalog : `~astropy.table.Table`, GaiaArchive or HatsCatalog
        Reference catalog, or the archive from which its parts are read.
    catalog_path : path-like or None
        File of the catalog, if there is one.
    solution : DistortionSolution, mapping or None
        Stored solutions.
    update : bool
        Whether the stored solutions are updated.

    Returns
    -------
    Manifest
        Manifest in which all frames are pending.
    """
    files = {file: None for group in groups for frame in group for file in files_of(frame)}
    if catalog_path is not None:
        files[Path(re.sub(r"\[[^\[\]]*\]$", "", str(catalog_path)))] = None
    return Manifest(
        run=run_id,
        created=datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ"),
        software={
            **{name: version(name) for name in _PACKAGES},
            "python": ".".join(map(str, sys.version_info[:3])),
        },
        # In the form in which it is read back.
        settings=json.loads(json.dumps(dataclasses.asdict(settings), default=repr)),
        catalog=_sum_of_catalog(catalog),
        solution=None if solution is None else _sum_of_solution(solution),
        update=bool(update),
        inputs=[_state_of(file) for file in files if file.is_file()],
        frames={
            frame.name: {
                "detector": frame.detector,
                "camera": frame.camera,
                "exposure": frame.exposure,
                "input": frame_sum(frame),
                "group": number,
                "state": "pending",
            }
            for number, group in enumerate(groups)
            for frame in group
        },
    )


def read_manifest(path):
    """Read a manifest.

    Parameters
    ----------
    path : path-like
        File with the output of `Manifest.to_json`.

    Returns
    -------
    Manifest
        The manifest.

    Raises
    ------
    FileFormatError
        If the file is not a manifest.
    """
    try:
        manifest = Manifest(**json.loads(Path(path).read_text(encoding="utf-8")))
        for frame in manifest.frames.values():
            if not {"input", "group", "state"} <= set(frame):
                raise ValueError("a frame lacks its state")
    except (OSError, TypeError, ValueError, AttributeError, RecursionError) as problem:
        raise FileFormatError(f"{path}: not a manifest of a run: {problem}") from problem
    return manifest


def frame_sum(frame):
    """Compute a checksum of the input of a frame: size and time of its files, and its header.

    Parameters
    ----------
    frame : Frame
        The frame.

    Returns
    -------
    str or None
        `None` for a frame that is not from a file.
    """
    files = files_of(frame)
    if not files or not all(file.is_file() for file in files):
        return None
    ny, nx = frame.image_shape
    x, y = np.meshgrid(np.linspace(0, nx - 1, 3), np.linspace(0, ny - 1, 3))
    plain = {
        f.name: getattr(frame, f.name)
        for f in dataclasses.fields(frame)
        if f.name != "wcs" and not callable(getattr(frame, f.name))
    }
    states = [[state["size"], state["modified"]] for state in map(_state_of, files)]
    text = json.dumps([plain, states], sort_keys=True, default=repr)
    try:
        sky = np.array(sky_of(frame.wcs, x.ravel(), y.ravel()))
    except Exception:  # noqa: BLE001  A WCS that cannot be used makes its frame fail later.
        return None
    return hashlib.sha256(text.encode("utf-8", "surrogatepass") + sky.tobytes()).hexdigest()


def files_of(frame):
    """Return the files of a frame: that of its source, and those of mask and weight.

    Parameters
    ----------
    frame : Frame
        The frame.

    Returns
    -------
    list of Path
        Paths; empty for a frame that is not from a file.
    """
    if not frame.source:
        return []
    path = Path(frame.source)
    path = path if path.exists() else Path(re.sub(r"\[[^\[\]]*\]$", "", frame.source))
    return [path, *map(Path, frame.inputs)]


def _state_of(file):
    stat = file.stat()
    return {
        "path": str(file).encode("utf-8", "backslashreplace").decode(),
        "size": stat.st_size,
        "modified": datetime.fromtimestamp(stat.st_mtime_ns / 1e9, UTC).isoformat(),
    }


def _sum_of_catalog(catalog):
    """Identify a catalog; a part, which depends on the frames, by the whole it comes from."""
    identity = getattr(catalog, "identity", None) or identity_of(catalog)
    if identity is not None:
        return {"part_of": identity}
    return {"rows": len(catalog), "sum": _sum_of_table(catalog)}


def _sum_of_table(table):
    digest = hashlib.sha256()
    for name in sorted(table.colnames):
        values = np.ascontiguousarray(table[name])
        digest.update(f"{name} {values.dtype.str} {values.shape}".encode())
        digest.update(values.tobytes())
    return digest.hexdigest()


def _sum_of_solution(solution):
    from wpdc_gwcs.io.asdf import sum_of

    stored = solution if hasattr(solution, "items") else {solution.detector: solution}
    text = "".join(f"{name} {sum_of(one)}\n" for name, one in sorted(stored.items()))
    return hashlib.sha256(text.encode("utf-8", "surrogatepass")).hexdigest()
