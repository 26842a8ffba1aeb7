"""Writing a WCS into an image: cards and tables are replaced, every other byte is copied.

::

    image --parts--> [header, data] ...   cards of the old WCS  -->  cards of the new one
                                          tables of the old one -->  tables of the new one
"""

import contextlib
import dataclasses
import io
import os
import shutil
import warnings
from pathlib import Path
from typing import NamedTuple

import numpy as np
from astropy.io import fits

from wpdc_gwcs import __version__
from wpdc_gwcs.exceptions import FileFormatError, InputError, WPDCWarning
from wpdc_gwcs.export import FORMAT_VERSION, deviation, image_shape_of, make_form
from wpdc_gwcs.export.exact import astropy_sky
from wpdc_gwcs.io.checksum import checksum_text, sum_words
from wpdc_gwcs.io.files import (
    READ_ERRORS,
    atomic_path,
    check_output,
    file_kind,
    first_line,
    open_fits,
    open_stream,
    split_extension,
)
from wpdc_gwcs.io.fits import warn_if_far
from wpdc_gwcs.io.headers import (
    WRITTEN_BY_US,
    extension_names,
    find_extension,
    header_shape,
    header_value,
)
from wpdc_gwcs.io.stale import alternates_of, is_stale, tables_of

__all__ = ["INTO_FORMS", "image_numbers", "write_into"]

#: Forms that can be written into an image.
INTO_FORMS = ("tpv", "sip", "cpdis", "fits", "tab")
_BLOCK = 2880
_CHUNK = 1 << 24
# The written file is read back: it must be as accurate as stated, up to rounding.
_READ_BACK = 1.1
_ROUNDING_PX = 1e-5


class _Part(NamedTuple):
    """One HDU of a file: positions of its header and data, and its kind."""

    header: fits.Header
    start: int
    data: int
    end: int
    name: tuple[str, int]


def image_numbers(path):
    """Return the numbers of the HDUs of a file that are images of two axes, without look-up tables.

    Parameters
    ----------
    path : path-like
        FITS file.

    Returns
    -------
    list of int
        Numbers, from zero.

    Raises
    ------
    InputError
        If the file is missing, damaged or not FITS.
    """
    path = Path(path)
    if file_kind(path) != "fits":
        raise FileFormatError(f"{path}: must be a FITS image")
    with _named(path):
        return _images(_read_parts(path))


def write_into(
    obj, image, *, form="tpv", degree=None, output=None, alternates="keep", overwrite=False
):
    """Write the WCS of a calibration into an image, or those of several into its extensions.

    Parameters
    ----------
    obj : `~wpdc_gwcs.Calibration`, `~wpdc_gwcs.DistortionSolution` or dict
        The calibration; or the calibration of each extension by its number.
    image : path-like
        FITS image, ``path[EXT]`` if there are several in the file and `obj` is not a dict; also
        tile-compressed or compressed as a whole.
    form : {"tpv", "sip", "cpdis", "fits", "tab"}, optional
        See `wpdc_gwcs.export.make_form`.
    degree : int, optional
        Degree of the polynomials.
    output : path-like, optional
        Copy to write; by default the image itself is replaced.
    alternates : {"keep", "remove"}, optional
        Treatment of alternate WCSs (``CTYPE1A``...).  Those that use the SIP terms of the old
        WCS are removed in any case.
    overwrite : bool, optional
        Whether an existing copy may be replaced.

    Returns
    -------
    made : `~wpdc_gwcs.export.FitsForm` or dict
        The written form, or that of each extension.

    Raises
    ------
    InputError
        If the file is not such an image, has another shape than the detector, or cannot be
        written.
    ValueError
        If a choice is unknown.

    Warns
    -----
    WPDCWarning
        If alternates are removed that use SIP, or a table cannot be made dense enough.

    Notes
    -----
    Either all extensions are written or the file stays as it was.  All terms of the old WCS are
    removed: CD, PC, CDELT, CROTA, PV, PS, SIP, CPDIS, D2IM, plate solutions, LONPOLE and so on,
    with the tables that they refer to unless another image of the file needs them.  All other
    cards, the data, and all other HDUs are copied byte by byte.  A CHECKSUM is updated if there
    was one.  The file is read back before it gets its final name.
    """
    if form not in INTO_FORMS:
        raise ValueError(f"format must be one of {', '.join(INTO_FORMS)}, got {form!r}")
    if alternates not in ("keep", "remove"):
        raise ValueError(f"alternates must be 'keep' or 'remove', got {alternates!r}")
    path, extension = split_extension(image)
    # Replace the file that a symbolic link points to, not the link.
    path = Path(os.path.realpath(path))
    target = path if output is None else Path(output)
    check_output(target, overwrite=overwrite or output is None)
    if file_kind(path) != "fits":
        raise FileFormatError(f"{path}: must be a FITS image")
    if output is None and not os.access(path, os.W_OK):
        raise InputError(
            f"{path}: the image must be writable, is not; a copy can be written instead"
        )
    with _named(image):
        parts = _read_parts(path)
        if isinstance(obj, dict):
            places = {_choose(parts, number, path): f"{image}[{number}]" for number in obj}
            objs = dict(zip(places, obj.values(), strict=True))
        else:
            places = {_choose(parts, extension, path): str(image)}
            objs = dict.fromkeys(places, obj)
        objs = {k: _fit_shape(o, parts[k].header, places[k]) for k, o in objs.items()}
        gone = set().union(*(tables_of(parts[k].header) for k in objs))
        for other, part in enumerate(parts):
            if other not in objs:
                gone -= tables_of(part.header)
    # Tables of a WCS are not offered as images, under any name.
    kept = [
        k
        for k, part in enumerate(parts)
        if k == 0 or k in objs or part.name not in gone or not _may_be_table(part)
    ]
    made = _make_forms(objs, [parts[k] for k in kept], places, form=form, degree=degree)
    letters = {k: alternates_of(parts[k].header) for k in objs}
    with atomic_path(target, overwrite=overwrite or output is None) as temporary:
        with open_stream(path) as source, open_stream(temporary, "wb", like=path) as copy:
            for k in kept:
                if k in made:
                    every, with_sip = letters[k]
                    gone_letters = every if alternates == "remove" else with_sip
                    _copy_target(source, copy, parts[k], made[k], gone_letters, places[k])
                else:
                    _copy_bytes(source, copy, parts[k].start, parts[k].end)
            for k, one in made.items():
                copy.write(_table_bytes(one.tables, parts[k].header))
            _copy_bytes(source, copy, parts[-1].end, None)
        if output is None:
            _copy_owner(path, temporary)
        _check(objs, made, temporary, {k: kept.index(k) for k in objs}, places, image)
    for k, (_, with_sip) in letters.items():
        if alternates == "keep" and with_sip:
            warnings.warn(
                f"{places[k]}: alternate WCS {', '.join(sorted(with_sip))} removed: it used the "
                "SIP terms of the old WCS",
                WPDCWarning,
            )
    return dict(zip(obj, made.values(), strict=True)) if isinstance(obj, dict) else made[k]


def _make_forms(objs, parts, places, *, form, degree):
    """Forms by number; tables of the same name get the versions that are free."""
    versions = {}
    for part in parts:
        name, version = part.name
        versions[name] = max(versions.get(name, 1), version + 1)
    made = {}
    for k, obj in objs.items():
        versions["WPDC_LUT"] = max(versions.get(n, 1) for n in ("WPDC_LUT", "WPDC_INSTRUMENT"))
        made[k] = make_form(obj, form, degree=degree, versions=versions)
        warn_if_far(made[k], places[k])
        for table in made[k].tables:
            versions[table.name] = max(versions.get(table.name, 1), table.ver + 1)
    return made


def _copy_owner(path, temporary):
    """Give a file the owner and permissions of another, as far as permitted."""
    state = path.stat()
    if hasattr(os, "chown"):
        with contextlib.suppress(OSError):
            os.chown(temporary, state.st_uid, state.st_gid)
    # After the owner, because a change of owner clears some permissions.
    shutil.copymode(path, temporary)


@contextlib.contextmanager
def _named(image):
    """Name the image in errors of astropy about its headers."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            yield
        except InputError:
            raise
        except READ_ERRORS as problem:
            raise FileFormatError(f"{image}: damaged header: {first_line(problem)}") from problem


def _read_parts(path):
    with open_fits(path):
        # Check that it is complete.
        pass
    parts = []
    with fits.open(path, memmap=False, disable_image_compression=True) as hdus:
        for hdu in hdus:
            info = hdu.fileinfo()
            start, data = info["hdrLoc"], info["datLoc"]
            name = (hdu.name.upper(), hdu.ver)
            parts.append(_Part(hdu.header.copy(), start, data, data + info["datSpan"], name))
    return parts


def _is_image(header):
    if header_value(header, "ZIMAGE") is True:
        return header_value(header, "ZNAXIS") == 2
    is_table = str(header_value(header, "XTENSION") or "IMAGE").strip() != "IMAGE"
    return not is_table and header_value(header, "NAXIS") == 2


def _may_be_table(part):
    """Whether an HDU is a table, or an image with a name of look-up tables."""
    return not _is_image(part.header) or part.name[0] in ("WCSDVARR", "D2IMARR")


def _images(parts):
    """Numbers of the images of two axes that are no look-up tables."""
    return [
        k
        for k, part in enumerate(parts)
        if _is_image(part.header) and not part.name[0].startswith(("WCSDVARR", "D2IMARR"))
    ]


def _choose(parts, extension, path):
    """Return the number of the image that is meant."""
    with open_fits(path, lazy=True) as hdus:
        names = extension_names(hdus)
        number = None if extension is None else find_extension(hdus, extension, path)
    if number is None:
        own = _images(parts)
        if len(own) != 1:
            raise InputError(
                f"{path}: has {len(own)} images of two axes; choose one with path[EXT], "
                f"EXT one of {names}"
            )
        return own[0]
    if not _is_image(parts[number].header):
        raise InputError(f"{path}[{extension}]: must be an image of two axes")
    return number


def _fit_shape(obj, header, image):
    shape, known = header_shape(header), image_shape_of(obj)
    if known is None:
        solution = dataclasses.replace(getattr(obj, "solution", obj), image_shape=shape)
        return dataclasses.replace(obj, solution=solution) if obj is not solution else solution
    if tuple(known) != tuple(shape):
        raise InputError(
            f"{image}: must have the shape of the detector, {known[1]} x {known[0]} px, "
            f"has {shape[1]} x {shape[0]}"
        )
    return obj


def _copy_bytes(source, copy, start, end):
    source.seek(start)
    left = np.inf if end is None else end - start
    while left > 0 and (chunk := source.read(int(min(_CHUNK, left)))):
        copy.write(chunk)
        left -= len(chunk)
    if end is not None and left:
        # Padding is missing at the end of the file.
        copy.write(b"\0" * int(left))


def _copy_target(source, copy, part, made, letters, image):
    source.seek(part.start)
    text = source.read(part.data - part.start).decode("latin-1")
    cards = [text[i : i + 80] for i in range(0, len(text), 80)]
    end = next((i for i, card in enumerate(cards) if card.rstrip() == "END"), None)
    if end is None:
        raise FileFormatError(f"{image}: damaged header: must have an END card, has none")
    cards, place = _without_stale(cards[:end], letters)
    own = [card.image for card in made.header.cards]
    if made.form == "fits":
        own.append(fits.Card("WPDCVERS", FORMAT_VERSION, "format version of wpdc_gwcs").image)
    own = [line[i : i + 80] for line in own for i in range(0, len(line), 80)]
    cards[place:place] = own
    if made.tables and part.start == 0 and not any(c.startswith("EXTEND  =") for c in cards):
        after = max(i for i, c in enumerate(cards) if c.startswith("NAXIS"))
        cards.insert(after + 1, fits.Card("EXTEND", True, "there may be extensions").image)
    cards.append(fits.Card("HISTORY", _history(made)).image)
    header = _pad([*cards, "END".ljust(80)])
    checksum = next((i for i, c in enumerate(cards) if c.startswith("CHECKSUM=")), None)
    if checksum is not None:
        cards[checksum] = _checksum_card(cards[checksum], "0" * 16)
        total = sum_words(_pad([*cards, "END".ljust(80)]))
        total = sum_words(b"", total + _data_sum(source, part))
        cards[checksum] = _checksum_card(cards[checksum], checksum_text(total))
        header = _pad([*cards, "END".ljust(80)])
    copy.write(header)
    _copy_bytes(source, copy, part.data, part.end)


def _without_stale(cards, letters):
    """Remove stale cards; return the rest and the position of the first one removed."""
    left, place, following = [], None, False
    for card in cards:
        # CONTINUE cards go with them, and so does the checksum of a header that tile
        # compression replaced.
        stale = following if card.startswith("CONTINUE") else is_stale(card, letters)
        stale = stale or card.startswith("ZHECKSUM=")
        following = stale
        if not stale:
            left.append(card)
        elif place is None and card[8:9] == "=":
            place = len(left)
    if place is None:
        place = len(left)
        while place and not left[place - 1].strip():
            place -= 1
    return left, place


def _pad(cards):
    data = "".join(cards).encode("latin-1")
    return data.ljust(-(-len(data) // _BLOCK) * _BLOCK)


def _checksum_card(card, value):
    """Replace the value; keep the comment only if the length is the same."""
    comment = card[28:] if card[10] == card[27] == "'" else ""
    return f"CHECKSUM= '{value}'{comment}".ljust(80)


def _data_sum(source, part):
    """Return the sum of the data: as stated, so that damage stays visible, or counted."""
    stated = header_value(part.header, "DATASUM")
    if stated is not None and str(stated).strip().isdigit():
        return int(stated)
    source.seek(part.data)
    total, left = 0, part.end - part.data
    while left > 0 and (chunk := source.read(min(_CHUNK, left))):
        left -= len(chunk)
        total = sum_words(chunk.ljust(-(-len(chunk) // 4) * 4, b"\0"), total)
    return total


def _history(made):
    worst = made.keywords_deviation if made.form == "fits" else made.deviation
    text = f"{WRITTEN_BY_US} {__version__.split('+')[0]} as {made.form}"
    return f"{text}, good to {worst:.2g} px"[:72]


def _table_bytes(tables, header):
    """Return the bytes of extensions, with checksums where the image has them."""
    if not tables:
        return b""
    file = io.BytesIO()
    hdus = fits.HDUList([fits.PrimaryHDU(), *(table.copy() for table in tables)])
    hdus.writeto(file, checksum="CHECKSUM" in header)
    return file.getvalue()[_BLOCK:]


def _check(objs, made, path, numbers, places, image):
    """Read the file back: the old WCSs must have no effect on it."""
    found = {}
    try:
        with open_fits(path) as hdus:
            for k, one in made.items():
                header = hdus[numbers[k]].header.copy()
                # Without the other images of a mosaic, which are large.
                wanted = set() if one.form == "fits" else tables_of(header)
                tables = [h.copy() for h in hdus[1:] if (h.name.upper(), h.ver) in wanted]
                found[k] = header, tables
    except InputError as problem:
        reason = str(problem).removeprefix(f"{path}: ")
        raise FileFormatError(f"{image}: no WCS can be written into it: {reason}") from problem
    for k, one in made.items():
        with _named(places[k]):
            worst = deviation(objs[k], astropy_sky(*found[k]))
        expected = one.keywords_deviation if one.form == "fits" else one.deviation
        if not worst <= _READ_BACK * expected + _ROUNDING_PX:
            raise FileFormatError(
                f"{places[k]}: other cards of the header interfere with the WCS: it would deviate "
                f"by {worst:.3g} px instead of {expected:.3g} px"
            )
