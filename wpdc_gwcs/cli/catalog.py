"""`wpdc catalog`: prepare and describe reference catalogs."""

import logging
import re
import warnings
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from wpdc_gwcs.cli.app import app
from wpdc_gwcs.cli.inputs import expand_paths
from wpdc_gwcs.cli.options import (
    Cache,
    Overwrite,
    Quiet,
    TapUrl,
    Verbose,
    read_numbers,
    require_free,
)
from wpdc_gwcs.cli.positions import read_position
from wpdc_gwcs.description import as_text
from wpdc_gwcs.exceptions import InputError
from wpdc_gwcs.extras import require

log = logging.getLogger("wpdc_gwcs.cli")

catalog_app = typer.Typer(
    no_args_is_help=True, rich_markup_mode=None, help="Prepare or inspect a reference catalog."
)
app.add_typer(catalog_app, name="catalog")

Cone = Annotated[
    str | None,
    typer.Option(
        metavar="RA,DEC,RADIUS",
        help="Part of the sky: a cone, deg; the center also as 12:34:56.7,-01:02:03.",
    ),
]
Box = Annotated[
    str | None,
    typer.Option(
        metavar="WEST,EAST,SOUTH,NORTH",
        help="Part of the sky: range of right ascension (from WEST up to EAST) and Dec, deg.",
    ),
]
Around = Annotated[
    list[str] | None,
    typer.Option(metavar="FRAME", help="Part of the sky: around this frame; can be repeated."),
]

# Purpose of columns, reported if they are missing.
_PURPOSES = {
    "pmra": "stars stay where they were at the epoch of the catalog",
    "ref_epoch": "2016.0 is assumed",
    "phot_g_mean_mag": "bright stars cannot be matched first, and --max-mag has no effect",
    "ra_error": "all stars have the same weight",
    "pmra_error": "errors of positions do not grow with time",
    "parallax": "no annual parallax",
    "ra_pmra_corr": "errors at the epoch of a frame ignore correlations",
    "radial_velocity": "no perspective motion",
    "ruwe": "binaries have the same weight as single stars",
    "bp_rp": "no refraction or lateral color",
}


@catalog_app.command(
    "prepare",
    no_args_is_help=True,
    epilog="Example: wpdc catalog prepare gaia --around image.fits --output gaia.fits",
)
def prepare_command(
    catalogs: Annotated[
        list[str],
        typer.Argument(metavar="CAT", help="Files, 'gaia', 'hats:PATH'; several are merged."),
    ],
    output: Annotated[
        Path,
        typer.Option(
            "--output", metavar="FILE", help="Table to write: .fits, .ecsv, .csv, .vot or .parquet."
        ),
    ],
    cone: Cone = None,
    box: Box = None,
    around: Around = None,
    min_mag: Annotated[
        float | None, typer.Option(metavar="MAG", help="Magnitude of the brightest stars to keep.")
    ] = None,
    max_mag: Annotated[
        float | None, typer.Option(metavar="MAG", help="Magnitude of the faintest stars to keep.")
    ] = None,
    max_ruwe: Annotated[
        float | None,
        typer.Option(metavar="RUWE", help="Largest RUWE; 1.4 keeps single stars."),
    ] = None,
    max_error: Annotated[
        float | None,
        typer.Option(metavar="MAS", help="Largest error of the position along either axis."),
    ] = None,
    tap_url: TapUrl = None,
    cache: Cache = None,
    overwrite: Overwrite = False,
    verbose: Verbose = 0,
    quiet: Quiet = False,
):
    """Cut, merge and clean reference catalogs, and write one table.

    The columns of the table have the names and units of Gaia.  Duplicate rows of a star are
    merged, keeping the best values.  A missing value never excludes a star.
    """
    from astropy.table import vstack

    from wpdc_gwcs.catalogs import read_catalog
    from wpdc_gwcs.catalogs.overview import distrusted
    from wpdc_gwcs.columns import numbers_or_nan
    from wpdc_gwcs.exceptions import WPDCWarning

    require_free(output, overwrite)
    form = _format_of(output)
    region, inside = _sky(cone, box, around)
    options = {"tap_url": tap_url, "cache": cache, "max_mag": max_mag}
    parts = [_read(name, region, **options) for name in catalogs]
    merged = parts[0]
    n_read = sum(map(len, parts))
    if len(parts) > 1:
        stacked = vstack(parts, metadata_conflicts="silent")
        stacked.meta.clear()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", WPDCWarning)
            merged = read_catalog(stacked) if len(stacked) else stacked
    counts = {"read": n_read, "repeated rows of a star": n_read - len(merged)}
    mag = numbers_or_nan(merged, "phot_g_mean_mag")
    broken = {"outside the region": ~inside(merged)}
    if min_mag is not None:
        broken[f"brighter than {min_mag:g}"] = mag < min_mag
    if max_mag is not None:
        broken[f"fainter than {max_mag:g}"] = mag > max_mag
    broken |= distrusted(merged, max_ruwe=max_ruwe, max_error=max_error)
    keep = np.ones(len(merged), bool)
    for rule, mask in broken.items():
        counts[rule] = int(np.sum(keep & mask))
        keep &= ~mask
    if not keep.any():
        told = ", ".join(f"{rule}: {n}" for rule, n in counts.items())
        raise InputError(f"{output}: no stars are left ({told})")
    kept = merged[keep]
    kept.remove_column("catalog_index")
    kept.meta.clear()
    _write(kept, output, form, overwrite=overwrite)
    if not quiet:
        for rule, n in counts.items():
            if n:
                typer.echo(f"{n:10d}  {rule}")
        typer.echo(f"{len(kept):10d}  written to {output}")


@catalog_app.command("info", no_args_is_help=True, epilog="Example: wpdc catalog info gaia.fits")
def info_command(
    catalog: Annotated[str, typer.Argument(metavar="CAT", help="A file, 'gaia' or 'hats:PATH'.")],
    cone: Cone = None,
    box: Box = None,
    around: Around = None,
    tap_url: TapUrl = None,
    cache: Cache = None,
    verbose: Verbose = 0,
    quiet: Quiet = False,
):
    """Describe a catalog: area, epoch, columns, stars by magnitude."""
    region, inside = _sky(cone, box, around)
    stars = _read(catalog, region, tap_url=tap_url, cache=cache)
    stars = stars[inside(stars)]
    if len(stars) == 0:
        raise InputError(f"{catalog}: has no stars in this part of the sky")
    for line in as_text(list(lines_about(stars))):
        typer.echo(line)
    from wpdc_gwcs.catalogs.overview import count_by_magnitude

    rows = count_by_magnitude(stars)
    if len(rows):
        typer.echo("\n   mag      stars  per sq. deg  with motion  error mas")
    for row in rows:
        typer.echo(
            f"{row['mag_from'].value:3.0f}-{row['mag_to'].value:<3.0f} {row['n']:9d}  "
            f"{row['density'].value:11.1f}  {100 * row['with_motion']:9.1f} %  "
            f"{row['position_error'].value:9.3f}"
        )


def lines_about(stars):
    """Describe a catalog.

    Parameters
    ----------
    stars : `~astropy.table.Table`
        As returned by `read_catalog`.

    Yields
    ------
    label, text : str
        Label and text of a line.
    """
    from wpdc_gwcs.catalogs.overview import sky_area
    from wpdc_gwcs.columns import numbers_or_nan

    ra, dec = (np.asarray(stars[name], float) for name in ("ra", "dec"))
    # From the end of the widest gap, so that the range may include RA 0.
    order = np.sort(ra)
    gaps = np.diff(order, append=order[0] + 360)
    west, east = order[(np.argmax(gaps) + 1) % len(order)], order[np.argmax(gaps)]
    yield "stars", f"{len(stars)}"
    yield (
        "sky",
        f"RA {west:.4f} to {east:.4f}, Dec {dec.min():.4f} to {dec.max():.4f} deg, about "
        f"{sky_area(stars):.3g} square degrees",
    )
    epochs = numbers_or_nan(stars, "ref_epoch")
    if np.isfinite(epochs).any():
        low, high = np.nanmin(epochs), np.nanmax(epochs)
        yield "epoch", f"{low:g}" if low == high else f"{low:g} to {high:g}"
    present = [name for name in stars.colnames if name != "catalog_index"]
    yield "columns", ", ".join(present)
    for name, purpose in _PURPOSES.items():
        if name not in present:
            yield "lacks", f"{name}: {purpose}"
    for name in ("pmra", "parallax", "radial_velocity", "bp_rp", "ruwe"):
        if name in present:
            known = np.isfinite(numbers_or_nan(stars, name)).mean()
            yield "known", f"{name} for {100 * known:.1f} % of the stars"
    if "ruwe" in present:
        yield "RUWE", f"{int(np.sum(numbers_or_nan(stars, 'ruwe') > 1.4))} above 1.4"


def _read(name, region, *, tap_url=None, cache=None, max_mag=None):
    from wpdc_gwcs.catalogs import catalog_source, read_catalog

    source = catalog_source(name, url=tap_url, cache=cache, max_mag=max_mag)
    if region is None and hasattr(source, "stars_of"):
        raise InputError(
            f"{source}: name the part of the sky: --cone RA,DEC,RADIUS, "
            "--box WEST,EAST,SOUTH,NORTH or --around FRAME"
        )
    return read_catalog(source, region=region)


def _sky(cone, box, around):
    """Region to read, and a function that selects the stars inside."""
    from wpdc_gwcs.catalogs import Region

    if sum(bool(given) for given in (cone, box, around)) > 1:
        raise InputError("only one of --cone, --box and --around may be given")
    try:
        if cone:
            region = Region(*_cone(cone))
        elif box:
            west, east, south, north = read_numbers("--box", box, 4)
            region = Region.box(west, east, south, north)
            width = (east - west) % 360.0 or 360.0

            def in_box(stars):
                ra, dec = (np.asarray(stars[name], float) for name in ("ra", "dec"))
                return ((ra - west) % 360 <= width) & (dec >= south) & (dec <= north)

            return region, in_box
        elif around:
            region = _region_of(around)
        else:
            return None, lambda stars: np.ones(len(stars), bool)
    except ValueError as problem:
        raise InputError(f"--{'cone' if cone else 'box'}: {problem}") from problem
    return region, lambda stars: region.contains(
        np.asarray(stars["ra"], float), np.asarray(stars["dec"], float)
    )


def _cone(text):
    cells = re.split(r"[,\s]+", text.strip())
    if len(cells) != 3:
        raise InputError(f"--cone must be RA,DEC,RADIUS, got {text!r}")
    position = read_position(cells[:2], "--cone")
    return *position, *read_numbers("the radius of --cone", cells[2], 1)


def _region_of(paths):
    from wpdc_gwcs.calibration import Settings
    from wpdc_gwcs.calibration.matched import sky_of_frame
    from wpdc_gwcs.catalogs import Region
    from wpdc_gwcs.io import read_files

    cones = [sky_of_frame(frame, Settings()) for frame in read_files(expand_paths(paths))]
    cones = [cone for cone in cones if cone is not None]
    if not cones:
        raise InputError("--around: no frame has a WCS that places it on the sky")
    return Region(*zip(*cones, strict=True))


_FORMATS = {
    ".fits": "fits",
    ".fit": "fits",
    ".ecsv": "ascii.ecsv",
    ".csv": "ascii.csv",
    ".vot": "votable",
    ".xml": "votable",
    ".parquet": "parquet",
    ".pq": "parquet",
}


def _format_of(path):
    form = _FORMATS.get(path.suffix.lower())
    if form is None:
        raise InputError(f"{path}: must end with one of {', '.join(_FORMATS)}")
    if form == "parquet":
        require(path, "hats", "pyarrow")
    return form


def _write(table, path, form, *, overwrite):
    from wpdc_gwcs.catalogs.parquet import write_parquet
    from wpdc_gwcs.io import atomic_path

    with atomic_path(path, overwrite=overwrite) as temporary:
        if form == "parquet":
            write_parquet(table, temporary)
        else:
            table.write(temporary, format=form, overwrite=True)
