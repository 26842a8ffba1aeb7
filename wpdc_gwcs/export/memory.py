"""The WCS of a calibration as objects of astropy, without a file."""

import warnings

from astropy.io import fits

from wpdc_gwcs.export.exact import astropy_wcs, image_shape_of
from wpdc_gwcs.export.forms import make_form

__all__ = ["InMemory"]

_HEADER_FORMS = ("tpv", "sip")
_WCS_FORMS = ("tpv", "sip", "cpdis", "tab")


class InMemory:
    """Methods of calibrations and solutions that return their WCS as astropy objects."""

    def to_header(self, format="tpv", *, degree=None):
        """Return the WCS as FITS keywords alone.

        Parameters
        ----------
        format : {"tpv", "sip"}, optional
            TPV polynomials, for SWarp, SCAMP, GalSim and astropy; or SIP polynomials, for DS9 and
            all viewers.  Both are fitted to the whole mapping, look-up table included.
        degree : int, optional
            Degree of the polynomials; by default the lowest that is accurate to 1e-3 px or nearly
            as good as any other.

        Returns
        -------
        header : `~astropy.io.fits.Header`
            With NAXIS1 and NAXIS2; its card ``WPDCDEV`` has the largest deviation from the exact
            WCS, px.

        Raises
        ------
        ValueError
            If the format needs tables, or the degree is out of range.
        """
        if format not in _HEADER_FORMS:
            raise ValueError(
                f"format of a header must be one of {', '.join(_HEADER_FORMS)}, got {format!r}"
            )
        made = make_form(self, format, degree=degree)
        header, shape = fits.Header(), image_shape_of(self)
        if shape is not None:
            header["NAXIS"] = (2, "number of axes")
            header["NAXIS1"] = (int(shape[1]), "[pixel] width of the detector")
            header["NAXIS2"] = (int(shape[0]), "[pixel] height of the detector")
        header.extend(made.header, end=True)
        if made.deviation is not None:
            header["WPDCDEV"] = (made.deviation, "[pixel] greatest deviation")
        return header

    def to_astropy_wcs(self, format="tpv", *, degree=None):
        """Return the WCS as an `astropy.wcs.WCS`.

        Parameters
        ----------
        format : {"tpv", "sip", "cpdis", "tab"}, optional
            Polynomials fitted to the whole mapping (``tpv``, ``sip``), or polynomials and look-up
            tables (``cpdis``) or a table alone (``tab``), accurate to 1e-3 px.  The tables of
            astropy are not adapted if the WCS is sliced or written with
            `~astropy.wcs.WCS.to_header`.
        degree : int, optional
            Degree of the polynomials.

        Returns
        -------
        wcs : `~astropy.wcs.WCS`
            With the shape of the detector.

        Raises
        ------
        ValueError
            If the format is unknown, or the degree is out of range.
        """
        if format not in _WCS_FORMS:
            raise ValueError(
                f"format of an astropy WCS must be one of {', '.join(_WCS_FORMS)}, got {format!r}"
            )
        made = make_form(self, format, degree=degree)
        wcs = astropy_wcs(made.header, made.tables)
        wcs.array_shape = image_shape_of(self)
        return wcs

    def to_ccddata(self, data, format="tpv", *, degree=None, **kwargs):
        """Return an image with the WCS as an `astropy.nddata.CCDData`.

        Parameters
        ----------
        data : (ny, nx) array_like or `~astropy.units.Quantity`
            The image.
        format : {"tpv", "sip"}, optional
            As for `to_header`.  These are kept in cut-outs and files of a CCDData; tables are not.
        degree : int, optional
            Degree of the polynomials.
        **kwargs
            For `~astropy.nddata.CCDData`: ``unit``, ``mask``, ``uncertainty``, ``meta``.

        Returns
        -------
        image : `~astropy.nddata.CCDData`
            In ``adu`` unless a unit is given.

        Raises
        ------
        ValueError
            If the image has another shape than the detector, or the format needs tables.
        """
        from astropy.nddata import CCDData

        if format not in _HEADER_FORMS:
            raise ValueError(
                f"format of a CCDData must be one of {', '.join(_HEADER_FORMS)}, got {format!r}"
            )
        shape = image_shape_of(self)
        if shape is not None and tuple(data.shape) != tuple(shape):
            raise ValueError(
                f"data must have the shape of the detector, {tuple(shape)}, not {data.shape}"
            )
        if not hasattr(data, "unit"):
            kwargs.setdefault("unit", "adu")
        wcs = self.to_astropy_wcs(format, degree=degree)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", fits.verify.VerifyWarning)
            return CCDData(data, wcs=wcs, **kwargs)
