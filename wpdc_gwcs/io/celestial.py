"""Celestial headers of any kind as a starting WCS in ICRS."""

import math
import re
import warnings

import numpy as np
from astropy.coordinates import FK4, FK5, ICRS, FK4NoETerms, SkyCoord
from astropy.time import Time
from astropy.wcs import WCS, WcsError
from astropy.wcs.utils import wcs_to_celestial_frame

from wpdc_gwcs.exceptions import FileFormatError, WPDCWarning
from wpdc_gwcs.io.files import READ_ERRORS, first_line
from wpdc_gwcs.io.headers import header_shape, header_text, header_value
from wpdc_gwcs.io.tan import PV_CARD, idle_pv, parse_tan, require_place

__all__ = ["parse_wcs"]


# Values of RADESYS, without blanks, hyphens and underscores.  All realizations of ICRS are equal.
_SYSTEMS = (
    ("ICRS", re.compile(r"ICR[SF]\d?|GAIA.*|HIPPARCOS|HIP|BCRS|GCRS")),
    ("FK4NOE", re.compile(r"FK4NOE(TERMS)?")),
    ("FK4", re.compile(r"FK4|B1950(0)?")),
    ("FK5", re.compile(r"FK[56]|J2000(0)?|MEAN")),
    (
        "OF DATE",
        re.compile(r"GAPPT?|APPT?|APPARENT|TETE|CIRS|TOD|EOD|TRUE.*|(MEAN)?(EQ.*)?OFDATE|CURRENT"),
    ),
)
_UNKNOWN = re.compile(r"(UNKNOWN|UNDEFINED|NONE|NULL|N/?A|TBD|\?*)")
# Mean places with an earlier equinox are FK4 (paper II, section 3.1).
_FK4_BEFORE = 1984.0


def parse_wcs(header, *, hdus=None, name="header", error=FileFormatError, pixel_scale=None):
    """Read any celestial header as a starting WCS in ICRS.

    Parameters
    ----------
    header : `~astropy.io.fits.Header`
        The header.
    hdus : `~astropy.io.fits.HDUList`, optional
        File of the header, for look-up tables in it.
    name : str, optional
        Name of the header in messages.
    error : type, optional
        Subclass of `~wpdc_gwcs.exceptions.InputError` that is raised.
    pixel_scale : float, optional
        Scale in arcsec / px instead of the header's; the orientation stays.

    Returns
    -------
    wcs : `~astropy.wcs.WCS`
        RA is the first world axis, in ICRS (FK5 J2000 is treated as ICRS: 0.02 arcsec).

    Raises
    ------
    InputError
        If the header is not a usable celestial WCS.

    Warns
    -----
    WPDCWarning
        If the reference system is unknown, or is of apparent places, which are treated as mean
        places of their equinox (up to 40 arcsec off).
    """
    if pixel_scale is not None:
        header = _with_scale(header, pixel_scale)
    tan = parse_tan(header, name=name, error=error)
    wcs = tan.to_wcs() if tan is not None else _parse_other(header, hdus, name, error)
    if pixel_scale is not None:
        factor = pixel_scale / 3600 / np.sqrt(abs(np.linalg.det(wcs.pixel_scale_matrix)))
        if wcs.wcs.has_cd():
            wcs.wcs.cd = wcs.wcs.cd * factor
        else:
            wcs.wcs.cdelt = np.array(wcs.wcs.cdelt) * factor
        wcs.wcs.set()
    return _to_icrs(wcs, _sky_frame(header, wcs, name, error), name, error)


def _with_scale(header, pixel_scale):
    """Copy a header with a new scale; without a linear part, North is up and East left."""
    header = header.copy()
    if not any(re.fullmatch(r"CD\d_\d|PC\d_\d|PC00\d00\d|CDELT\d", key) for key in header):
        is_longitude = not header_text(header, "CTYPE1").upper().startswith("DEC")
        for axis in (1, 2):
            turn = -1.0 if (axis == 1) == is_longitude else 1.0
            header[f"CDELT{axis}"] = turn * pixel_scale / 3600
    return header


def _sky_frame(header, wcs, name, error):
    """Find the reference system of the celestial axes, as an astropy frame."""
    if not wcs.wcs.ctype[0].startswith("RA"):
        try:
            return wcs_to_celestial_frame(wcs)
        except ValueError as problem:
            raise error(f"{name}: not a usable celestial frame: {first_line(problem)}") from problem
    given = header_text(header, "RADESYS") or header_text(header, "RADECSYS")
    word = re.sub(r"[\s_.-]", "", given.upper())
    if _UNKNOWN.fullmatch(word):
        word = ""
    equinox = _equinox(header)
    system = next((s for s, pattern in _SYSTEMS if pattern.fullmatch(word)), None)
    if system == "OF DATE":
        if equinox is None:
            raise error(
                f"{name}: RADESYS {given!r} (apparent places) needs the EQUINOX that they are of"
            )
        warnings.warn(
            f"{name}: RADESYS {given!r}: apparent places are taken for mean places of "
            f"{equinox:.1f}, up to 40 arcsec off",
            WPDCWarning,
        )
        system = "FK5"
    if system is None:
        if equinox is None or equinox == 2000.0:
            system = "ICRS"
        else:
            system = "FK4" if equinox < _FK4_BEFORE else "FK5"
        if word:
            of = "" if system == "ICRS" else f" of {equinox:.1f}"
            warnings.warn(
                f"{name}: RADESYS must be ICRS, FK5, FK4 or FK4-NO-E, got {given!r}: it is taken "
                f"for {system}{of}",
                WPDCWarning,
            )
    if system == "ICRS":
        return ICRS()
    if system == "FK5":
        return FK5(equinox=Time(equinox or 2000.0, format="jyear"))
    kind = FK4 if system == "FK4" else FK4NoETerms
    return kind(equinox=Time(equinox or 1950.0, format="byear"))


def _equinox(header):
    """Year of EQUINOX, or of EPOCH, its former name; `None` if it makes no sense."""
    for key in ("EQUINOX", "EPOCH"):
        value = header_value(header, key)
        if isinstance(value, str):
            found = re.fullmatch(r"[JB ]*(\d{4}(\.\d*)?)\s*", value.upper())
            value = float(found[1]) if found else None
        if isinstance(value, int | float) and 1800 <= value <= 2200:
            return float(value)
    return None


def _parse_other(header, hdus, name, error):
    """Parse SIP, other projections and look-up tables with astropy."""
    if "SIP" in header_text(header, "CTYPE1") or idle_pv(header):
        # SIP wins over PV cards of SCAMP.
        header = header.copy()
        for key in [k for k in header if PV_CARD.fullmatch(k)]:
            del header[key]
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            wcs = WCS(header, fobj=hdus, naxis=2)
            wcs.wcs.set()
    except (WcsError, *READ_ERRORS) as problem:
        # Messages of wcslib include places in its source code.
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
    if not wcs.wcs.tab:
        # CRVAL of a table is a row number.
        require_place(*wcs.wcs.crval, name, error)
    shape = header_shape(header)
    if shape is not None:
        wcs.array_shape = shape
    return wcs


def _to_icrs(wcs, frame, name, error):
    """Rotate the sphere of a WCS to ICRS: only CRVAL and LONPOLE change."""
    equinox = getattr(getattr(frame, "equinox", None), "jyear", 2000.0)
    if frame.name == "icrs" or (frame.name == "fk5" and abs(equinox - 2000.0) < 1e-3):
        wcs.wcs.radesys, wcs.wcs.equinox = "ICRS", math.nan
        wcs.wcs.set()
        return wcs
    lon, lat = wcs.wcs.crval
    if wcs.wcs.theta0 == 90.0:
        # The reference point of a zenithal projection is the pole of the native sphere.
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
    """Compare a WCS rotated to ICRS with the original, around its reference point."""
    x, y = before.wcs.crpix[:, np.newaxis] - 1.0 + 50.0 * np.array([[-1, 1, 1, -1], [-1, -1, 1, 1]])
    lon, lat = before.wcs_pix2world(x, y, 0)
    ra, dec = after.wcs_pix2world(x, y, 0)
    expected = SkyCoord(lon, lat, unit="deg", frame=frame).icrs
    if not np.all(expected.separation(SkyCoord(ra, dec, unit="deg")).deg < 1e-7):
        raise error(f"{name}: {frame.name} axes of this projection cannot be turned to ICRS")
