"""`wpdc reproduce`: the tables and figures of the paper."""

from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from wpdc_gwcs.cli.app import app
from wpdc_gwcs.cli.options import Overwrite, Quiet, Verbose, require_plotting
from wpdc_gwcs.cli.progress import progress_bar
from wpdc_gwcs.exceptions import InputError


@app.command(
    "reproduce", no_args_is_help=True, epilog="Example: wpdc reproduce all --output paper --quick"
)
def reproduce_command(
    part: Annotated[
        str,
        typer.Argument(
            metavar="PART",
            help="detectors, cluster, bass, weights or centroids; all for all of them.",
        ),
    ],
    output: Annotated[
        Path, typer.Option("--output", metavar="DIR", help="Folder to write to; created if needed.")
    ],
    quick: Annotated[
        bool,
        typer.Option(
            "--quick", help="Small detectors and few fields: minutes instead of about an hour."
        ),
    ] = False,
    jobs: Annotated[int, typer.Option(metavar="N", help="Number of processes.")] = 1,
    # SEED of the reproduction, which is imported only when needed.
    seed: Annotated[
        int, typer.Option(metavar="N", help="Another seed gives another camera.")
    ] = 9193,
    overwrite: Overwrite = False,
    verbose: Verbose = 0,
    quiet: Quiet = False,
):
    """Reproduce the tables and figures of the paper.

    Both the literal and the default method are used.  Writes a folder for each part, and
    results.ecsv with the numbers of the paper, of its exact method, and of the default method.
    """
    from wpdc_gwcs.reproduction import FULL, PARTS, QUICK, reproduce

    require_plotting("the reproduction")
    if part not in (*PARTS, "all"):
        raise InputError(f"PART must be one of {', '.join(PARTS)} or all, got {part!r}")
    if jobs < 1:
        raise InputError(f"--jobs must be at least 1, got {jobs}")
    if seed < 0:
        raise InputError(f"--seed must be 0 or more, got {seed}")
    with progress_bar(quiet=quiet) as progress:
        results = reproduce(
            tuple(PARTS) if part == "all" else (part,),
            output,
            scale=QUICK if quick else FULL,
            seed=seed,
            jobs=jobs,
            overwrite=overwrite,
            progress=progress,
        )
    if quiet:
        return
    known = results[np.isfinite(results["paper"])]
    for name in ("paper", "literal", "ours"):
        known[name].info.format = ".3f"
    for line in known.pformat(max_lines=-1, max_width=-1):
        typer.echo(line)
    typer.echo(f"{len(results)} numbers in {output / 'results.ecsv'}, figures beside it")
