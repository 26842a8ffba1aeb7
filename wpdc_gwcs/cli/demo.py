"""`wpdc demo`: from a simulation to a WCS that is compared with the truth."""

import time
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from wpdc_gwcs.cli.app import app
from wpdc_gwcs.cli.options import Overwrite, Quiet, Verbose, require_plotting
from wpdc_gwcs.cli.progress import progress_bar
from wpdc_gwcs.cli.simulate import write_files
from wpdc_gwcs.exceptions import InputError

# The demo fails if the error of the delivered WCS exceeds this, px rms.
DEMO_LIMIT = 0.02


@app.command("demo", epilog="Example: wpdc demo --output demo")
def demo_command(
    output: Annotated[
        Path, typer.Option("--output", metavar="DIR", help="Folder to write to; created if needed.")
    ] = Path("wpdc-demo"),
    seed: Annotated[int, typer.Option(metavar="N", help="Another seed gives another camera.")] = 1,
    overwrite: Overwrite = False,
    verbose: Verbose = 0,
    quiet: Quiet = False,
):
    """Simulate and calibrate exposures, and compare with the truth.

    The camera has 40 px of distortion.  Of five exposures, one is an image and four are source
    lists.  All inputs, results and pictures are kept in the output folder.  The exit status is 1 if
    the error of the WCS exceeds 0.02 px rms.
    """
    from wpdc_gwcs.calibration import calibrate
    from wpdc_gwcs.io import read_frames
    from wpdc_gwcs.simulation import simulate

    require_plotting("the demo")
    began = time.perf_counter()
    try:
        simulation = simulate(5, distortion=40.0, seed=seed)
    except ValueError as err:
        raise InputError(str(err)) from err
    files = write_files(simulation, output / "input", images=(0,), overwrite=overwrite)
    frames = [frame for path in files["frames"] for frame in read_frames(path)]
    with progress_bar(quiet=quiet) as progress:
        run = calibrate(
            frames, files["reference"], output=output, overwrite=overwrite, progress=progress
        )
    for name, error in run.failures.items():
        typer.echo(f"wpdc: error: {name}: not solved: {error}", err=True)
    solved = {calibration.frame: calibration for calibration in run.calibrations}
    truth = [e for e in simulation.exposures if e.name in solved]
    errors = [e.wcs_error(solved[e.name].wcs) for e in truth]
    if errors:
        draw_demo(truth[0], solved[truth[0].name], errors[0], output / "pictures")
    seconds = time.perf_counter() - began
    worst = max((float(np.sqrt(np.mean(e[2] ** 2 + e[3] ** 2))) for e in errors), default=np.inf)
    if not quiet:
        print_demo(simulation, solved, errors, output, seconds)
    if run.failures or not worst <= DEMO_LIMIT:
        raise typer.Exit(1)


def draw_demo(exposure, calibration, error, folder):
    """Draw the pictures of the demo: before and after, residuals, look-up table.

    Parameters
    ----------
    exposure : SimulatedExposure
        The exposure, with its truth.
    calibration : Calibration
        Its calibration.
    error : tuple of ndarray
        Grid positions and error of the calibrated WCS, px.
    folder : Path
        Folder for the pictures.
    """
    from wpdc_gwcs import plotting
    from wpdc_gwcs.io.files import make_folder

    make_folder(folder)
    shape = exposure.image_shape
    table = calibration.solution.lookup_table
    figures = {
        "before.png": plotting.plot_residual_arrows(
            *exposure.wcs_error(exposure.wcs), image_shape=shape, title="Header: error of the WCS"
        ),
        "after.png": plotting.plot_residual_arrows(
            *error, image_shape=shape, title="Calibrated: error of the WCS"
        ),
        "residuals.png": plotting.plot_residuals_vs_position(calibration.matches),
    }
    if table is not None:
        figures["lookup_table.png"] = plotting.plot_lookup_table(table)
    for name, figure in figures.items():
        figure.savefig(folder / name, dpi=110)


def print_demo(simulation, solved, errors, output, seconds):
    """Print the error of each exposure against its truth, before and after calibration.

    Parameters
    ----------
    simulation : Simulation
        Exposures with their truth.
    solved : dict
        Calibrations by exposure name.
    errors : list of tuple
        Errors on a grid for each solved exposure.
    output : Path
        Folder of the results.
    seconds : float
        Duration, s.
    """
    typer.echo("                stars           error of the WCS against the truth [px]")
    typer.echo("exposure      matched   header rms   calibrated rms     90 %      max")
    remaining = iter(errors)
    for exposure in simulation.exposures:
        before = np.hypot(*exposure.wcs_error(exposure.wcs)[2:])
        line = f"{exposure.name:<12}"
        if exposure.name not in solved:
            typer.echo(f"{line}  not solved")
            continue
        after = np.hypot(*next(remaining)[2:])
        typer.echo(
            f"{line} {solved[exposure.name].statistics['n_matched']:8d} "
            f"{np.sqrt(np.mean(before**2)):12.3f} {np.sqrt(np.mean(after**2)):16.4f} "
            f"{np.percentile(after, 90):8.4f} {after.max():8.4f}"
        )
    if errors:
        total = np.concatenate([np.hypot(*e[2:]) for e in errors])
        typer.echo(f"All exposures: {np.sqrt(np.mean(total**2)):.4f} px rms off the truth")
    typer.echo(f"{seconds:.1f} s; WCS files, tables and pictures are in {output}")
