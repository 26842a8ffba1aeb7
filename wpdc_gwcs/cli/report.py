"""`wpdc report`: a page about a run."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import typer

from wpdc_gwcs.cli.app import app
from wpdc_gwcs.cli.options import Overwrite, Quiet, require_free, require_plotting
from wpdc_gwcs.counts import counted
from wpdc_gwcs.exceptions import FileFormatError


@app.command("report", no_args_is_help=True, epilog="Example: wpdc report results")
def report_command(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Output folder of wpdc calibrate.")],
    output: Annotated[
        Path | None,
        typer.Option("--output", metavar="FILE", help="Page to write; default: DIR/report.html."),
    ] = None,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
):
    """Write one self-contained HTML page about a result folder.

    The page has the detectors, pooled over their frames, then each frame, and the settings.
    """
    require_plotting("the report")
    output = folder / "report.html" if output is None else output
    require_free(output, overwrite)
    n_frames = write_page(folder, output, overwrite=overwrite)
    if not quiet:
        typer.echo(f"{output}: report of {counted(n_frames, 'frame')}")


class _Matches(Mapping):
    """Match tables of the frames of a folder, each read on access."""

    def __init__(self, folder, names):
        self._folder, self._names = folder, dict.fromkeys(map(str, names))

    def __getitem__(self, name):
        from wpdc_gwcs.io import read_matches

        if name not in self._names:
            raise KeyError(name)
        return read_matches(self._folder / f"{name}.matches.ecsv")

    def __contains__(self, name):
        return name in self._names

    def __iter__(self):
        return iter(self._names)

    def __len__(self):
        return len(self._names)


def write_page(folder, path, *, overwrite):
    """Write the report of a result folder, atomically.

    Parameters
    ----------
    folder : Path
        Result folder.
    path : Path
        File to write.
    overwrite : bool
        Whether an existing file may be replaced.

    Returns
    -------
    int
        Number of frames.
    """
    from wpdc_gwcs.io import atomic_path, read, read_table
    from wpdc_gwcs.report import write_report

    summary = read_table(folder / "summary.ecsv")
    for column in ("frame", "detector", "status"):
        if column not in summary.colnames:
            raise FileFormatError(f"{folder / 'summary.ecsv'}: must have a column {column!r}")
    matches = _Matches(folder, summary["frame"][summary["status"] != "failed"])
    found = [read(path) for path in sorted(folder.glob("*.solution.asdf"))]
    # Superseded solutions of an update lie next to the valid ones.
    found.sort(key=lambda solution: solution.valid_to is None)
    solutions = {s.detector: s for s in found}
    with (
        atomic_path(path, overwrite=overwrite) as temporary,
        temporary.open("w", encoding="utf-8") as file,
    ):
        write_report(summary, solutions, matches, file, about=about_run(folder))
    return len(summary)


def about_run(folder):
    """Describe the run of a folder.

    Parameters
    ----------
    folder : Path
        Result folder, perhaps with a manifest.

    Returns
    -------
    dict or None
        Names and values by heading; `None` without a manifest.
    """
    from wpdc_gwcs.calibration.manifest import read_manifest

    path = folder / "manifest.json"
    if not path.exists():
        return None
    plan = read_manifest(path)
    run = {"run": plan.run, "began": plan.created, "input files": len(plan.inputs)}
    return {"settings": plan.settings, "run": run, "software": plan.software}
