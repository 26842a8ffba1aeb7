"""Coordinate transforms with result files: `pix2sky`, `sky2pix`."""

from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from wpdc_gwcs.cli.app import app
from wpdc_gwcs.cli.completion import one_of
from wpdc_gwcs.cli.options import Overwrite
from wpdc_gwcs.cli.positions import read_position, require_on_sphere
from wpdc_gwcs.columns import listed, spelled_names
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

_DEG_PER_HOUR = 15.0


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


def read_stored(path, what):
    """Read a stored solution, or those of a camera.

    Parameters
    ----------
    path : Path
        Their file.
    what : str
        Option or command that needs it, for messages.

    Returns
    -------
    DistortionSolution or Camera
        The content of the file.

    Raises
    ------
    InputError
        If the file is of another kind, or cannot be read.
    """
    from wpdc_gwcs.camera import Camera
    from wpdc_gwcs.io import read
    from wpdc_gwcs.io.files import file_kind
    from wpdc_gwcs.solution import DistortionSolution

    stored = None
    # A file that is not ASDF cannot be one, and what a reader of headers says of it does not help.
    if not path.is_dir() and file_kind(path) == "asdf":
        stored = read(path)
    if isinstance(stored, DistortionSolution | Camera):
        return stored
    folder = path if path.is_dir() else path.parent
    inside = [*sorted(folder.glob("*.camera.asdf")), *sorted(folder.glob("*.solution.asdf"))]
    option = f"{what} " if what.startswith("--") else ""
    hint = f"; try: {option}{inside[0]}" if inside else ""
    kind = ", is a folder" if path.is_dir() else ""
    raise InputError(f"{path}: {what} needs a *.solution.asdf or *.camera.asdf file{kind}{hint}")


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
    epilog="Example: wpdc sky2pix results/image.wcs.asdf 19:38:31.2 +35:10:48",
)
def sky2pix_command(
    file: CalibrationFile,
    points: Annotated[
        list[str],
        typer.Argument(
            metavar="RA DEC | TABLE",
            help="ICRS position, or a table with ra, dec.  Plain numbers are in deg.  In a "
            "sexagesimal position such as 12:34:56.7 -01:02:03, ra is in hours, unless units say "
            "something else (188d44m10s).",
        ),
    ],
    origin: Origin = 0,
    output: Output = None,
    overwrite: Overwrite = False,
):
    """Convert RA and Dec (ICRS) to pixels.

    A table gets the columns x and y.  Positions outside the detector become nan.
    """
    _transform(file, points, origin, output, overwrite, forward=False)


def _transform(file, points, origin, output, overwrite, *, forward):
    if origin not in (0, 1):
        raise InputError(f"--origin must be 0 or 1, got {origin}")
    calibration = read_one(file)
    wcs = calibration.wcs
    names = ("x", "y", "ra", "dec") if forward else ("ra", "dec", "x", "y")

    def transform(a, b):
        if forward:
            return wcs(a - origin, b - origin)
        x, y = wcs.invert(a, b)
        return x + origin, y + origin

    if len(points) == 1 and Path(points[0]).exists():
        _transform_table(points[0], names, transform, output, overwrite)
        return
    read_point = _read_pixel if forward else _read_sky
    result = [float(value) for value in transform(*read_point(points))]
    if not np.all(np.isfinite(result)):
        where = "detector"
        if not forward:
            where = f"sky of the detector{_center(calibration)}{_if_in_hours(points, wcs)}"
        typer.echo("nan nan")
        typer.echo(f"wpdc: error: {' '.join(points)} is outside the {where}", err=True)
        raise typer.Exit(1)
    digits = 10 if forward else 5
    typer.echo(" ".join(f"{value:.{digits}f}" for value in result))


def _center(calibration):
    """Center of the detector on the sky, in words."""
    shape = getattr(calibration, "solution", calibration).image_shape
    if shape is None:
        return ""
    ra, dec = calibration.wcs(*((n - 1) / 2 for n in reversed(shape)))
    return f", whose center is RA {float(ra):.5f} Dec {float(dec):+.5f} deg"


def _if_in_hours(points, wcs):
    """Hint for a plain number of hours as right ascension."""
    ra, dec = _read_sky(points)
    word = _two_words(points, ("ra", "dec"))[0]
    if not _is_number(word) or not np.all(np.isfinite(wcs.invert(_DEG_PER_HOUR * ra, dec))):
        return ""
    return f"; if {word} is in hours, RA is {_DEG_PER_HOUR * ra:.5f} deg, which is inside: give deg"


def _read_pixel(points):
    words = _two_words(points, ("x", "y"))
    try:
        return [np.float64(word) for word in words]
    except ValueError as err:
        raise InputError(f"x and y must be numbers, got {' '.join(points)} (in px)") from err


def _read_sky(points):
    return read_position(_two_words(points, ("ra", "dec")))


def _two_words(points, names):
    """Split arguments into two coordinates: ``a b``, ``"a b"``, ``a, b``, ``h m s d m s``."""
    words = [point.strip(" ,") for point in points]
    if len(words) != 2:
        words = " ".join(points).replace(",", " ").split()
    if len(words) == 6:
        words = [" ".join(words[:3]), " ".join(words[3:])]
    if len(words) != 2:
        if len(points) == 1 and not _is_number(points[0]):
            raise InputError(
                f"{points[0]}: no such file; give {names[0]} and {names[1]}, or one table"
            )
        raise InputError(
            f"give {names[0]} and {names[1]}, or one table; got {counted(len(words), 'value')}: "
            f"{' '.join(points)}"
        )
    return words


def _is_number(text):
    try:
        float(text)
    except ValueError:
        return False
    return True


def _transform_table(path, names, transform, output, overwrite):
    from wpdc_gwcs.io import read_table, write_table

    if names[0] == "ra":
        table = read_table(path)
        a, b = _table_sky(table, path)
    else:
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


def _table_sky(table, path):
    """Right ascension and declination of a table in deg; NaN where they are missing."""
    from wpdc_gwcs.catalogs.positions import column_angles, find_positions

    pair = find_positions(spelled_names(table.colnames))
    if pair is None:
        raise InputError(
            f"{path}: table must have columns 'ra' and 'dec', has {listed(table.colnames)}"
        )
    values = []
    for name in pair:
        found, unreadable = column_angles(table[name], name, path)
        if unreadable.any():
            row = int(np.flatnonzero(unreadable)[0])
            raise InputError(
                f"{path}: column {name!r} must hold angles, got {str(table[name][row])!r} in row "
                f"{row}"
            )
        values.append(found)
    require_on_sphere(pair, values, path=path)
    return values


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


def wcs_beside(path):
    """Return the path of the WCS file that belongs to a match table.

    Parameters
    ----------
    path : Path
        Match table.

    Returns
    -------
    Path
        The file may be absent.
    """
    return path.with_name(path.name.removesuffix(".matches.ecsv") + ".wcs.asdf")


def read_with_wcs(path):
    """Read a match table and the WCS file next to it.

    Parameters
    ----------
    path : Path
        Match table.

    Returns
    -------
    table : Table
        The matches.
    calibration : Calibration or None
        None if there is no WCS file.

    Raises
    ------
    InputError
        If the two are from different runs.
    """
    from wpdc_gwcs.io import read, read_matches

    table, beside = read_matches(path), wcs_beside(path)
    if not beside.exists():
        return table, None
    calibration = read(beside)
    runs = calibration.provenance.get("run"), table.meta.get("run")
    if runs[0] != runs[1]:
        raise InputError(
            f"{path}: must come from the same run as {beside.name} ({runs[0]}), "
            f"comes from {runs[1]}"
        )
    return table, calibration


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
