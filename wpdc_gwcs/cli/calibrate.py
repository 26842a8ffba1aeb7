"""`wpdc calibrate`: frames and a catalog in, WCS files out."""

import logging
import os
import shlex
from contextlib import nullcontext
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from wpdc_gwcs.cli.app import Interrupted, app
from wpdc_gwcs.cli.completion import complete, one_of
from wpdc_gwcs.cli.files import read_stored
from wpdc_gwcs.cli.hints import hint_of_frame
from wpdc_gwcs.cli.inputs import expand_paths
from wpdc_gwcs.cli.options import (
    Blind,
    Cache,
    Config,
    Epoch,
    Gain,
    Mask,
    MaskBits,
    MaxMag,
    MaxRoundness,
    MinSNR,
    Origin,
    Overwrite,
    PixelScale,
    Preset,
    Quiet,
    Saturation,
    TapUrl,
    Threshold,
    Verbose,
    WeightMap,
    by_hand,
    require_free,
    require_plotting,
    settings_of,
    state_first_pixel,
)
from wpdc_gwcs.cli.progress import progress_bar
from wpdc_gwcs.cli.report import write_page
from wpdc_gwcs.counts import counted
from wpdc_gwcs.exceptions import InputError, InternalError

log = logging.getLogger("wpdc_gwcs.cli")

# Maximum number of frames that are reported one by one.
_MOST_LINES = 100

Catalog = Annotated[
    str,
    typer.Option(
        "--catalog",
        metavar="CAT",
        help="Reference catalog: FITS_LDAC, or any table astropy reads (Gaia column names); "
        "'gaia' queries the archive, 'hats:PATH' reads a partitioned catalog.",
    ),
]
WcsFile = Annotated[
    str | None,
    typer.Option(
        "--wcs",
        metavar="HEADER",
        help="Starting WCS instead of the frame's own: for an image with a wrong header, and for "
        "tables of sources; FITS file[EXT], FITS_LDAC list, text header or .head file.",
    ),
]


@app.command(
    "calibrate",
    no_args_is_help=True,
    epilog="Example: wpdc calibrate image.fits --catalog gaia.fits --output results",
)
def calibrate_command(
    frames: Annotated[
        list[str],
        typer.Argument(
            metavar="FRAME",
            help="FITS images (path or path[EXT]), FITS_LDAC lists, or source tables with --wcs; "
            "folders of them, patterns in quotes, @LIST for a file with one in each line.",
        ),
    ],
    catalog: Catalog,
    output: Annotated[
        Path,
        typer.Option("--output", metavar="DIR", help="Folder for the results; created if needed."),
    ],
    wcs: WcsFile = None,
    detector: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="Detector of all frames; default: from the headers."),
    ] = None,
    epoch: Epoch = None,
    pixel_scale: PixelScale = None,
    origin: Origin = None,
    exposure_key: Annotated[
        str | None,
        typer.Option(
            metavar="KEYWORD",
            help="Header keyword that is the same for all detectors of one exposure; default: "
            "EXPNUM, OBSID and similar keywords, else the start time.",
        ),
    ] = None,
    no_camera: Annotated[
        bool,
        typer.Option("--no-camera", help="Treat the detectors of one exposure separately."),
    ] = False,
    solution: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="FILE",
            help="Stored *.solution.asdf (once for each detector) or *.camera.asdf: keep its "
            "distortion; fit the attitude of each frame, and a field if there is evidence.",
        ),
    ] = None,
    update: Annotated[
        bool,
        typer.Option(
            "--update",
            help="Merge the frames into the stored solution, and adapt it if the detector has "
            "changed.",
        ),
    ] = False,
    refine: Annotated[
        str,
        typer.Option(
            **one_of("auto", "attitude", "field", "pv"),
            help="Fit for each exposure: six linear numbers (attitude), also a smooth field if "
            "there is evidence (auto) or always (field), or a polynomial (pv).",
        ),
    ] = "auto",
    free_stars: Annotated[
        bool,
        typer.Option(
            "--free-stars",
            help="Fit the positions of reference stars that are in several exposures, for catalogs "
            "that are less accurate than the camera.",
        ),
    ] = False,
    method: Annotated[
        str,
        typer.Option(
            **one_of("wpdc", "paper"),
            help="One solution of all exposures (wpdc), or WPDC-2P exactly as published (paper): "
            "a polynomial per exposure, raw residuals in a bilinear table.",
        ),
    ] = "wpdc",
    degree: Annotated[
        str,
        typer.Option(
            metavar="{auto,1...7}",
            autocompletion=complete("auto", *"1234567"),
            help="Degree of the polynomial; auto: by evidence, stored as a cubic and a table.",
        ),
    ] = "auto",
    lut: Annotated[
        str,
        typer.Option(
            **one_of("auto", "none"),
            help="Look-up table for the residuals of the polynomial (auto), or the polynomial "
            "alone (none).",
        ),
    ] = "auto",
    weight: Annotated[
        str,
        typer.Option(
            metavar="NAME",
            autocompletion=complete(
                "exp-sqrt",
                "gaussian",
                "inverse",
                "inverse-square",
                "uniform",
                "w1",
                "w2",
                "w3",
                "w4",
            ),
            help="Radial weight of the polynomial; the table contains the rest: exp-sqrt, "
            "gaussian, inverse, inverse-square (w1 to w4 of the paper) or uniform.",
        ),
    ] = "exp-sqrt",
    r0: Annotated[
        float | None,
        typer.Option(
            metavar="PX",
            help="Radius in px within which the polynomial follows the distortion; default: "
            "0.87 x half the shorter side.",
        ),
    ] = None,
    n_grid: Annotated[
        int, typer.Option(metavar="N", help="Nodes of the look-up table along each axis.")
    ] = 50,
    centroids: Annotated[
        str,
        typer.Option(
            **one_of("psf", "windowed", "given"), help="How positions on images are measured."
        ),
    ] = "psf",
    reference_point: Annotated[
        str,
        typer.Option(
            **one_of("header", "center", "nearest-source"),
            help="Tangent point and origin of the polynomial; the center if off the detector.",
        ),
    ] = "header",
    threshold: Threshold = 5.0,
    min_snr: MinSNR = 10.0,
    max_roundness: MaxRoundness = 0.3,
    max_mag: MaxMag = None,
    tap_url: TapUrl = None,
    cache: Cache = None,
    gain: Gain = None,
    saturation: Saturation = None,
    mask: Mask = None,
    mask_bits: MaskBits = None,
    weight_map: WeightMap = None,
    blind: Blind = False,
    holdout: Annotated[
        float,
        typer.Option(
            metavar="SHARE",
            help="Share of the reference stars kept out of every fit and evaluated separately.",
        ),
    ] = 0.0,
    seed: Annotated[
        int, typer.Option(metavar="N", help="Seed of the choice of held-out stars.")
    ] = 0,
    jobs: Annotated[
        int, typer.Option(metavar="N", help="Processes that measure, match and write frames.")
    ] = 1,
    scheduler: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS", help="Address of a running Dask scheduler, instead of --jobs."
        ),
    ] = None,
    scheduler_timeout: Annotated[
        float,
        typer.Option(
            metavar="SECONDS",
            help="How long to wait for the scheduler, and for a worker whenever there is none.",
        ),
    ] = 60.0,
    resume: Annotated[
        bool,
        typer.Option(
            "--resume",
            help="Skip frames that a run with the same options and version has already done.",
        ),
    ] = False,
    report: Annotated[
        bool, typer.Option("--report", help="Also write report.html with figures.")
    ] = False,
    preset: Preset = None,
    config: Config = None,
    overwrite: Overwrite = False,
    verbose: Verbose = 0,
    quiet: Quiet = False,
):
    """Calibrate frames: detect, match, fit, write one WCS file each.

    Writes STEM.wcs.asdf and STEM.matches.ecsv for each solved frame (and STEM.sources.ecsv for
    images), DETECTOR.solution.asdf for each detector, CAMERA.camera.asdf for detectors that were
    solved together, and summary.ecsv.  A frame whose WCS has a limitation is degraded, and the
    summary names the limitation.  The exit status is 1 if a frame was not solved: it has no WCS
    file, and its row of the summary says why.
    """
    from wpdc_gwcs.calibration import calibrate
    from wpdc_gwcs.calibration.cluster import cluster_executor
    from wpdc_gwcs.calibration.results import ERRORS
    from wpdc_gwcs.catalogs import catalog_source, require_catalog_file
    from wpdc_gwcs.io import read_files

    if report:
        require_plotting("--report")
    if update and not solution:
        raise InputError("--update needs the stored solution: --solution FILE")
    if update and method == "paper":
        raise InputError(
            "--update needs --method wpdc: the paper's table is always made from scratch"
        )
    if no_camera and exposure_key is not None:
        raise InputError(
            "--exposure-key and --no-camera cannot be used together: one ties detectors to each "
            "other, the other separates them"
        )
    if detector is not None and not (detector.strip() and detector.isprintable()):
        raise InputError(f"--detector must be a printable name, got {detector!r}")
    if not 0 < scheduler_timeout < float("inf"):
        raise InputError(
            f"--scheduler-timeout must be positive, in seconds, got {scheduler_timeout}"
        )
    if jobs < 1:
        raise InputError(f"--jobs must be at least 1, got {jobs}")
    settings = settings_of(
        weight=weight,
        r0=r0,
        n_grid=n_grid,
        lut=lut,
        refine=refine,
        free_stars=free_stars,
        method=method,
        degree=degree,
        centroids=centroids,
        reference_point=reference_point,
        threshold=threshold,
        min_snr=min_snr,
        max_roundness=max_roundness,
        max_mag=max_mag,
        gain=gain,
        saturation=saturation,
        blind=blind,
        holdout=holdout,
        seed=seed,
    )

    keys = {"exposure_keyword": exposure_key, "camera": not no_camera}
    keys |= by_hand(epoch, pixel_scale, origin)
    keys |= {"mask": mask, "mask_bits": mask_bits, "weight_map": weight_map}
    maps = [path for path in (catalog, mask, weight_map) if path is not None]
    paths = expand_paths(frames, without=maps)
    # Thousands of frames take minutes to read: what else may be wrong is found before.
    page = output / "report.html"
    if report:
        require_free(page, overwrite or resume)
    stored = stored_solutions(solution or [])
    stars = catalog_source(catalog, url=tap_url, cache=cache, max_mag=max_mag)
    if stars is catalog:
        require_catalog_file(catalog)
    cluster = nullcontext() if scheduler is None else cluster_executor(scheduler, scheduler_timeout)
    run = None
    try:
        with cluster as pool, progress_bar(quiet=quiet) as progress:
            loaded = read_files(paths, progress=progress, wcs=wcs, detector=detector, **keys)
            run = calibrate(
                loaded,
                stars,
                solution=stored,
                update=update,
                settings=settings,
                jobs=jobs,
                executor=pool,
                output=output,
                overwrite=overwrite,
                resume=resume,
                keep=False,
                progress=progress,
            )
        if report:
            write_page(output, page, overwrite=overwrite or resume)
    except KeyboardInterrupt as stop:
        if run is None and not getattr(stop, "has_results", False):
            raise
        raise Interrupted from stop
    if not quiet:
        if resume:
            typer.echo(
                f"{len(run.resumed)} of {counted(len(run.summary), 'frame')} skipped: already "
                f"done by run {run.run_id}"
            )
        print_summary(run, output)
        if update:
            print_changes(run)
    state_first_pixel(loaded)
    degraded = [row for row in run.summary if row["status"] == "degraded"]
    for row in degraded[:_MOST_LINES]:
        log.warning("%s: degraded: %s", row["frame"], row["reason"])
    for name, error in list(run.failures.items())[:_MOST_LINES]:
        details = f" (details in {output / ERRORS})" if isinstance(error, InternalError) else ""
        log.error("%s: not solved: %s%s", name, error, details)
    for what, found in (("degraded", degraded), ("not solved", run.failures)):
        if len(found) > _MOST_LINES:
            log.warning(
                "%s %s: see the column 'reason' of %s",
                counted(len(found) - _MOST_LINES, "more frame"), what, output / "summary.ecsv",
            )  # fmt: skip
    if not quiet:
        tell_hints(run.failures, {f.name: f.source for f in loaded}, catalog=catalog, wcs=wcs)
    if any(isinstance(error, InputError) for error in run.failures.values()):
        raise typer.Exit(2)
    if run.failures:
        raise typer.Exit(1)


def stored_solutions(paths):
    """Read the files of ``--solution``.

    Parameters
    ----------
    paths : list of Path
        Solutions and cameras.

    Returns
    -------
    DistortionSolution or dict or None
        A single solution, or several by the names of their detectors; `None` without files.
    """
    from wpdc_gwcs.solution import DistortionSolution

    found, source = {}, {}
    single = None
    for path in paths:
        stored = read_stored(path, "--solution")
        if isinstance(stored, DistortionSolution):
            single, several = stored, {stored.detector: stored}
        else:
            several = stored.solutions
        for name, one in several.items():
            if name in found:
                raise InputError(
                    f"{path}: detector {name!r} already has a solution, in {source[name]}"
                )
            found[name], source[name] = one, path
    if not found:
        return None
    return single if len(paths) == 1 and single is not None else found


def tell_hints(failures, sources, **given):
    """Print what to try with failed frames, once for each kind of reason.

    Parameters
    ----------
    failures : dict
        Errors by frame name.
    sources : dict
        Paths by frame name.
    **given
        As for `hint_of_frame`.
    """
    told = set()
    for name, error in failures.items():
        hint = hint_of_frame(error, sources[name], **given)
        # Hints of the same kind differ only in the frame.
        kind = None if hint is None else hint.replace(shlex.quote(sources[name]), "")
        if kind is not None and kind not in told:
            told.add(kind)
            typer.echo(f"try: {hint}")


def print_changes(run):
    """Print the changes that an update has made.

    Parameters
    ----------
    run : CalibrationRun
        Result of the run.
    """
    for name, solution in run.solutions.items():
        if not solution.statistics.get("updates"):
            continue
        last = solution.statistics["updates"][-1]
        exposures = counted(last["n_exposures"], "exposure")
        if last["process_noise"] == 0:
            typer.echo(f"{name}: no change found, {exposures} added")
            continue
        since = "" if last.get("first_epoch") is None else f" before {last['first_epoch']:.4f},"
        kept = ""
        if name in run.superseded:
            from wpdc_gwcs.calibration.names import superseded_name

            kept = f"; the old solution is in {superseded_name(run.superseded[name])}"
        typer.echo(
            f"{name}: changed{since} by {last['rms_change_px']:.4f} px rms, "
            f"{last['max_change_px']:.4f} px at most ({exposures}, log evidence "
            f"{last['evidence']:.1f}){kept}"
        )


def print_summary(run, folder):
    """Print a line per frame and the folder of the results.

    Parameters
    ----------
    run : CalibrationRun
        Result of the run.
    folder : Path
        Folder of the results.
    """
    shown = run.summary
    if len(shown) > _MOST_LINES:
        typer.echo(f"{len(shown)} frames, see {folder / 'summary.ecsv'}; the last {_MOST_LINES}:")
        shown = shown[-_MOST_LINES:]
    width = max([len("frame"), *(len(name) for name in shown["frame"])])
    typer.echo(
        f"{'frame':<{width}}  status    sources  matched  sigma_dx  sigma_dy  rms_mas  seconds"
    )
    for row in shown:
        typer.echo(
            f"{row['frame']:<{width}}  {row['status']:<8}  {row['n_sources']:7d}  "
            f"{row['n_matched']:7d}  "
            f"{float(row['sigma_dx'].value):8.4f}  {float(row['sigma_dy'].value):8.4f}  "
            f"{float(row['rms_mas'].value):7.2f}  {float(row['seconds'].value):7.2f}"
        )
    n = int(np.sum(run.summary["status"] != "failed"))
    degraded = int(np.sum(run.summary["status"] == "degraded"))
    also = f", {degraded} of them degraded" if degraded else ""
    typer.echo(f"{n} of {len(run.summary)} frames solved{also}; results in {os.fspath(folder)}")
