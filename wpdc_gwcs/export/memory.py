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
            TPV polynomials, for SWarp, SCAMP, GalSim and astropy, or SIP polynomials, for DS9 and
            other viewers.  Both are fitted to the whole mapping, including the look-up table.
        degree : int, optional
            Degree of the polynomials.  Default: the lowest one that is accurate to 1e-3 px
            (``tpv``) or 1e-4 px (``sip``), or nearly as accurate as any other.

        Returns
        -------
        header : `~astropy.io.fits.Header`
            Header with NAXIS1, NAXIS2 and the WCS.  Its card ``WPDCDEV`` has the largest deviation
            from the exact WCS, px.

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
            Polynomials fitted to the whole mapping (``tpv``, ``sip``), polynomials with look-up
            tables (``cpdis``), or a table alone (``tab``).  The tables are accurate to 1e-3 px, but
            astropy does not adapt them when the WCS is sliced or written with
            `~astropy.wcs.WCS.to_header`.
        degree : int, optional
            Degree of the polynomials.  Default: as for `make_form`.

        Returns
        -------
        wcs : `~astropy.wcs.WCS`
            The WCS, with the shape of the detector.

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
            As for `to_header`.  Cut-outs and files of a CCDData keep these forms, but not tables.
        degree : int, optional
            Degree of the polynomials.
        **kwargs
            For `~astropy.nddata.CCDData`: ``unit``, ``mask``, ``uncertainty``, ``meta``.

        Returns
        -------
        image : `~astropy.nddata.CCDData`
            The image with the WCS, in ``adu`` unless a unit is given.

        Raises
        ------
        ValueError
            If the image does not have the shape of the detector, or the format needs tables.
        """
        from astropy.nddata import CCDData

        if format not in _HEADER_FORMS:
            raise ValueError(
                f"format of a CCDData must be one of {', '.join(_HEADER_FORMS)}, got {format!r}"
            )
        shape = image_shape_of(self)
        if shape is not None and tuple(data.shape) != tuple(shape):
            raise ValueError(
                f"data must have the shape of the detector, {tuple(shape)}, got {data.shape}"
            )
        if not hasattr(data, "unit"):
            kwargs.setdefault("unit", "adu")
        wcs = self.to_astropy_wcs(format, degree=degree)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", fits.verify.VerifyWarning)
            return CCDData(data, wcs=wcs, **kwargs)
