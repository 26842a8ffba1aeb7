"""Frames from files: images, FITS_LDAC source lists, source tables.

::

    image.fits[.fz|.gz], image.fits[EXT] --+
    list.cat (FITS_LDAC)                 --+--read_frames--> one Frame per detector
    table.ecsv + WCS header              --+

Headers are read at once and checked; pixels and source lists when they are needed.
"""

import functools
import re
import warnings
from dataclasses import replace

import numpy as np
from astropy.io import fits

from wpdc_gwcs.columns import listed
from wpdc_gwcs.exceptions import FrameError, InputError, WPDCWarning
from wpdc_gwcs.frame import Frame
from wpdc_gwcs.io.celestial import parse_wcs
from wpdc_gwcs.io.companions import (
    data_section,
    given_plane,
    load_mask,
    load_weight,
    map_beside,
    pair_companions,
)
from wpdc_gwcs.io.dates import header_epoch
from wpdc_gwcs.io.files import (
    file_kind,
    open_fits,
    split_extension,
    stem_of,
)
from wpdc_gwcs.io.headers import (
    extension_names,
    find_extension,
    header_shape,
    header_text,
    history_of_wcs,
    ldac_header,
    read_headers,
)
from wpdc_gwcs.io.identity import (
    NOT_NAMES,
    detector_name,
    distinct,
    exposure_keys,
    file_name,
    header_facts,
    of_one_exposure,
    on_its_own,
)
from wpdc_gwcs.io.images import (
    choose_plane,
    image_gain,
    image_read_noise,
    image_saturation,
    image_shape,
    load_image,
    planes_of,
    split_plane,
)
from wpdc_gwcs.io.sources import (
    load_fits_sources,
    position_columns,
    read_source_table,
    source_origin,
    standardize_sources,
)

__all__ = ["read_frames"]

# Companions with the noise of the sky, best first.
_WEIGHTS = ("weight", "error", "variance")


def read_frames(
    path,
    *,
    wcs=None,
    detector=None,
    name=None,
    image_shape=None,
    exposure_keyword=None,
    camera=True,
    epoch=None,
    pixel_scale=None,
    origin=None,
    mask=None,
    weight_map=None,
    mask_bits=None,
    beside=(),
):
    """Read the frames of a file.

    Parameters
    ----------
    path : path-like
        FITS image (plain, tile-compressed, gzipped; one frame for each image extension with a
        celestial WCS), ``path[EXT]`` with the number or name of an extension, ``path[EXT][plane]``
        with the number of a plane of a cube (from zero; ``L``: the sum of all), FITS_LDAC source
        list (one frame for each of its detectors), or a table of sources, which needs ``wcs``.
    wcs : path-like or `~astropy.io.fits.Header`, optional
        Header to use instead of that of the frame: FITS file, ``path[EXT]``, ``.head`` or other
        text file; several headers are used for one frame each.
    detector : str, optional
        Name of the detector instead of the header's.
    name : str, optional
        Name of the frame instead of the file's.
    image_shape : (int, int), optional
        Shape ``(ny, nx)`` of the detector, if it is not in a source list or table.
    exposure_keyword : str, optional
        Header keyword that distinguishes exposures, instead of the usual ones.
    camera : bool, optional
        Whether frames belong to a camera and an exposure; `False` leaves each on its own.
    epoch : float, optional
        Julian year of the middle of the exposures, instead of the headers' dates.
    pixel_scale : float, optional
        Scale in arcsec / px, instead of the headers'.
    origin : {0, 1}, optional
        Number of the first pixel in tables of sources, instead of that found in the table.
    mask, weight_map : path-like, optional
        FITS images, ``path`` or ``path[EXT]``, of bad pixels and of inverse variances, instead of
        those in the file.  If a file has several images, those with the names or the numbers of
        the extensions of the frames are used.
    mask_bits : int, optional
        Sum of the bits that mean bad pixels in masks.  By default those that the header names, or
        all except those that mark sources or whose pixels look like the others.
    beside : sequence of path-like, optional
        Files with masks and weights that belong to this one.  They are used like those in the file
        itself unless ``mask`` or ``weight_map`` is given.

    Returns
    -------
    frames : list of `~wpdc_gwcs.frame.Frame`
        At least one.  Pixels and sources are read when their loaders are called.

    Raises
    ------
    FrameError
        If the file is missing, empty, damaged, truncated, not what its name says, or without a
        celestial WCS, or lacks the keyword of the exposure.

    Warns
    -----
    WPDCWarning
        If a date is invalid, a reference system is unknown, or a shape has to be guessed.

    Notes
    -----
    The name of a frame is that of its file without endings.  If a file has several frames, the name
    or the number of the extension is appended.  The detector comes from ``DETECTOR``, ``DETNAME``,
    ``CCDNAME``, ``EXTNAME``, ... in this order; frames of one file are never the same detector.

    Extensions with masks, weights, errors or times are not frames; they are used with the image to
    which they belong (SCI, ERR, DQ and similar names).  A mosaic of pixels behind different
    filters, and an image with three planes that its header describes as colors, are measured on
    the sum of their light.  For other cubes, a plane must be chosen.

    The camera comes from ``INSTRUME``, else from ``TELESCOP``.  Frames of one camera belong to one
    exposure if ``EXPNUM``, ``OBSID`` or a similar keyword is the same or, if there is none, the
    start time.  Frames of one file always do, unless such a keyword differs.

    Examples
    --------
    >>> import tempfile
    >>> from wpdc_gwcs import read_frames, simulate
    >>> from wpdc_gwcs.simulation import write_simulation
    >>> sky = simulate(1, image_shape=(256, 256), density=30, distortion=2, seed=1)
    >>> files = write_simulation(sky, tempfile.mkdtemp(), images=(0,))
    >>> [(frame.name, frame.image_shape) for frame in read_frames(files["frames"][0])]
    [('sim-01', (256, 256))]
    """
    if origin not in (None, 0, 1):
        raise ValueError(f"origin must be 0 or 1, got {origin!r}")
    if pixel_scale is not None and not 0 < pixel_scale < np.inf:
        raise ValueError(f"pixel_scale must be positive, in arcsec / px, got {pixel_scale!r}")
    path, plane = split_plane(path)
    path, extension = split_extension(path)
    stem = stem_of(path) if name is None else str(name)
    planes = {"mask": mask, "weight": weight_map}
    by_hand = {} if epoch is None else {"epoch": float(epoch)}
    if file_kind(path, error=FrameError) != "fits":
        _refuse_planes(path, planes)
        frame = _read_text_table(
            path,
            wcs,
            detector,
            stem,
            image_shape,
            exposure_keyword,
            pixel_scale=pixel_scale,
            origin=origin,
        )
        frame = replace(frame, **by_hand)
        return [frame if camera else on_its_own(frame)]
    headers = None if wcs is None else _given_headers(wcs)
    with open_fits(path, error=FrameError) as hdus:
        chosen, companions = _choose(hdus, path, extension)
        if headers is not None and len(headers) not in (1, len(chosen)):
            raise FrameError(
                f"{wcs}: must have one WCS header for each of the {len(chosen)} frames of {path}, "
                f"has {len(headers)}"
            )
        if headers is not None and len(headers) == 1 < len(chosen):
            raise FrameError(
                f"{path}: has {len(chosen)} frames, which cannot share one WCS header; give one "
                "for each"
            )
        several = len(_choose(hdus, path, None, quiet=True)[0]) > 1
        prepared = [
            _prepare(
                hdus,
                f"{path}[{index}]" if several or extension is not None else str(path),
                kind,
                index,
                None if headers is None else headers[i],
                plane=plane,
                pixel_scale=pixel_scale,
                origin=origin,
            )
            for i, (kind, index) in enumerate(chosen)
        ]
    frames = []
    for part in prepared:
        for message in part["warnings"]:
            warnings.warn(message)
        if part["kind"] != "image":
            _refuse_planes(part["where"], planes)
        part["companions"] = _companions(part, companions, planes, beside)
        part["mask_bits"] = mask_bits
        label = "_".join([part["label"]] * several + part["chosen"])
        frames.append(_frame_of(part, path, stem, label, detector, image_shape, exposure_keyword))
    frames = [replace(f, **by_hand) for f in distinct(frames, prepared)]
    if not camera:
        return [on_its_own(f) for f in frames]
    if not several or exposure_keyword is not None:
        return frames
    return of_one_exposure(frames, prepared, path)


def _given_headers(wcs):
    if isinstance(wcs, fits.Header):
        return [wcs]
    try:
        return read_headers(wcs)
    except FrameError:
        raise
    except InputError as problem:
        raise FrameError(str(problem)) from problem


def _choose(hdus, path, extension, *, quiet=False):
    """Find the HDUs that are frames, as (kind, index), and the companions of images."""
    lists = [i for i, hdu in enumerate(hdus) if hdu.name == "LDAC_OBJECTS"]
    images = [
        i for i, hdu in enumerate(hdus) if hdu.is_image and image_shape(hdu.header) is not None
    ]
    companions = pair_companions(hdus, images, path)
    tables = [i for i, h in enumerate(hdus) if isinstance(h, fits.BinTableHDU | fits.TableHDU)]
    tables = [i for i in tables if i not in images]
    if extension is not None:
        index = find_extension(hdus, extension, path, error=FrameError)
        if index in lists or index + 1 in lists:
            return [("list", index if index in lists else index + 1)], {}
        if index in images:
            return [("image", index)], companions
        if index in tables:
            return [("table", index)], {}
        raise FrameError(
            f"{path}[{extension}]: must be an image, a source list or a table, "
            f"is {type(hdus[index]).__name__} without data"
        )
    if lists:
        return [("list", i) for i in lists], {}
    images = list(companions)
    if len(images) > 1:
        # Among several images, those without a WCS are not frames (guiders, focus chips).
        images = [i for i in images if "CTYPE1" in hdus[i].header] or images[:1]
    if images:
        # Cubes next to images are not frames either.
        flat = [i for i in images if planes_of(hdus[i].header) == 1]
        return [("image", i) for i in flat or images], companions
    sources = [i for i in tables if position_columns(hdus[i].columns.names) is not None]
    if sources:
        return [("table", sources[0])], {}
    if quiet:
        return [], {}
    raise FrameError(
        f"{path}: must have an image, FITS_LDAC sources or a table with positions, "
        f"has {extension_names(hdus)}"
    )


def _refuse_planes(where, given):
    """Raise an error for masks and weights of a source list."""
    for path in given.values():
        if path is not None:
            raise FrameError(f"{where}: is a source list, for which {path} is of no use")


def _companions(part, companions, given, beside):
    """Collect the companions of a frame: given ones, else those in its file or next to it."""
    found = list(companions.get(part["index"], ()))
    if part["kind"] == "image":
        found += [map_beside(p, part["index"], part["label"], part["shape"]) for p in beside]
    for role, path in given.items():
        if path is None:
            continue
        found = [c for c in found if (c.role == "mask") != (role == "mask")]
        found.append(given_plane(path, part["index"], part["label"], part["shape"], role))
    return found


def _prepare(hdus, where, kind, index, given, *, plane, pixel_scale, origin):
    """Read everything that needs the open file: headers, WCS, names of columns."""
    hdu = hdus[index]
    header = hdu.header
    if kind == "list":
        header = ldac_header(hdus, index, where, error=FrameError)
    # Keywords of the whole file stand in the primary header.
    headers = [header.copy()] + ([hdus[0].header.copy()] if index > 0 else [])
    if kind == "table" and given is not None:
        # The header of a bare table does not describe the exposure.
        headers.append(given)
    if kind != "image":
        names = hdu.columns.names
        if position_columns(names) is None:
            raise FrameError(
                f"{where}: source list must have positions (x, y; XWIN_IMAGE, YWIN_IMAGE; X_IMAGE, "
                f"Y_IMAGE; ...), has {listed(names)}"
            )
    wcs_header = given
    if wcs_header is None:
        wcs_header = header
        if kind == "table" and "CTYPE1" not in header:
            wcs_header = next((h for h in headers if "CTYPE1" in h), None)
            if wcs_header is None:
                raise FrameError(f"{where}: a table of sources needs a WCS header (--wcs)")
        elif "CTYPE1" not in header:
            raise FrameError(f"{where}: header must have a celestial WCS, has no CTYPE1")
    label = header_text(header, "EXTNAME")
    if label.upper() in NOT_NAMES or label == "LDAC_OBJECTS":
        label = str(index)
    elif hdu.is_image and hdu.ver > 1:
        label += f"_{hdu.ver}"
    shape = image_shape(header) if kind == "image" else header_shape(header)
    if shape is None:
        shape = header_shape(wcs_header)
    chosen = []
    if kind == "image":
        if plane is not None and planes_of(header) > 1:
            # Other planes of the cube may be frames of the same run.
            chosen = [f"p{plane}"]
        plane = choose_plane(header, plane, f"{where}" if "[" in where else f"{where}[{index}]")
    # Warnings are suppressed while a file is open: ours are repeated afterwards.
    with warnings.catch_warnings(record=True) as seen:
        warnings.simplefilter("always")
        parsed = parse_wcs(
            wcs_header,
            hdus=hdus if given is None else None,
            name=where,
            error=FrameError,
            pixel_scale=pixel_scale,
        )
    if kind == "table" and origin is None:
        origin = source_origin(hdu.columns.names, headers[:2])
    return {
        "plane": plane,
        "section": data_section(header, shape) if kind == "image" else None,
        "kind": kind,
        "index": index,
        "where": where,
        "label": label,
        "chosen": chosen,
        "headers": headers,
        "shape": shape,
        "wcs": parsed,
        "facts": _facts_of_wcs(wcs_header),
        "origin": origin,
        "warnings": [w.message for w in seen if issubclass(w.category, WPDCWarning)],
    }


def _facts_of_wcs(header):
    """Projection of a WCS, and its origin if this package wrote it."""
    facts = {"projection": ", ".join(header_text(header, f"CTYPE{axis}") for axis in (1, 2))}
    history = history_of_wcs(header)
    return facts | {"wcs_origin": history} if history else facts


def _frame_of(part, path, stem, label, detector, image_shape, exposure_keyword):
    headers, where, index = part["headers"], part["where"], part["index"]
    loaders = {}
    if part["kind"] == "image":
        loaders = _image_loaders(part, str(path))
    else:
        loaders["load_sources"] = functools.partial(
            load_fits_sources, str(path), index, origin=part["origin"]
        )
    shape = image_shape if image_shape is not None and part["kind"] != "image" else part["shape"]
    if shape is None:
        shape = _guess_shape(loaders["load_sources"](), where)
    return Frame(
        name=f"{stem}_{file_name(label)}" if label else stem,
        detector=str(detector) if detector is not None else detector_name(headers),
        image_shape=tuple(int(n) for n in shape),
        wcs=part["wcs"],
        epoch=header_epoch(headers, name=where),
        source=where,
        gain=image_gain(headers),
        read_noise=image_read_noise(headers),
        saturation=image_saturation(headers),
        **exposure_keys(headers, exposure_keyword, where, part["chosen"]),
        meta=header_facts(headers) | part["facts"] | _choices(part, str(path)),
        inputs=tuple(dict.fromkeys(c.path for c in part["companions"] if c.path != str(path))),
        **loaders,
    )


def _choices(part, path):
    """Describe the choices that were made to get the frame from the file."""
    if part["kind"] == "table":
        return _first_pixel(part["origin"])
    if part["kind"] == "list":
        return {}
    outside = [c for c in part["companions"] if c.given or c.path != path]
    facts = {c.role: f"{c.path}[{c.index}]" for c in outside}
    if part["mask_bits"] is not None:
        facts["mask_bits"] = part["mask_bits"]
    return facts | ({"plane": part["plane"]} if part["plane"] != 0 else {})


def _image_loaders(part, path):
    """Loaders of pixels, mask and weight."""
    shape = tuple(part["shape"])
    load = functools.partial(load_image, path, part["index"], part["plane"])
    loaders = {"load_image": load, "fresh_image": True}
    masks = [c for c in part["companions"] if c.role == "mask"]
    if masks or part["section"] is not None:
        loaders["load_mask"] = functools.partial(
            load_mask, masks, part["section"], shape, part["mask_bits"], load
        )
    weights = {c.role: c for c in reversed(part["companions"]) if c.role in _WEIGHTS}
    if weights:
        best = min(weights, key=_WEIGHTS.index)
        loaders["load_weight"] = functools.partial(load_weight, weights[best], shape)
    return loaders


def _first_pixel(origin):
    """State the number of the first pixel of a table of sources."""
    return {"first_pixel": "0, since nothing tells" if origin is None else str(origin)}


def _read_text_table(
    path, wcs, detector, stem, image_shape, exposure_keyword, *, pixel_scale, origin
):
    """Read a table of sources in any text format of astropy."""
    if wcs is None:
        raise FrameError(f"{path}: a table of sources needs a WCS header (--wcs)")
    headers = _given_headers(wcs)
    if len(headers) != 1:
        raise FrameError(
            f"{wcs}: must have one WCS header, has {len(headers)}; choose with path[N]"
        )
    table, texts = read_source_table(path)
    if origin is None:
        origin = source_origin(table.colnames, texts=texts)
    sources = standardize_sources(table, name=str(path), origin=origin)
    header = headers[0]
    shape = image_shape if image_shape is not None else header_shape(header)
    if shape is None:
        shape = table.meta.get("image_shape") or _guess_shape(sources, path)
    meta = fits.Header()
    for key, value in table.meta.items():
        if isinstance(value, str | int | float) and re.fullmatch(r"[A-Za-z0-9_-]{1,8}", str(key)):
            meta[str(key)] = value
    epoch = table.meta.get("epoch")
    if not (isinstance(epoch, int | float) and 1800 <= epoch <= 2200):
        epoch = header_epoch([meta, header], name=str(path))
    return Frame(
        name=stem,
        detector=str(detector) if detector is not None else detector_name([meta, header]),
        image_shape=tuple(int(n) for n in shape),
        wcs=parse_wcs(header, name=str(wcs), error=FrameError, pixel_scale=pixel_scale),
        epoch=epoch,
        source=str(path),
        load_sources=sources.copy,
        **exposure_keys([meta, header], exposure_keyword, str(path)),
        meta=header_facts([meta, header]) | _facts_of_wcs(header) | _first_pixel(origin),
    )


def _guess_shape(sources, where):
    x, y = (np.asarray(sources[c]) for c in ("x", "y"))
    if not (np.isfinite(x).any() and np.isfinite(y).any()):
        raise FrameError(
            f"{where}: the shape of the detector must be given (NAXIS1, NAXIS2), is unknown"
        )
    shape = tuple(int(np.ceil(np.nanmax(v) + 0.5)) for v in (y, x))
    warnings.warn(
        f"{where}: the header does not tell the shape of the detector; {shape[1]} x {shape[0]} px, "
        "the extent of the sources, is assumed",
        WPDCWarning,
    )
    return shape
