"""Source lists: conversion of the columns of other programs to those of this package.

::

    table (FITS, ECSV, IRAF, DAOPHOT, ...) --standardize_sources--> x, y from zero, errors, flags

Here, pixels are counted from zero.  A list is counted from one if its columns are those of
SExtractor, or if it says so: files of astrometry.net (``AN_FILE``), IRAF and DAOPHOT, or words in a
header, comment or description.
"""

import logging
import re
import warnings

import numpy as np
from astropy.table import Table

from wpdc_gwcs.catalogs import read_lines, read_table_file
from wpdc_gwcs.columns import find_name, listed, read_numbers, spelled_names
from wpdc_gwcs.copies import group_copies
from wpdc_gwcs.counts import counted
from wpdc_gwcs.exceptions import FrameError, WPDCWarning
from wpdc_gwcs.flags import FLAG_BAD_PIXEL, FLAG_BLENDED, FLAG_EDGE, FLAG_SATURATED
from wpdc_gwcs.io.files import READ_ERRORS, first_line, open_fits
from wpdc_gwcs.io.headers import header_value

__all__ = [
    "load_fits_sources",
    "position_columns",
    "read_source_table",
    "source_origin",
    "standardize_sources",
]

log = logging.getLogger(__name__)

# Families of position columns, best first: x, y, first pixel.  SExtractor and the tables of
# Cambridge (CASU, WFCAM) count from one; photutils and the Rubin pipelines count from zero.
_FAMILIES = (
    ("x", "y", None),
    ("x_centroid", "y_centroid", 0),
    ("xcentroid", "ycentroid", 0),
    ("x_fit", "y_fit", 0),
    ("xpsf_image", "ypsf_image", 1),
    ("xwin_image", "ywin_image", 1),
    ("xmodel_image", "ymodel_image", 1),
    ("x_image", "y_image", 1),
    ("x_coordinate", "y_coordinate", 1),
    ("base_sdsscentroid_x", "base_sdsscentroid_y", 0),
    ("slot_centroid_x", "slot_centroid_y", 0),
    ("field_x", "field_y", 1),
    ("xcenter", "ycenter", None),
    ("x_center", "y_center", None),
    ("xcen", "ycen", None),
    ("xc", "yc", None),
    ("xpos", "ypos", None),
    ("x_pix", "y_pix", None),
    ("xpix", "ypix", None),
)
_TAGS = {"xpsf_image": "psf", "xwin_image": "win", "xmodel_image": "model", "x_image": ""}
_PLAIN_ERRORS = (("x_err", "y_err"), ("x_error", "y_error"), ("xerr", "yerr"))
_FLUXES = (
    "flux",
    "flux_psf",
    "flux_auto",
    "flux_fit",
    "flux_model",
    "flux_best",
    "flux_iso",
    "flux_aper",
)
_MAGNITUDES = ("mag_psf", "mag_auto", "mag_best", "mag_iso", "mag_aper", "mag")
_WANTED = {
    *(c for family in _FAMILIES for c in family[:2]),
    *(c for pair in _PLAIN_ERRORS for c in pair),
    *(
        f"{kind}{tag}_image"
        for tag in ("psf", "win", "model", "")
        for kind in ("erra", "errb", "errtheta", "errx2", "erry2")
    ),
    *_FLUXES,
    *(f.replace("flux", "fluxerr") for f in _FLUXES),
    *_MAGNITUDES,
    *("snr_win", "snr", "roundness", "flags", "flags_win", "imaflags_iso", "elongation"),
    *("sharpness", "fwhm", "fwhm_image", "flux_radius", "peak", "flux_max"),
}


# Keywords and words that indicate the first pixel.
_FROM = (
    r"\b({word}|{digit})[- ]?(based|index)|\borigin\W+(is |at )?\W*{digit}\b"
    r"|\b(pixel|coordinate|position|x, ?y)\w*\b[^.;]{{0,40}}\b(from|at|with) \W*({word}|{digit})\b"
    r"|\bfirst pixel\b.{{0,12}}\b{digit}(\.0)?, *{digit}\b"
)
_FROM_ONE = re.compile(
    _FROM.format(word="one", digit="1")
    + r"|\bFITS (pixel )?(convention|pixels)|DAOPHOT|DAOFIND|ALLSTAR|ALLFRAME",
    re.IGNORECASE,
)
_FROM_ZERO = re.compile(
    _FROM.format(word="zero", digit="0") + r"|\bphotutils\b|\bwpdc_gwcs\b", re.IGNORECASE
)
# In the header of an image, this says nothing about a list that was made later.
_IRAF = re.compile(r"\bIRAF\b")
# Files of astrometry.net, whose X and Y are FITS pixels.
_MARKS_OF_ONE = ("AN_FILE",)
_ORIGIN_KEYS = ("PIXORIG", "PIX_ORIG", "PIXEL_ORIGIN", "XYORIGIN", "XYORIG", "PIXBASE", "INDEXING")
# Sources within this distance are one source, because no program separates closer ones.
_COPY_REACH = 1.0  # px
# By chance, a few sources in a thousand have a neighbor within their errors.  A list with more than
# this fraction was stacked from several lists.
_MOST_BY_CHANCE = 0.01


def position_columns(names):
    """Find the position columns.

    Parameters
    ----------
    names : sequence of str
        Names of the columns.

    Returns
    -------
    (str, str, int or None) or None
        Names of the columns x and y, and the number of the first pixel, which is `None` if the
        names do not show it; `None` if there are no such columns.
    """
    spelled = spelled_names(names)
    for x, y, origin in _FAMILIES:
        if x in spelled and y in spelled:
            # SExtractor leaves the errors out if few PSF fits converged.
            if x == "xpsf_image" and "errapsf_image" not in spelled:
                continue
            return spelled[x], spelled[y], origin
    if "xpsf_image" in spelled and "ypsf_image" in spelled:
        return spelled["xpsf_image"], spelled["ypsf_image"], 1
    return None


def source_origin(names, headers=(), texts=()):
    """Find the number of the first pixel of a list.

    Parameters
    ----------
    names : sequence of str
        Names of the columns.
    headers : sequence of `~astropy.io.fits.Header`, optional
        Headers of the list.
    texts : sequence of str, optional
        Comments and descriptions.

    Returns
    -------
    int or None
        0 or 1; `None` if there is no indication.
    """
    found = position_columns(names)
    if found is not None and found[2] is not None:
        return found[2]
    if any(_IRAF.search(text) for text in texts):
        return 1
    for header in headers:
        if any(header_value(header, key) is not None for key in _MARKS_OF_ONE):
            return 1
        for key in _ORIGIN_KEYS:
            value = header_value(header, key)
            if value in (0, 1, "0", "1"):
                return int(value)
        texts = [*texts, *(f"{c.keyword} {c.value} {c.comment}" for c in header.cards)]
    for text in texts:
        for origin, pattern in ((1, _FROM_ONE), (0, _FROM_ZERO)):
            if pattern.search(text):
                return origin
    return None


def load_fits_sources(path, index, *, origin=0):
    """Load a source list from a table of a FITS file.

    Parameters
    ----------
    path : path-like
        FITS file.
    index : int
        Number of the extension.
    origin : int, optional
        Number of the first pixel.

    Returns
    -------
    `~astropy.table.Table`
        Table as from `standardize_sources`.

    Raises
    ------
    FrameError
        If the table is damaged or has no positions.
    """
    where = f"{path}[{index}]"
    with open_fits(path, error=FrameError, lazy=True) as hdus:
        try:
            columns = hdus[index].columns
            data = hdus[index].data
            needed = {c: np.array(data[c]) for c in columns.names if c.lower() in _WANTED}
            for column in columns:
                if column.name in needed and column.null is not None:
                    values = needed[column.name]
                    needed[column.name] = np.where(values == int(column.null), np.nan, values)
        except READ_ERRORS as problem:
            raise FrameError(f"{where}: damaged source list: {first_line(problem)}") from problem
    return standardize_sources(needed, name=where, origin=origin)


def read_source_table(path):
    """Read a source list that is not FITS.

    Parameters
    ----------
    path : path-like
        File with a table that astropy can read, or a list of DAOPHOT.

    Returns
    -------
    table : `~astropy.table.Table`
        Table as in the file.
    texts : list of str
        Comments, keywords and descriptions in the file.

    Raises
    ------
    FrameError
        If the file cannot be read or has no positions.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with open(path, "rb") as file:
                is_daophot = re.match(rb"\s*NL\s+NX\s+NY\s", file.read(80)) is not None
            table = _read_daophot(path) if is_daophot else read_table_file(path)
    except READ_ERRORS as problem:
        raise FrameError(
            f"{path}: neither FITS nor a readable table of sources: {first_line(problem)}"
        ) from problem
    found = position_columns(table.colnames)
    if found is None:
        raise FrameError(
            f"{path}: table of sources must have columns 'x' and 'y' (zero based; or X_IMAGE, "
            f"Y_IMAGE), has {listed(table.colnames)}"
        )
    texts = [_text_of(key, value) for key, value in table.meta.items()]
    texts += [str(getattr(table[c], "description", None) or "") for c in found[:2]]
    return table, texts


def _text_of(key, value):
    if isinstance(value, dict):
        return " ".join(_text_of(k, v) for k, v in value.items())
    if isinstance(value, list | tuple):
        return f"{key} {' '.join(map(str, value))}"
    return f"{key} {value}"


def _read_daophot(path):
    """Read a list of Stetson's DAOPHOT: three header lines, then one or more lines per star.

    The files of FIND, PEAK, NSTAR and ALLSTAR have one line for each star, those of PHOTOMETRY an
    empty line and two more (NL = 2).  All begin with identifier, x, y and magnitude.
    """
    lines = read_lines(path)
    kind = int(lines[1].split()[0])
    rows = [line.split() for line in lines[3:]]
    if kind == 2:
        rows = [r for r, before in zip(rows[1:], rows[:-1], strict=True) if r and not before]
    rows = [r for r in rows if r]
    table = Table(
        {name: [r[k] for r in rows] for k, name in enumerate(("id", "x", "y", "mag"))},
        meta={"comments": ["DAOPHOT"]},
    )
    return table


def standardize_sources(table, *, name="sources", origin=None):
    """Convert a source list to the columns of this package.

    Parameters
    ----------
    table : mapping
        Table or dictionary of columns, with names of this package, photutils or SExtractor.
    name : str, optional
        Name of the list in messages.
    origin : int, optional
        Number of the first pixel.  Default: that of the column names, or else 0.

    Returns
    -------
    sources : `~astropy.table.Table`
        Columns ``x``, ``y`` (zero based) and, if the list has them, ``x_err``, ``y_err``, ``flux``,
        ``snr``, ``roundness``, ``flags``, ``sharpness``, ``fwhm``, ``peak`` and ``mag``.  The rows
        are those of the input.

    Raises
    ------
    FrameError
        If there are no positions, or none of them is a number.

    Warns
    -----
    WPDCWarning
        If rows or columns cannot be read, or rows are copies of others, whose positions become NaN.

    Notes
    -----
    Errors of SExtractor are ellipses (``ERRAWIN_IMAGE``, ...), of which the extent along x and y is
    used.  ``ELONGATION`` e becomes the roundness 2 (e - 1) / (e + 1), which is that of DAOFIND for
    a source elongated along an axis.  The lowest bit of SExtractor's ``FLAGS`` (a neighbor in the
    aperture) is ignored, because it does not concern the centroid.
    """
    names = list(getattr(table, "colnames", table))
    found = position_columns(names)
    if found is None:
        raise FrameError(f"{name}: source list must have positions, has {listed(names)}")
    x, y, usual = found
    spelled = spelled_names(names)
    origin = (usual or 0) if origin is None else origin

    def column(*aliases):
        label = find_name(spelled, aliases)
        if label is None:
            return None
        try:
            return read_numbers(table[label], several=True)[0]
        except ValueError as problem:
            warnings.warn(f"{name}: column {label!r} {problem}: it is left out", WPDCWarning)
            return None

    out = {"x": _position(table, x, name) - origin, "y": _position(table, y, name) - origin}
    tag = _TAGS.get(x.lower())
    errors = _ellipse(column, tag) if tag is not None else None
    if errors is None:
        errors = next(
            ((column(a), column(b)) for a, b in _PLAIN_ERRORS if a in spelled and b in spelled),
            None,
        )
    if errors is not None and all(e is not None for e in errors):
        # In SExtractor, an error of zero means that it is unknown.
        out["x_err"], out["y_err"] = (np.where(e > 0, e, np.nan) for e in errors)
    fluxes = _FLUXES if tag == "psf" else tuple(f for f in _FLUXES if f != "flux_psf")
    flux_name = next((f for f in fluxes if f in spelled), None)
    if flux_name is not None:
        out["flux"] = column(flux_name)
    else:
        magnitude = column(*_MAGNITUDES)
        if magnitude is not None:
            # 99 means that there is no magnitude.
            faint = np.where(np.abs(magnitude) < 90.0, magnitude, np.nan)
            out["flux"] = 10.0 ** (-0.4 * (faint - 25.0))
    out["snr"] = column("snr", "snr_win")
    if out["snr"] is None and flux_name is not None:
        error = column(flux_name.replace("flux", "fluxerr"))
        if error is not None and out["flux"] is not None:
            out["snr"] = out["flux"] / np.where(error > 0, error, np.nan)
    out["roundness"] = column("roundness")
    if out["roundness"] is None and (elongation := column("elongation")) is not None:
        out["roundness"] = 2.0 * (elongation - 1.0) / (elongation + 1.0)
    out["sharpness"] = column("sharpness")
    out["fwhm"] = column("fwhm", "fwhm_image")
    if out["fwhm"] is None and (radius := column("flux_radius")) is not None:
        out["fwhm"] = 2.0 * radius
    out["peak"] = column("peak", "flux_max")
    flags = column("flags")
    if flags is not None:
        flags = np.clip(np.nan_to_num(flags), 0, 2**31).astype(np.int64)
        out["flags"] = flags if tag is None else _sextractor_flags(flags, column("imaflags_iso"))
    sources = Table({c: v for c, v in out.items() if v is not None})
    again, stacked = _copies(sources)
    if again.any():
        message = (
            f"{name}: {again.sum()} of {len(sources)} rows repeat a source that another row has: "
            "one row per source is used"
        )
        if stacked:
            warnings.warn(message, WPDCWarning)
        else:
            log.info("%s", message)
        sources["x"][again] = sources["y"][again] = np.nan
    return sources


def _position(table, label, name):
    """Pixel coordinates of one axis; NaN where a cell cannot be read."""
    try:
        values, unreadable = read_numbers(table[label], several=True)
    except ValueError as problem:
        raise FrameError(f"{name}: column {label!r} {problem}") from None
    if unreadable.any():
        row = int(np.flatnonzero(unreadable)[0])
        warnings.warn(
            f"{name}: {unreadable.sum()} of {counted(len(values), 'row')} left out: column "
            f"{label!r} cannot be read ({str(table[label][row])!r} in row {row})",
            WPDCWarning,
        )
    return values


def _copies(sources):
    """Mark repeated rows of sources, and return whether there are too many for chance."""
    again = np.zeros(len(sources), bool)
    rows = np.flatnonzero(np.isfinite(sources["x"]) & np.isfinite(sources["y"]))
    if len(rows) < 2:
        return again, False
    part = sources[rows]
    errors = (
        np.hypot(part["x_err"], part["y_err"]) / np.sqrt(2) if "x_err" in sources.colnames else None
    )
    mag = None
    if "flux" in sources.colnames:
        mag = -2.5 * np.log10(np.where(part["flux"] > 0, part["flux"], np.nan))
    points = np.column_stack([part["x"], part["y"]])
    star = group_copies(points, reach=_COPY_REACH, errors=errors, mag=mag)
    rank = np.zeros(len(rows)) if errors is None else np.nan_to_num(errors, nan=np.inf)
    order = np.lexsort((rows, rank, star))
    again[rows[order[1:]]] = star[order][1:] == star[order][:-1]
    in_place = len(np.unique(points, axis=0)) < len(points)
    return again, in_place or again.sum() > _MOST_BY_CHANCE * len(rows)


def _sextractor_flags(flags, external):
    """Translate FLAGS and IMAFLAGS_ISO of SExtractor."""
    ours = np.zeros_like(flags)
    # 2 deblended, 4 saturated, 8 truncated, 16 aperture incomplete, above: memory overflows
    for theirs, flag in (
        (2, FLAG_BLENDED),
        (4, FLAG_SATURATED),
        (8 | 16, FLAG_EDGE),
        (32 | 64 | 128, FLAG_BAD_PIXEL),
    ):
        ours[flags & theirs != 0] |= flag
    if external is not None:
        ours[np.nan_to_num(external) != 0] |= FLAG_BAD_PIXEL
    return ours


def _ellipse(column, tag):
    """Errors along x and y from an error ellipse or from variances."""
    a, b = column(f"erra{tag}_image"), column(f"errb{tag}_image")
    if a is not None and b is not None:
        theta = column(f"errtheta{tag}_image")
        theta = np.zeros_like(a) if theta is None else np.radians(theta)
        c2, s2 = np.cos(theta) ** 2, np.sin(theta) ** 2
        return np.sqrt(a**2 * c2 + b**2 * s2), np.sqrt(a**2 * s2 + b**2 * c2)
    x2, y2 = column(f"errx2{tag}_image"), column(f"erry2{tag}_image")
    if x2 is not None and y2 is not None:
        return np.sqrt(np.maximum(x2, 0.0)), np.sqrt(np.maximum(y2, 0.0))
    return None
