"""Exchange of WCSs with other programs: `export`, `convert`."""

import contextlib
import logging
from pathlib import Path
from typing import Annotated

import typer

from wpdc_gwcs.cli.app import app
from wpdc_gwcs.cli.completion import one_of
from wpdc_gwcs.cli.files import read_one, wcs_files
from wpdc_gwcs.cli.options import Overwrite, Quiet, Verbose, require_free
from wpdc_gwcs.columns import listed
from wpdc_gwcs.counts import counted
from wpdc_gwcs.exceptions import InputError

log = logging.getLogger("wpdc_gwcs.cli")

# The deviation in SWarp is reported if it exceeds that of other readers by this factor and is not
# negligible.
_AS_GOOD = 1.1
_TOLD_PX = 1e-3
FORMATS = ("fits", "cpdis", "tpv", "head", "sip", "tab", "stock")
# Names of files in a folder: STEM.head, STEM.stock.asdf, STEM.sip.fits...
_SUFFIXES = {"head": ".head", "stock": ".stock.asdf"}

Degree = Annotated[
    int | None,
    typer.Option(
        metavar="N",
        help="Degree of the polynomials: 1 to 7, or 2 to 9 for sip. Default: for fits and cpdis "
        "that of the solution, otherwise the lowest one that is accurate to 0.001 px or nearly as "
        "good as any other.",
    ),
]


@app.command(
    "export",
    no_args_is_help=True,
    epilog="Example: wpdc export results/image.wcs.asdf --format sip --into image.fits",
)
def export_command(
    files: Annotated[
        list[Path],
        typer.Argument(
            metavar="FILE...",
            help="*.wcs.asdf, *.solution.asdf or exported FITS files; folders of *.wcs.asdf.",
        ),
    ],
    format: Annotated[
        str | None,
        typer.Option(
            "--format",
            **one_of("fits", "cpdis", "tpv", "head", "sip", "tab", "stock"),
            help="fits: TPV and table, exact for wpdc; cpdis: for astropy.wcs; tpv, head: TPV "
            "fitted to everything, for SWarp, SCAMP, GalSim (FITS or text); sip: for DS9; tab: for "
            "wcslib; stock: gwcs alone. Default with --into: tpv.",
        ),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            metavar="OUT",
            help="File to write, or a folder for STEM.head, STEM.sip.fits and so on (created if "
            "needed for several FILEs); with --into, a copy.",
        ),
    ] = None,
    into: Annotated[
        str | None,
        typer.Option(
            metavar="IMAGE[EXT]",
            help="Replace the WCS of this image; with several FILEs or a folder of results, the "
            "WCSs of its extensions.",
        ),
    ] = None,
    degree: Degree = None,
    alternates: Annotated[
        str,
        typer.Option(
            **one_of("keep", "remove"), help="With --into: keep or remove alternate WCSs."
        ),
    ] = "keep",
    any_exposure: Annotated[
        bool,
        typer.Option(
            "--any-exposure",
            help="With --into: do not compare the date, the detector and the field of the image "
            "with those of FILE.",
        ),
    ] = False,
    overwrite: Overwrite = False,
    verbose: Verbose = 0,
    quiet: Quiet = False,
):
    """Write a WCS in a format for other programs.

    The deviation of the written WCS from the exact one is printed.  With --into, a folder of
    results stands for the WCS files of the image.
    """
    if format is None and into is not None:
        format = "tpv"
    if format is None:
        raise InputError(f"export needs --format, one of {', '.join(FORMATS)}, or --into IMAGE")
    if format not in FORMATS:
        raise InputError(f"--format must be one of {', '.join(FORMATS)}, got {format!r}")
    if into is None and output is None:
        raise InputError("export needs --output FILE or DIR, or --into IMAGE")
    if alternates not in ("keep", "remove"):
        raise InputError(f"--alternates must be keep or remove, got {alternates!r}")
    if into is not None:
        if output is not None:
            require_free(output, overwrite, format=format)
        lines = _into(files, into, format, degree, output, alternates, any_exposure, overwrite)
    else:
        lines = _one_by_one(files, output, format, degree, overwrite)
    for line in lines:
        if not quiet:
            typer.echo(line)


def _one_by_one(files, output, format, degree, overwrite):
    """Write a file for each file; yield what to print."""
    found = wcs_files(files)
    places = _places(found, output, format, in_folder=found != files or len(files) > 1)
    for place in places.values():
        require_free(place, overwrite, format=format)
    for file, place in places.items():
        calibration = read_one(file)
        with _as_input_error():
            note = write_as(calibration, place, format, degree=degree, overwrite=overwrite)
        yield f"{place}: written as {format}{note}"


@contextlib.contextmanager
def _as_input_error():
    try:
        yield
    except ValueError as err:
        raise InputError(str(err)) from err


def _places(files, output, format, *, in_folder):
    """File to write for each file; a folder that is needed is made."""
    if not in_folder and not output.is_dir():
        return {files[0]: output}
    from wpdc_gwcs.io.files import make_folder, stem_of

    suffix = _SUFFIXES.get(format, f".{format}.fits")
    places = {file: output / (stem_of(file).removesuffix(".wcs") + suffix) for file in files}
    origins = {}
    for file, place in places.items():
        if (other := origins.setdefault(place, file)) != file:
            raise InputError(f"{other} and {file} would both write {place}")
    make_folder(output)
    return places


def _into(files, image, format, degree, output, alternates, any_exposure, overwrite):
    """Write one WCS into an image, or all of its extensions at once; return what to print."""
    from wpdc_gwcs.catalogs.files import split_extension
    from wpdc_gwcs.io.assignment import require_same_exposure
    from wpdc_gwcs.io.embed import INTO_FORMS, image_numbers, write_into

    if format not in INTO_FORMS:
        raise InputError(
            f"--format must be one of {', '.join(INTO_FORMS)} with --into, got {format!r}"
        )
    path, extension = split_extension(image)
    folder = any(file.is_dir() for file in files)
    if extension is not None and (folder or len(files) > 1):
        raise InputError(
            f"--into {image} takes one FILE; without [{extension}], all extensions are written"
        )
    target = image if output is None else output
    if folder or len(files) > 1 or (extension is None and len(image_numbers(path)) > 1):
        given, owners = _calibrations_of(files, path, any_exposure)
        places = [f"{target}[{number}]: {owners[number].name}" for number in given]
    else:
        given, places = read_one(files[0]), [f"{target}:"]
        if not any_exposure:
            require_same_exposure(image, files[0], given)
    with _as_input_error():
        made = write_into(
            given,
            image,
            form=format,
            degree=degree,
            output=output,
            alternates=alternates,
            overwrite=overwrite,
        )
    forms = made.values() if isinstance(made, dict) else [made]
    return [
        f"{place} written as {format}{_note(one)}" for place, one in zip(places, forms, strict=True)
    ]


def _calibrations_of(files, image, any_exposure):
    """Calibrations for the extensions of an image by their numbers, and the files they are from."""
    from wpdc_gwcs.io.assignment import assign_extensions, frames_of_image

    frames = frames_of_image(image)
    names = [f"{frame.name}.wcs.asdf" for frame in frames.values()]
    found = []
    for file in files:
        inside = [file]
        if file.is_dir() and not (inside := [file / n for n in names if (file / n).exists()]):
            raise InputError(f"{file}: has no WCS file of {image}, such as {names[0]}")
        found += inside
    calibrations = {file: read_one(file) for file in dict.fromkeys(found)}
    owners = assign_extensions(image, frames, calibrations, any_exposure=any_exposure)
    left = [frames[number].name for number in sorted(set(frames) - set(owners))]
    if left:
        log.warning("%s: no WCS for %s: left as it was", image, listed(left, kind="frames"))
    return {number: calibrations[file] for number, file in owners.items()}, owners


def write_as(calibration, output, format, *, degree=None, overwrite=False):
    """Write a calibration in a format, and describe the accuracy.

    Parameters
    ----------
    calibration : Calibration or DistortionSolution
        Calibration to write.
    output : Path
        File to write.
    format : str
        One of the formats of `wpdc_gwcs.io.write`.
    degree : int, optional
        Degree of the polynomials.
    overwrite : bool, optional
        Whether an existing file may be replaced.

    Returns
    -------
    note : str
        Text to print after the name of the format.
    """
    from wpdc_gwcs.export import FORMS
    from wpdc_gwcs.io import write
    from wpdc_gwcs.io.fits import write_form

    if format in FORMS:
        return _note(
            write_form(calibration, output, form=format, degree=degree, overwrite=overwrite)
        )
    worst = write(calibration, output, format=format, degree=degree, overwrite=overwrite)
    return _greatest(worst)


def _greatest(worst):
    return "" if worst is None else f" (greatest deviation {worst:.2g} px)"


def _note(made):
    if (made.swarp_deviation or 0.0) > max(_AS_GOOD * (made.deviation or 0.0), _TOLD_PX):
        return (
            f" (greatest deviation {made.deviation:.2g} px, in SWarp {made.swarp_deviation:.2g} px)"
        )
    if made.form != "fits":
        return _greatest(made.deviation)
    exact = "exact" if made.deviation is None else f"greatest deviation {made.deviation:.2g} px"
    if made.keywords_deviation is None:
        return f" ({exact} for wpdc_gwcs)"
    return (
        f" ({exact} for wpdc_gwcs, {made.keywords_deviation:.2g} px for readers of its keywords "
        "without the table)"
    )


@app.command(
    "convert",
    no_args_is_help=True,
    epilog="Example: wpdc convert jwst.asdf --to tpv --output jwst.tpv.fits",
)
def convert_command(
    file: Annotated[
        str,
        typer.Argument(
            metavar="FILE",
            help="ASDF with a gwcs, FITS or FITS[EXT] with any WCS, .head or text header.",
        ),
    ],
    to: Annotated[
        str,
        typer.Option(
            **one_of("asdf", "fits", "cpdis", "tpv", "head", "sip", "tab", "stock"),
            help="asdf: as wpdc calibrate writes it; the others: as for wpdc export.",
        ),
    ],
    output: Annotated[Path, typer.Option("--output", metavar="OUT", help="File to write.")],
    size: Annotated[
        tuple[int, int] | None,
        typer.Option(metavar="NX NY", help="Size of the image, if it is not in the file."),
    ] = None,
    degree: Degree = None,
    overwrite: Overwrite = False,
    verbose: Verbose = 0,
    quiet: Quiet = False,
):
    """Convert the WCS of any file to the models and formats of wpdc.

    The deviation of the written WCS from the original one is printed.
    """
    from wpdc_gwcs.camera import Camera
    from wpdc_gwcs.io.any_wcs import read_any

    formats = ("asdf", *FORMATS)
    if to not in formats:
        raise InputError(f"--to must be one of {', '.join(formats)}, got {to!r}")
    if size is not None and min(size) < 2:
        raise InputError(f"--size must be two numbers of 2 or more, got {size[0]} {size[1]}")
    require_free(output, overwrite, format=to)
    found = read_any(file, image_shape=None if size is None else size[::-1])
    if isinstance(found, Camera):
        raise InputError(
            f"{file}: is a camera of {counted(len(found.detectors), 'detector')}, not a single WCS"
        )
    try:
        note = write_as(found, output, to, degree=degree, overwrite=overwrite)
    except ValueError as err:
        raise InputError(str(err)) from err
    if not quiet:
        worst = found.statistics.get("conversion_deviation")
        read = "read exactly" if worst is None else f"read to {worst:.2g} px"
        typer.echo(f"{output}: {read}, written as {to}{note}")
