"""`wpdc evaluate`: residuals of frames, detectors and runs, and comparison with a truth."""

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from wpdc_gwcs.cli.app import app
from wpdc_gwcs.cli.files import match_files, read_with_wcs, wcs_beside
from wpdc_gwcs.cli.options import (
    Overwrite,
    Quiet,
    Verbose,
    read_numbers,
    require_free,
    require_plotting,
)
from wpdc_gwcs.counts import counted
from wpdc_gwcs.exceptions import FitError, InputError

# Maximum number of frames that are printed one by one.
_MOST_FRAMES = 40


@app.command("evaluate", no_args_is_help=True, epilog="Example: wpdc evaluate results --no-weights")
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
            help="Write the tables instead of printing them: the frames to FILE, the others to "
            "FILE with .detectors, .truth, .truth-detectors, .weights before its suffix.",
        ),
    ] = None,
    table: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Also write the detectors like table 2 of the paper: LaTeX (.tex), ECSV (.ecsv) "
            "or plain text.",
        ),
    ] = None,
    truth: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR", help="Folder of wpdc simulate: compare the results with its truth."
        ),
    ] = None,
    limit: Annotated[
        float,
        typer.Option(metavar="PX", help="Limit for the share of the area with small errors."),
    ] = 0.01,
    min_radius: Annotated[
        float | None,
        typer.Option(metavar="PX", help="Only stars further than this from the reference point."),
    ] = None,
    max_radius: Annotated[
        float | None,
        typer.Option(metavar="PX", help="Only stars nearer than this to the reference point."),
    ] = None,
    about: Annotated[
        str | None,
        typer.Option(metavar="X,Y", help="Pixel from which these radii are measured instead."),
    ] = None,
    region: Annotated[
        str | None,
        typer.Option(metavar="X0,X1,Y0,Y1", help="Only stars in this part of the detector, px."),
    ] = None,
    min_mag: Annotated[
        float | None, typer.Option(metavar="MAG", help="Only stars fainter than this.")
    ] = None,
    max_mag: Annotated[
        float | None, typer.Option(metavar="MAG", help="Only stars of this magnitude or brighter.")
    ] = None,
    min_snr: Annotated[
        float | None,
        typer.Option(metavar="RATIO", help="Only stars with a higher signal-to-noise ratio."),
    ] = None,
    plots: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Also write figures of the residuals into this folder."),
    ] = None,
    weights: Annotated[
        str | None,
        typer.Option(
            metavar="NAMES",
            help="Radial weights to compare, separated by commas, by name or as w1 to w4; default: "
            "all five.",
        ),
    ] = None,
    degree: Annotated[
        int, typer.Option(metavar="N", help="Degree of the polynomial in that comparison, 1 to 7.")
    ] = 3,
    no_weights: Annotated[
        bool,
        typer.Option(
            "--no-weights",
            help="Do not compare the radial weights.",
        ),
    ] = False,
    overwrite: Overwrite = False,
    verbose: Verbose = 0,
    quiet: Quiet = False,
):
    """Print statistics of residuals, by detector and by frame.

    With --truth, also print the error of the WCS itself, wrong pairs and pulls.  Finally, compare
    solutions with each of the five radial weights, without and with a table.  This needs the
    *.wcs.asdf files next to the matches.
    """
    from astropy.table import QTable

    from wpdc_gwcs.evaluation import Cuts, evaluate, tabulate_detectors, tabulate_scores
    from wpdc_gwcs.io import write_table

    if plots is not None:
        require_plotting("--plots")
    if not 1 <= degree <= 7:
        raise InputError(f"--degree must be 1 to 7, got {degree}")
    if not limit > 0:
        raise InputError(f"--limit must be positive, in px, got {limit:g}")
    try:
        cuts = Cuts(
            min_radius=min_radius,
            max_radius=max_radius,
            about=None if about is None else read_numbers("--about", about, 2),
            min_magnitude=min_mag,
            max_magnitude=max_mag,
            min_snr=min_snr,
            region=None if region is None else read_numbers("--region", region, 4),
        )
    except ValueError as err:
        raise InputError(str(err)) from err
    names = _weight_names(weights)
    frames = [_EvaluatedFrame(path, cuts) for path in match_files(paths)]
    known = [frame.calibration for frame in frames if frame.calibration is not None]
    for option, given in (("--truth", truth), ("--table", table)):
        if given is not None and len(known) < len(frames):
            raise InputError(f"{option} needs the *.wcs.asdf files beside the matches")
    parts = {"frames": True, "detectors": bool(known), "weights": bool(known) and not no_weights}
    parts |= dict.fromkeys(("truth", "truth-detectors"), truth is not None)
    files = _files(output, [name for name, there in parts.items() if there], overwrite)
    if table is not None:
        require_free(table, overwrite)

    tables = {}
    if known:
        pooled = _pool(known, cuts, limit)
        tables["detectors"] = tabulate_detectors(pooled)
        if table is not None:
            _write_paper_table(pooled, table, overwrite)
    if truth is not None:
        scores, together = _score(known, truth, cuts, limit)
        tables["truth-detectors"] = tabulate_scores(together)
        tables["truth"] = tabulate_scores(scores)
    rows = []
    for frame in frames:
        for stars, mask in (("used", frame.flag("used")), ("holdout", frame.flag("holdout"))):
            if mask.any():
                dx, dy = (np.asarray(frame.matches[name])[mask] for name in ("dx", "dy"))
                rows.append(dict(frame=frame.name, stars=stars, **vars(evaluate(dx, dy))))
    if not rows:
        raise InputError(f"no star of {counted(len(frames), 'frame')} is within the given limits")
    tables["frames"] = QTable(rows)
    compared = _compare_weights(known, names, degree, cuts) if parts["weights"] else {}
    if compared:
        tables["weights"] = _table_of_weights(compared)
    if plots is not None:
        _write_plots(frames, compared, plots, overwrite=overwrite)
    for name, file in files.items():
        if name in tables:
            write_table(tables[name], file, overwrite=overwrite)
    if not quiet and output is None:
        _print_tables(tables)


def _weight_names(text):
    from wpdc_gwcs.fitting import RadialWeight

    if text is None:
        return RadialWeight.names
    try:
        return tuple(RadialWeight(name.strip()).name for name in text.split(","))
    except ValueError as err:
        raise InputError(f"--weights: {err}") from err


def _files(output, names, overwrite):
    """Output files by the names of tables."""
    if output is None:
        return {}
    files = {
        name: output if name == "frames" else output.with_suffix(f".{name}{output.suffix}")
        for name in names
    }
    for file in files.values():
        require_free(file, overwrite)
    return files


def _pool(calibrations, cuts, limit):
    from wpdc_gwcs.evaluation import pool_residuals

    try:
        pooled = pool_residuals(calibrations, cuts=cuts, limit=limit)
        held = [c for c in calibrations if np.any(c.matches["holdout"])]
        if held:
            pooled += pool_residuals(held, cuts=cuts, limit=limit, stars="holdout")
    except ValueError as err:
        raise InputError(str(err)) from err
    return pooled


def _write_paper_table(pooled, path, overwrite):
    from wpdc_gwcs.evaluation import format_table, tabulate_detectors
    from wpdc_gwcs.io import atomic_path, write_table

    detectors = [r for r in pooled if r.stars == "used"]
    if path.suffix == ".ecsv":
        names = ("detector", "mean_dx", "sigma_dx", "mean_dy", "sigma_dy")
        paper = tabulate_detectors(detectors)[names]
        for name in names[1:]:
            paper[name].unit = "pix"
        write_table(paper, path, overwrite=overwrite)
        return
    text = format_table(detectors, form="latex" if path.suffix == ".tex" else "ascii")
    with atomic_path(path, overwrite=overwrite) as temporary:
        temporary.write_text(text, encoding="utf-8")


def _score(calibrations, folder, cuts, limit):
    """Scores of the frames, and pooled scores."""
    from wpdc_gwcs.evaluation import pool_scores, score_frame
    from wpdc_gwcs.io import read_truth

    truth = read_truth(folder)
    scores = []
    for c in calibrations:
        if c.frame not in truth.frames:
            raise InputError(f"{folder}: the simulation has no frame {c.frame}")
        try:
            scores.append(
                score_frame(c, truth.frames[c.frame], truth.stars(c.frame), cuts=cuts, limit=limit)
            )
        except ValueError as err:
            raise InputError(str(err)) from err
    return scores, pool_scores(scores)


def _print_tables(tables):
    order = ("detectors", "truth-detectors", "frames", "truth", "weights")
    first = True
    for name in order:
        if name not in tables:
            continue
        if not first:
            typer.echo()
        first = False
        if name in ("frames", "truth") and len(tables[name]) > _MOST_FRAMES:
            typer.echo(f"{counted(len(tables[name]), 'row')} of {name}: written with --output FILE")
            continue
        _print_statistics(tables[name])


def _print_statistics(table):
    """Print statistics: numbers of stars first, then values in px with four digits."""
    words = [name for name in table.colnames if table[name].dtype.kind == "U"]
    for name in table.colnames:
        if table[name].dtype.kind == "f":
            table[name].info.format = ".0f" if name == "r0" else ".4f"
    align = ["<" if name in words else ">" for name in table.colnames]
    for line in table.pformat(max_lines=-1, max_width=-1, align=align):
        typer.echo(line)


class _EvaluatedFrame:
    """Matches of a frame within the limits, and its calibration if the file is there."""

    def __init__(self, path, cuts):
        self.name = path.name.removesuffix(".matches.ecsv")
        matches, calibration = read_with_wcs(path)
        self.calibration = crpix = None
        if calibration is not None:
            self.calibration = replace(calibration, matches=matches)
            crpix = calibration.solution.crpix
        self.matches = matches
        if not cuts:
            return
        by_radius = not (cuts.min_radius is None and cuts.max_radius is None)
        if crpix is None and cuts.about is None and by_radius:
            raise InputError(
                f"{path}: radii need --about X,Y, or {wcs_beside(path).name} beside it"
            )
        try:
            self.matches = matches[cuts.select(matches, (0.0, 0.0) if crpix is None else crpix)]
        except ValueError as err:
            raise InputError(f"{path}: {err}") from err

    def flag(self, name):
        return np.asarray(self.matches[name], bool)


def _compare_weights(calibrations, weights, degree, cuts):
    """Results of the weights by detector, for frames with a known calibration.

    All stars are fitted; the results are for stars within the limits on position.
    """
    from wpdc_gwcs.evaluation import compare_weights

    groups = {}
    for c in calibrations:
        groups.setdefault(c.solution.detector, []).append(c)
    try:
        found = {
            detector: compare_weights(group, weights=weights, degree=degree)
            for detector, group in groups.items()
        }
    except FitError as err:
        raise InputError(f"{err} (--no-weights skips this test)") from err
    return {
        detector: [
            r.select(cuts.place(r.x, r.y, groups[detector][0].solution.crpix)) for r in results
        ]
        for detector, results in found.items()
    }


def _table_of_weights(compared):
    from astropy.table import vstack

    from wpdc_gwcs.evaluation import tabulate_weights

    tables = []
    for detector, results in compared.items():
        table = tabulate_weights(results)
        table.add_column(np.full(len(table), detector), name="detector", index=0)
        tables.append(table)
    return vstack(tables)


def _write_plots(frames, compared, folder, *, overwrite):
    from wpdc_gwcs import plotting
    from wpdc_gwcs.calibration.names import file_stem
    from wpdc_gwcs.io.files import make_folder

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
    make_folder(folder)
    for name in figures:
        require_free(folder / name, overwrite)
    for name, plot in figures.items():
        plot().savefig(folder / name, dpi=110)
