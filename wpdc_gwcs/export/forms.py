"""FITS forms of a calibration, for different readers.

========= ============================================================== =======================
form      content                                                        exact for
========= ============================================================== =======================
``fits``  TPV keywords, BINTABLE ``WPDC_LUT``                            this package, all of it
``cpdis`` TPV keywords, ``CPDIS`` look-up tables before CD and PV        astropy, to 1e-3 px
``tpv``   TPV keywords fitted to the whole mapping                       none: deviation given
``head``  the same as text                                               none: deviation given
``sip``   SIP polynomials fitted to the whole mapping                    none: deviation given
``tab``   ``-TAB`` table                                                 wcslib, to 1e-3 px
========= ============================================================== =======================
"""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

from astropy.io import fits

from wpdc_gwcs.export.cpdis import cpdis_form
from wpdc_gwcs.export.exact import astropy_sky, deviation, image_shape_of
from wpdc_gwcs.export.own import own_tables
from wpdc_gwcs.export.sip import sip_keywords
from wpdc_gwcs.export.tab import TAB_NAME, tab_form
from wpdc_gwcs.export.tpv import fit_tpv, fold_polynomial, refit, tpv_keywords

__all__ = ["FORMS", "FitsForm", "make_form"]

#: Forms of `make_form`.
FORMS = ("fits", "cpdis", "tpv", "head", "sip", "tab")


@dataclass(frozen=True, eq=False)
class FitsForm:
    """The WCS of a calibration as FITS keywords, with the tables that they refer to.

    Parameters
    ----------
    form : str
        One of `FORMS`.
    header : `~astropy.io.fits.Header`
        WCS keywords only.
    tables : tuple of HDU
        Extensions that readers of the form need.
    deviation : float or None
        Largest deviation from the exact WCS over the detector, in px, for readers of the form;
        `None` if the form is exact or the shape of the detector is unknown.
    keywords_deviation : float or None
        For ``fits``: the same for readers that ignore the table.
    inverse_deviation : float or None
        For ``sip``: largest deviation of the inverse polynomials, px.
    swarp_deviation : float or None
        For ``tpv`` and ``head``: largest deviation in SWarp, px, which inverts the polynomial
        approximately.
    written : Calibration or DistortionSolution or None
        For ``fits`` and ``cpdis``: the same mapping, with the polynomial of the keywords.

    Examples
    --------
    >>> import numpy as np
    >>> from wpdc_gwcs import DistortionSolution, PVPolynomial
    >>> from wpdc_gwcs.export import make_form
    >>> cd, crpix, crval = np.diag([-8e-5, 8e-5]), np.array([511.5, 511.5]), np.array([10.0, 45.0])
    >>> solution = DistortionSolution("d1", (1024, 1024), crpix, cd, crval, PVPolynomial(pv1_7=4.0))
    >>> form = make_form(solution, "tpv")
    >>> form.header["PV1_7"], form.tables, form.deviation < 1e-6
    (4.0, (), True)
    """

    form: str
    header: fits.Header
    tables: tuple = ()
    deviation: float | None = None
    keywords_deviation: float | None = None
    inverse_deviation: float | None = None
    swarp_deviation: float | None = None
    written: object = None


def make_form(obj, form, *, degree=None, versions: Mapping = MappingProxyType({})):
    """Return the WCS of a calibration in one of the FITS forms.

    Parameters
    ----------
    obj : Calibration or DistortionSolution
        What is exported; a solution has its nominal pointing.
    form : {"fits", "cpdis", "tpv", "head", "sip", "tab"}
        The form.
    degree : int, optional
        Degree of the polynomials.  Default: that of the solution for ``fits`` and ``cpdis``; for
        the others, the lowest degree that is accurate to 1e-3 px (``tpv``, ``head``) or 1e-4 px
        (``sip``), or nearly as accurate as any.
    versions : mapping of str to int, optional
        EXTVER of the first table of each EXTNAME, for files that already have such tables.

    Returns
    -------
    made : FitsForm
        Keywords, tables and deviations.

    Raises
    ------
    ValueError
        If the form is unknown, or has no polynomials of this degree.
    FileFormatError
        If the shape of the detector is needed and unknown.

    Examples
    --------
    >>> import numpy as np
    >>> from wpdc_gwcs import DistortionSolution, PVPolynomial
    >>> from wpdc_gwcs.export import make_form
    >>> solution = DistortionSolution(
    ...     detector="d1", image_shape=(1024, 1024), crpix=np.array([511.5, 511.5]),
    ...     cd=np.array([[-8e-5, 0.0], [0.0, 8e-5]]), crval=np.array([10.0, 45.0]),
    ...     pv=PVPolynomial(pv1_7=4.0, pv2_7=-3.0)
    ... )
    >>> made = make_form(solution, "sip")
    >>> made.header["CTYPE1"], made.deviation < 1e-3
    ('RA---TAN-SIP', True)
    """
    if form not in FORMS:
        raise ValueError(f"format must be one of {', '.join(FORMS)}, got {form!r}")
    if form in ("tpv", "head"):
        tpv = fit_tpv(obj, degree)
        return FitsForm(
            form,
            tpv_keywords(obj, tpv.pv, crpix=tpv.crpix, cd=tpv.cd),
            deviation=tpv.deviation,
            swarp_deviation=tpv.swarp_deviation,
        )
    if form == "sip":
        header, worst, inverse_worst = sip_keywords(obj, degree)
        return FitsForm(form, header, deviation=worst, inverse_deviation=inverse_worst)
    if form == "tab":
        if degree is not None:
            raise ValueError(
                f"degree must be None for 'tab', which has no polynomials, got {degree}"
            )
        header, tables, worst = tab_form(obj, version=versions.get(TAB_NAME, 1))
        return FitsForm(form, header, tuple(tables), worst)
    written = obj if degree is None else refit(obj, degree)
    if form == "cpdis":
        header, tables, _ = cpdis_form(written, first_version=versions.get("WCSDVARR", 1))
        worst = deviation(obj, astropy_sky(header, tables))
        return FitsForm(form, header, tuple(tables), worst, written=written)
    version = versions.get("WPDC_LUT", 1)
    header = tpv_keywords(written, fold_polynomial(written))
    header["WPDCTAB"] = (version, "EXTVER of the tables WPDC_...")
    known = image_shape_of(obj) is not None
    return FitsForm(
        form,
        header,
        tuple(own_tables(written, version=version)),
        None if degree is None else deviation(obj, lambda x, y: written.wcs(x, y)),
        deviation(obj, astropy_sky(header)) if known else None,
        written=written,
    )
