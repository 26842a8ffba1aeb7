"""Hints what to try next, for every kind of error, in one place.

A hint is a command, or an option of the command that failed.  The first matching rule applies; a
message that already says what to do needs no hint.
"""

import difflib
import os
import re
import shlex
from pathlib import Path

from wpdc_gwcs.exceptions import InternalError
from wpdc_gwcs.extras import PLOT, missing

__all__ = ["hint_of", "hint_of_frame", "similar_option"]

# Names of options in other programs, and ours; the first that the command has is suggested.
_OTHER_NAMES = {
    "--report --plots --output": "plot plots figure figures image images picture pictures png pdf",
    "--output": "o out outdir output-dir outfile out-file dest dir d",
    "--overwrite": "f force clobber replace",
    "--jobs": "j n np nproc ncores cores cpus threads processes workers parallel",
    "--catalog": "c cat ref refcat reference reference-catalog astref gaia stars",
    "--wcs": "h w header head ahead",
    "--pixel-scale": "scale pixscale",
    "--max-mag": "mag mag-limit mag-max maglim limit",
    "--min-snr": "snr sn",
    "--threshold": "sigma detect-thresh thresh",
    "--epoch": "date mjd time obs-date",
    "--degree": "deg order polynomial distort-degrees",
    "--weight-map": "weights wht",
    "--config": "config-file settings params",
    "--detector": "chip ccd",
    "--solution": "distortion model camera prior",
    "--resume": "continue restart",
    "--saturation": "satur satur-level",
    "--refine": "fit",
}

# Messages of errors that end a command, and hints; "{path}" is the path that begins the message.
_OF_COMMANDS = (
    (
        r".*summary\.ecsv: must be a readable file: No such file"
        r"|.*the folder has no \*\.(?:matches\.ecsv|wcs\.asdf)",
        "the output folder of wpdc calibrate",
    ),
    (
        r"[^;]*needs a \*\.solution\.asdf or \*\.camera\.asdf file[^;]*$",
        "the file of this name that wpdc calibrate has written",
    ),
    (
        r"(?P<path>.+?): (?:catalog must be an existing file|must be a readable file: No such file"
        r"|no such file|no such configuration file)",
        "_similar",
    ),
    (
        r"(?P<path>.+?): catalog must have columns 'ra'",
        "rename its columns to ra and dec, in degrees",
    ),
    (
        r"(?P<path>.+?): columns .* must have a unit",
        "wpdc catalog prepare with a copy of it that has units",
    ),
    (
        r"(?P<path>.+?): (?:header must have a celestial WCS|a table of sources needs a WCS header"
        r"|must hold a header with CTYPE1|.*CD matrix must not be singular|card \S+ is missing"
        r"|.*CTYPE1 and CTYPE2 must)",
        "--wcs HEADER, with the header of another exposure, a .head file or a text file",
    ),
    (r"(?P<path>.+?): header must have the pixel scale", "--pixel-scale ARCSEC, or --wcs HEADER"),
    (
        r"(?P<path>.+?): the shape of the detector must be given",
        "--wcs HEADER, with NAXIS1 and NAXIS2 in it",
    ),
    (
        r"(?P<path>.+?): (?:truncated|damaged|must not be empty|.*must agree with its CHECKSUM)",
        "get the file again, or leave it out",
    ),
    (
        r"(?P<path>.+?): must have an image, FITS_LDAC sources or a table",
        "wpdc show {path}, which says what it is",
    ),
    (
        r"(?P<path>.+?): must have a 'wpdc' tree",
        "wpdc show {path}, which says what it is",
    ),
    (r"(?P<path>.+?): .*\bthe manifest of a run", "wpdc show {folder}"),
    (
        r".*not a manifest of a run|.*must come from the same run as its tables",
        "--overwrite to start over, or another --output",
    ),
    (r".*another solution", "the --solution of that run, or another --output"),
    (
        r".*(?:No space left|File too large|Disk quota)",
        "another --output, on a disk with free space",
    ),
    (
        r"--scheduler (?P<path>\S+): must have a worker",
        "dask worker {path}, on machines that see the files",
    ),
    (r"--scheduler .*: no Dask scheduler", "dask scheduler, which prints its address"),
    (r"a distortion of .* is not invertible", "a smaller --distortion, or a larger --size"),
    (
        r".*: not the same (?:exposure|detector)",
        "--any-exposure if the header of the image is wrong, or the WCS file of this image",
    ),
    (r".*would both write", "different names, or one run for each of them"),
    (r"exposure .*left out|all \d+ exposures were left out", "wpdc explain FRAME --catalog CAT"),
)
# Reasons of failed frames, and hints.
_EXPLAIN = "wpdc explain {frame} --catalog {catalog}{wcs}{picture}"
_OF_FRAMES = (
    (r".*is the right ascension in hours", "--wcs HEADER, with the right ascension in degrees"),
    (r".*the catalog has no star within", "--wcs HEADER if the header is wrong, or a catalog of "
     "this field: wpdc catalog prepare gaia --around {frame} --output gaia.fits"),
    (r".*too few reference stars", "a deeper catalog: wpdc catalog prepare gaia --around {frame} "
     "--output gaia.fits"),
    (r".*of (?:different|another) shapes?|.*the frame has shape", "a run of its own for frames of "
     "this shape, without --solution"),
    (r".*the frame is from detector", "--detector NAME if the header is wrong, or another "
     "--solution"),
    (r".*it cannot be updated", "a run of these frames without --update"),
    (r".*those of the stored solution by", "a run without --solution; wpdc monitor tests whether "
     "the solution is still valid"),
    (r".*contradicts those of the other detectors", "--no-camera if this header is right"),
    (r".*could be fitted; at least", "more exposures of this detector in one run, or its stored "
     "--solution"),
    (r".*its process died", "fewer --jobs, so that each has more memory"),
    (r".*cannot be handed to another process", "--jobs 1"),
    (r".*must be (?:a|an) .*px|.*is a cube|.*centroids 'given'|.*has no rows", None),
    (r".*image is flat|.*no finite, unmasked pixel", "wpdc show {frame}{look}"),
    (r".*no source above", "wpdc detect {frame} --threshold 3 --output sources.ecsv"),
    (r".*signal-to-noise ratio above", "--min-snr 5; if the gain is wrong, --gain"),
)  # fmt: skip


def hint_of(message, command=""):
    """Return a hint for an error that ends a command.

    Parameters
    ----------
    message : str
        Message of the error.
    command : str, optional
        Command that failed, such as ``show`` or ``catalog info``; it is not suggested for the same
        file again.

    Returns
    -------
    str or None
        The hint; None if the message itself says what to do.
    """
    for pattern, hint in _OF_COMMANDS:
        found = re.match(pattern, message, re.DOTALL)
        if found:
            parts = found.groupdict()
            path = parts.get("path") or ""
            if hint == "_similar":
                return _similar(path)
            folder = shlex.quote(str(Path(path).parent))
            hint = hint.format(path=shlex.quote(path), folder=folder)
            again = f"wpdc {command} {shlex.quote(path)}" if command and path else None
            return None if again and f"{hint},".startswith(f"{again},") else hint
    return None


def hint_of_frame(error, source, *, catalog, wcs=None):
    """Return a hint for a frame that was not solved.

    Parameters
    ----------
    error : WPDCError
        The reason.
    source : str
        Path of the frame.
    catalog : str
        Catalog on the command line.
    wcs : str, optional
        Header on the command line.

    Returns
    -------
    str or None
        The hint; None if the reason itself says what to do.
    """
    can_draw = not missing(*PLOT)
    parts = {
        "frame": shlex.quote(source),
        "catalog": shlex.quote(catalog),
        "wcs": "" if wcs is None else f" --wcs {shlex.quote(wcs)}",
        "picture": " --output why.png" if can_draw else "",
        "look": " --output look.png" if can_draw else "",
    }
    for pattern, hint in _OF_FRAMES:
        if re.match(pattern, str(error), re.DOTALL):
            return None if hint is None else hint.format(**parts)
    if isinstance(error, InternalError):
        return "the same command with --resume; if it fails again, please report it"
    if isinstance(error, OSError):
        return None
    return hint_of(str(error)) or _EXPLAIN.format(**parts)


def similar_option(name, options):
    """Return the option that was probably meant.

    Parameters
    ----------
    name : str
        What was typed, such as ``--plots`` or ``-o``.
    options : list of str
        Options of the command.

    Returns
    -------
    str or None
        One of `options`; None if none is similar.
    """
    word = name.lstrip("-").lower().replace("_", "-")
    ours = (option for option, names in _OTHER_NAMES.items() if word in names.split())
    for option in next(ours, "").split():
        if option in options:
            return option
    long = [option for option in options if option.startswith("--")]
    begin = [option for option in long if len(word) > 1 and option.startswith(f"--{word}")]
    return next(iter(begin or difflib.get_close_matches(f"--{word}", long, n=1, cutoff=0.7)), None)


def _similar(path):
    """Suggest an existing file with a similar name, or name the missing folder."""
    path = Path(re.sub(r"\[[^\[\]]*\]$", "", path))
    folder = path.parent
    if not folder.is_dir():
        while not folder.is_dir() and folder != folder.parent:
            missing, folder = folder, folder.parent
        return f"another folder: there is no {missing}"
    # The same name in other letters comes first.
    names = {name.casefold(): name for name in sorted(os.listdir(folder))}
    close = difflib.get_close_matches(path.name.casefold(), names, n=1, cutoff=0.75)
    return f"{shlex.quote(str(folder / names[close[0]]))}, which is there" if close else None
