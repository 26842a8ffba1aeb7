"""Cards of a header that belong to its WCS, and the extensions that they refer to."""

import re

from astropy.io import fits

from wpdc_gwcs.export import INSTRUMENT_NAME, TABLE_NAME
from wpdc_gwcs.io.headers import WRITTEN_BY_US, header_text, header_value, is_ours

__all__ = ["alternates_of", "is_stale", "tables_of"]

# Keywords of a WCS that may end in the letter of an alternate.
_ANY = (
    r"WCSAXES|WCSNAME|LONPOLE|LATPOLE|RADESYS|EQUINOX|"
    r"(?:CTYPE|CUNIT|CRVAL|CRPIX|CDELT|CROTA|CNAME|CRDER|CSYER)\d+|"
    r"(?:CD|PC|PV|PS)\d+_\d+|"
    r"(?:CPDIS|CQDIS|CPERR|CQERR|DP|DQ)\d+|DVERR"
)
_ALTERNATE = re.compile(rf"(?:{_ANY})([A-Z])")
_PRIMARY = re.compile(
    rf"{_ANY}|"
    # Spellings before the standard.
    r"RADECSYS|LONGPOLE|(?:PC|CD)00\d00\d|PROJP\d+|"
    # SIP; look-up tables of astropy's for the detector.
    r"[AB]P?_ORDER|[AB]P?_\d+_\d+|[AB]P?_DMAX|D2IM(?:DIS|ERR)?\d+|D2IMEXT|AXISCORR|"
    # Plate solutions of the Digitized Sky Survey and of SuperCOSMOS; TNX and ZPX of IRAF.
    r"AMD[XY]\d+|PPO\d+|CO[12]_\d+|PLTRA[HMS]|PLTDEC(?:SN|[DMS])|PLTSCALE|CNPIX[12]|[XY]PIXELSZ|"
    r"WAT\d_\d+|WCSDIM|"
    # Keywords of this package.
    r"WPDC(?:VERS|TAB|DEV)"
)


def is_stale(card, alternates):
    """Return whether a card must be removed when the primary WCS is replaced.

    Parameters
    ----------
    card : str
        The card, 80 characters.
    alternates : collection of str
        Letters of alternate WCSs that are removed, too.

    Returns
    -------
    stale : bool
        True for a card of the old WCS.
    """
    keyword = card[:8].rstrip()
    if keyword == "HISTORY":
        return card[8:].startswith(WRITTEN_BY_US)
    if card[8:9] != "=":
        return False
    if _PRIMARY.fullmatch(keyword):
        return True
    match = _ALTERNATE.fullmatch(keyword)
    return match is not None and match[1] in alternates


def alternates_of(header):
    """Return the letters of the alternate WCSs of a header, and of those that use SIP terms.

    Parameters
    ----------
    header : `~astropy.io.fits.Header`
        The header.

    Returns
    -------
    letters, with_sip : set of str
        Letters of all alternates, and of those that need the SIP terms of the primary WCS.
    """
    letters = {m[1] for key in header if (m := _ALTERNATE.fullmatch(key)) is not None}
    with_sip = {
        letter
        for letter in letters
        if any(header_text(header, f"CTYPE{i}{letter}").endswith("-SIP") for i in (1, 2))
    }
    return letters, with_sip


def tables_of(header):
    """Return the extensions that the primary WCS of a header refers to.

    Parameters
    ----------
    header : `~astropy.io.fits.Header`
        The header.

    Returns
    -------
    tables : set of (str, int)
        EXTNAME and EXTVER.
    """
    found = set()
    for axis in range(1, 10):
        for kind, record, name in (
            ("CPDIS", "DP", "WCSDVARR"),
            ("CQDIS", "DQ", "WCSDVARR"),
            ("D2IMDIS", "D2IM", "D2IMARR"),
        ):
            if header_text(header, f"{kind}{axis}").lower() == "lookup":
                found.add((name, _version(header, f"{record}{axis}.EXTVER")))
        name = header_text(header, f"PS{axis}_0").upper()
        # Without a name, it refers to no extension, not to all those without a name.
        if header_text(header, f"CTYPE{axis}").endswith("-TAB") and name:
            found.add((name, _version(header, f"PV{axis}_1")))
    if is_ours(header):
        version = _version(header, "WPDCTAB")
        found |= {(TABLE_NAME, version), (INSTRUMENT_NAME, version)}
    return found


def _version(header: fits.Header, key):
    value = header_value(header, key)
    return int(value) if isinstance(value, int | float) else 1
