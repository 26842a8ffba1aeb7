"""`wpdc show` and `wpdc explain`: the contents of a file, and the reasons of a result."""

import warnings
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from wpdc_gwcs.cli.app import app
from wpdc_gwcs.cli.calibrate import Catalog, WcsFile
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
from wpdc_gwcs.counts import counted
from wpdc_gwcs.exceptions import FileFormatError, FrameError, InputError

Picture = Annotated[
    Path | None,
    typer.Option("--output", metavar="FILE", help="Also draw a picture: .png, .pdf or .svg."),
]
# Width of the names at the beginning of lines.
_LABEL = 11
# Maximum number of rows shown; the rest is counted.
_MOST_ROWS = 20


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
    lines, draw = _told(file)
    for label, text in lines:
        typer.echo(f"{label:<{_LABEL}} {text}")
    if output is not None:
        _save(draw(), output, overwrite=overwrite)


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
    typer.echo(f"{'picture':<{_LABEL}} {path}")


def _told(file):
    """Lines about a file, and a function that draws its picture."""
    from wpdc_gwcs.catalogs import split_extension
    from wpdc_gwcs.io.files import file_kind

    path, _ = split_extension(file)
    if path.is_dir():
        return _of_folder(path)
    kind = file_kind(path)
    if kind == "asdf":
        return _of_result(file)
    if kind == "text":
        table = _table_or_none(path)
        if table is not None:
            return _of_table(path, table)
        return _of_result(file)
    return _of_fits(file)


def _of_result(file):
    from wpdc_gwcs.description import describe
    from wpdc_gwcs.io import read
    from wpdc_gwcs.pictures import draw_solution

    found = read(file)
    if hasattr(found, "solutions"):
        solution, sigma = found.solutions[found.reference], None
    else:
        solution, sigma = getattr(found, "solution", found), getattr(found, "sigma", None)
    return describe(found), lambda: draw_solution(solution, sigma)


def _of_folder(path):
    from wpdc_gwcs.io import read_table

    if not (path / "summary.ecsv").is_file():
        raise InputError(f"{path}: must be a folder of results, has no summary.ecsv")
    lines, draw = _of_table(path, read_table(path / "summary.ecsv"))
    for kind, ending in (("WCS", "wcs"), ("solutions", "solution"), ("cameras", "camera")):
        names = sorted(found.name for found in path.glob(f"*.{ending}.asdf"))
        if names:
            more = f", ... ({len(names)} files)" if len(names) > 3 else ""
            lines.append((kind, ", ".join(names[:3]) + more))
    return lines, draw


def _of_table(path, table):
    """Lines about a table: a summary, matches, sources, or a catalog."""
    from wpdc_gwcs import pictures
    from wpdc_gwcs.catalogs import read_catalog
    from wpdc_gwcs.columns import numbers_or_nan

    names = set(table.colnames)
    if {"frame", "status", "reason"} <= names:
        return _of_summary(table), lambda: pictures.draw_summary(table)
    if {"x", "y", "dx", "dy", "used"} <= names:
        return _of_matches(table)
    if {"x", "y"} <= names:
        flags = numbers_or_nan(table, "flags")
        lines = [("sources", f"{len(table)}, {np.sum(~(flags > 0))} of them without flags")]
        if "snr" in names:
            snr = numbers_or_nan(table, "snr")
            lines.append(("S/N", f"{np.nanmin(snr):.1f} to {np.nanmax(snr):.0f}"))
        lines.append(("columns", ", ".join(table.colnames)))
        return lines, lambda: pictures.draw_sources(table)
    from wpdc_gwcs.cli.catalog import lines_about

    stars = read_catalog(path)
    return list(lines_about(stars)), lambda: pictures.draw_catalog(stars)


def _of_summary(summary):
    states = [str(status) for status in summary["status"]]
    lines = [("frames", f"{len(summary)}")]
    lines += [(state, f"{states.count(state)}") for state in dict.fromkeys(states)]
    told = [row for row in summary if str(row["reason"]) not in ("", "--")]
    for row in told[:_MOST_ROWS]:
        lines.append((str(row["frame"]), f"{row['status']}: {row['reason']}"))
    if len(told) > _MOST_ROWS:
        lines.append(("...", f"{len(told) - _MOST_ROWS} more with reasons"))
    return lines


def _of_matches(matches):
    from wpdc_gwcs.columns import numbers_or_nan
    from wpdc_gwcs.evaluation import evaluate
    from wpdc_gwcs.plotting import plot_residual_arrows

    used = np.asarray(matches["used"]).astype(bool)
    x, y, dx, dy = (numbers_or_nan(matches, name) for name in ("x", "y", "dx", "dy"))
    lines = [("pairs", f"{len(matches)}, {used.sum()} used")]
    if "holdout" in matches.colnames:
        lines.append(("held out", f"{int(np.asarray(matches['holdout']).astype(bool).sum())}"))
    if used.any():
        found = evaluate(dx[used], dy[used])
        text = f"{found.sigma_dx:.4f} and {found.sigma_dy:.4f} px in x and y after clipping"
        lines.append(("residuals", text))
    shape = (int(np.nanmax(y)) + 1, int(np.nanmax(x)) + 1)

    def draw():
        parts = (c[used] for c in (x, y, dx, dy))
        return plot_residual_arrows(*parts, image_shape=shape, title="mean residuals")

    return lines, draw


def _of_fits(file):
    """Lines about a FITS file: a frame with stars or pixels, a result, or a catalog."""
    from wpdc_gwcs.catalogs import read_catalog
    from wpdc_gwcs.cli.catalog import lines_about
    from wpdc_gwcs.io import read_frames
    from wpdc_gwcs.pictures import draw_catalog, draw_sources

    try:
        frames = read_frames(file)
    except FrameError as no_frame:
        try:
            return _of_result(file)
        except FileFormatError:
            pass
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                stars = read_catalog(file)
        except InputError:
            raise no_frame from None
        return list(lines_about(stars)), lambda: draw_catalog(stars)
    lines = []
    for frame in frames[:_MOST_ROWS]:
        ny, nx = frame.image_shape
        kind = "image" if frame.load_image is not None else "list of sources"
        epoch = "no epoch" if frame.epoch is None else f"epoch {frame.epoch:.3f}"
        ra, dec = frame.wcs.pixel_to_world_values((nx - 1) / 2, (ny - 1) / 2)
        lines.append((frame.name, f"{kind} of {nx} x {ny} px, detector {frame.detector}, {epoch}"))
        lines.append(("", f"center by the header at RA {float(ra):.5f} Dec {float(dec):.5f} deg"))
    if len(frames) > _MOST_ROWS:
        lines.append(("...", counted(len(frames) - _MOST_ROWS, "more frame")))
    first = frames[0]

    def draw():
        from wpdc_gwcs.calibration import measure_sources

        return draw_sources(measure_sources(first), image_shape=first.image_shape)

    return lines, draw


def _table_or_none(path):
    from wpdc_gwcs.io import read_table

    try:
        table = read_table(path)
    except FileFormatError:
        return None
    return table if len(table.colnames) > 1 else None
