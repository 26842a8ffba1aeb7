"""Calibrations as FITS files and SCAMP ``.head`` files, in the forms of `wpdc_gwcs.export`."""

import os
import warnings

import numpy as np
from astropy.io import fits

from wpdc_gwcs.columns import listed
from wpdc_gwcs.detector import UNNAMED
from wpdc_gwcs.exceptions import FileFormatError, WPDCWarning
from wpdc_gwcs.export import (
    INSTRUMENT_NAME,
    TABLE_COLUMNS,
    TABLE_NAME,
    add_history,
    frame_cards,
    image_shape_of,
    make_form,
    own_tables,
)
from wpdc_gwcs.io.checksum import checksum_text, sum_words
from wpdc_gwcs.io.files import (
    READ_ERRORS,
    atomic_path,
    file_kind,
    first_line,
    open_fits,
    split_extension,
    stem_of,
)
from wpdc_gwcs.io.headers import (
    clean_header,
    find_extension,
    header_number,
    header_of,
    header_text,
    is_ours,
)
from wpdc_gwcs.io.integrity import check_sums, check_version
from wpdc_gwcs.io.tan import parse_tan
from wpdc_gwcs.models import LookupTable, PVPolynomial
from wpdc_gwcs.models.attitude import fold_attitude
from wpdc_gwcs.solution import Calibration, DistortionSolution

__all__ = ["read_fits", "warn_if_far", "write_form"]

# Promised accuracy of `cpdis` and `tab`, px.
_PROMISED_PX = 1e-3


def write_form(obj, path, *, form, degree=None, overwrite=False):
    """Write a calibration in one of the FITS forms.

    Parameters
    ----------
    obj : `~wpdc_gwcs.Calibration` or `~wpdc_gwcs.DistortionSolution`
        What to write; a solution about its nominal pointing.
    path : path-like
        File to write.
    form : str
        One of `wpdc_gwcs.export.FORMS`.
    degree : int, optional
        Degree of the polynomials, see `wpdc_gwcs.export.make_form`.
    overwrite : bool, optional
        Whether an existing file may be replaced.

    Returns
    -------
    made : `~wpdc_gwcs.export.FitsForm`
        The written form, with its deviation.

    Warns
    -----
    WPDCWarning
        If a table cannot be made dense enough.

    Notes
    -----
    ``tpv`` and ``sip`` are headers without an image.  Many readers need its size, so an
    image of zeros follows, which takes no space on file systems with sparse files.  ``cpdis`` also
    has the tables of ``fits``, so that it can be read back exactly.
    """
    made = make_form(obj, form, degree=degree)
    warn_if_far(made, path)
    header = made.header.copy()
    header.extend(frame_cards(obj), strip=False, end=True)
    if made.deviation is not None:
        add_history(header, f"greatest deviation from the exact WCS: {made.deviation:.3g} px")
    if made.inverse_deviation is not None:
        add_history(header, f"that of the inverse polynomials: {made.inverse_deviation:.3g} px")
    if made.swarp_deviation is not None:
        add_history(header, f"that of SWarp: {made.swarp_deviation:.3g} px")
    if form == "head":
        _write_text(header, path, image_shape_of(obj), overwrite)
        return made
    tables = list(made.tables)
    if form == "cpdis":
        tables += own_tables(made.written)
        header["WPDCTAB"] = (1, "EXTVER of the tables WPDC_...")
    with atomic_path(path, overwrite=overwrite) as temporary:
        if tables or image_shape_of(obj) is None:
            fits.HDUList([fits.PrimaryHDU(header=header), *tables]).writeto(
                temporary, checksum=True
            )
        else:
            _write_header(header, temporary, image_shape_of(obj))
    return made


def warn_if_far(made, path):
    """Warn if a form is less accurate than promised.

    Parameters
    ----------
    made : `~wpdc_gwcs.export.FitsForm`
        The form.
    path : path-like
        File to write, for the message.

    Warns
    -----
    WPDCWarning
        For ``cpdis`` and ``tab``.
    """
    if made.form in ("cpdis", "tab") and made.deviation > _PROMISED_PX:
        warnings.warn(
            f"{path}: the look-up table cannot be made dense enough: its readers deviate by up to "
            f"{made.deviation:.2g} px",
            WPDCWarning,
        )


def _write_text(header, path, shape, overwrite):
    """Write a header as SCAMP does: cards in lines, with the size of the image."""
    sizes = [] if shape is None else [(2, "axes"), (shape[1], "width"), (shape[0], "height")]
    cards = [
        fits.Card(keyword, value, f"[pixel] {comment}" if keyword != "NAXIS" else "number of axes")
        for keyword, (value, comment) in zip(("NAXIS", "NAXIS1", "NAXIS2"), sizes)
    ]
    cards += [card for card in header.cards if card.keyword not in ("WPDCVERS", "COMMENT")]
    lines = [card.image for card in cards]
    with atomic_path(path, overwrite=overwrite) as temporary:
        temporary.write_bytes("\n".join([*lines, "END".ljust(80), ""]).encode("ascii"))


def _write_header(header, path, shape):
    """Write a primary header and an image of zeros as a sparse file."""
    primary = fits.PrimaryHDU(header=header)
    primary.data = np.broadcast_to(np.uint8(0), shape)
    # The sum of zeros is zero, so the checksum is that of the header.
    primary.header["CHECKSUM"], primary.header["DATASUM"] = "0" * 16, "0"
    total = sum_words(primary.header.tostring().encode("ascii"))
    primary.header["CHECKSUM"] = checksum_text(total)
    text = primary.header.tostring().encode("ascii")
    size = -(-shape[0] * shape[1] // 2880) * 2880
    with open(path, "wb") as file:
        file.write(text)
        file.seek(0, os.SEEK_END)
        file.truncate(len(text) + size)


def read_fits(path):
    """Read a TAN, TPV or TAN + PV header, with our look-up table if there is one.

    Parameters
    ----------
    path : path-like
        FITS file, ``path[EXT]``, SCAMP ``.head`` or other text file of one header.

    Returns
    -------
    calibration : `~wpdc_gwcs.Calibration`
        CD0 is the CD of the header; ``image_shape`` is `None` if the header does not tell.

    Raises
    ------
    FileFormatError
        If the file is damaged, has no such header or more than one.
    """
    path, extension = split_extension(path)
    table, instrument, number, name = None, None, 0, str(path)
    if file_kind(path) == "fits":
        with open_fits(path) as hdus:
            if extension is not None:
                number = find_extension(hdus, extension, path)
            else:
                every = [header_of(hdus, i, path) for i in range(len(hdus))]
                number = _only([i for i, one in enumerate(every) if "CTYPE1" in one], path)
            header = header_of(hdus, number, path)
            several = len(hdus) > 1
            if is_ours(header):
                check_sums(hdus, path)
                table, instrument = _read_own_tables(hdus, header, path)
        if several and extension is not None:
            name = f"{path}[{extension}]"
    else:
        headers = [h for h in clean_header(path.read_bytes()) if "CTYPE1" in h]
        number = extension if isinstance(extension, int) else _only(range(len(headers)), path)
        if not 0 <= number < len(headers):
            raise FileFormatError(f"{path}: header number must be < {len(headers)}, got {number}")
        header = headers[number]
        _require_no_tables(header, path)
    version = header_text(header, "WPDCVERS")
    if version:
        check_version(version, path)
    tan = parse_tan(header, name=name, ignore_tables=table is not None)
    if tan is None:
        raise FileFormatError(
            f"{name}: header must be TAN or TPV without foreign look-up tables to be a "
            f"calibration, got {header_text(header, 'CTYPE1')!r}; as a starting WCS it can be read"
        )
    if instrument is None or not _agree(instrument, tan):
        instrument = {"crpix": tan.crpix, "cd": tan.cd, "crval": tan.crval, "pv": tan.pv}
    frame = header_text(header, "FRAME") or stem_of(path)
    try:
        solution = DistortionSolution(
            detector=header_text(header, "DETECTOR") or header_text(header, "EXTNAME") or UNNAMED,
            image_shape=tan.image_shape,
            lookup_table=table,
            **instrument,
            provenance={"file": str(path)},
        )
        return Calibration(frame=frame, solution=solution, crval=tan.crval, cd=tan.cd)
    except ValueError as problem:
        raise FileFormatError(f"{name}: {first_line(problem)}") from problem


def _read_own_tables(hdus, header, path):
    """Read the look-up table and the instrument of a header of this package.

    A file cut between two HDUs is valid FITS, but these belong together.
    """
    version = header_number(header, "WPDCTAB", name=str(path), required=False, default=1)
    found = []
    for name, reader in ((TABLE_NAME, _read_table), (INSTRUMENT_NAME, _read_instrument)):
        key = (name, int(version))
        found.append(reader(hdus[key], f"{path}[{name}]") if key in hdus else None)
    table, instrument = found
    if instrument is None and table is None:
        _require_no_tables(header, path)
    if instrument is not None and table is None:
        if hdus[INSTRUMENT_NAME, int(version)].header.get("WPDCLUT") is True:
            raise FileFormatError(
                f"{path}: truncated file: must have the table {TABLE_NAME} that belongs to "
                f"{INSTRUMENT_NAME}, has none"
            )
    return table, instrument


def _require_no_tables(header, path):
    if "WPDCTAB" in header:
        raise FileFormatError(
            f"{path}: must have the tables WPDC_... that its keyword WPDCTAB refers to, has none: "
            "it was cut short, or the header was copied without them (export it as tpv or head)"
        )


def _only(numbers, path):
    if len(numbers) == 1:
        return numbers[0]
    if not numbers:
        raise FileFormatError(f"{path}: must hold a header with CTYPE1, CRVAL1, ...; found none")
    raise FileFormatError(
        f"{path}: has {len(numbers)} WCS headers; choose one with path[N], "
        f"N one of {listed([str(n) for n in numbers], kind='headers')}"
    )


def _read_table(hdu, name):
    try:
        missing = [c for c in TABLE_COLUMNS if c not in hdu.columns.names]
        if missing:
            raise FileFormatError(f"{name}: column {missing[0]} is missing")
        x, y, dx, dy = (np.array(hdu.data[c], float) for c in TABLE_COLUMNS)
        method = header_text(hdu.header, "METHOD") or "cubic"
    except READ_ERRORS as problem:
        raise FileFormatError(f"{name}: damaged table: {first_line(problem)}") from problem
    x_grid, y_grid = np.unique(x), np.unique(y)
    shape = len(y_grid), len(x_grid)
    if shape[0] * shape[1] != len(x) or not (
        np.array_equal(x.reshape(shape), np.broadcast_to(x_grid, shape))
        and np.array_equal(y.reshape(shape), np.broadcast_to(y_grid[:, None], shape))
    ):
        raise FileFormatError(
            f"{name}: nodes must be a full grid with x running fastest, got {len(x)} rows with "
            f"{shape[1]} values of X_GRID and {shape[0]} of Y_GRID"
        )
    # From one-based to zero-based; nodes that are evenly spaced up to rounding become exactly so.
    grids = []
    for grid in (x_grid - 1.0, y_grid - 1.0):
        even = np.linspace(grid[0], grid[-1], len(grid))
        grids.append(even if np.allclose(grid, even, rtol=0, atol=1e-9) else grid)
    try:
        return LookupTable(*grids, dx.reshape(shape), dy.reshape(shape), method=method)
    except ValueError as problem:
        raise FileFormatError(f"{name}: {first_line(problem)}") from problem


def _read_instrument(hdu, name):
    try:
        row = {c: np.array(hdu.data[c][0]) for c in hdu.columns.names}
        return {
            "crpix": row["CRPIX"].astype(float),
            "cd": row["CD"].astype(float).reshape(2, 2),
            "crval": row["CRVAL"].astype(float),
            "pv": PVPolynomial.from_coefficients(
                row["PV"].astype(float).reshape(2, -1),
                degree=int(row["DEGREE"]),
                radial=bool(row["RADIAL"]),
            ),
        }
    except READ_ERRORS as problem:
        raise FileFormatError(f"{name}: damaged table: {first_line(problem)}") from problem


def _agree(instrument, tan):
    """Return whether the keywords agree with the instrument table: they may have been edited."""
    if instrument["pv"].degree != tan.pv.degree or instrument["pv"].radial != tan.pv.radial:
        return False
    folded = fold_attitude(instrument["pv"], np.linalg.solve(instrument["cd"].T, tan.cd.T).T)
    same = np.allclose(folded.coefficients, tan.pv.coefficients, rtol=1e-9, atol=1e-13)
    return same and np.allclose(instrument["crpix"], tan.crpix, rtol=0, atol=1e-9)
