"""Exact reading of TAN, TPV and TAN + PV headers, in which pixels are counted from one.

::

    header --parse_tan--> TanHeader (CRPIX, CD, CRVAL, PV)
"""

import re
import warnings
from dataclasses import dataclass

import numpy as np
from astropy import units as u
from astropy.wcs import WCS

from wpdc_gwcs.exceptions import FileFormatError
from wpdc_gwcs.io.headers import header_number, header_shape, header_text, header_value
from wpdc_gwcs.models import PVPolynomial, pv_terms
from wpdc_gwcs.models.attitude import fold_attitude
from wpdc_gwcs.solution import FARTHEST_PX

__all__ = ["PV_CARD", "TanHeader", "idle_pv", "parse_tan", "require_place"]

#: Keywords of projection parameters: axis and index.
PV_CARD = re.compile(r"PV([12])_(\d+)")
_TABLE_CARD = re.compile(r"(CPDIS|CQDIS|D2IMDIS)[12]")
# SIP, regardless of CTYPE, and the plate solution of the Digitized Sky Survey.
_DISTORTION_CARD = re.compile(r"[AB]_ORDER|AMDX1")
_LONGITUDES = ("RA", "GLON", "ELON")
_LATITUDES = ("DEC", "GLAT", "ELAT")
# Highest PV index of each degree, including the radial term of odd degrees.
_LAST_INDEX = {1: 3, 2: 6, 3: 11, 4: 16, 5: 23, 6: 30, 7: 39}
_RADIAL = (3, 11, 23, 39)
# Some programs let longitudes run on after a full turn; larger ones are meaningless.
_FARTHEST_LONGITUDE = 720.0  # deg


@dataclass(frozen=True, eq=False)
class TanHeader:
    """The numbers of a TAN, TPV or TAN + PV header, with the axes in the order RA, Dec.

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
        Shape ``(ny, nx)``; `None` if the header does not have it.
    """

    crpix: np.ndarray
    cd: np.ndarray
    crval: np.ndarray
    pv: PVPolynomial
    image_shape: tuple[int, int] | None = None

    def to_wcs(self):
        """Build the equivalent `astropy.wcs.WCS`.

        Returns
        -------
        wcs : `~astropy.wcs.WCS`
            TPV, or TAN if there is no distortion; RA is the first world axis.
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


def parse_tan(header, *, name="header", error=FileFormatError, ignore_tables=False):
    """Read a TAN, TPV or TAN + PV header exactly.

    Parameters
    ----------
    header : `~astropy.io.fits.Header`
        Header with CD, PC + CDELT or CDELT + CROTA; axes in either order.
    name : str, optional
        Name of the header in messages.
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
        If the axes are not celestial, a card is missing or not a number, or CD or the PV terms are
        singular.

    Notes
    -----
    ``RA---TAN`` with PV cards of index 5 or more, or with any PV card on the Dec axis, is TPV, as
    written by SCAMP before version 2.0.  Absent PV cards have the default values of the convention:
    1 for PVi_1, and 0 for the others.  But if one axis has all terms of its degree and the other
    axis does not, a card has been lost, which is an error.
    """
    order, codes = _celestial_axes(header, name, error)
    if codes[0] not in ("TAN", "TPV") or header_text(header, "CTYPE1")[:2] not in ("RA", "DE"):
        return None
    if any(_DISTORTION_CARD.fullmatch(key) for key in header):
        return None
    if not ignore_tables and any(_TABLE_CARD.fullmatch(key) for key in header):
        return None
    numbers = {
        (int(m[1]), int(m[2])) for key in header if (m := PV_CARD.fullmatch(key)) is not None
    }
    if idle_pv(header):
        numbers = set()
    latitude = order[1] + 1
    is_tpv = codes[0] == "TPV" or any(
        j >= 5 or (axis == latitude and j >= 1) for axis, j in numbers
    )
    if codes[0] == "TAN" and not is_tpv and numbers:
        # PV on the RA axis of a plain TAN moves the native pole, which is rare and left to wcslib.
        return None

    def number(key, **options):
        return header_number(header, key, name=name, error=error, **options)

    scale = [_degrees(header, axis, name, error) for axis in (1, 2)]
    crval = np.array([number(f"CRVAL{axis}") * scale[axis - 1] for axis in (1, 2)])[order]
    crpix = np.array([number("CRPIX1"), number("CRPIX2")]) - 1.0
    if np.abs(crpix).max() > FARTHEST_PX:
        raise error(
            f"{name}: CRPIX must be within {FARTHEST_PX:g} px, got {crpix[0] + 1:g}, "
            f"{crpix[1] + 1:g}"
        )
    cd = (_linear(header, order, number, name, error) * np.array(scale)[:, None])[order]
    spread = np.abs(cd).max()
    if not spread > 0 or abs(np.linalg.det(cd)) < 1e-10 * spread**2:
        rows = ", ".join(f"{v:.6g}" for v in cd.ravel())
        raise error(f"{name}: CD matrix must not be singular, got [{rows}]")
    require_place(*crval, name, error)
    pv = _read_pv(numbers if is_tpv else set(), order, number, name, error)
    shape = header_shape(header)
    _require_area(pv, cd, crpix, shape, name, error)
    # Paper II: the default LONPOLE of a zenithal projection is 0 where the pole is the reference
    # point.
    lonpole = number("LONPOLE", required=False, default=180.0 if crval[1] < 90.0 else 0.0)
    if lonpole != 180.0:
        a = np.radians(180.0 - lonpole)
        turn = np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]])
        cd, pv = turn @ cd, fold_attitude(pv, turn)
    return TanHeader(crpix, cd, crval, pv, shape)


def require_place(longitude, latitude, name, error):
    """Raise an error unless a reference point is a position on the sphere.

    Parameters
    ----------
    longitude, latitude : float
        Values of ``CRVAL``, deg.
    name : str
        Name of the header in messages.
    error : type
        Subclass of `~wpdc_gwcs.exceptions.InputError` that is raised.

    Raises
    ------
    InputError
        If the longitude is outside -720 to 720 deg, or the latitude outside -90 to 90 deg.
    """
    if not abs(longitude) <= _FARTHEST_LONGITUDE:
        raise error(
            f"{name}: longitude CRVAL must lie within {_FARTHEST_LONGITUDE:g} deg, "
            f"got {longitude:g}"
        )
    if not abs(latitude) <= 90.0:
        raise error(f"{name}: latitude CRVAL must lie in [-90, 90] deg, got {latitude:g}")


def _require_area(pv, cd, crpix, shape, name, error):
    """Raise an error for terms that map the image to a line or a point."""
    # Away from the reference point, where radial terms have no derivatives.
    place = crpix + 1.0 if shape is None else 0.3 * np.array(shape[::-1])
    area = np.linalg.det(pv.jacobian(*(cd @ (place - crpix))))
    if not abs(area) > 0:
        raise error(f"{name}: PV terms must not collapse all pixels to a line or point, do so")


def idle_pv(header):
    """Return whether all PV cards of a TAN header are zero, so that they have no meaning.

    Parameters
    ----------
    header : `~astropy.io.fits.Header`
        The header.

    Returns
    -------
    bool
        True if all are zero; as a TPV polynomial, they would map the whole frame to one point.
    """
    if not header_text(header, "CTYPE1").upper().endswith("TAN"):
        return False
    values = [header_value(header, key) for key in header if PV_CARD.fullmatch(key)]
    return all(isinstance(value, int | float) and value == 0 for value in values)


def _celestial_axes(header, name, error):
    """Numbers of the longitude and latitude axes, and their projection codes."""
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
    # PC001001 is how a draft of the standard spelled PC1_1; wcslib still reads it.
    for key in ("PC{}_{}", "PC00{}00{}"):
        if any(key.format(i, j) in header for i in (1, 2) for j in (1, 2)):
            pc = [
                [number(key.format(i, j), required=False, default=float(i == j)) for j in (1, 2)]
                for i in (1, 2)
            ]
            # With PC, the default of CDELT is 1 (paper I, section 2.1.2).
            steps = [number(f"CDELT{i}", required=False, default=1.0) for i in (1, 2)]
            return np.array(steps)[:, None] * np.array(pc)
    if "CDELT1" not in header and "CDELT2" not in header:
        raise error(f"{name}: header must have the pixel scale in CD, PC or CDELT, has none")
    cdelt = np.array([number("CDELT1"), number("CDELT2")])
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
