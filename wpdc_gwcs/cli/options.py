"""Options that several commands share, with configuration files and presets."""

import logging
import math
import tomllib
from importlib.resources import files
from pathlib import Path
from typing import Annotated

import typer

from wpdc_gwcs.cli.app import set_verbosity
from wpdc_gwcs.cli.completion import complete, one_of
from wpdc_gwcs.exceptions import InputError
from wpdc_gwcs.extras import PLOT, require

__all__ = [
    "Blind",
    "Cache",
    "Config",
    "Epoch",
    "Gain",
    "Mask",
    "MaskBits",
    "MaxMag",
    "MaxRoundness",
    "MinSNR",
    "Origin",
    "Overwrite",
    "PixelScale",
    "Preset",
    "Quiet",
    "Saturation",
    "TapUrl",
    "Threshold",
    "Verbose",
    "by_hand",
    "read_numbers",
    "settings_of",
    "state_first_pixel",
    "WeightMap",
    "require_free",
    "require_plotting",
]


log = logging.getLogger("wpdc_gwcs.cli")


def preset_names():
    """Return the names of the presets of the package.

    Returns
    -------
    list of str
        Sorted names.
    """
    folder = files("wpdc_gwcs") / "presets"
    return sorted(
        p.name.removesuffix(".toml") for p in folder.iterdir() if p.name.endswith(".toml")
    )


def _as_defaults(ctx, text, where):
    """Make the options of a TOML text the defaults of the command; typed options still win."""
    try:
        values = tomllib.loads(text)
    except (ValueError, RecursionError) as err:  # numbers of 5,000 digits, and lists in lists
        raise InputError(f"{where}: not valid TOML: {err}") from err
    known = {p.name: p for p in ctx.command.params}
    defaults = dict(ctx.default_map or {})
    for key, value in values.items():
        name = key.replace("-", "_")
        if name not in known or name in ("frames", "config", "preset"):
            raise InputError(f"{where}: unknown option {key!r}; see '{ctx.command_path} --help'")
        if isinstance(value, dict):
            raise InputError(f"{where}: option {key!r} must be a single value, got a table")
        defaults[name] = value
    ctx.default_map = defaults


def _load_preset(ctx: typer.Context, name: str | None):
    if name is None or ctx.resilient_parsing:
        return name
    if name not in preset_names():
        raise typer.BadParameter(
            f"unknown preset {name!r}: must be one of {', '.join(preset_names())}", ctx=ctx
        )
    text = (files("wpdc_gwcs") / "presets" / f"{name}.toml").read_text(encoding="utf-8")
    # A configuration file wins over the preset, even if it comes first on the command line.
    typed = dict(ctx.default_map or {})
    _as_defaults(ctx, text, f"preset {name}")
    ctx.default_map = {**ctx.default_map, **typed}
    return name


def _load_config(ctx: typer.Context, path: Path | None):
    if path is None or ctx.resilient_parsing:
        return path
    from wpdc_gwcs.catalogs import special_file

    if (what := special_file(path)) is not None:
        raise InputError(f"{path}: the configuration must be a file, is {what}")
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError as err:
        raise InputError(f"{path}: no such configuration file") from err
    except (OSError, UnicodeDecodeError) as err:
        raise InputError(f"{path}: cannot read the configuration file: {err}") from err
    _as_defaults(ctx, text, str(path))
    return path


def _verbose(ctx: typer.Context, value: int):
    ctx.meta["wpdc.verbose"] = value
    set_verbosity(value, quiet=ctx.meta.get("wpdc.quiet", False))
    return value


def _quiet(ctx: typer.Context, value: bool):
    ctx.meta["wpdc.quiet"] = value
    set_verbosity(ctx.meta.get("wpdc.verbose", 0), quiet=value)
    return value


Preset = Annotated[
    str | None,
    typer.Option(
        metavar="NAME",
        autocompletion=complete(*preset_names()),
        help=f"Options for a known camera: {', '.join(preset_names())}.",
        callback=_load_preset,
        is_eager=True,
    ),
]
Config = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE.toml",
        help="Options from a TOML file; the command line takes precedence.",
        callback=_load_config,
        is_eager=True,
    ),
]
Threshold = Annotated[
    float,
    typer.Option(metavar="SIGMA", help="Detection threshold above the background."),
]

MinSNR = Annotated[
    float,
    typer.Option(metavar="RATIO", help="Smallest signal-to-noise ratio of sources; 0 keeps all."),
]

Blind = Annotated[
    bool,
    typer.Option(
        "--blind", help="Also try flips, all rotations, scale +-5 %, pointing +-1/4 frame."
    ),
]

Epoch = Annotated[
    str | None,
    typer.Option(
        metavar="DATE",
        help="Epoch of the frames (Julian year, date or MJD), instead of the headers' dates.",
    ),
]

PixelScale = Annotated[
    float | None,
    typer.Option(metavar="ARCSEC", help="Scale in arcsec / px, instead of the headers'."),
]

Origin = Annotated[
    int | None,
    typer.Option(
        **one_of("0", "1"),
        help="Number of the first pixel in tables of sources; default: from the table, else 0.",
    ),
]

MaxRoundness = Annotated[
    float,
    typer.Option(metavar="R", help="Largest difference in roundness from the stars of the frame."),
]
MaxMag = Annotated[
    float | None,
    typer.Option(metavar="MAG", help="Magnitude of the faintest reference stars used."),
]
Gain = Annotated[
    float | None,
    typer.Option(metavar="E/COUNT", help="Electrons per count, instead of the header's value."),
]
Saturation = Annotated[
    float | None,
    typer.Option(metavar="COUNTS", help="Saturation level, instead of the header's value."),
]
Mask = Annotated[
    str | None,
    typer.Option(metavar="FILE[EXT]", help="Mask of bad pixels, instead of the masks in the file."),
]
MaskBits = Annotated[
    int | None,
    typer.Option(
        metavar="SUM", help="Bits of bad pixels in masks; default: from header and pixels."
    ),
]
WeightMap = Annotated[
    str | None,
    typer.Option(
        metavar="FILE[EXT]", help="Inverse variances of the sky, instead of those in the file."
    ),
]

TapUrl = Annotated[
    str | None,
    typer.Option(
        metavar="URL",
        envvar="WPDC_GWCS_TAP_URL",
        help="TAP service for --catalog gaia; default: the Gaia archive at ESA.",
    ),
]
Cache = Annotated[
    Path | None,
    typer.Option(
        metavar="DIR",
        envvar="WPDC_GWCS_CACHE",
        help="Folder for downloaded stars; default: in the user's cache folder.",
    ),
]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace existing files.")]
Verbose = Annotated[
    int,
    typer.Option(
        "-v",
        "--verbose",
        count=True,
        help="Print progress (-vv: details).",
        callback=_verbose,
        show_default=False,
    ),
]
Quiet = Annotated[bool, typer.Option("-q", "--quiet", help="Print errors only.", callback=_quiet)]


def by_hand(epoch, pixel_scale, origin):
    """Check options that replace header values.

    Parameters
    ----------
    epoch : str or None
        Epoch of the frames.
    pixel_scale : float or None
        Pixel scale, arcsec / px.
    origin : int or None
        Number of the first pixel.

    Returns
    -------
    dict
        Keyword arguments of `wpdc_gwcs.io.read_frames`.
    """
    from wpdc_gwcs.io.dates import read_epoch

    if origin not in (None, 0, 1):
        raise InputError(f"--origin must be 0 or 1, got {origin}")
    if pixel_scale is not None and not 0 < pixel_scale < float("inf"):
        raise InputError(f"--pixel-scale must be positive, in arcsec / px, got {pixel_scale:g}")
    try:
        year = None if epoch is None else read_epoch(epoch)
    except ValueError as problem:
        raise InputError(f"--{problem}") from problem
    return {"epoch": year, "pixel_scale": pixel_scale, "origin": origin}


def settings_of(**choices):
    """Build the settings of a calibration.

    Parameters
    ----------
    **choices
        As for `wpdc_gwcs.calibration.Settings`; ``degree`` is the text of the option.

    Returns
    -------
    Settings
        The settings.

    Raises
    ------
    InputError
        If a value is invalid.
    """
    from wpdc_gwcs.calibration import Settings

    try:
        if (degree := choices.get("degree", "auto")).isdigit():
            choices["degree"] = int(degree)
        return Settings(**choices)
    except ValueError as err:
        raise InputError(str(err)) from err


def read_numbers(option, text, n=None, separator=","):
    """Parse an option with several numbers.

    Parameters
    ----------
    option : str
        Name of the option.
    text : str
        Value of the option.
    n : int, optional
        Required count.
    separator : str, optional
        Separator.

    Returns
    -------
    tuple of float
        The numbers, all finite.
    """
    try:
        numbers = tuple(float(part) for part in text.split(separator))
    except ValueError:
        numbers = ()
    if not numbers or n not in (None, len(numbers)) or not all(map(math.isfinite, numbers)):
        what = {None: "numbers", 1: "a number"}.get(n, f"{n} numbers")
        between = "" if n == 1 else f" with {separator!r} between them"
        raise InputError(f"{option} must be {what}{between}, got {text!r}")
    return numbers


def state_first_pixel(frames):
    """Warn of source tables that do not tell whether pixels count from 0 or 1.

    Parameters
    ----------
    frames : list of Frame
        Frames that were read.
    """
    untold = [f.source for f in frames if "nothing tells" in f.meta.get("first_pixel", "")]
    if untold:
        more = f" and {len(untold) - 1} more" if len(untold) > 1 else ""
        log.warning(
            "%s%s: nothing tells whether x and y count from 0 or from 1: the first pixel was taken "
            "to be 0 (--origin 1 if it is 1)",
            untold[0],
            more,
        )


def require_free(path, overwrite, *, format=None):
    """Raise an error if a file exists and may not be replaced, or has the suffix of another format.

    Parameters
    ----------
    path : Path
        File that will be written.
    overwrite : bool
        Whether it may be replaced.
    format : str, optional
        Format that will be written, as for `wpdc_gwcs.io.write`.  Default: any.
    """
    from wpdc_gwcs.io.files import check_suffix

    if format is not None:
        check_suffix(path, format)
    if path.exists() and not overwrite:
        raise InputError(f"{path}: file exists, and is replaced only with --overwrite")


def require_plotting(what):
    """Raise an error unless the packages for figures are installed.

    Parameters
    ----------
    what : str
        What needs them, for the message.
    """
    require(what, "plot", *PLOT)
