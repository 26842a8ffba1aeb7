"""Simulations written to files, as the command line reads them."""

from pathlib import Path

import numpy as np
from astropy.io import fits
from astropy.table import Table

__all__ = ["write_simulation"]


def write_simulation(
    simulation, directory, *, images=(0,), sources="ecsv", overwrite=False, **render_options
):
    """Write a simulation to files, as `wpdc calibrate` reads them.

    Parameters
    ----------
    simulation : Simulation
        The simulation.
    directory : path-like
        Folder to write to; made where it is missing.
    images : sequence of int, optional
        Exposures (counted from 0) that are written as rendered images; the others as source lists.
    sources : {"ecsv", "ldac"}, optional
        Form of the source lists: a table beside a text header, or FITS_LDAC.
    overwrite : bool, optional
        Replace files that are already there.
    **render_options
        Passed to `SimulatedExposure.render`.

    Returns
    -------
    dict
        ``"reference"``: path of the catalog; ``"frames"``: list with one path per exposure, image
        or source list; ``"headers"``: list of paths of the text headers, `None` where the frame has
        its own.

    Raises
    ------
    ValueError
        If the form of the source lists is unknown.
    FileExistsError
        If a file is there already and ``overwrite`` is not set.
    """
    if sources not in ("ecsv", "ldac"):
        raise ValueError(f"sources must be 'ecsv' or 'ldac', not {sources!r}")
    directory = Path(directory)
    suffix = {"ecsv": ".cat.ecsv", "ldac": ".ldac"}[sources]
    paths = [directory / f"{simulation.exposures[0].detector}-reference.fits"]
    frames, headers = [], []
    for k, exposure in enumerate(simulation.exposures):
        is_image = k in images
        frames.append(directory / (exposure.name + (".fits" if is_image else suffix)))
        has_own = is_image or sources == "ldac"
        headers.append(None if has_own else directory / f"{exposure.name}.hdr")
    paths += [p for p in frames + headers if p is not None]
    for path in paths:
        if path.exists() and not overwrite:
            raise FileExistsError(f"{path} exists; overwrite is not set")
    directory.mkdir(parents=True, exist_ok=True)
    simulation.reference.write(paths[0], overwrite=True)
    for k, exposure in enumerate(simulation.exposures):
        if k in images:
            image = exposure.render(**render_options)
            fits.writeto(frames[k], image, exposure.header, overwrite=True)
        elif sources == "ecsv":
            exposure.sources.write(frames[k], format="ascii.ecsv", overwrite=True)
            exposure.header.totextfile(headers[k], overwrite=True)
        else:
            _write_ldac(exposure, frames[k])
    return {"reference": paths[0], "frames": frames, "headers": headers}


def _write_ldac(exposure, path):
    s = exposure.sources
    cards = [str(card).ljust(80).encode("ascii") for card in exposure.header.cards]
    cards.append(b"END".ljust(80))
    # Padded with blanks: readers in C take a NUL for the end of the header.
    text = np.frombuffer(b"".join(cards), np.uint8).reshape(1, len(cards), 80)
    imhead = fits.BinTableHDU.from_columns(
        [fits.Column("Field Header Card", f"{text.size}B", dim=f"(80, {len(cards)})", array=text)],
        name="LDAC_IMHEAD",
    )
    imhead.header["TFORM1"] = f"{text.size}A"
    columns = {
        "XWIN_IMAGE": s["x"] + 1,  # FITS_LDAC counts pixels from 1
        "YWIN_IMAGE": s["y"] + 1,
        "ERRAWIN_IMAGE": s["x_err"],
        "ERRBWIN_IMAGE": s["y_err"],
        "ERRTHETAWIN_IMAGE": np.zeros(len(s)),
        "FLUX_AUTO": s["flux"],
        "FLUXERR_AUTO": s["flux"] / s["snr"],
        "FLAGS": np.zeros(len(s), np.int16),
    }
    objects = fits.BinTableHDU(Table(columns), name="LDAC_OBJECTS")
    fits.HDUList([fits.PrimaryHDU(), imhead, objects]).writeto(path, overwrite=True)
