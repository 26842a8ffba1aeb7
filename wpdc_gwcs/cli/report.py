"""`wpdc report`: one page about a run."""

from pathlib import Path
from typing import Annotated

import typer

from wpdc_gwcs.cli.app import app
from wpdc_gwcs.cli.options import Overwrite, Quiet, require_free, require_plotting


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
    """Write one self-contained HTML page about a result folder: summary, tables, residuals."""
    from wpdc_gwcs.io import read, read_matches, read_table

    require_plotting("the report")
    output = folder / "report.html" if output is None else output
    require_free(output, overwrite)
    summary = read_table(folder / "summary.ecsv")
    tables = {
        name: read_matches(folder / f"{name}.matches.ecsv")
        for name in summary["frame"][summary["status"] == "solved"]
    }
    found = [read(path) for path in sorted(folder.glob("*.solution.asdf"))]
    # What an update has superseded lies beside what is valid now.
    found.sort(key=lambda solution: solution.valid_to is None)
    write_page(summary, {s.detector: s for s in found}, tables, output, overwrite=overwrite)
    if not quiet:
        typer.echo(f"{output}: report of {len(summary)} frames")


def write_page(summary, solutions, matches, path, *, overwrite):
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
    """
    from wpdc_gwcs.io import atomic_path
    from wpdc_gwcs.report import write_report

    with (
        atomic_path(path, overwrite=overwrite) as temporary,
        temporary.open("w", encoding="utf-8") as file,
    ):
        write_report(summary, solutions, matches, file)
