"""The WCS of any file as a calibration: exact if possible, otherwise fitted.

::

    ours, TAN, TPV ------------------------------> Calibration
    gwcs in ASDF, ASDF in FITS --+
    SIP, tables, -TAB, others ---+--fit_wcs------> Calibration, and how far it is off
    AST in FITS -----------------+
"""

import dataclasses
import io
import warnings

import asdf
import numpy as np

from wpdc_gwcs.conversion import fit_wcs
from wpdc_gwcs.exceptions import FileFormatError, InputError
from wpdc_gwcs.io.asdf import read_asdf
from wpdc_gwcs.io.extensions import load_extensions
from wpdc_gwcs.io.files import (
    READ_ERRORS,
    file_kind,
    first_line,
    open_fits,
    split_extension,
    stem_of,
)
from wpdc_gwcs.io.fits import read_fits
from wpdc_gwcs.io.formats import read_wcs
from wpdc_gwcs.io.headers import header_shape, is_ours, read_headers
from wpdc_gwcs.io.integrity import check_size
from wpdc_gwcs.io.tan import parse_tan

__all__ = ["read_any"]

# Extension in which pipelines of telescopes store an ASDF tree in FITS files.
_ASDF_EXTENSION = "ASDF"


def read_any(path, *, image_shape=None):
    """Read the WCS of any file as a calibration.

    Parameters
    ----------
    path : path-like
        ASDF file with a gwcs anywhere in its tree; FITS file or ``path[EXT]`` with a celestial WCS
        of any kind, or with the tree of a pipeline in an extension ``ASDF``; ``.head`` or other
        text header.
    image_shape : (int, int), optional
        Shape of the image, (ny, nx); needed if the file does not tell.

    Returns
    -------
    obj : `~wpdc_gwcs.Calibration` or `~wpdc_gwcs.DistortionSolution`
        Exact for files of this package and for TAN and TPV headers; for others see
        `wpdc_gwcs.fit_wcs`.

    Raises
    ------
    InputError
        If there is no such WCS in the file, or more than one.
    """
    plain, extension = split_extension(path)
    if file_kind(plain) == "asdf":
        if extension is not None:
            raise FileFormatError(f"{path}: only FITS and text files have extensions")
        # Absolute, since a leading '~' is special to asdf, even if the file is open.
        with open(plain.absolute(), "rb") as file:
            tree = _read_tree(file, plain)
        if "wpdc" in tree:
            return read_asdf(plain)
        return _fit(_find_wcs(tree, plain), path, image_shape)
    if file_kind(plain) == "fits":
        tree = None
        with open_fits(plain) as hdus:
            if extension is None and _ASDF_EXTENSION in hdus:
                data = np.array(hdus[_ASDF_EXTENSION].data[0][0], dtype=np.uint8).tobytes()
                tree = _read_tree(io.BytesIO(data), f"{plain}[{_ASDF_EXTENSION}]")
        if tree is not None:
            return _fit(_find_wcs(tree, plain), path, image_shape)
    return _read_header(path, image_shape)


def _read_header(path, image_shape):
    headers = read_headers(path)
    if len(headers) > 1:
        raise FileFormatError(f"{path}: has {len(headers)} WCS headers; choose one with path[N]")
    header = headers[0]
    if "BEGAST_A" in header:
        return _fit(_read_ast(header, path), path, image_shape or header_shape(header))
    ours = is_ours(header) and str(header.get("CTYPE1")) == "RA---TPV"
    if ours or parse_tan(header, name=str(path)) is not None:
        found = read_fits(path)
        if found.solution.image_shape is not None:
            return found
        if image_shape is None:
            raise InputError(
                f"{path}: the size of the image must be given (--size): the header does not have it"
            )
        solution = dataclasses.replace(found.solution, image_shape=tuple(image_shape))
        return dataclasses.replace(found, solution=solution)
    return _fit(read_wcs(path), path, image_shape or header_shape(header))


def _fit(wcs, path, image_shape):
    name = stem_of(split_extension(path)[0])
    try:
        return fit_wcs(wcs, image_shape=image_shape, frame=name)
    except (ValueError, TypeError) as problem:
        reason = first_line(problem).replace("image_shape", "the size of the image")
        raise InputError(f"{path}: {reason}") from problem


def _read_tree(file, name):
    load_extensions()
    with warnings.catch_warnings():
        # Warnings about tags of packages that are not installed do not matter here.
        warnings.simplefilter("ignore")
        try:
            check_size(file, name)
            with asdf.open(file, lazy_load=False, memmap=False) as opened:
                return dict(opened.tree)
        except (asdf.exceptions.ValidationError, *READ_ERRORS) as problem:
            raise FileFormatError(f"{name}: damaged ASDF file: {first_line(problem)}") from problem


def _find_wcs(tree, name):
    """Find the single WCS nearest to the root of a tree."""
    level = [("", tree)]
    seen = set()
    while level:
        found = {path: node for path, node in level if hasattr(node, "pixel_to_world_values")}
        if len(found) == 1:
            return next(iter(found.values()))
        if found:
            raise FileFormatError(
                f"{name}: must have one WCS, has {len(found)}: {', '.join(sorted(found))}"
            )
        below = []
        for path, node in level:
            if id(node) in seen:
                continue
            seen.add(id(node))
            children = _children(node)
            below += [(f"{path}.{key}".strip("."), child) for key, child in children]
        level = below
    raise FileFormatError(f"{name}: must have a WCS that gwcs can open, has none")


def _children(node):
    data = getattr(node, "data", node)  # nodes with unknown tags
    if hasattr(data, "items"):
        return list(data.items())
    if isinstance(data, list | tuple):
        return list(enumerate(data))
    return []


def _read_ast(header, path):
    try:
        from starlink import Ast
    except ImportError:
        raise InputError(
            f"{path}: to read a WCS of AST, starlink-pyast must be installed"
        ) from None
    channel = Ast.FitsChan()
    for card in header.cards:
        if card.keyword not in ("HISTORY", "COMMENT", ""):
            channel.putfits(card.image, False)
    channel.clear("Card")
    frames = channel.read()
    if frames is None:
        raise FileFormatError(f"{path}: must have a WCS that AST can read, has none")
    return frames
