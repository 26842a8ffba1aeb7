"""Contents of a file, in words and as a picture.

::

    file or folder --contents_of--> Contents: lines of a label and a text, and a picture
"""

import re
import warnings
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from wpdc_gwcs.counts import counted
from wpdc_gwcs.exceptions import FileFormatError, FrameError, InputError

__all__ = ["Contents", "contents_of"]

# Maximum number of rows shown; the rest is counted.
_MOST_ROWS = 20
# The selection is that of a run without options.
_BY_DEFAULT = " by default"
# Bytes of a text that are searched for cards and marks.
_MOST_BYTES = 20_000
_CARD = re.compile(r"(CTYPE|CRVAL|CRPIX|CUNIT|CD|PC|PV|NAXIS|CDELT|WCSAXES)[\d_]* *=")
# Maps that belong to images, by the meaning of their pixels.
_MAPS = {
    "mask": "mask",
    "weight": "weight map",
    "error": "map of errors",
    "variance": "map of variances",
}
_PAGE = re.compile(rb"\s*(<\?xml[^>]*>\s*)?<(!doctype\s+html|html)\b", re.IGNORECASE)


@dataclass(frozen=True, eq=False)
class Contents:
    """Contents of a file.

    Parameters
    ----------
    lines : list of (str, str)
        Labels and texts.
    draw : callable, optional
        Returns a picture, a `matplotlib.figure.Figure`; `None` if there is nothing to draw.
    """

    lines: list
    draw: Callable | None = None


def contents_of(file):
    """Find out what a file is.

    Parameters
    ----------
    file : str
        Path of a file, ``path[EXT]``, or a folder.

    Returns
    -------
    Contents
        The description.

    Raises
    ------
    InputError
        If it cannot be read, or is of no use for this package; the message says what it is.
    """
    from wpdc_gwcs.catalogs import split_extension
    from wpdc_gwcs.io.files import file_kind

    path, _ = split_extension(file)
    if path.is_dir():
        return _of_folder(path)
    kind = file_kind(path)
    if kind == "asdf":
        return _of_asdf(file, path)
    if kind == "text":
        return _of_text(file, path)
    found = _map_in(path)
    return _of_fits(file) if found is None else _of_map(path, *found)


def _of_folder(path):
    from wpdc_gwcs.cli.inventory import inventory_of
    from wpdc_gwcs.io import read_table

    if not (path / "summary.ecsv").is_file():
        inventory = inventory_of(path)
        if not inventory:
            raise InputError(f"{path}: must be a folder of results, is an empty folder")
        return Contents([("folder", inventory), ("results", "none: it has no summary.ecsv")])
    found = _of_table(path, read_table(path / "summary.ecsv"))
    lines = list(found.lines)
    for kind, ending in (("WCS", "wcs"), ("solutions", "solution"), ("cameras", "camera")):
        names = sorted(found.name for found in path.glob(f"*.{ending}.asdf"))
        if names:
            more = f", ... ({len(names)} files)" if len(names) > 3 else ""
            lines.append((kind, ", ".join(names[:3]) + more))
    return Contents(lines, found.draw)


def _of_result(file):
    from wpdc_gwcs.description import describe
    from wpdc_gwcs.io import read
    from wpdc_gwcs.pictures import draw_camera, draw_solution

    found = read(file)
    if hasattr(found, "solutions"):
        return Contents(describe(found), lambda: draw_camera(found))
    solution, sigma = getattr(found, "solution", found), getattr(found, "sigma", None)
    return Contents(describe(found), lambda: draw_solution(solution, sigma))


def _of_asdf(file, path):
    from wpdc_gwcs.io.asdf import read_asdf_wcs, read_entry

    if isinstance(read_entry(path, "wpdc"), dict):
        return _of_result(file)
    if isinstance(read_entry(path, "truth"), dict):
        return _of_truth(path)
    try:
        wcs = read_asdf_wcs(path)
    except FileFormatError:
        # The message for any other file.
        return _of_result(file)
    lines = [("WCS", f"a gwcs from {' to '.join(wcs.available_frames)}, without its statistics")]
    if wcs.pixel_shape is not None:
        nx, ny = wcs.pixel_shape
        ra, dec = wcs.pixel_to_world_values((nx - 1) / 2, (ny - 1) / 2)
        lines.append(("area", f"{nx} x {ny} px about RA {float(ra):.5f} Dec {float(dec):.5f} deg"))
    return Contents(lines)


def _of_truth(path):
    """Lines about the truth of a simulation."""
    from wpdc_gwcs.io.truth import read_truths
    from wpdc_gwcs.pictures import draw_truth

    tree, truths = read_truths(path)
    measured = [node["measured"] for node in tree["frames"].values()]
    kinds = [counted(measured.count(k), k) for k in dict.fromkeys(measured)]
    epochs = sorted({truth.epoch for truth in truths.values()})
    lines = [
        ("truth", f"the exact WCS of each frame of a simulation, camera {tree['camera']}"),
        ("frames", f"{len(truths)}: {', '.join(kinds)}; the stars are in FRAME.truth.ecsv"),
        ("epoch", " to ".join(f"{epoch:.3f}" for epoch in dict.fromkeys((epochs[0], epochs[-1])))),
        ("catalog", tree["catalog"]),
    ]
    for truth in {truth.detector: truth for truth in truths.values()}.values():
        ny, nx = truth.image_shape
        most = truth.distortion.greatest()
        lines.append((truth.detector, f"{nx} x {ny} px, distortion up to {most:.2f} px"))
    return Contents(lines, lambda: draw_truth(list(truths.values())))


def _of_text(file, path):
    """Lines about a text: a header, a table, or a text of no use."""
    from wpdc_gwcs.catalogs.files import open_any
    from wpdc_gwcs.io.headers import clean_header

    with open_any(path) as stream:
        start = stream.read(_MOST_BYTES)
    if any(_CARD.match(card.image) for header in clean_header(start) for card in header.cards):
        return _of_result(file)
    is_page = _PAGE.match(start)
    sources = _of_foreign_list(path)
    if sources is not None:
        return sources
    table = _table_or_none(path)
    if table is not None:
        try:
            return _of_table(path, table)
        except InputError:
            if not is_page and _has_numbers(table):
                return _of_any_table(table)
    what = "an HTML page; open it in a browser" if is_page else "a text without columns"
    raise FileFormatError(f"{path}: must be FITS, ASDF, a header or a table, is {what}")


def _of_foreign_list(path):
    """Contents of a list of sources by SExtractor, DAOPHOT or photutils, or `None`."""
    from wpdc_gwcs.io.sources import read_source_table, source_origin, standardize_sources

    try:
        table, texts = read_source_table(path)
    except FrameError:
        return None
    if {"x", "y"} <= set(table.colnames) and not any("DAOPHOT" in text for text in texts):
        return None
    origin = source_origin(table.colnames, texts=texts)
    found = _of_sources(standardize_sources(table, name=str(path), origin=origin))
    first = "not known, taken as 0 (--origin)" if origin is None else str(origin)
    found.lines.append(("first pixel", first))
    return found


def _table_or_none(path):
    from wpdc_gwcs.io import read_table

    try:
        table = read_table(path)
    except FileFormatError:
        return None
    return table if len(table.colnames) > 1 else None


def _has_numbers(table):
    """Whether a table is one, and not a text whose words were taken for columns."""
    return len(table) > 0 and any(table[name].dtype.kind in "iuf" for name in table.colnames)


def _of_any_table(table):
    return Contents(
        [
            ("table", counted(len(table), "row")),
            ("columns", ", ".join(table.colnames)),
            ("positions", "none: a catalog has ra and dec, a list of sources x and y"),
        ]
    )


def _of_table(path, table):
    """Lines about a table: a summary, matches, sources, or a catalog."""
    from wpdc_gwcs.catalogs import read_catalog
    from wpdc_gwcs.pictures import draw_summary

    names = set(table.colnames)
    if {"frame", "status", "reason"} <= names:
        return Contents(_of_summary(table), lambda: draw_summary(table))
    if {"x", "y", "dx", "dy", "used"} <= names:
        return _of_matches(table)
    if {"x", "y"} <= names:
        return _of_sources(table)
    return _of_catalog(read_catalog(path))


def _of_sources(table):
    """Lines about a list of sources with columns x and y."""
    from wpdc_gwcs.columns import numbers_or_nan
    from wpdc_gwcs.pictures import draw_sources
    from wpdc_gwcs.selection import judge_sources, left_out

    lines = [("sources", left_out(judge_sources(table)) + _BY_DEFAULT)]
    snr = numbers_or_nan(table, "snr")
    if np.isfinite(snr).any():
        lines.append(("S/N", f"{np.nanmin(snr):.1f} to {np.nanmax(snr):.0f}"))
    lines.append(("columns", ", ".join(table.colnames)))
    return Contents(lines, lambda: draw_sources(table))


def _of_catalog(stars):
    from wpdc_gwcs.cli.catalog import lines_about
    from wpdc_gwcs.pictures import draw_catalog

    return Contents(list(lines_about(stars)), lambda: draw_catalog(stars))


def _of_summary(summary):
    states = [str(status) for status in summary["status"]]
    lines = [("frames", f"{len(summary)}")]
    lines += [(state, f"{states.count(state)}") for state in dict.fromkeys(states)]
    told = [row for row in summary if str(row["reason"]) not in ("", "--")]
    for row in told[:_MOST_ROWS]:
        lines.append((str(row["frame"]), f"{row['status']}: {row['reason']}"))
    if len(told) > _MOST_ROWS:
        lines.append(("...", f"{len(told) - _MOST_ROWS} more with reasons"))
    return lines


def _of_matches(matches):
    from wpdc_gwcs.columns import numbers_or_nan
    from wpdc_gwcs.evaluation import evaluate
    from wpdc_gwcs.plotting import plot_residual_arrows

    used = np.asarray(matches["used"]).astype(bool)
    x, y, dx, dy = (numbers_or_nan(matches, name) for name in ("x", "y", "dx", "dy"))
    lines = [("pairs", f"{len(matches)}, {used.sum()} used")]
    if "holdout" in matches.colnames:
        lines.append(("held out", f"{int(np.asarray(matches['holdout']).astype(bool).sum())}"))
    if used.any():
        found = evaluate(dx[used], dy[used])
        text = f"{found.sigma_dx:.4f} and {found.sigma_dy:.4f} px in x and y after clipping"
        lines.append(("residuals", text))
    shape = (int(np.nanmax(y)) + 1, int(np.nanmax(x)) + 1)

    def draw():
        parts = (c[used] for c in (x, y, dx, dy))
        return plot_residual_arrows(*parts, image_shape=shape, title="mean residuals")

    return Contents(lines, draw)


def _of_fits(file):
    """Lines about a FITS file: a frame with stars or pixels, a result, a catalog, or a table."""
    from wpdc_gwcs.catalogs import read_catalog
    from wpdc_gwcs.io import read_frames

    try:
        frames = read_frames(file)
    except FrameError as no_frame:
        try:
            return _of_result(file)
        except FileFormatError:
            pass
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                stars = read_catalog(file)
        except InputError:
            tables = _tables_of(file)
            if not tables:
                raise no_frame from None
            return _of_any_table(tables[0])
        return _of_catalog(stars)
    return _of_frames(frames)


def _tables_of(file):
    """Tables of a FITS file that has no image; none if it has one, or is damaged."""
    from astropy.table import Table

    from wpdc_gwcs.io.files import open_fits, split_extension

    try:
        with open_fits(split_extension(file)[0]) as hdus:
            if any(hdu.is_image and hdu.data is not None for hdu in hdus):
                return []
            return [Table(hdu.data) for hdu in hdus if hasattr(hdu, "columns")]
    except InputError:
        return []


def _of_frames(frames):
    lines = []
    for frame in frames[:_MOST_ROWS]:
        lines += _of_frame(frame)
    if len(frames) > _MOST_ROWS:
        lines.append(("...", counted(len(frames) - _MOST_ROWS, "more frame")))
    first = frames[0]

    def draw():
        from wpdc_gwcs.calibration import measure_sources
        from wpdc_gwcs.pictures import draw_sources

        return draw_sources(measure_sources(first), image_shape=first.image_shape)

    return Contents(lines, draw)


def _of_frame(frame):
    from wpdc_gwcs.calibration import Settings
    from wpdc_gwcs.calibration.measure import rules_of
    from wpdc_gwcs.calibration.start import header_reference_point, linear_wcs
    from wpdc_gwcs.detector import detector_label
    from wpdc_gwcs.selection import left_out

    ny, nx = frame.image_shape
    kind = "image" if frame.load_image is not None else "list of sources"
    epoch = "no epoch" if frame.epoch is None else f"epoch {frame.epoch:.3f}"
    parts = (f"{kind} of {nx} x {ny} px", detector_label(frame.detector), epoch)
    ra, dec = frame.wcs.pixel_to_world_values((nx - 1) / 2, (ny - 1) / 2)
    scale = linear_wcs(frame.wcs, header_reference_point(frame)).scale
    size = f"{_angle(nx * scale)} x {_angle(ny * scale)}"
    lines = [
        (frame.name, ", ".join(filter(None, parts))),
        ("", f"center by the header at RA {float(ra):.5f} Dec {float(dec):.5f} deg"),
        ("", f"{scale * 3600:.4g} arcsec / px, {size}, {frame.meta['projection']}"),
    ]
    if "wcs_origin" in frame.meta:
        lines.append(("", frame.meta["wcs_origin"]))
    if frame.load_sources is not None:
        sources = frame.load_sources()
        lines.append(("", left_out(rules_of(sources, frame, Settings())) + _BY_DEFAULT))
        lines.append(("", f"columns used: {', '.join(sources.colnames)}"))
    return lines


def _angle(degrees):
    """Return a length on the sky in the unit that suits it."""
    return f"{degrees:.3g} deg" if degrees >= 1 else f"{60 * degrees:.3g} arcmin"


def _of_map(path, role, index):
    """Lines about a weight map or a mask: they belong to an image, and have no stars."""
    from wpdc_gwcs.io.beside import tell_frames
    from wpdc_gwcs.io.files import FITS_NAME, open_fits
    from wpdc_gwcs.pictures import draw_map

    with open_fits(path) as hdus:
        pixels = np.array(hdus[index].data)
    ny, nx = pixels.shape
    known = pixels[np.isfinite(pixels)]
    lines = [(path.name, f"{_MAPS[role]} of {nx} x {ny} px, by its name")]
    if known.size:
        lines.append(("values", f"{known.min():.4g} to {known.max():.4g}"))
        lines.append(("zero", f"{100 * np.mean(pixels == 0):.1f} % of the pixels"))
    near = [p for p in sorted(path.parent.iterdir()) if FITS_NAME.search(p.name)]
    owner = next((o for o, maps in tell_frames(near) if path in maps), None)
    text = "none beside it" if owner is None else f"{owner.name}, with which it is used"
    lines.append(("image", text))
    return Contents(lines, lambda: draw_map(pixels, _MAPS[role]))


def _map_in(path):
    """Role of a file that is a map by its name, and the number of its image; or `None`."""
    from wpdc_gwcs.io.companions import map_role, words_of
    from wpdc_gwcs.io.files import open_fits, stem_of
    from wpdc_gwcs.io.images import image_shape

    role = map_role(words_of(stem_of(path)))
    if role is None:
        return None
    with open_fits(path) as hdus:
        images = [
            k for k, hdu in enumerate(hdus) if hdu.is_image and image_shape(hdu.header) is not None
        ]
        flat = [k for k in images if hdus[k].header["NAXIS"] == 2]
    return (role, flat[0]) if len(images) == len(flat) == 1 else None
