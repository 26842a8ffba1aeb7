"""Single stages from the shell: `detect` and `match`."""

import logging
from pathlib import Path
from typing import Annotated

import typer

from wpdc_gwcs.cli.app import app
from wpdc_gwcs.cli.calibrate import Catalog, WcsFile
from wpdc_gwcs.cli.completion import one_of
from wpdc_gwcs.cli.options import (
    Blind,
    Cache,
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
    Quiet,
    Saturation,
    TapUrl,
    Threshold,
    Verbose,
    WeightMap,
    by_hand,
    require_free,
    settings_of,
    state_first_pixel,
)
from wpdc_gwcs.counts import counted
from wpdc_gwcs.exceptions import InputError

log = logging.getLogger("wpdc_gwcs.cli")

Table = Annotated[Path, typer.Option("--output", metavar="FILE", help="Table to write (ECSV).")]


def one_frame(path, **options):
    """Read a file with a single frame.

    Parameters
    ----------
    path : str
        FITS image or source list; ``path[EXT]`` chooses an extension.
    **options
        As for `wpdc_gwcs.io.read_frames`.

    Returns
    -------
    Frame
        The frame.
    """
    from wpdc_gwcs.io import read_frames

    frames = read_frames(path, **options)
    if len(frames) > 1:
        names = ", ".join(frame.source for frame in frames)
        raise InputError(f"{path}: has {len(frames)} frames; choose one with path[EXT]: {names}")
    return frames[0]


@app.command(
    "detect", no_args_is_help=True, epilog="Example: wpdc detect image.fits --output sources.ecsv"
)
def detect_command(
    frame: Annotated[str, typer.Argument(metavar="IMAGE", help="FITS image, path or path[EXT].")],
    output: Table,
    centroids: Annotated[
        str, typer.Option(**one_of("psf", "windowed"), help="How positions are measured.")
    ] = "psf",
    threshold: Threshold = 5.0,
    min_snr: MinSNR = 10.0,
    gain: Gain = None,
    saturation: Saturation = None,
    mask: Mask = None,
    mask_bits: MaskBits = None,
    weight_map: WeightMap = None,
    overwrite: Overwrite = False,
    verbose: Verbose = 0,
    quiet: Quiet = False,
):
    """Detect the stars of an image and measure their positions."""
    from wpdc_gwcs.calibration import measure_sources
    from wpdc_gwcs.io import write_table

    require_free(output, overwrite, format="ecsv")
    settings = settings_of(
        centroids=centroids,
        threshold=threshold,
        min_snr=min_snr,
        gain=gain,
        saturation=saturation,
    )
    planes = {"mask": mask, "mask_bits": mask_bits, "weight_map": weight_map}
    sources = measure_sources(one_frame(frame, **planes), settings)
    write_table(sources, output, overwrite=overwrite)
    if not quiet:
        clean = int((sources["flags"] == 0).sum())
        typer.echo(f"{output}: {counted(len(sources), 'source')}, {clean} of them without flags")


@app.command(
    "match",
    no_args_is_help=True,
    epilog="Example: wpdc match image.fits --catalog gaia.fits --output pairs.ecsv",
)
def match_command(
    frame: Annotated[
        str,
        typer.Argument(metavar="FRAME", help="FITS image, FITS_LDAC list, or table with --wcs."),
    ],
    catalog: Catalog,
    output: Table,
    wcs: WcsFile = None,
    epoch: Epoch = None,
    pixel_scale: PixelScale = None,
    origin: Origin = None,
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
    overwrite: Overwrite = False,
    verbose: Verbose = 0,
    quiet: Quiet = False,
):
    """Match the sources of a frame to a catalog.

    The exit status is 1 if there is not enough evidence for a match.
    """
    import numpy as np

    from wpdc_gwcs.calibration import match_frame
    from wpdc_gwcs.catalogs import catalog_source
    from wpdc_gwcs.io import write_table
    from wpdc_gwcs.matching import pair_table

    require_free(output, overwrite, format="ecsv")
    settings = settings_of(
        blind=blind,
        min_snr=min_snr,
        max_roundness=max_roundness,
        max_mag=max_mag,
        gain=gain,
        saturation=saturation,
    )
    given = by_hand(epoch, pixel_scale, origin)
    given |= {"mask": mask, "mask_bits": mask_bits, "weight_map": weight_map}
    one = one_frame(frame, wcs=wcs, **given)
    source = catalog_source(catalog, url=tap_url, cache=cache, max_mag=max_mag)
    matched = match_frame(one, source, settings)
    if one.epoch is None and "pmra" in matched.reference.colnames:
        log.warning("%s: no epoch is known: proper motions were not applied (--epoch)", one.source)
    i, j = matched.pairs
    x, y = (np.asarray(matched.sources[name], float)[i] for name in ("x", "y"))
    ra, dec = (np.asarray(matched.reference[name], float)[j] for name in ("ra", "dec"))
    table = pair_table(
        matched.diagnostics,
        source_index=i,
        catalog_index=matched.reference["catalog_index"][j],
        detector=(x, y),
        sky=(ra, dec),
        start=matched.start.pixels(*matched.wcs.pixel_to_world_values(x, y)),
        reference=matched.start.pixels(ra, dec),
    )
    write_table(table, output, overwrite=overwrite)
    state_first_pixel([one])
    if not quiet:
        found = matched.diagnostics
        typer.echo(
            f"{output}: {counted(len(table), 'pair')}, {found.expected_by_chance:.1f} expected by "
            f"chance ({found.significance:.1f} sigma), purity {found.purity:.4f}, "
            f"{found.n_ambiguous} ambiguous left out"
        )
