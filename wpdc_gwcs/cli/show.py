"""`wpdc show` and `wpdc explain`: the contents of a file, and the reasons of a result."""

from pathlib import Path
from typing import Annotated

import typer

from wpdc_gwcs.cli.app import app
from wpdc_gwcs.cli.calibrate import Catalog, WcsFile
from wpdc_gwcs.cli.contents import contents_of
from wpdc_gwcs.cli.options import (
    Blind,
    Cache,
    Epoch,
    MaxMag,
    MaxRoundness,
    MinSNR,
    Origin,
    Overwrite,
    PixelScale,
    Saturation,
    TapUrl,
    Threshold,
    Verbose,
    by_hand,
    require_free,
    require_plotting,
    settings_of,
)
from wpdc_gwcs.cli.stages import one_frame
from wpdc_gwcs.description import as_text
from wpdc_gwcs.exceptions import InputError

Picture = Annotated[
    Path | None,
    typer.Option("--output", metavar="FILE", help="Also draw a picture: .png, .pdf or .svg."),
]


@app.command(
    "show",
    no_args_is_help=True,
    epilog="Example: wpdc show results/image.wcs.asdf --output look.png",
)
def show_command(
    file: Annotated[
        str,
        typer.Argument(
            metavar="FILE", help="A result, a folder of results, a frame, a table or a catalog."
        ),
    ],
    output: Picture = None,
    overwrite: Overwrite = False,
    verbose: Verbose = 0,
):
    """Describe the contents of a file, in words and in one picture."""
    _check_picture(output, overwrite)
    found = contents_of(file)
    for line in as_text(found.lines):
        typer.echo(line)
    if output is None:
        return
    if found.draw is None:
        raise InputError(f"{file}: there is no picture of such a file, only words")
    _save(found.draw(), output, overwrite=overwrite)


@app.command(
    "explain",
    no_args_is_help=True,
    epilog="Example: wpdc explain image.fits --catalog gaia.fits --output why.png",
)
def explain_command(
    frame: Annotated[
        str,
        typer.Argument(metavar="FRAME", help="FITS image, FITS_LDAC list, or table with --wcs."),
    ],
    catalog: Catalog,
    output: Picture = None,
    wcs: WcsFile = None,
    epoch: Epoch = None,
    pixel_scale: PixelScale = None,
    origin: Origin = None,
    threshold: Threshold = 5.0,
    min_snr: MinSNR = 10.0,
    max_roundness: MaxRoundness = 0.3,
    max_mag: MaxMag = None,
    saturation: Saturation = None,
    blind: Blind = False,
    tap_url: TapUrl = None,
    cache: Cache = None,
    overwrite: Overwrite = False,
    verbose: Verbose = 0,
):
    """Explain the result of a frame, stage by stage, and what to try.

    This tells why a frame is solved, degraded or refused.  The frame is solved by itself, without
    others of its camera.  The exit status is 1 if it fails.
    """
    from wpdc_gwcs.catalogs import catalog_source
    from wpdc_gwcs.explanation import explain_frame
    from wpdc_gwcs.pictures import draw_explanation

    _check_picture(output, overwrite)
    settings = settings_of(
        threshold=threshold,
        min_snr=min_snr,
        max_roundness=max_roundness,
        max_mag=max_mag,
        saturation=saturation,
        blind=blind,
    )
    one = one_frame(frame, wcs=wcs, **by_hand(epoch, pixel_scale, origin))
    source = catalog_source(catalog, url=tap_url, cache=cache, max_mag=max_mag)
    told = explain_frame(one, source, settings)
    for stage in told.stages:
        mark = "ok" if stage.went_well else "!!"
        for k, line in enumerate(stage.lines):
            typer.echo(f"{stage.name if k == 0 else '':<10}{mark if k == 0 else '':<4}{line}")
    typer.echo(f"\n{told.frame.name}: {told.status}")
    for advice in told.advice:
        typer.echo(f"try: {advice}")
    if output is not None:
        _save(draw_explanation(told), output, overwrite=overwrite)
    if told.status == "failed":
        raise typer.Exit(1)


def _check_picture(output, overwrite):
    if output is None:
        return
    if output.suffix.lower() not in (".png", ".pdf", ".svg"):
        raise InputError(f"{output}: a picture must end with .png, .pdf or .svg")
    require_plotting("a picture")
    require_free(output, overwrite)


def _save(figure, path, *, overwrite):
    from wpdc_gwcs.io import atomic_path

    with atomic_path(path, overwrite=overwrite) as temporary:
        figure.savefig(temporary, dpi=120, format=path.suffix[1:].lower())
    typer.echo(*as_text([("picture", str(path))]))
