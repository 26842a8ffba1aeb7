"""`wpdc report`: one page about a run."""

from pathlib import Path
from typing import Annotated

import typer

from wpdc_gwcs.cli.app import app
from wpdc_gwcs.cli.options import Overwrite, Quiet, require_free, require_plotting
from wpdc_gwcs.exceptions import FileFormatError


@app.command("report", no_args_is_help=True)
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

    Detectors come first, pooled over their frames, then the frames, folded, and the settings.
    """
    from wpdc_gwcs.io import read, read_matches, read_table

    require_plotting("the report")
    output = folder / "report.html" if output is None else output
    require_free(output, overwrite)
    summary = read_table(folder / "summary.ecsv")
    for column in ("frame", "detector", "status"):
        if column not in summary.colnames:
            raise FileFormatError(f"{folder / 'summary.ecsv'}: must have a column {column!r}")
    tables = {
        name: read_matches(folder / f"{name}.matches.ecsv")
        for name in summary["frame"][summary["status"] != "failed"]
    }
    found = [read(path) for path in sorted(folder.glob("*.solution.asdf"))]
    # What an update has superseded lies beside what is valid now.
    found.sort(key=lambda solution: solution.valid_to is None)
    write_page(
        summary, {s.detector: s for s in found}, tables, output, overwrite=overwrite, folder=folder
    )
    if not quiet:
        typer.echo(f"{output}: report of {len(summary)} frames")


def write_page(summary, solutions, matches, path, *, overwrite, folder=None):
    """Write the report, whole or not at all.

    Parameters
    ----------
    summary : `~astropy.table.Table`
        One row per frame.
    solutions : dict
        Detector name to solution.
    matches : dict
        Frame name to match table.
    path : Path
        File to write.
    overwrite : bool
        Whether it may be replaced.
    folder : Path, optional
        Result folder, if it is not that of the page.
    """
    from wpdc_gwcs.io import atomic_path
    from wpdc_gwcs.report import write_report

    about = about_run(path.parent if folder is None else folder)

    with (
        atomic_path(path, overwrite=overwrite) as temporary,
        temporary.open("w", encoding="utf-8") as file,
    ):
        write_report(summary, solutions, matches, file, about=about)


def about_run(folder):
    """Tell what the run in a folder was.

    Parameters
    ----------
    folder : Path
        With its manifest, if there is one.

    Returns
    -------
    dict or None
        Headings to names and values.
    """
    from wpdc_gwcs.calibration.manifest import read_manifest

    path = folder / "manifest.json"
    if not path.exists():
        return None
    plan = read_manifest(path)
    run = {"run": plan.run, "began": plan.created, "input files": len(plan.inputs)}
    return {"settings": plan.settings, "run": run, "software": plan.software}
