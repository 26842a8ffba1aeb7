"""Coordinate transforms with result files: `pix2sky`, `sky2pix`."""

from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from wpdc_gwcs.cli.app import app
from wpdc_gwcs.cli.completion import one_of
from wpdc_gwcs.cli.options import Overwrite
from wpdc_gwcs.counts import counted
from wpdc_gwcs.exceptions import InputError

CalibrationFile = Annotated[
    Path,
    typer.Argument(metavar="FILE", help="A *.wcs.asdf, *.solution.asdf or exported FITS file."),
]
Origin = Annotated[
    int,
    typer.Option(**one_of("0", "1"), help="Pixel coordinate of the center of the first pixel."),
]
Output = Annotated[
    Path | None,
    typer.Option("--output", metavar="FILE", help="Write the table here instead of printing it."),
]


def read_one(file):
    """Read a file with a single WCS.

    Parameters
    ----------
    file : Path
        File of a frame or of a detector.

    Returns
    -------
    Calibration or DistortionSolution
        Its content; a camera is refused.
    """
    from wpdc_gwcs.camera import Camera
    from wpdc_gwcs.io import read

    found = read(file)
    if isinstance(found, Camera):
        raise InputError(
            f"{file}: is a camera of {counted(len(found.detectors), 'detector')}; name one file, "
            f"for example {file.parent / found.files[found.reference]}"
        )
    return found


@app.command(
    "pix2sky",
    no_args_is_help=True,
    context_settings={"ignore_unknown_options": True},
    epilog="Example: wpdc pix2sky results/image.wcs.asdf 1024 1024",
)
def pix2sky_command(
    file: CalibrationFile,
    points: Annotated[
        list[str],
        typer.Argument(metavar="X Y | TABLE", help="Pixel position, or a table with x, y."),
    ],
    origin: Origin = 0,
    output: Output = None,
    overwrite: Overwrite = False,
):
    """Convert pixels to RA and Dec (ICRS, deg).

    A table gets the columns ra and dec.  Positions outside the detector become nan.
    """
    _transform(file, points, origin, output, overwrite, forward=True)


@app.command(
    "sky2pix",
    no_args_is_help=True,
    context_settings={"ignore_unknown_options": True},
    epilog="Example: wpdc sky2pix results/image.wcs.asdf 294.63 35.18",
)
def sky2pix_command(
    file: CalibrationFile,
    points: Annotated[
        list[str],
        typer.Argument(
            metavar="RA DEC | TABLE", help="ICRS position in deg, or a table with ra, dec."
        ),
    ],
    origin: Origin = 0,
    output: Output = None,
    overwrite: Overwrite = False,
):
    """Convert RA and Dec (ICRS, deg) to pixels.

    A table gets the columns x and y.  Positions outside the detector become nan.
    """
    _transform(file, points, origin, output, overwrite, forward=False)


def _transform(file, points, origin, output, overwrite, *, forward):
    if origin not in (0, 1):
        raise InputError(f"--origin must be 0 or 1, got {origin}")
    wcs = read_one(file).wcs
    names = ("x", "y", "ra", "dec") if forward else ("ra", "dec", "x", "y")

    def transform(a, b):
        if forward:
            return wcs(a - origin, b - origin)
        x, y = wcs.invert(a, b)
        return x + origin, y + origin

    if len(points) == 1 and not (_is_number(points[0]) and not Path(points[0]).exists()):
        _transform_table(points[0], names, transform, output, overwrite)
        return
    a, b = _numbers(points, names[:2])
    result = [float(value) for value in transform(a, b)]
    if not np.all(np.isfinite(result)):
        where = "detector" if forward else "sky of the detector"
        typer.echo("nan nan")
        typer.echo(f"wpdc: error: {' '.join(points)} is outside the {where}", err=True)
        raise typer.Exit(1)
    digits = 10 if forward else 5
    typer.echo(" ".join(f"{value:.{digits}f}" for value in result))


def _is_number(text):
    try:
        float(text)
    except ValueError:
        return False
    return True


def _numbers(points, names):
    if len(points) != 2:
        raise InputError(
            f"give {names[0]} and {names[1]}, or one table; got {counted(len(points), 'value')}: "
            f"{' '.join(points)}"
        )
    try:
        return [np.float64(p) for p in points]
    except ValueError as err:
        unit = "deg" if names[0] == "ra" else "px"
        raise InputError(
            f"{names[0]} and {names[1]} must be numbers, got {' '.join(points)} (in {unit})"
        ) from err


def _transform_table(path, names, transform, output, overwrite):
    from wpdc_gwcs.io import read_table, write_table

    table = read_table(path, columns=names[:2])
    a, b = (np.asarray(table[name], float) for name in names[:2])
    c, d = transform(a, b)
    unit = "deg" if names[2] == "ra" else "pix"
    for name, values in zip(names[2:], (c, d), strict=True):
        table[name] = values
        table[name].unit = unit
    if output is None:
        table.write(typer.get_text_stream("stdout"), format="ascii.ecsv")
    else:
        write_table(table, output, overwrite=overwrite)


def match_files(paths):
    """List the match tables of files and folders, in order.

    Parameters
    ----------
    paths : list of Path
        Match tables, WCS files with match tables next to them, or folders of these.

    Returns
    -------
    list of Path
        Paths of existing match tables.
    """
    found = []
    for path in paths:
        if path.is_dir():
            inside = sorted(path.glob("*.matches.ecsv"))
            if not inside:
                raise InputError(f"{path}: the folder has no *.matches.ecsv file")
            found += inside
            continue
        if path.name.endswith(".wcs.asdf"):
            path = path.with_name(path.name.removesuffix(".wcs.asdf") + ".matches.ecsv")
        if not path.exists():
            raise InputError(f"{path}: no such file")
        found.append(path)
    return found


def wcs_files(paths):
    """List the WCS files of files and folders, in order.

    Parameters
    ----------
    paths : list of Path
        Files, or folders with ``*.wcs.asdf`` files.

    Returns
    -------
    list of Path
        The files, each once.
    """
    found = []
    for path in paths:
        inside = [path]
        if path.is_dir():
            inside = sorted(path.glob("*.wcs.asdf"))
            if not inside:
                raise InputError(f"{path}: the folder has no *.wcs.asdf file")
        found += inside
    return list(dict.fromkeys(found))
