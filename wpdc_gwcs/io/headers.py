"""What FITS headers say: the WCS, the epoch, the camera.  Only here do pixels count from one.

::

    FITS file, .head or text file --read_headers--> headers
    header --parse_tan--> TanHeader (CRPIX, CD, CRVAL, PV: exact)      TAN, TPV, TAN + PV
    header --parse_wcs--> astropy.wcs.WCS                              these, SIP, and whatever else
"""

import math
import re
import warnings
from dataclasses import dataclass

import numpy as np
from astropy import units as u
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.wcs import WCS, WcsError
from astropy.wcs.utils import wcs_to_celestial_frame

from wpdc_gwcs.exceptions import FileFormatError
from wpdc_gwcs.io.files import READ_ERRORS, file_kind, first_line, open_fits, split_extension
from wpdc_gwcs.models import PVPolynomial, pv_terms
from wpdc_gwcs.models.attitude import fold_attitude

__all__ = [
    "TanHeader",
    "clean_header",
    "extension_names",
    "find_extension",
    "header_number",
    "header_shape",
    "header_text",
    "header_value",
    "parse_tan",
    "parse_wcs",
    "positive_number",
    "read_headers",
]

_PV_CARD = re.compile(r"PV([12])_(\d+)")
_TABLE_CARD = re.compile(r"(CPDIS|CQDIS|D2IMDIS)[12]")
# SIP whatever CTYPE says, and the plate solution of the Digitized Sky Survey.
_DISTORTION_CARD = re.compile(r"[AB]_ORDER|AMDX1")
_CARD_START = re.compile(r"[A-Z0-9_-]{1,8} *= *\S")
_LONGITUDES = ("RA", "GLON", "ELON")
_LATITUDES = ("DEC", "GLAT", "ELAT")
# Highest PV index of each degree, the radial term of odd degrees included.
_LAST_INDEX = {1: 3, 2: 6, 3: 11, 4: 16, 5: 23, 6: 30, 7: 39}
_RADIAL = (3, 11, 23, 39)


@dataclass(frozen=True, eq=False)
class TanHeader:
    """The numbers of a TAN, TPV or TAN + PV header, axes in the order RA, Dec.

    Parameters
    ----------
    crpix : (2,) ndarray
        Reference pixel, zero based.
    cd : (2, 2) ndarray
        Linear map, deg / px; rows are xi and eta.
    crval : (2,) ndarray
        RA and Dec of the reference point, deg.
    pv : `~wpdc_gwcs.models.PVPolynomial`
        Distortion of (xi, eta); the identity for a plain TAN header.
    image_shape : (int, int) or None
        ``(ny, nx)``, where the header tells.
    """

    crpix: np.ndarray
    cd: np.ndarray
    crval: np.ndarray
    pv: PVPolynomial
    image_shape: tuple[int, int] | None = None

    def to_wcs(self):
        """Build the `astropy.wcs.WCS` that says the same.

        Returns
        -------
        wcs : `~astropy.wcs.WCS`
            TPV, or TAN where there is no distortion; RA is the first world axis.
        """
        coefficients = self.pv.coefficients
        distorted = not np.array_equal(coefficients, PVPolynomial(self.pv.degree).coefficients)
        wcs = WCS(naxis=2)
        code = "TPV" if distorted else "TAN"
        wcs.wcs.ctype = [f"RA---{code}", f"DEC--{code}"]
        wcs.wcs.cunit = ["deg", "deg"]
        wcs.wcs.crpix = self.crpix + 1.0
        wcs.wcs.cd = self.cd
        wcs.wcs.crval = self.crval
        wcs.wcs.lonpole = 180.0
        wcs.wcs.radesys = "ICRS"
        if distorted:
            wcs.wcs.set_pv(
                [
                    (axis + 1, int(j), float(value))
                    for axis in (0, 1)
                    for j, value in zip(self.pv.term_indices, coefficients[axis], strict=True)
                ]
            )
        wcs.wcs.set()
        if self.image_shape is not None:
            wcs.array_shape = self.image_shape
        return wcs


def clean_header(text):
    r"""Build a header from text, whatever its line ends, padding and encoding accidents.

    Parameters
    ----------
    text : bytes
        Cards of 80 bytes with or without line ends, NULs for blanks and latin-1 in comments
        allowed.

    Returns
    -------
    headers : list of `~astropy.io.fits.Header`
        One for each ``END`` card (or for the end of the text); without COMMENT and HISTORY.

    Examples
    --------
    >>> from wpdc_gwcs.io.headers import clean_header
    >>> clean_header("CRVAL1  = 1.5 / é\nEND\n".encode("latin-1"))[0]["CRVAL1"]
    1.5
    """
    text = text.replace(b"\0", b" ").decode("latin-1")
    text = re.sub(r"[^\x20-\x7e\r\n]", "?", text)
    lines = text.splitlines()
    if any(len(line) > 240 for line in lines):
        lines = [line[i : i + 80] for line in lines for i in range(0, len(line), 80)]
    headers, cards = [], []
    for line in [*lines, "END"]:
        if line.rstrip() == "END":
            if cards:
                headers.append(fits.Header(cards))
            cards = []
        elif _CARD_START.match(line):
            cards.append(fits.Card.fromstring(line[:80].ljust(80)))
    return headers


def read_headers(path):
    """Read every header with a WCS from a file.

    Parameters
    ----------
    path : path-like
        FITS file, ``path[EXT]``, SCAMP ``.head`` file, or any text file of header cards.

    Returns
    -------
    headers : list of `~astropy.io.fits.Header`
        Headers with a ``CTYPE1``, in the order of the file; copies that live on without the file.

    Raises
    ------
    FileFormatError
        If the file is missing, empty, damaged or has no such header.
    """
    path, extension = split_extension(path)
    if file_kind(path) == "fits":
        with open_fits(path) as hdus:
            if extension is None:
                chosen = list(hdus)
            else:
                chosen = [hdus[find_extension(hdus, extension, path)]]
            headers = [hdu.header.copy() for hdu in chosen]
    else:
        # Some keep the 80-byte cards of FITS in a file without line ends: the same thing to read.
        headers = clean_header(path.read_bytes())
        if extension is not None:
            if not isinstance(extension, int) or not 0 <= extension < len(headers):
                raise FileFormatError(
                    f"{path}: header number must be below {len(headers)}, got {extension!r}"
                )
            headers = [headers[extension]]
    headers = [header for header in headers if "CTYPE1" in header]
    if not headers:
        raise FileFormatError(f"{path}: must hold a header with CTYPE1, CRVAL1, ...; found none")
    return headers


def find_extension(hdus, extension, path, *, error=FileFormatError):
    """Find an extension by number, name, or ``NAME,VERSION``.

    Parameters
    ----------
    hdus : `~astropy.io.fits.HDUList`
        The open file.
    extension : int or str
        What stood in the brackets.
    path : path-like
        For messages.
    error : type, optional
        Subclass of `~wpdc_gwcs.exceptions.InputError` that is raised.

    Returns
    -------
    index : int
        Number of the extension.

    Raises
    ------
    InputError
        If there is no such extension.
    """
    key = extension
    if isinstance(key, str) and "," in key:
        name, version = key.rsplit(",", 1)
        if version.strip().isdigit():
            key = name.strip(), int(version)
    try:
        index = hdus.index_of(key)
        hdus[index]
    except (KeyError, IndexError):
        raise error(
            f"{path}: extension must be one of {extension_names(hdus)}, got {extension!r}"
        ) from None
    return index


def extension_names(hdus):
    """List the extensions of a file for a message.

    Parameters
    ----------
    hdus : `~astropy.io.fits.HDUList`
        The open file.

    Returns
    -------
    text : str
        Numbers and names.
    """
    return ", ".join(f"{i} {hdu.name}".strip() for i, hdu in enumerate(hdus))


def header_text(header, key):
    """Give a keyword as stripped text, an empty one if it is absent, blank or broken.

    Parameters
    ----------
    header : `~astropy.io.fits.Header`
        The header.
    key : str
        Keyword.

    Returns
    -------
    text : str
        Its value.
    """
    value = header_value(header, key)
    return "" if value is None else str(value).strip()


def header_value(header, key):
    """Give the value of a keyword.

    Parameters
    ----------
    header : `~astropy.io.fits.Header`
        The header.
    key : str
        Keyword.

    Returns
    -------
    value : object
        `None` if it is absent, undefined or cannot be parsed.
    """
    if key not in header:
        return None
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            value = header[key]
    except (fits.VerifyError, ValueError):
        return None
    return None if isinstance(value, fits.card.Undefined) else value


def header_number(
    header, key, *, name="header", required=True, default=None, error=FileFormatError
):
    """Give a keyword as a finite number.

    Parameters
    ----------
    header : `~astropy.io.fits.Header`
        The header.
    key : str
        Keyword.
    name : str, optional
        What messages call the header.
    required : bool, optional
        Whether the card must be there.
    default : float, optional
        Given for an absent card that is not required.
    error : type, optional
        Subclass of `~wpdc_gwcs.exceptions.InputError` that is raised.

    Returns
    -------
    number : float
        Its value.

    Raises
    ------
    InputError
        If the card is missing or not a finite number.
    """
    if key not in header:
        if required:
            raise error(f"{name}: card {key} is missing")
        return default
    value = header_value(header, key)
    if isinstance(value, bool | str | complex) or value is None or not math.isfinite(value):
        shown = "what cannot be parsed" if value is None else repr(value)
        raise error(f"{name}: card {key} must be a finite number, got {shown}")
    return float(value)


def positive_number(headers, keys):
    """Give the first positive finite number among some keywords.

    Parameters
    ----------
    headers : sequence of `~astropy.io.fits.Header`
        Looked through in turn.
    keys : sequence of str
        Keywords, best first.

    Returns
    -------
    number : float or None
        `None` if there is none.
    """
    for header in headers:
        for key in keys:
            value = header_value(header, key)
            if (
                isinstance(value, int | float)
                and not isinstance(value, bool)
                and math.isfinite(value)
                and value > 0
            ):
                return float(value)
    return None


def header_shape(header):
    """Give the shape of the image a header belongs to.

    Parameters
    ----------
    header : `~astropy.io.fits.Header`
        The header; of a tile-compressed image or of astrometry.net as well.

    Returns
    -------
    shape : (int, int) or None
        ``(ny, nx)``; `None` if the header does not tell.
    """
    for x, y in (("ZNAXIS1", "ZNAXIS2"), ("NAXIS1", "NAXIS2"), ("IMAGEW", "IMAGEH")):
        if x.startswith("NAXIS") and header_text(header, "XTENSION") in ("BINTABLE", "TABLE"):
            continue
        nx, ny = header_value(header, x), header_value(header, y)
        sizes = [n for n in (nx, ny) if isinstance(n, int | float) and n >= 1 and n == int(n)]
        if len(sizes) == 2:
            return int(ny), int(nx)
    return None


def parse_tan(header, *, name="header", error=FileFormatError, ignore_tables=False):
    """Read a TAN, TPV or TAN + PV header exactly.

    Parameters
    ----------
    header : `~astropy.io.fits.Header`
        Header with CD, PC + CDELT or CDELT + CROTA; axes in either order.
    name : str, optional
        What messages call the header.
    error : type, optional
        Subclass of `~wpdc_gwcs.exceptions.InputError` that is raised.
    ignore_tables : bool, optional
        Whether to read a header with look-up tables (``CPDIS``, ``D2IMDIS``) as if it had none.

    Returns
    -------
    tan : TanHeader or None
        `None` for celestial headers of other kinds (SIP, look-up tables, plate solutions, other
        projections, galactic axes), which `parse_wcs` reads.

    Raises
    ------
    InputError
        If the axes are not celestial, a card is missing or not a number, or CD is singular.

    Notes
    -----
    ``RA---TAN`` with PV cards of index 5 or more, or with any on the Dec axis, is TPV, as SCAMP
    wrote it before version 2.0.  Absent PV cards have the defaults of the convention, 0, and 1 for
    PVi_1; but where one axis has all terms of its degree and the other lacks some of them, a card
    was lost.
    """
    order, codes = _celestial_axes(header, name, error)
    if codes[0] not in ("TAN", "TPV") or header_text(header, "CTYPE1")[:2] not in ("RA", "DE"):
        return None
    if any(_DISTORTION_CARD.fullmatch(key) for key in header):
        return None
    if not ignore_tables and any(_TABLE_CARD.fullmatch(key) for key in header):
        return None
    numbers = {
        (int(m[1]), int(m[2])) for key in header if (m := _PV_CARD.fullmatch(key)) is not None
    }
    latitude = order[1] + 1
    is_tpv = codes[0] == "TPV" or any(
        j >= 5 or (axis == latitude and j >= 1) for axis, j in numbers
    )
    if codes[0] == "TAN" and not is_tpv and numbers:
        # PV on the RA axis of a plain TAN moves the native pole: rare enough to leave to wcslib.
        return None

    def number(key, **options):
        return header_number(header, key, name=name, error=error, **options)

    scale = [_degrees(header, axis, name, error) for axis in (1, 2)]
    crval = np.array([number(f"CRVAL{axis}") * scale[axis - 1] for axis in (1, 2)])[order]
    crpix = np.array([number("CRPIX1"), number("CRPIX2")]) - 1.0
    cd = (_linear(header, order, number, name, error) * np.array(scale)[:, None])[order]
    spread = np.abs(cd).max()
    if not spread > 0 or abs(np.linalg.det(cd)) < 1e-10 * spread**2:
        rows = ", ".join(f"{v:.6g}" for v in cd.ravel())
        raise error(f"{name}: CD matrix must not be singular, got [{rows}]")
    if not -90.0 <= crval[1] <= 90.0:
        raise error(f"{name}: declination CRVAL must lie in [-90, 90] deg, got {crval[1]:g}")
    pv = _read_pv(numbers if is_tpv else set(), order, number, name, error)
    # Paper II: the default LONPOLE of a zenithal projection is 0 where the pole is the reference
    # point.
    lonpole = number("LONPOLE", required=False, default=180.0 if crval[1] < 90.0 else 0.0)
    if lonpole != 180.0:
        a = np.radians(180.0 - lonpole)
        turn = np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]])
        cd, pv = turn @ cd, fold_attitude(pv, turn)
    return TanHeader(crpix, cd, crval, pv, header_shape(header))


def _celestial_axes(header, name, error):
    """Which axis is longitude and which latitude, and their projection codes."""
    types = [header_text(header, f"CTYPE{axis}").upper() for axis in (1, 2)]
    kinds = [t[:5].strip("-").split("-")[0] for t in types]
    order = None
    for i, j in ((0, 1), (1, 0)):
        if kinds[i] in _LONGITUDES and kinds[j] == _LATITUDES[_LONGITUDES.index(kinds[i])]:
            order = [i, j]
    if order is None:
        raise error(
            f"{name}: CTYPE1 and CTYPE2 must be a celestial pair such as 'RA---TAN' and "
            f"'DEC--TAN', got {types[0]!r} and {types[1]!r}"
        )
    codes = [t[5:] for t in types]
    if codes[0] != codes[1]:
        raise error(
            f"{name}: CTYPE1 and CTYPE2 must have the same projection, "
            f"got {types[0]!r} and {types[1]!r}"
        )
    return order, codes


def _degrees(header, axis, name, error):
    """Degrees per unit of an axis."""
    text = header_text(header, f"CUNIT{axis}")
    if not text:
        return 1.0
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return u.Unit(text.lower()).to(u.deg)
    except (ValueError, TypeError, u.UnitConversionError) as problem:
        raise error(f"{name}: CUNIT{axis} must be an angle, got {text!r}") from problem


def _linear(header, order, number, name, error):
    """Linear map of pixels to intermediate world coordinates in the units of the header."""
    keys = np.array([["CD1_1", "CD1_2"], ["CD2_1", "CD2_2"]])
    present = np.array([[k in header for k in row] for row in keys])
    if present.any():
        # Writers leave out zeros in pairs; a single gap is a lost card.
        for pair in ([(0, 0), (1, 1)], [(0, 1), (1, 0)]):
            if len({present[i] for i in pair}) > 1:
                gone = next(keys[i] for i in pair if not present[i])
                raise error(f"{name}: card {gone} is missing")
        return np.array([[number(k, required=False, default=0.0) for k in row] for row in keys])
    cdelt = np.array([number("CDELT1"), number("CDELT2")])
    # PC001001 is how a draft of the standard spelled PC1_1; wcslib still reads it.
    for key in ("PC{}_{}", "PC00{}00{}"):
        if any(key.format(i, j) in header for i in (1, 2) for j in (1, 2)):
            pc = [
                [number(key.format(i, j), required=False, default=float(i == j)) for j in (1, 2)]
                for i in (1, 2)
            ]
            return cdelt[:, None] * np.array(pc)
    lon, lat = order
    rho = np.radians(number(f"CROTA{lat + 1}", required=False, default=0.0))
    linear = np.diag(cdelt * np.cos(rho))
    linear[lon, lat] = -cdelt[lat] * np.sin(rho)
    linear[lat, lon] = cdelt[lon] * np.sin(rho)
    return linear


def _read_pv(numbers, order, number, name, error):
    """Build the polynomial of the PV cards; `order` brings the axes to RA, Dec."""
    indices = [sorted(j for axis, j in numbers if axis == i + 1) for i in order]
    if not any(indices):
        return PVPolynomial(1)
    highest = max(max(i, default=0) for i in indices)
    if highest > _LAST_INDEX[7]:
        raise error(f"{name}: PV index must not exceed 39, got {highest}")
    degree = next(d for d, last in _LAST_INDEX.items() if highest <= last)
    complete = set(pv_terms(degree).index.tolist())
    for i, axis in enumerate(order):
        missing = sorted(complete - set(indices[i]))
        if missing and (complete <= set(indices[1 - i]) or not indices[i]):
            raise error(f"{name}: card PV{axis + 1}_{missing[0]} is missing")
    values = [{j: number(f"PV{axis + 1}_{j}") for j in indices[i]} for i, axis in enumerate(order)]
    radial = any(axis.get(j, 0.0) != 0.0 for axis in values for j in _RADIAL)
    coefficients = [
        [axis.get(j, 1.0 if j == 1 else 0.0) for j in pv_terms(degree, radial).index.tolist()]
        for axis in values
    ]
    return PVPolynomial.from_coefficients(np.array(coefficients), degree=degree, radial=radial)


def parse_wcs(header, *, hdus=None, name="header", error=FileFormatError):
    """Read any celestial header as a starting WCS in ICRS.

    Parameters
    ----------
    header : `~astropy.io.fits.Header`
        The header.
    hdus : `~astropy.io.fits.HDUList`, optional
        File of the header, for look-up tables in it.
    name : str, optional
        What messages call the header.
    error : type, optional
        Subclass of `~wpdc_gwcs.exceptions.InputError` that is raised.

    Returns
    -------
    wcs : `~astropy.wcs.WCS`
        RA is the first world axis, in ICRS (FK5 of J2000 is taken for it: 0.02 arcsec).

    Raises
    ------
    InputError
        If the header is not a usable celestial WCS.
    """
    tan = parse_tan(header, name=name, error=error)
    if tan is not None:
        wcs = tan.to_wcs()
        _copy_frame(header, wcs)
    else:
        wcs = _parse_other(header, hdus, name, error)
    return _to_icrs(wcs, name, error)


def _copy_frame(header, wcs):
    system = (header_text(header, "RADESYS") or header_text(header, "RADECSYS")).upper()
    equinox = header_value(header, "EQUINOX")
    if equinox is None:
        equinox = header_value(header, "EPOCH")
    if isinstance(equinox, str):
        equinox = float(equinox.strip("JB ")) if re.fullmatch(r"[JB ]*[\d.]+ *", equinox) else None
    if not isinstance(equinox, int | float) or not 1800 <= equinox <= 2200:
        equinox = None
    if system not in ("FK4", "FK5"):
        system = "ICRS" if system or equinox is None else "FK4" if equinox < 1984.0 else "FK5"
    wcs.wcs.radesys = system
    if system != "ICRS":
        wcs.wcs.equinox = equinox or (1950.0 if system == "FK4" else 2000.0)
    wcs.wcs.set()


def _parse_other(header, hdus, name, error):
    """SIP, other projections, look-up tables: what astropy makes of it."""
    if "SIP" in header_text(header, "CTYPE1"):
        # SIP wins over what SCAMP left beside it.
        header = header.copy()
        for key in [k for k in header if _PV_CARD.fullmatch(k)]:
            del header[key]
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            wcs = WCS(header, fobj=hdus, naxis=2)
            wcs.wcs.set()
    except (WcsError, *READ_ERRORS) as problem:
        # wcslib mixes what it is with the places in its own code.
        lines = [line for line in str(problem).splitlines() if line and "ERROR" not in line]
        reason = lines[-1] if lines else first_line(problem)
        raise error(f"{name}: not a usable WCS: {reason}") from problem
    if not wcs.has_celestial:
        raise error(f"{name}: WCS must be celestial, got {list(wcs.wcs.ctype)}")
    if wcs.wcs.lng == 1:
        # Swap the world axes and only these: `sub` would swap the pixel axes with them.
        linear = wcs.pixel_scale_matrix[::-1].copy()
        ctype, crval = list(wcs.wcs.ctype)[::-1], wcs.wcs.crval[::-1].copy()
        pv = [(3 - axis, m, value) for axis, m, value in wcs.wcs.get_pv()]
        if wcs.wcs.has_cd():
            wcs.wcs.cd = linear
        else:
            wcs.wcs.pc, wcs.wcs.cdelt = linear, [1.0, 1.0]
        wcs.wcs.ctype, wcs.wcs.crval = ctype, crval
        wcs.wcs.set_pv(pv)
        wcs.wcs.set()
    shape = header_shape(header)
    if shape is not None:
        wcs.array_shape = shape
    return wcs


def _to_icrs(wcs, name, error):
    """Turn the sphere of a WCS to ICRS: another CRVAL, another LONPOLE, all else stays."""
    try:
        frame = wcs_to_celestial_frame(wcs)
    except ValueError as problem:
        raise error(f"{name}: not a usable celestial frame: {first_line(problem)}") from problem
    equinox = getattr(getattr(frame, "equinox", None), "jyear", 2000.0)
    if frame.name == "icrs" or (frame.name == "fk5" and abs(equinox - 2000.0) < 1e-3):
        return wcs
    lon, lat = wcs.wcs.crval
    if wcs.wcs.theta0 == 90.0:
        # Of a zenithal projection, the reference point is the pole of the native sphere.
        north = min(lat + 1e-3, 90.0)
        if not north > lat:
            raise error(f"{name}: {frame.name} frame cannot be turned to ICRS at its own pole")
        points = SkyCoord([lon, lon], [lat, north], unit="deg", frame=frame).icrs
        lonpole = wcs.wcs.lonpole + points[0].position_angle(points[1]).deg
        latpole = math.nan
        reference = points[0]
    else:
        reference = SkyCoord(lon, lat, unit="deg", frame=frame).icrs
        pole = SkyCoord(0.0, 90.0, unit="deg", frame="icrs").transform_to(frame).spherical
        native = wcs.wcs.s2p([[pole.lon.deg, pole.lat.deg]], 0)
        lonpole, latpole = float(native["phi"][0]), float(native["theta"][0])
    before = wcs.deepcopy()
    wcs.wcs.crval = [reference.ra.deg, reference.dec.deg]
    wcs.wcs.lonpole, wcs.wcs.latpole = lonpole, latpole
    wcs.wcs.ctype = [
        re.sub("^.LON-", "RA---", wcs.wcs.ctype[0]),
        re.sub("^.LAT-", "DEC--", wcs.wcs.ctype[1]),
    ]
    wcs.wcs.radesys, wcs.wcs.equinox = "ICRS", math.nan
    wcs.wcs.set()
    _check_turned(before, wcs, frame, name, error)
    return wcs


def _check_turned(before, after, frame, name, error):
    """Compare a WCS turned to ICRS with what it was, around its reference point."""
    x, y = before.wcs.crpix[:, np.newaxis] - 1.0 + 50.0 * np.array([[-1, 1, 1, -1], [-1, -1, 1, 1]])
    lon, lat = before.wcs_pix2world(x, y, 0)
    ra, dec = after.wcs_pix2world(x, y, 0)
    expected = SkyCoord(lon, lat, unit="deg", frame=frame).icrs
    if not np.all(expected.separation(SkyCoord(ra, dec, unit="deg")).deg < 1e-7):
        raise error(f"{name}: {frame.name} axes of this projection cannot be turned to ICRS")
