"""Header cards: exact numbers, the linear keywords, and the origin of a WCS."""

import textwrap

from astropy.io import fits

from wpdc_gwcs.export.exact import description, image_shape_of

__all__ = ["FORMAT_VERSION", "add_history", "frame_cards", "linear_cards", "number_card"]

#: Version of all formats of this package that can be read back, ASDF and FITS.
FORMAT_VERSION = "1.2.0"


def number_card(keyword, value, comment=""):
    """Make a card with 17 significant digits, from which every float64 is read back exactly.

    Parameters
    ----------
    keyword : str
        Keyword.
    value : float
        Value; astropy alone would write 16 digits.
    comment : str, optional
        Comment.

    Returns
    -------
    card : `~astropy.io.fits.Card`
        The card.

    Examples
    --------
    >>> from wpdc_gwcs.export import number_card
    >>> card = number_card("CRVAL1", 0.1 + 0.2, "[deg]")
    >>> print(str(card).rstrip())
    CRVAL1  =   3.0000000000000004E-01 / [deg]
    """
    text = f"{keyword:<8}= {float(value):>24.16E}"
    return fits.Card.fromstring(f"{text} / {comment}"[:80].ljust(80))


def linear_cards(code, crpix, cd, crval):
    """Make the keywords of the linear part and of the celestial frame.

    Parameters
    ----------
    code : str
        Projection, for example ``TPV``.
    crpix : (2,) array_like
        Reference pixel, zero based.
    cd : (2, 2) array_like
        Matrix, deg / px.
    crval : (2,) array_like
        RA and Dec, deg.

    Returns
    -------
    header : `~astropy.io.fits.Header`
        CTYPE, CUNIT, CRVAL, CRPIX (from one), CD, LONPOLE, RADESYS, EQUINOX.
    """
    header = fits.Header()
    header["WCSAXES"] = (2, "number of axes")
    header["CTYPE1"] = (f"RA---{code}", "right ascension, projection")
    header["CTYPE2"] = (f"DEC--{code}", "declination, projection")
    for axis in (1, 2):
        header[f"CUNIT{axis}"] = ("deg", "unit")
    for axis in (1, 2):
        card = number_card(f"CRVAL{axis}", crval[axis - 1], "[deg] reference point")
        header.append(card, end=True)
    for axis in (1, 2):
        card = number_card(f"CRPIX{axis}", crpix[axis - 1] + 1.0, "[pixel] counted from one")
        header.append(card, end=True)
    for i in (1, 2):
        for j in (1, 2):
            header.append(number_card(f"CD{i}_{j}", cd[i - 1, j - 1], "[deg/pixel]"), end=True)
    header["LONPOLE"] = (180.0, "[deg] native longitude of the pole")
    header["RADESYS"] = ("ICRS", "celestial frame")
    header["EQUINOX"] = (2000.0, "[yr] for readers that need it")
    return header


def frame_cards(obj):
    """Make the keywords that name frame and detector, for files without an image.

    Parameters
    ----------
    obj : Calibration or DistortionSolution
        Calibration or solution that is exported.

    Returns
    -------
    header : `~astropy.io.fits.Header`
        IMAGEW, IMAGEH, DETECTOR, FRAME, WPDCVERS, HISTORY.

    Examples
    --------
    >>> import numpy as np
    >>> from wpdc_gwcs import Calibration, DistortionSolution, PVPolynomial
    >>> from wpdc_gwcs.export import frame_cards
    >>> cd, crpix, crval = np.diag([-8e-5, 8e-5]), np.array([1023.5, 511.5]), np.array([10.0, 45.0])
    >>> solution = DistortionSolution("d1", (1024, 2048), crpix, cd, crval, PVPolynomial())
    >>> header = frame_cards(Calibration("night-07", solution, crval=crval, cd=cd))
    >>> header["IMAGEW"], header["IMAGEH"], header["DETECTOR"], header["FRAME"]
    (2048, 1024, 'd1', 'night-07')
    """
    from wpdc_gwcs import __version__

    exact, header = description(obj), fits.Header()
    shape = image_shape_of(obj)
    if shape is not None:
        header["IMAGEW"] = (int(shape[1]), "[pixel] width of the detector")
        header["IMAGEH"] = (int(shape[0]), "[pixel] height of the detector")
    header["DETECTOR"] = (_ascii(exact.solution.detector)[:60], "detector")
    if exact.frame:
        header["FRAME"] = (_ascii(exact.frame)[:60], "frame")
    header["WPDCVERS"] = (FORMAT_VERSION, "format version of wpdc_gwcs")
    add_history(header, f"WCS by wpdc_gwcs {__version__}")
    settings = {**exact.solution.settings, **getattr(obj, "settings", {})}
    for key, value in settings.items():
        add_history(header, f"{key} = {value}")
    return header


def add_history(header, text):
    """Add a text to a header as HISTORY cards.

    Parameters
    ----------
    header : `~astropy.io.fits.Header`
        Header, changed in place.
    text : str
        Text, of any length.

    Examples
    --------
    >>> from astropy.io import fits
    >>> from wpdc_gwcs.export import add_history
    >>> header = fits.Header()
    >>> add_history(header, "calibrated with " + 30 * "many ")
    >>> len(header["HISTORY"]), max(len(line) for line in header["HISTORY"]) <= 72
    (3, True)
    """
    for line in textwrap.wrap(_ascii(text), 70, subsequent_indent="  "):
        header.add_history(line)


def _ascii(text):
    return str(text).encode("ascii", "replace").decode()
