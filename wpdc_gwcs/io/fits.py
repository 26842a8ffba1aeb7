"""Calibrations as standard FITS: TPV with our table, TPV with Paper IV tables, ``.head``, SIP.

::

    sky = TAN^-1( PV(U) - CD table(x) ) about CRVAL,    U = CD (x - CRPIX)

========= ============================================================== =======================
format    content                                                        exact for
========= ============================================================== =======================
``fits``  TPV keywords, BINTABLE ``WPDC_LUT``                            this package, all of it
``cpdis`` TPV keywords, ``CPDIS`` look-up tables in front of CD and PV   astropy, to 1e-3 px
``head``  TPV keywords as text                                           the PV part
``sip``   SIP polynomials fitted to everything                           nothing, by what is told
========= ============================================================== =======================
"""

import textwrap
import warnings

import numpy as np
from astropy.io import fits
from astropy.wcs import WCS

from wpdc_gwcs.exceptions import FileFormatError, WPDCWarning
from wpdc_gwcs.io.files import (
    READ_ERRORS,
    atomic_path,
    file_kind,
    first_line,
    open_fits,
    split_extension,
    stem_of,
)
from wpdc_gwcs.io.headers import clean_header, find_extension, header_text
from wpdc_gwcs.io.integrity import FORMAT_VERSION, check_sums, check_version
from wpdc_gwcs.io.sip import fit_sip, fit_sip_inverse
from wpdc_gwcs.io.tan import fold_attitude, parse_tan
from wpdc_gwcs.models import LookupTable, PVPolynomial, project
from wpdc_gwcs.solution import Calibration, DistortionSolution

__all__ = [
    "deviation",
    "read_fits",
    "tpv_header",
    "write_cpdis",
    "write_fits",
    "write_head",
    "write_sip",
]

_TABLE_NAME = "WPDC_LUT"
_INSTRUMENT_NAME = "WPDC_INSTRUMENT"
_TABLE_COLUMNS = ("X_GRID", "Y_GRID", "DX_LUT", "DY_LUT")
_CPDIS_TOLERANCE = 5e-4  # px, aimed at; 1e-3 is promised
_CPDIS_MOST_NODES = 1 << 22
_SIP_DEGREES = range(2, 10)


def write_fits(obj, path, *, overwrite=False):
    """Write TPV keywords and the look-up table as a binary table.

    Parameters
    ----------
    obj : `~wpdc_gwcs.Calibration` or `~wpdc_gwcs.DistortionSolution`
        What to write; a solution about its nominal pointing.
    path : path-like
        File to write.
    overwrite : bool, optional
        Whether an existing file may be replaced.

    Notes
    -----
    ``WPDC_LUT`` has one row for each node, x running fastest: ``X_GRID``, ``Y_GRID`` in FITS pixels
    (from one) and ``DX_LUT``, ``DY_LUT``, px, to be subtracted from the undistorted position.  The
    attitude of the exposure is folded into the polynomial, ``PV(U) = A PV0(A^-1 U)``, where
    ``A = CD CD0^-1``.  The one row of ``WPDC_INSTRUMENT`` has CD0, PV0, the zero-based CRPIX and
    the nominal CRVAL as they are, so that what is read back is the same to the last bit.
    """
    _write_hdus([fits.PrimaryHDU(header=tpv_header(obj)), *_own_hdus(obj)], path, overwrite)


def read_fits(path):
    """Read a TAN, TPV or TAN + PV header, with our look-up table where there is one.

    Parameters
    ----------
    path : path-like
        FITS file, ``path[EXT]``, SCAMP ``.head`` or other text file of one header.

    Returns
    -------
    calibration : `~wpdc_gwcs.Calibration`
        CD0 is the CD of the header; ``image_shape`` is `None` where the header does not tell.

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
                number = _only([i for i, hdu in enumerate(hdus) if "CTYPE1" in hdu.header], path)
            header = hdus[number].header.copy()
            several = len(hdus) > 1
            if "WPDCVERS" in header:
                check_sums(hdus, path)
            if _TABLE_NAME in hdus:
                table = _read_table(hdus[_TABLE_NAME], f"{path}[{_TABLE_NAME}]")
            if _INSTRUMENT_NAME in hdus:
                instrument = _read_instrument(hdus[_INSTRUMENT_NAME], f"{path}[{_INSTRUMENT_NAME}]")
        if several and extension is not None:
            name = f"{path}[{extension}]"
    else:
        headers = [h for h in clean_header(path.read_bytes()) if "CTYPE1" in h]
        number = extension if isinstance(extension, int) else _only(range(len(headers)), path)
        if not 0 <= number < len(headers):
            raise FileFormatError(f"{path}: header number must be < {len(headers)}, got {number}")
        header = headers[number]
    version = header_text(header, "WPDCVERS")
    if version:
        check_version(version, path)
    tan = parse_tan(header, name=name, ignore_tables=table is not None)
    if tan is None:
        raise FileFormatError(
            f"{name}: header must be TAN or TPV without look-up tables of others to be a "
            f"calibration, got {header_text(header, 'CTYPE1')!r}; as a starting WCS it can be read"
        )
    if instrument is None or not _agree(instrument, tan):
        instrument = {"crpix": tan.crpix, "cd": tan.cd, "crval": tan.crval, "pv": tan.pv}
    solution = DistortionSolution(
        detector=header_text(header, "DETECTOR") or header_text(header, "EXTNAME") or "detector",
        image_shape=tan.image_shape,
        lookup_table=table,
        **instrument,
        provenance={"file": str(path)},
    )
    frame = header_text(header, "FRAME") or stem_of(path)
    return Calibration(frame=frame, solution=solution, crval=tan.crval, cd=tan.cd)


def write_cpdis(obj, path, *, overwrite=False):
    """Write TPV keywords and the look-up table in the form that plain astropy.wcs applies.

    Parameters
    ----------
    obj : `~wpdc_gwcs.Calibration` or `~wpdc_gwcs.DistortionSolution`
        What to write.
    path : path-like
        File to write.
    overwrite : bool, optional
        Whether an existing file may be replaced.

    Returns
    -------
    deviation : float
        Greatest deviation from the exact WCS, px.

    Warns
    -----
    WPDCWarning
        If that is more than 1e-3 px however dense the table.

    Notes
    -----
    ``CPDIS`` (Paper IV) acts on the pixel position, in front of CD and PV, and is bilinear.  A
    shift d that does there what the table does behind PV is found at every node by Newton's method:
    ``PV(CD (x + d - CRPIX)) = PV(CD (x - CRPIX)) - CD table(x)``.  The nodes are made denser by
    factors of two until astropy.wcs agrees everywhere.  The tables of the format ``fits`` are there
    as well, for an exact way back.
    """
    header = tpv_header(obj)
    _require_shape(obj)
    table = obj.lookup_table
    hdus, worst, factor = [fits.PrimaryHDU(header=header)], np.inf, 1
    while table is not None and worst > _CPDIS_TOLERANCE:
        grids = [
            np.linspace(g[0], g[-1], (len(g) - 1) * factor + 1)
            for g in (table.x_grid, table.y_grid)
        ]
        if factor > 1 and len(grids[0]) * len(grids[1]) > _CPDIS_MOST_NODES:
            break
        hdus = _cpdis_hdus(header, grids, _prior_shift(obj, *np.meshgrid(*grids)))
        worst = deviation(obj, _astropy_sky(hdus))
        factor *= 2
    if table is None:
        worst = deviation(obj, _astropy_sky(hdus))
    if worst > 1e-3:
        warnings.warn(
            f"{path}: the look-up table cannot be made dense enough: plain astropy.wcs deviates by "
            f"up to {worst:.2g} px",
            WPDCWarning,
        )
    _add_history(hdus[0].header, f"greatest deviation of astropy.wcs: {worst:.3g} px")
    _write_hdus([*hdus, *_own_hdus(obj)], path, overwrite)
    return worst


def write_head(obj, path, *, overwrite=False):
    """Write the PV part as a SCAMP-style ``.head`` file.

    Parameters
    ----------
    obj : `~wpdc_gwcs.Calibration` or `~wpdc_gwcs.DistortionSolution`
        What to write.
    path : path-like
        File to write.
    overwrite : bool, optional
        Whether an existing file may be replaced.

    Returns
    -------
    deviation : float
        Greatest deviation from the exact WCS, px: the look-up table, which is left out.
    """
    header = tpv_header(obj)
    lines = [card.image for card in header.cards if card.keyword not in ("WPDCVERS", "COMMENT")]
    with atomic_path(path, overwrite=overwrite) as temporary:
        temporary.write_bytes("\n".join([*lines, "END".ljust(80), ""]).encode("ascii"))
    if obj_shape(obj) is None:
        return None
    return deviation(obj, _astropy_sky([fits.PrimaryHDU(header=header)]))


def write_sip(obj, path, *, overwrite=False, degree=None):
    """Write a TAN-SIP approximation of everything, look-up table included.

    Parameters
    ----------
    obj : `~wpdc_gwcs.Calibration` or `~wpdc_gwcs.DistortionSolution`
        What to write.
    path : path-like
        File to write.
    overwrite : bool, optional
        Whether an existing file may be replaced.
    degree : int, optional
        Degree of the polynomials, 2 to 9; the lowest that is nearly as good as any by default.

    Returns
    -------
    deviation : float
        Greatest deviation from the exact WCS, px.

    Notes
    -----
    SIP has no constant and no linear terms (Shupe et al. 2005, ASP Conf. Ser. 347, 491): the linear
    ones go into CD, and CRPIX moves to where the sky is CRVAL.
    """
    _require_shape(obj)
    if degree is not None and degree not in _SIP_DEGREES:
        raise ValueError(f"degree must be from 2 to 9, got {degree}")
    pixels, plane = _sip_samples(obj)
    trials = []
    for n in _SIP_DEGREES if degree is None else [degree]:
        sip = fit_sip(pixels, plane, n)
        worst = deviation(obj, _astropy_sky(_sip_hdus(obj, sip)), n=151)
        trials.append((worst, sip))
        if worst < 1e-4:
            break
    best = min(trial[0] for trial in trials)
    sip = next(trial[1] for trial in trials if trial[0] <= 1.1 * best)
    worst = deviation(obj, _astropy_sky(_sip_hdus(obj, sip)))
    for n in _SIP_DEGREES:
        inverse, inverse_worst = fit_sip_inverse(sip, pixels, plane, n)
        if inverse_worst <= max(worst, 1e-3):
            break
    hdus = _sip_hdus(obj, sip, inverse)
    _add_history(
        hdus[0].header,
        f"greatest deviation of the SIP approximation: {worst:.3g} px, "
        f"of its inverse polynomials (AP, BP): {inverse_worst:.3g} px",
    )
    _write_hdus(hdus, path, overwrite)
    return worst


def tpv_header(obj):
    """Give the header of a calibration: TPV keywords with 17 digits.

    Parameters
    ----------
    obj : `~wpdc_gwcs.Calibration` or `~wpdc_gwcs.DistortionSolution`
        A solution stands about its nominal pointing.

    Returns
    -------
    header : `~astropy.io.fits.Header`
        CTYPE, CRPIX (from one), CD, CRVAL, PV, RADESYS, units, HISTORY.
    """
    solution, cd, crval, _ = _parts(obj)
    header = _linear_header(obj, "TPV", solution.crpix, cd, crval)
    pv = fold_attitude(solution.pv, _relative(cd, solution.cd))
    for axis in (1, 2):
        for j, value in zip(pv.term_indices, pv.coefficients[axis - 1], strict=True):
            header.append(_number_card(f"PV{axis}_{j}", value, "[deg] distortion"), end=True)
    _add_provenance(header, obj)
    return header


def deviation(obj, sky, *, n=401):
    """Measure the greatest distance of another WCS from the exact one.

    Parameters
    ----------
    obj : `~wpdc_gwcs.Calibration` or `~wpdc_gwcs.DistortionSolution`
        The exact one.
    sky : callable
        ``sky(x, y)`` -> RA, Dec in deg of zero-based pixels.
    n : int, optional
        Points along each side of a grid from edge to edge.

    Returns
    -------
    deviation : float
        In undistorted pixels; NaN where the other has no answer counts as infinite.
    """
    solution, cd, crval, _ = _parts(obj)
    ny, nx = solution.image_shape
    x, y = np.meshgrid(np.linspace(-0.5, nx - 0.5, n), np.linspace(-0.5, ny - 0.5, n))
    x, y = x.ravel(), y.ravel()
    exact = np.array(obj.wcs.get_transform("detector", "undistorted")(x, y))
    plane = np.array(project(*sky(x, y), crval))
    other = np.linalg.solve(cd, plane) + np.asarray(solution.crpix)[:, None]
    distance = np.hypot(*(other - exact))[np.isfinite(exact).all(axis=0)]
    return float(np.where(np.isfinite(distance), distance, np.inf).max(initial=0.0))


def obj_shape(obj):
    """Give the shape of the detector of a calibration or solution.

    Parameters
    ----------
    obj : `~wpdc_gwcs.Calibration` or `~wpdc_gwcs.DistortionSolution`
        Either.

    Returns
    -------
    shape : (int, int) or None
        ``(ny, nx)``.
    """
    return _parts(obj)[0].image_shape


def _parts(obj):
    """Instrument, CD, CRVAL and name of a calibration or of a solution."""
    if isinstance(obj, Calibration):
        return obj.solution, np.asarray(obj.cd), np.asarray(obj.crval), obj.frame
    if isinstance(obj, DistortionSolution):
        return obj, np.asarray(obj.cd), np.asarray(obj.crval), ""
    raise TypeError(f"must be a Calibration or a DistortionSolution, got {type(obj).__name__}")


def _relative(cd, nominal):
    if np.array_equal(cd, nominal):
        return np.eye(2)
    return np.linalg.solve(np.asarray(nominal).T, np.asarray(cd).T).T


def _require_shape(obj):
    if obj_shape(obj) is None:
        raise FileFormatError("shape of the detector must be known for this format, is unknown")


def _only(numbers, path):
    if len(numbers) == 1:
        return numbers[0]
    if not numbers:
        raise FileFormatError(f"{path}: must hold a header with CTYPE1, CRVAL1, ...; found none")
    raise FileFormatError(
        f"{path}: has {len(numbers)} WCS headers; choose one with path[N], "
        f"N one of {', '.join(map(str, numbers[:12]))}"
    )


def _read_table(hdu, name):
    try:
        missing = [c for c in _TABLE_COLUMNS if c not in hdu.columns.names]
        if missing:
            raise FileFormatError(f"{name}: column {missing[0]} is missing")
        x, y, dx, dy = (np.array(hdu.data[c], float) for c in _TABLE_COLUMNS)
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
    # From one to zero; where the nodes are spaced as evenly as they can, so that they are again.
    grids = []
    for grid in (x_grid - 1.0, y_grid - 1.0):
        even = np.linspace(grid[0], grid[-1], len(grid))
        grids.append(even if np.allclose(grid, even, rtol=0, atol=1e-9) else grid)
    try:
        return LookupTable(*grids, dx.reshape(shape), dy.reshape(shape), method=method)
    except ValueError as problem:
        raise FileFormatError(f"{name}: {first_line(problem)}") from problem


def _own_hdus(obj):
    """Make the tables that bring the instrument back exactly."""
    solution = _parts(obj)[0]
    pv, table = solution.pv, obj.lookup_table
    values = {
        "CRPIX": ("2D", "pixel", solution.crpix),
        "CD": ("4D", "deg/pixel", solution.cd),
        "CRVAL": ("2D", "deg", solution.crval),
        "DEGREE": ("1J", None, pv.degree),
        "RADIAL": ("1L", None, pv.radial),
        "PV": (f"{pv.coefficients.size}D", "deg", pv.coefficients),
    }
    columns = [
        fits.Column(name, form, unit=unit, array=np.asarray(value).reshape(1, -1))
        for name, (form, unit, value) in values.items()
    ]
    instrument = fits.BinTableHDU.from_columns(columns, name=_INSTRUMENT_NAME)
    instrument.header.add_comment("CRPIX counts from zero; PV: axis 1, axis 2, by FITS index")
    if table is None:
        return [instrument]
    x, y = np.meshgrid(table.x_grid + 1.0, table.y_grid + 1.0)
    columns = [
        fits.Column(name, "D", unit="pixel", array=np.asarray(value).ravel())
        for name, value in zip(_TABLE_COLUMNS, (x, y, table.dx, table.dy), strict=True)
    ]
    nodes = fits.BinTableHDU.from_columns(columns, name=_TABLE_NAME)
    nodes.header["METHOD"] = (table.method, "interpolation between the nodes")
    nodes.header["NXGRID"] = (len(table.x_grid), "nodes along x, which runs fastest")
    nodes.header["NYGRID"] = (len(table.y_grid), "nodes along y")
    return [instrument, nodes]


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
    """Tell whether the keywords still say what the instrument says: they may have been edited."""
    if instrument["pv"].degree != tan.pv.degree or instrument["pv"].radial != tan.pv.radial:
        return False
    folded = fold_attitude(instrument["pv"], _relative(tan.cd, instrument["cd"]))
    same = np.allclose(folded.coefficients, tan.pv.coefficients, rtol=1e-9, atol=1e-13)
    return same and np.allclose(instrument["crpix"], tan.crpix, rtol=0, atol=1e-9)


def _number_card(keyword, value, comment=""):
    """Make a card with 17 significant digits, which bring every float64 back; astropy writes 16."""
    text = f"{keyword:<8}= {float(value):>24.16E}"
    return fits.Card.fromstring(f"{text} / {comment}"[:80].ljust(80))


def _linear_header(obj, code, crpix, cd, crval):
    solution, _, _, frame = _parts(obj)
    header = fits.Header()
    header["WCSAXES"] = (2, "number of axes")
    header["CTYPE1"] = (f"RA---{code}", "right ascension, projection")
    header["CTYPE2"] = (f"DEC--{code}", "declination, projection")
    for axis in (1, 2):
        header[f"CUNIT{axis}"] = ("deg", "unit")
    for axis in (1, 2):
        card = _number_card(f"CRVAL{axis}", crval[axis - 1], "[deg] reference point")
        header.append(card, end=True)
    for axis in (1, 2):
        card = _number_card(f"CRPIX{axis}", crpix[axis - 1] + 1.0, "[pixel] counted from one")
        header.append(card, end=True)
    for i in (1, 2):
        for j in (1, 2):
            header.append(_number_card(f"CD{i}_{j}", cd[i - 1, j - 1], "[deg/pixel]"), end=True)
    header["LONPOLE"] = (180.0, "[deg] native longitude of the pole")
    header["RADESYS"] = ("ICRS", "celestial frame")
    header["EQUINOX"] = (2000.0, "[yr] for readers that need it")
    if solution.image_shape is not None:
        header["IMAGEW"] = (int(solution.image_shape[1]), "[pixel] width of the detector")
        header["IMAGEH"] = (int(solution.image_shape[0]), "[pixel] height of the detector")
    header["DETECTOR"] = (_ascii(solution.detector)[:60], "detector")
    if frame:
        header["FRAME"] = (_ascii(frame)[:60], "frame")
    header["WPDCVERS"] = (FORMAT_VERSION, "format version of wpdc_gwcs")
    return header


def _ascii(text):
    return str(text).encode("ascii", "replace").decode()


def _add_provenance(header, obj):
    from wpdc_gwcs import __version__

    solution = _parts(obj)[0]
    _add_history(header, f"WCS by wpdc_gwcs {__version__}")
    settings = {**solution.settings, **getattr(obj, "settings", {})}
    for key, value in settings.items():
        _add_history(header, f"{key} = {value}")


def _add_history(header, text):
    for line in textwrap.wrap(_ascii(text), 70, subsequent_indent="  "):
        header.add_history(line)


def _write_hdus(hdus, path, overwrite):
    hdus = fits.HDUList(hdus)
    with atomic_path(path, overwrite=overwrite) as temporary:
        hdus.writeto(temporary, checksum=True)


def _astropy_sky(hdus):
    """Give what astropy.wcs makes of HDUs, as a function of zero-based pixels."""
    hdus = fits.HDUList(hdus)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        wcs = WCS(hdus[0].header, hdus)

    def sky(x, y):
        return wcs.all_pix2world(x, y, 0)

    return sky


def _prior_shift(obj, x, y):
    """Shift of the pixel position that does in front of PV what the table does behind it."""
    solution, cd, _, _ = _parts(obj)
    pv = fold_attitude(solution.pv, _relative(cd, solution.cd))
    shape = x.shape
    offset = np.array([x.ravel(), y.ravel()]) - np.asarray(solution.crpix)[:, None]
    shift_behind = np.array(obj.lookup_table(x.ravel(), y.ravel()))
    u = cd @ offset
    target = np.array(pv(*u)) - cd @ shift_behind
    v = u.copy()
    for _ in range(20):
        wrong = np.array(pv(*v)) - target
        (a, b), (c, d) = pv.jacobian(*v)
        step = np.array([d * wrong[0] - b * wrong[1], a * wrong[1] - c * wrong[0]]) / (
            a * d - b * c
        )
        v -= step
        if np.abs(np.linalg.solve(cd, step)).max() < 1e-10:
            break
    shift = np.linalg.solve(cd, v - u)
    if not np.isfinite(shift).all():
        raise FileFormatError("look-up table cannot be carried in front of the polynomial")
    return shift.reshape(2, *shape)


def _cpdis_hdus(header, grids, shift):
    header = header.copy()
    images = []
    for axis in (1, 2):
        header[f"CPDIS{axis}"] = ("LOOKUP", "prior distortion: look-up table")
        header[f"DP{axis}.EXTVER"] = (float(axis), "version of WCSDVARR")
        header[f"DP{axis}.NAXES"] = (2.0, "number of axes of the table")
        for i in (1, 2):
            header[f"DP{axis}.AXIS.{i}"] = (float(i), "axis of the image")
        image = fits.ImageHDU(shift[axis - 1].astype(np.float32), name="WCSDVARR", ver=axis)
        for i, grid in enumerate(grids, start=1):
            image.header[f"CRPIX{i}"] = (1.0, "first node")
            image.header.append(_number_card(f"CRVAL{i}", grid[0] + 1.0, "its pixel"), end=True)
            step = (grid[-1] - grid[0]) / (len(grid) - 1)
            image.header.append(_number_card(f"CDELT{i}", step, "pixels between nodes"), end=True)
        images.append(image)
    return [fits.PrimaryHDU(header=header), *images]


def _sip_samples(obj):
    """Give pixels and their plane coordinates (deg) for a fit."""
    solution, cd, _, _ = _parts(obj)
    ny, nx = solution.image_shape
    # Chebyshev points make least squares nearly the best approximation in the greatest error.
    t = np.cos(np.pi * (np.arange(64) + 0.5) / 64)
    x, y = np.meshgrid(0.5 * (nx - 1) + 0.5 * nx * t, 0.5 * (ny - 1) + 0.5 * ny * t)
    x, y = x.ravel(), y.ravel()
    undistorted = np.array(obj.wcs.get_transform("detector", "undistorted")(x, y))
    return np.array([x, y]), cd @ (undistorted - np.asarray(solution.crpix)[:, None])


def _sip_hdus(obj, sip, inverse=None):
    header = _linear_header(obj, "TAN-SIP", sip.crpix, sip.cd, _parts(obj)[2])
    for tag, terms in (("", sip.terms), ("P", inverse)):
        if terms is None:
            continue
        degree = terms.shape[1] - 1
        for letter, axis in zip("AB", terms, strict=True):
            header[f"{letter}{tag}_ORDER"] = (degree, "degree of the polynomial")
            for p, q in np.argwhere(np.add.outer(range(degree + 1), range(degree + 1)) <= degree):
                # The standard has neither constant nor linear terms in the forward polynomials.
                if tag or p + q > 1:
                    header.append(_number_card(f"{letter}{tag}_{p}_{q}", axis[p, q]), end=True)
    _add_provenance(header, obj)
    return [fits.PrimaryHDU(header=header)]
