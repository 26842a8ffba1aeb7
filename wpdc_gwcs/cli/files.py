"""Commands on results: `pix2sky`, `sky2pix`, `evaluate`, `monitor`."""

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from wpdc_gwcs.cli.app import app
from wpdc_gwcs.cli.options import Overwrite, Quiet, Verbose, require_free, require_plotting
from wpdc_gwcs.exceptions import InputError

CalibrationFile = Annotated[
    Path,
    typer.Argument(metavar="FILE", help="A *.wcs.asdf, *.solution.asdf or exported FITS file."),
]
Origin = Annotated[
    int,
    typer.Option(metavar="{0,1}", help="Pixel coordinate of the center of the first pixel."),
]
Output = Annotated[
    Path | None,
    typer.Option("--output", metavar="FILE", help="Write the table here instead of printing it."),
]


def read_one(file):
    """Read a file that has one WCS.

    Parameters
    ----------
    file : Path
        Of a frame or of a detector.

    Returns
    -------
    Calibration or DistortionSolution
        What is in it; a camera is refused.
    """
    from wpdc_gwcs.camera import Camera
    from wpdc_gwcs.io import read

    found = read(file)
    if isinstance(found, Camera):
        raise InputError(
            f"{file}: is a camera of {len(found.detectors)} detectors; name the file of one, for "
            f"example {file.parent / found.files[found.reference]}"
        )
    return found


@app.command("pix2sky", no_args_is_help=True, context_settings={"ignore_unknown_options": True})
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
    """Pixel to sky: prints RA and Dec (ICRS, deg); a table gets the columns ra and dec."""
    _transform(file, points, origin, output, overwrite, forward=True)


@app.command("sky2pix", no_args_is_help=True, context_settings={"ignore_unknown_options": True})
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
    """Sky to pixel: prints x and y; a table gets the columns x and y.  Off the detector: nan."""
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

    if len(points) == 1:
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


def _numbers(points, names):
    if len(points) != 2:
        raise InputError(
            f"give {names[0]} and {names[1]}, or one table; got {len(points)} values: "
            f"{' '.join(points)}"
        )
    try:
        return [np.float64(p) for p in points]
    except ValueError as err:
        raise InputError(
            f"{names[0]} and {names[1]} must be numbers, got {' '.join(points)}"
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


@app.command("evaluate", no_args_is_help=True)
def evaluate_command(
    paths: Annotated[
        list[Path],
        typer.Argument(
            metavar="PATH...", help="*.matches.ecsv files, *.wcs.asdf files, or result folders."
        ),
    ],
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            metavar="FILE",
            help="Write the tables instead of printing them: that of the frames here, that of the "
            "weights into FILE with .weights before its suffix.",
        ),
    ] = None,
    plots: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Also write figures of the residuals into this folder."),
    ] = None,
    no_weights: Annotated[
        bool,
        typer.Option(
            "--no-weights",
            help="Do not fit the polynomial anew with each of the five radial weights.",
        ),
    ] = False,
    overwrite: Overwrite = False,
    verbose: Verbose = 0,
    quiet: Quiet = False,
):
    """Residuals of calibrated frames: clipped moments, d80, scatter; held-out stars apart.

    Then the same for all frames of a detector with each of the five radial weights, without and
    with a table, from the *.wcs.asdf files beside the matches.
    """
    from astropy.table import QTable

    from wpdc_gwcs.evaluation import evaluate
    from wpdc_gwcs.io import write_table

    if plots is not None:
        require_plotting("--plots")
    frames = [
        _EvaluatedFrame(path, not no_weights or plots is not None) for path in match_files(paths)
    ]
    compares = not no_weights and any(frame.calibration is not None for frame in frames)
    if output is not None:
        files = {"frames": output}
        if compares:
            files["weights"] = output.with_suffix(".weights" + output.suffix)
        for file in files.values():
            require_free(file, overwrite)
    compared = _compare_weights(frames) if compares else {}
    tables = {}
    rows = []
    for frame in frames:
        for stars, mask in (("used", frame.flag("used")), ("holdout", frame.flag("holdout"))):
            if mask.any():
                dx, dy = (np.asarray(frame.matches[name])[mask] for name in ("dx", "dy"))
                rows.append(dict(frame=frame.name, stars=stars, **vars(evaluate(dx, dy))))
    tables["frames"] = QTable(rows)
    if compared:
        tables["weights"] = _table_of_weights(compared)
    if plots is not None:
        _write_plots(frames, compared, plots, overwrite=overwrite)
    if output is not None:
        for name, table in tables.items():
            write_table(table, files[name], overwrite=overwrite)
    if not quiet and output is None:
        for k, table in enumerate(tables.values()):
            if k:
                typer.echo()
            _print_statistics(table)


def _print_statistics(table):
    """Print statistics, the numbers of stars first, then px with four digits."""
    words = [name for name in table.colnames if table[name].dtype.kind == "U"]
    for name in table.colnames:
        if table[name].dtype.kind == "f":
            table[name].info.format = ".0f" if name == "r0" else ".4f"
    align = ["<" if name in words else ">" for name in table.colnames]
    for line in table.pformat(max_lines=-1, max_width=-1, align=align):
        typer.echo(line)


class _EvaluatedFrame:
    """Matches of a frame, and its calibration where that is beside them."""

    def __init__(self, path, with_calibration):
        from wpdc_gwcs.io import read, read_matches

        self.name = path.name.removesuffix(".matches.ecsv")
        self.matches = read_matches(path)
        beside = path.with_name(f"{self.name}.wcs.asdf")
        self.calibration = None
        if with_calibration and beside.exists():
            calibration = read(beside)
            runs = calibration.provenance.get("run"), self.matches.meta.get("run")
            if runs[0] != runs[1]:
                raise InputError(
                    f"{path}: must be of the same run as {beside.name}, {runs[0]}, is of {runs[1]}"
                )
            self.calibration = replace(calibration, matches=self.matches)

    def flag(self, name):
        return np.asarray(self.matches[name], bool)


def _compare_weights(frames):
    """Detector to results of the five weights, for the frames whose calibration is known."""
    from wpdc_gwcs.evaluation import compare_weights

    groups = {}
    for frame in frames:
        if frame.calibration is not None:
            detector = frame.calibration.solution.detector
            groups.setdefault(detector, []).append(frame.calibration)
    return {detector: compare_weights(group) for detector, group in groups.items()}


def _table_of_weights(compared):
    from astropy.table import vstack

    from wpdc_gwcs.evaluation import tabulate_weights

    tables = []
    for detector, results in compared.items():
        table = tabulate_weights(results)
        table.add_column(np.full(len(table), detector), name="detector", index=0)
        tables.append(table)
    return vstack(tables)


def match_files(paths):
    """Match tables behind files and folders, in order.

    Parameters
    ----------
    paths : list of Path
        Match tables, WCS files with their match tables beside them, or folders of these.

    Returns
    -------
    list of Path
        Paths of match tables, all there.
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


def _write_plots(frames, compared, folder, *, overwrite):
    from wpdc_gwcs import plotting
    from wpdc_gwcs.calibration.results import file_stem

    figures = {}
    for frame in frames:
        m = frame.matches
        figures[f"{frame.name}.residuals.png"] = partial(plotting.plot_residuals_vs_position, m)
        figures[f"{frame.name}.magnitude.png"] = partial(plotting.plot_residuals_vs_magnitude, m)
        figures[f"{frame.name}.cdf.png"] = partial(plotting.plot_cdf, m)
        if frame.calibration is not None:
            shape = frame.calibration.solution.image_shape
            figures[f"{frame.name}.maps.png"] = partial(
                plotting.plot_residual_maps, m, image_shape=shape
            )
    for detector, results in compared.items():
        figures[f"{file_stem(detector)}.weights.png"] = partial(plotting.plot_weights, results)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as err:
        raise InputError(
            f"{folder}: the folder of --plots must be writable: {err.strerror}"
        ) from err
    for name in figures:
        require_free(folder / name, overwrite)
    for name, plot in figures.items():
        plot().savefig(folder / name, dpi=110)


@app.command("monitor", no_args_is_help=True)
def monitor_command(
    solution: Annotated[
        Path, typer.Argument(metavar="SOLUTION", help="The stored *.solution.asdf file.")
    ],
    paths: Annotated[
        list[Path],
        typer.Argument(
            metavar="MATCHES...",
            help="Results of frames calibrated with it: *.matches.ecsv, *.wcs.asdf or folders.",
        ),
    ],
    false_alarm: Annotated[
        float,
        typer.Option(metavar="P", help="Accepted probability of an alarm without a change."),
    ] = 0.01,
    output: Output = None,
    overwrite: Overwrite = False,
    verbose: Verbose = 0,
    quiet: Quiet = False,
):
    """Is a stored solution still right?  Exit status 1 if the residuals say that it is not.

    The frames must have been calibrated with it: wpdc calibrate --solution SOLUTION --refine
    attitude.
    """
    from wpdc_gwcs.evaluation import detect_drift
    from wpdc_gwcs.io import read, read_matches, write_table
    from wpdc_gwcs.solution import DistortionSolution

    stored = read(solution)
    if not isinstance(stored, DistortionSolution):
        raise InputError(f"{solution}: monitor needs a *.solution.asdf file")
    tables = [read_matches(path) for path in match_files(paths)]
    try:
        drift = detect_drift(stored, tables, false_alarm=false_alarm)
    except ValueError as err:
        raise InputError(str(err)) from err
    if output is not None:
        write_table(drift.cells, output, overwrite=overwrite)
    if not quiet:
        verdict = "has drifted" if drift.drifted else "no drift found"
        typer.echo(
            f"{stored.detector}: {verdict} (p = {drift.p_value:.2g}, {drift.n_stars} stars in "
            f"{len(tables)} frames)"
        )
        if drift.drifted:
            typer.echo(f"  by {drift.amplitude:.4f} px rms in {drift.area:.0%} of the detector")
        for cell in drift.cells[drift.cells["changed"]][:5]:
            typer.echo(
                f"  x {cell['x_min'].value:.0f} to {cell['x_max'].value:.0f}, "
                f"y {cell['y_min'].value:.0f} to {cell['y_max'].value:.0f}: "
                f"dx {cell['dx'].value:+.4f} +- {cell['sigma_dx'].value:.4f}, "
                f"dy {cell['dy'].value:+.4f} +- {cell['sigma_dy'].value:.4f} px"
            )
    if drift.drifted:
        raise typer.Exit(1)
