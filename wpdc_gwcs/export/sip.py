"""TAN-SIP: polynomials of pixels, fitted to the whole mapping."""

import numpy as np

from wpdc_gwcs.export._sip_fit import fit_sip, fit_sip_inverse
from wpdc_gwcs.export.cards import linear_cards, number_card
from wpdc_gwcs.export.exact import astropy_sky, description, deviation, sample_plane
from wpdc_gwcs.export.levelling import levelling_weights

__all__ = ["sip_keywords"]

_DEGREES = range(2, 10)
# A fit this good (px) is good enough.
_ENOUGH_PX = 1e-4
# If no fit is that good: how much worse than the best one a lower degree may be.
_NEARLY = 1.1
# Error that the inverse polynomials may add, px.
_INVERSE_PX = 1e-3


def sip_keywords(obj, degree=None):
    """Fit SIP polynomials to the whole mapping, including the look-up table.

    Parameters
    ----------
    obj : Calibration or DistortionSolution
        What is exported.
    degree : int, optional
        Degree of the polynomials, 2 to 9.  Default: the lowest that is accurate to 1e-4 px or
        nearly as accurate as any.

    Returns
    -------
    header : `~astropy.io.fits.Header`
        The keywords.
    deviation : float
        Largest deviation from the exact WCS, px.
    inverse_deviation : float
        Largest deviation of the inverse polynomials (AP, BP) from the inverse, px.

    Raises
    ------
    ValueError
        If the degree is not from 2 to 9.

    Notes
    -----
    SIP has no constant and no linear terms (Shupe et al. 2005, ASP Conf. Ser. 347, 491).  The
    linear terms go into CD, and CRPIX moves to the pixel whose position is CRVAL.
    """
    if degree is not None and degree not in _DEGREES:
        raise ValueError(f"degree must be from 2 to 9 for SIP, got {degree}")
    pixels, plane = sample_plane(obj)
    trials = []
    for n in _DEGREES if degree is None else [degree]:
        trials.append(_trial(obj, fit_sip(pixels, plane, n)))
        if trials[-1][0] < _ENOUGH_PX:
            break
        weights = levelling_weights(pixels, np.linalg.solve(description(obj).cd, plane), n)
        level = _trial(obj, fit_sip(pixels, plane, n, weights))
        trials[-1] = min(trials[-1], level, key=lambda t: t[0])
    best = min(worst for worst, _ in trials)
    sip = next(sip for worst, sip in trials if worst <= _NEARLY * best)
    worst = deviation(obj, astropy_sky(_keywords(obj, sip)))
    for n in _DEGREES:
        inverse, inverse_worst = fit_sip_inverse(sip, pixels, plane, n)
        if inverse_worst <= max(worst, _INVERSE_PX):
            break
    return _keywords(obj, sip, inverse), worst, inverse_worst


def _trial(obj, sip):
    return deviation(obj, astropy_sky(_keywords(obj, sip)), n=151), sip


def _keywords(obj, sip, inverse=None):
    header = linear_cards("TAN-SIP", sip.crpix, sip.cd, description(obj).crval)
    for tag, terms in (("", sip.terms), ("P", inverse)):
        if terms is None:
            continue
        degree = terms.shape[1] - 1
        for letter, axis in zip("AB", terms, strict=True):
            header[f"{letter}{tag}_ORDER"] = (degree, "degree of the polynomial")
            for p, q in np.argwhere(np.add.outer(range(degree + 1), range(degree + 1)) <= degree):
                # The standard has neither constant nor linear terms in the forward polynomials.
                if tag or p + q > 1:
                    header.append(number_card(f"{letter}{tag}_{p}_{q}", axis[p, q]), end=True)
    return header
