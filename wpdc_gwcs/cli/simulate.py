"""`wpdc simulate`: frames with a known distortion, and their truth."""

from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from wpdc_gwcs.cli.app import app
from wpdc_gwcs.cli.completion import complete, one_of
from wpdc_gwcs.cli.options import Overwrite, Quiet, Verbose, read_numbers
from wpdc_gwcs.cli.positions import read_position
from wpdc_gwcs.cli.progress import progress_bar
from wpdc_gwcs.exceptions import InputError

# Above this number, the printed command names the frames by a pattern.
_MOST_NAMED = 8


@app.command(
    "simulate",
    no_args_is_help=True,
    epilog="Example: wpdc simulate --output sky --exposures 3 --distortion 40",
)
def simulate_command(
    output: Annotated[
        Path, typer.Option("--output", metavar="DIR", help="Folder to write to; created if needed.")
    ],
    preset: Annotated[
        str,
        typer.Option(
            metavar="NAME",
            autocompletion=complete("generic", "csst-msc", "bass-90prime"),
            help="Camera: generic (one detector), csst-msc (18 detectors of 9216 x 9232 px) or "
            "bass-90prime (four chips around a common reference point).",
        ),
    ] = "generic",
    detectors: Annotated[
        str | None,
        typer.Option(metavar="NAMES", help="Detectors of the camera, as in g-1,y-4; default all."),
    ] = None,
    exposures: Annotated[
        int, typer.Option(metavar="N", help="Dithered exposures of each field.")
    ] = 5,
    fields: Annotated[
        int | None,
        typer.Option(
            metavar="N",
            help="Number of fields; those without a --center are spread over the sky. Default 1, "
            "or the number of centers.",
        ),
    ] = None,
    center: Annotated[
        list[str] | None,
        typer.Option(
            metavar="RA,DEC",
            help="Center of a field: ICRS in deg, or as 6:48:59,-36:00:18; one for each field.",
        ),
    ] = None,
    images: Annotated[
        int | None,
        typer.Option(
            metavar="N",
            help="How many of the exposures are images; the rest are lists. Default 1 for generic, "
            "else 0.",
        ),
    ] = None,
    sources: Annotated[
        str, typer.Option(**one_of("ldac", "ecsv"), help="Format of the lists.")
    ] = "ldac",
    size: Annotated[
        str | None,
        typer.Option(metavar="PX", help="Size of each detector: 2048, or 4096x2048 (x by y)."),
    ] = None,
    distortion: Annotated[
        float | None,
        typer.Option(metavar="PX", help="Largest displacement; default 40, csst-msc 200."),
    ] = None,
    waves: Annotated[
        float | None,
        typer.Option(metavar="PX", help="Amplitude of fine structure that no cubic can follow."),
    ] = None,
    pixel_scale: Annotated[
        float | None, typer.Option(metavar="ARCSEC", help="Pixel scale.")
    ] = None,
    roll: Annotated[
        float, typer.Option(metavar="DEG", help="Position angle of the camera's y axis.")
    ] = 0.0,
    density: Annotated[
        str | None,
        typer.Option(
            metavar="N",
            help="Stars per square arcmin; LOW:HIGH increases from field to field by equal "
            "factors; 20,50,1000 is one value per field.",
        ),
    ] = None,
    magnitudes: Annotated[
        str | None,
        typer.Option(metavar="BRIGHT,FAINT", help="Magnitudes of the stars."),
    ] = None,
    colors: Annotated[
        str | None,
        typer.Option(metavar="MEAN,SCATTER", help="Colors of the stars (bp_rp); default none."),
    ] = None,
    refraction: Annotated[
        float,
        typer.Option(metavar="MAS", help="Shift toward the zenith per magnitude of color."),
    ] = 0.0,
    lateral_color: Annotated[
        float,
        typer.Option(
            metavar="MAS", help="Outward shift at the farthest corner per magnitude of color."
        ),
    ] = 0.0,
    reference_limit: Annotated[
        float | None,
        typer.Option(
            metavar="MAG", help="Magnitude of the faintest star in the catalog; default all."
        ),
    ] = None,
    catalog_errors: Annotated[
        bool | None,
        typer.Option(
            "--catalog-errors/--no-catalog-errors",
            help="Give the catalog errors like Gaia's; default for all but csst-msc.",
        ),
    ] = None,
    cluster: Annotated[
        float,
        typer.Option(
            metavar="N", help="Stars per square arcmin at the center of a cluster in each field."
        ),
    ] = 0.0,
    core_radius: Annotated[
        float, typer.Option(metavar="ARCSEC", help="Core radius of the cluster (King profile).")
    ] = 20.0,
    tidal_radius: Annotated[
        float, typer.Option(metavar="ARCSEC", help="Radius at which the cluster ends.")
    ] = 400.0,
    galaxies: Annotated[
        float, typer.Option(metavar="N", help="Galaxies per square arcmin, not in the catalog.")
    ] = 0.0,
    cosmic_rays: Annotated[int, typer.Option(metavar="N", help="Cosmic rays in each image.")] = 0,
    epoch: Annotated[
        str | None,
        typer.Option(
            metavar="YEAR",
            help="Epoch of the exposures, or FIRST:LAST; the epoch of the catalog is 2016.",
        ),
    ] = None,
    proper_motion: Annotated[
        float | None,
        typer.Option(metavar="MAS/YR", help="Scatter of the stars' motions per axis."),
    ] = None,
    dither: Annotated[
        float | None,
        typer.Option(metavar="ARCSEC", help="Range of the pointings around the center."),
    ] = None,
    fwhm: Annotated[float | None, typer.Option(metavar="PX", help="Width of the PSF.")] = None,
    spurious: Annotated[
        float | None,
        typer.Option(
            metavar="SHARE", help="Spurious sources in the lists, as a share of the stars."
        ),
    ] = None,
    lost: Annotated[
        float, typer.Option(metavar="SHARE", help="Share of stars missing from the lists.")
    ] = 0.05,
    seed: Annotated[int, typer.Option(metavar="N", help="Another seed gives another camera.")] = 1,
    overwrite: Overwrite = False,
    verbose: Verbose = 0,
    quiet: Quiet = False,
):
    """Simulate exposures with a known distortion, and a catalog.

    Writes images or source lists, CAMERA-reference.fits, truth.asdf (an exact WCS for each frame)
    and STEM.truth.ecsv (star by star), and prints the command that calibrates them.  wpdc evaluate
    --truth DIR scores the result.
    """
    from astropy import units as u

    from wpdc_gwcs.simulation import KingCluster, simulate

    units = {"pixel_scale": u.arcsec, "dither": u.arcsec, "proper_motion": u.mas / u.yr}
    camera = {
        "distortion": distortion,
        "waves": waves,
        "pixel_scale": pixel_scale,
        "fwhm": fwhm,
        "magnitudes": None if magnitudes is None else read_numbers("--magnitudes", magnitudes, 2),
        "image_shape": None if size is None else _shape(size),
    }
    usual = {
        "catalog_errors": catalog_errors,
        "proper_motion": proper_motion,
        "dither": dither,
        "spurious": spurious,
    }
    given = {k: v for k, v in (camera | usual).items() if v is not None}
    given = {k: v * units[k] if k in units else v for k, v in given.items()}
    if images is None:
        images = int(preset == "generic" and exposures > 0)
    if not 0 <= images <= max(exposures, 0):
        raise InputError(f"--images must be between 0 and {exposures}, got {images}")
    if sources not in ("ldac", "ecsv"):
        raise InputError(f"--sources must be ldac or ecsv, got {sources}")
    centers = _centers(center or [], fields, seed)
    try:
        simulation = simulate(
            exposures,
            camera=preset,
            detectors=None if detectors is None else [d.strip() for d in detectors.split(",")],
            seed=seed,
            center=centers,
            roll=roll * u.deg,
            density=None if density is None else _densities(density, centers.size),
            reference_limit=reference_limit,
            cluster=KingCluster(cluster, core_radius * u.arcsec, tidal_radius * u.arcsec)
            if cluster
            else None,
            galaxies=galaxies,
            colors=None if colors is None else read_numbers("--colors", colors, 2),
            refraction=refraction * u.mas,
            lateral_color=lateral_color * u.mas,
            epoch=None if epoch is None else _epochs(epoch, exposures),
            lost=lost,
            **given,
        )
    except ValueError as err:
        raise InputError(str(err)) from err
    first = images * len(simulation.camera.detectors)
    with progress_bar(quiet=quiet) as progress:
        files = write_files(
            simulation,
            output,
            images=range(first),
            sources=sources,
            overwrite=overwrite,
            progress=progress,
            cosmic_rays=cosmic_rays,
        )
    if not quiet:
        for line in _commands(files, output):
            typer.echo(line)


def write_files(simulation, folder, *, sources="ldac", **options):
    """Write a simulation, with errors for the command line.

    Parameters
    ----------
    simulation : Simulation
        Simulation to write.
    folder : Path
        Output folder.
    sources : {"ldac", "ecsv"}, optional
        Form of the source lists.
    **options
        See `wpdc_gwcs.simulation.write_simulation`.

    Returns
    -------
    dict
        See there.
    """
    from wpdc_gwcs.simulation import write_simulation

    try:
        return write_simulation(simulation, folder, sources=sources, **options)
    except FileExistsError as err:
        raise InputError(f"{err}: replaced only with --overwrite") from err


def _commands(files, folder):
    """Commands that calibrate the written frames."""
    frames, catalog = files["frames"], files["reference"]
    if any(header is not None for header in files["headers"]):
        # The command line takes one header, so each table is a run of its own.
        for frame, header in zip(frames, files["headers"], strict=True):
            given = "" if header is None else f" --wcs {header}"
            yield f"wpdc calibrate {frame}{given} --catalog {catalog} --output results"
        return
    names = list(map(str, frames))
    if len(names) > _MOST_NAMED:
        names = [str(p) for p in frames if p.suffix == ".fits"]
        names = names if len(names) <= _MOST_NAMED else [f"{folder}/*-*[0-9].fits"]
        if any(p.suffix == ".ldac" for p in frames):
            names.append(f"{folder}/*.ldac")
    yield f"wpdc calibrate {' '.join(names)} --catalog {catalog} --output results"


def _shape(text):
    try:
        sides = [int(part) for part in text.lower().split("x")]
    except ValueError:
        sides = []
    if len(sides) not in (1, 2):
        raise InputError(f"--size must be like 2048 or 4096x2048, got {text!r}")
    return sides[-1], sides[0]


def _densities(text, n_fields):
    if ":" not in text:
        return read_numbers("--density", text)
    low, high = read_numbers("--density", text, 2, ":")
    if not 0 < low <= high:
        raise InputError(f"--density LOW:HIGH must be positive and increasing, got {text!r}")
    return np.geomspace(low, high, n_fields)


def _epochs(text, n_exposures):
    if ":" not in text:
        return read_numbers("--epoch", text, 1)[0]
    return np.linspace(*read_numbers("--epoch", text, 2, ":"), max(n_exposures, 1))


def _centers(texts, fields, seed):
    """Centers of the fields: the given ones, and random ones on the sky for the rest."""
    from astropy.coordinates import SkyCoord

    ra, dec = [], []
    for text in texts:
        parts = [part.strip() for part in text.split(",")]
        if len(parts) != 2:
            raise InputError(f"--center must be RA,DEC, got {text!r}")
        a, d = read_position(parts, "--center")
        ra.append(a % 360)
        dec.append(d)
    n = max(len(ra), 1) if fields is None else fields
    if n < max(len(ra), 1):
        raise InputError(f"--fields must be at least {max(len(ra), 1)}, got {n}")
    if not ra and n == 1:
        ra, dec = [120.0], [30.0]
    rng = np.random.default_rng([seed, 1] if seed >= 0 else 0)
    ra += rng.uniform(0, 360, n)[len(ra) :].tolist()
    dec += np.rad2deg(np.arcsin(rng.uniform(-1, 1, n)))[len(dec) :].tolist()
    return SkyCoord(ra, dec, unit="deg")
