r"""Step 1 of the WCS, detector to undistorted pixels, and its fusion with the tangent plane.

::

    detector px --CRPIX shift, CD, PV, CD^-1, shift back--+
          |                                              (-)--> undistorted px --TangentSky--> sky
          +---------------LookupTable---------------------+
    \_______________ DistortionCorrection _______________/
    \_________________________________ DetectorToSky _________________________________/
"""

import numpy as np
from astropy.modeling import Model, Parameter

from wpdc_gwcs.models.blocks import evaluate_blocks
from wpdc_gwcs.models.lookup_table import LookupTable
from wpdc_gwcs.models.mapping import TOLERANCE_PX, PlaneMap
from wpdc_gwcs.models.polynomial import PVPolynomial
from wpdc_gwcs.models.powers import expand_pv
from wpdc_gwcs.models.tangent import check_invertible

__all__ = ["DetectorToSky", "DistortionCorrection", "DistortionInverse", "SkyToDetector"]


class DistortionCorrection(Model):
    """Detector pixels to undistorted pixels: the PV polynomial in pixels, minus the look-up table.

    Parameters
    ----------
    crpix : (float, float)
        Reference point in zero-based pixels, (x, y).
    cd : (2, 2) array_like
        Matrix used by the PV polynomial, degrees per pixel.
    pv : PVPolynomial, optional
        The polynomial; the identity by default.
    lookup_table : LookupTable, optional
        Table that is subtracted after the polynomial; none by default.
    **kwargs
        ``name`` and ``meta`` of the model.

    Raises
    ------
    ValueError
        If a shape is wrong, a number is not finite or ``cd`` is singular.
    TypeError
        If ``pv`` or ``lookup_table`` is of another type.

    Notes
    -----
    ::

        X' = CD^-1 PV(CD (x - CRPIX)) + CRPIX - table(x)

    This is ``pv_chain - lookup_table`` in ordinary model arithmetic (see `composed`), evaluated in
    one pass: in each cell of the table, the sum is a single bicubic polynomial.  `DetectorToSky`
    includes the tangent plane in the same pass.

    The model is defined everywhere, because the table is continued linearly outside its nodes.

    Examples
    --------
    >>> from wpdc_gwcs.models import DistortionCorrection, PVPolynomial
    >>> pv = PVPolynomial(pv1_0=2e-4)
    >>> model = DistortionCorrection((49.5, 49.5), [[-1e-4, 0], [0, 1e-4]], pv)
    >>> x, y = model(10.0, 20.0)
    >>> float(x), float(y)
    (8.0, 20.0)
    >>> x, y = model.inverse(8.0, 20.0)
    >>> float(x), float(y)
    (10.0, 20.0)
    """

    n_inputs = 2
    n_outputs = 2
    _separable = False
    standard_broadcasting = False

    crpix = Parameter(default=[0.0, 0.0], description="reference point, zero-based pixels")
    cd = Parameter(
        default=[[1.0, 0.0], [0.0, 1.0]],
        description="matrix the polynomial stands in, degrees per pixel",
    )

    def __init__(self, crpix, cd, pv=None, lookup_table=None, **kwargs):
        pv = PVPolynomial(1) if pv is None else pv
        if not isinstance(pv, PVPolynomial):
            raise TypeError(f"pv must be a PVPolynomial, not {type(pv).__name__}")
        if lookup_table is not None and not isinstance(lookup_table, LookupTable):
            raise TypeError(
                f"lookup_table must be a LookupTable, not {type(lookup_table).__name__}"
            )
        crpix, cd = np.array(crpix, dtype=float), np.array(cd, dtype=float)
        for label, value, shape in (("crpix", crpix, (2,)), ("cd", cd, (2, 2))):
            if value.shape != shape:
                raise ValueError(f"{label} must have the shape {shape}, not {value.shape}")
        for label, value in (("crpix", crpix), ("cd", cd), ("pv", pv.coefficients)):
            if not np.all(np.isfinite(value)):
                raise ValueError(f"{label} must be finite, not {value.tolist()}")
        check_invertible("cd", cd)
        self._pv = pv
        self._lookup_table = lookup_table
        self._cache = None
        super().__init__(crpix=crpix, cd=cd, **kwargs)
        self.inputs = ("x", "y")
        self.outputs = ("x_undistorted", "y_undistorted")

    def __getstate__(self):
        # The folded coefficients are computed again when they are needed.
        return {**self.__dict__, "_cache": None}

    def __repr__(self):
        parts = {"pv": self._pv, "lookup_table": self._lookup_table}
        return self._format_repr(kwargs={k: v for k, v in parts.items() if v is not None})

    def __str__(self):
        return self._format_str([("PV", repr(self._pv)), ("Table", repr(self._lookup_table))])

    @property
    def pv(self):
        """The PV polynomial."""
        return self._pv

    @property
    def lookup_table(self):
        """The look-up table, or `None`."""
        return self._lookup_table

    @property
    def composed(self):
        """The same transform as a compound of simple models, which is slow to evaluate."""
        from astropy.modeling.models import AffineTransformation2D, Identity

        matrix, crpix = self.cd.value, self.crpix.value
        to_plane = AffineTransformation2D(matrix, translation=-matrix @ crpix)
        chain = (
            to_plane | self.pv | AffineTransformation2D(np.linalg.inv(matrix), translation=crpix)
        )
        if self._lookup_table is None:
            return chain | Identity(2)
        return chain - self._lookup_table

    def _plane_map(self, crpix=None, cd=None):
        """Return the map on blocks, kept until a parameter, the polynomial or the table changes."""
        if crpix is None:
            crpix, cd = self.crpix.value, self.cd.value
        cells = None if self._lookup_table is None else self._lookup_table._cells()
        key = (crpix.tobytes(), cd.tobytes(), self._pv._values())
        cache = self._cache
        if cache is not None and cache[1] is cells and cache[0] == key:
            return cache[2]
        crpix, cd = np.reshape(crpix, 2), np.reshape(cd, (2, 2))
        polynomial, radial = self._expand(crpix, cd)
        plane_map = PlaneMap(
            polynomial,
            crpix,
            radial=radial,
            radial_matrix=cd,
            grid=None if cells is None else cells.transformed(-np.eye(2)),
        )
        self._cache = (key, cells, plane_map)
        return plane_map

    def _expand(self, crpix, cd):
        polynomial, radial = expand_pv(self._pv.coefficients, self._pv.degree, self._pv.radial, cd)
        to_pixels = np.linalg.inv(cd)
        polynomial = np.einsum("ij,jpq->ipq", to_pixels, polynomial)
        polynomial[:, 0, 0] += crpix
        return polynomial, (None if radial is None else to_pixels @ radial)

    def expand(self):
        """Expand the PV chain, without the table, into powers of ``x - crpix``.

        Returns
        -------
        polynomial : (2, n, n) ndarray
            ``polynomial[k, p, q]`` multiplies ``u**p v**q`` in output k, where (u, v) is the pixel
            minus ``crpix``.
        radial : (2, m) ndarray or None
            ``radial[k, s]`` multiplies ``r**s``, r being the length of ``cd @ (u, v)``; `None`
            without radial terms.
        """
        return self._expand(self.crpix.value, self.cd.value)

    def evaluate(self, x, y, crpix, cd):
        """Correct the distortion.

        Parameters
        ----------
        x, y : array_like
            Detector pixel coordinates, zero based.
        crpix, cd : array_like
            The parameters.

        Returns
        -------
        x, y : ndarray
            Undistorted pixel coordinates, zero based.
        """
        return evaluate_blocks(self._plane_map(crpix, cd).evaluate, x, y)

    def jacobian(self, x, y):
        """Return the derivatives of both outputs by both inputs.

        Parameters
        ----------
        x, y : array_like
            Detector pixel coordinates, zero based.

        Returns
        -------
        jacobian : (2, 2, ...) ndarray
            ``jacobian[i, j]`` is the derivative of output i by input j.
        """
        rows = evaluate_blocks(self._plane_map().jacobian, x, y, n_outputs=6)[2:]
        return np.array(rows).reshape(2, 2, *rows[0].shape)

    @property
    def inverse(self):
        """The exact inverse, by Newton's method (a `DistortionInverse`)."""
        return DistortionInverse(self)


class DistortionInverse(Model):
    """Undistorted to detector pixels: the inverse of `DistortionCorrection`, by Newton's method.

    Every solution is verified by its residual or an upper limit of it (1e-9 px); it is NaN if there
    is none.

    Parameters
    ----------
    distortion : DistortionCorrection
        The model to invert.
    **kwargs
        ``name`` and ``meta`` of the model.

    Examples
    --------
    >>> from wpdc_gwcs.models import DistortionCorrection, PVPolynomial
    >>> pv = PVPolynomial(pv1_0=2e-4)
    >>> correct = DistortionCorrection((49.5, 49.5), [[-1e-4, 0], [0, 1e-4]], pv)
    >>> type(correct.inverse).__name__
    'DistortionInverse'
    >>> x, y = correct.inverse([8.0, 18.0], [20.0, 20.0])
    >>> x.round(9).tolist(), y.round(9).tolist()
    ([10.0, 20.0], [20.0, 20.0])
    """

    n_inputs = 2
    n_outputs = 2
    _separable = False

    # astropy takes a model without Parameters for one that wants Quantities.
    uses_quantity = False

    def __init__(self, distortion, **kwargs):
        self.distortion = distortion
        super().__init__(**kwargs)
        self.inputs = ("x_undistorted", "y_undistorted")
        self.outputs = ("x", "y")

    def evaluate(self, x, y):
        """Put the distortion back.

        Parameters
        ----------
        x, y : array_like
            Undistorted pixel coordinates, zero based.

        Returns
        -------
        x, y : ndarray
            Detector pixel coordinates, zero based; NaN where there is no solution.
        """
        invert = self.distortion._plane_map().inverse(tolerance=TOLERANCE_PX)
        return evaluate_blocks(invert, x, y)

    @property
    def inverse(self):
        """The model from detector to undistorted pixels (a copy)."""
        return self.distortion.copy()


class DetectorToSky(Model):
    """Detector pixels to the sky in one pass: ``distortion | sky``, to 1e-7 px.

    If there is a look-up table, the projection is included in its cells, provided that it is
    bicubic there to 1e-7 px, as it is except near the poles.  Otherwise the formulas are evaluated.

    Parameters
    ----------
    distortion : DistortionCorrection
        Detector to undistorted pixels.
    sky : TangentSky
        Undistorted pixels to the sky.
    **kwargs
        ``name`` and ``meta`` of the model.

    Examples
    --------
    >>> from wpdc_gwcs.models import DetectorToSky, DistortionCorrection, PVPolynomial, TangentSky
    >>> cd = [[-1e-4, 0], [0, 1e-4]]
    >>> correct = DistortionCorrection((49.5, 49.5), cd, PVPolynomial(pv1_0=2e-4))
    >>> sky = TangentSky((49.5, 49.5), cd, (10.0, 20.0))
    >>> one, two = DetectorToSky(correct, sky)(10.0, 20.0), (correct | sky)(10.0, 20.0)
    >>> bool(abs(one[0] - two[0]) < 1e-11), bool(abs(one[1] - two[1]) < 1e-11)
    (True, True)
    """

    n_inputs = 2
    n_outputs = 2
    _separable = False
    uses_quantity = False

    def __init__(self, distortion, sky, **kwargs):
        self.distortion = distortion
        self.sky = sky
        super().__init__(**kwargs)
        self.inputs, self.outputs = distortion.inputs, sky.outputs

    def __repr__(self):
        return self._format_repr(kwargs={"distortion": self.distortion, "sky": self.sky})

    def __str__(self):
        parts = [("Distortion", repr(self.distortion)), ("Sky", repr(self.sky))]
        return self._format_str(parts)

    def evaluate(self, x, y):
        """Map detector pixels to the sky.

        Parameters
        ----------
        x, y : array_like
            Detector pixel coordinates, zero based.

        Returns
        -------
        ra, dec : ndarray
            Positions in degrees.
        """
        return evaluate_blocks(self.block_function(), x, y)

    def block_function(self, *, box=None, fill_value=np.nan):
        """Return the map as a function of contiguous 1-D float64 arrays, without model overhead.

        Parameters
        ----------
        box : ((float, float), (float, float)), optional
            Smallest and largest x, smallest and largest y.
        fill_value : float, optional
            Value of points outside the box.

        Returns
        -------
        function : callable
            ``function(x, y, ra, dec)`` writes positions in degrees.
        """
        return self.sky._after(self.distortion._plane_map()).to_sky(box, fill_value)

    def row_function(self, x, y):
        """Return the map as a function of whole rows of an image.

        Parameters
        ----------
        x, y : (N,), (M,) ndarray
            Columns and rows.

        Returns
        -------
        function : callable
            ``function(start, stop, ra, dec)`` writes the positions of some of the rows in degrees,
            each (stop - start, N).
        """
        return self.sky._after(self.distortion._plane_map()).row_function(x, y)

    @property
    def inverse(self):
        """The exact inverse (a `SkyToDetector`)."""
        return SkyToDetector(self.distortion, self.sky)


class SkyToDetector(Model):
    """The sky to detector pixels in one pass: the inverse of `DetectorToSky`.

    Parameters
    ----------
    distortion : DistortionCorrection
        Detector to undistorted pixels.
    sky : TangentSky
        Undistorted pixels to the sky.
    **kwargs
        ``name`` and ``meta`` of the model.

    Examples
    --------
    >>> from wpdc_gwcs.models import DetectorToSky, DistortionCorrection, PVPolynomial, TangentSky
    >>> cd = [[-1e-4, 0], [0, 1e-4]]
    >>> correct = DistortionCorrection((49.5, 49.5), cd, PVPolynomial(pv1_0=2e-4))
    >>> model = DetectorToSky(correct, TangentSky((49.5, 49.5), cd, (10.0, 20.0)))
    >>> type(model.inverse).__name__
    'SkyToDetector'
    >>> x, y = model.inverse(*model(10.0, 20.0))
    >>> round(float(x), 6), round(float(y), 6)
    (10.0, 20.0)
    """

    n_inputs = 2
    n_outputs = 2
    _separable = False
    uses_quantity = False

    def __init__(self, distortion, sky, **kwargs):
        self.distortion = distortion
        self.sky = sky
        super().__init__(**kwargs)
        self.inputs, self.outputs = sky.outputs, distortion.inputs

    def evaluate(self, ra, dec):
        """Map the sky to detector pixels.

        Parameters
        ----------
        ra, dec : array_like
            Positions in degrees.

        Returns
        -------
        x, y : ndarray
            Detector pixel coordinates, zero based; NaN where there is no solution.
        """
        return evaluate_blocks(self.block_function(), ra, dec)

    def block_function(self, *, box=None, fill_value=np.nan):
        """Return the map as a function of contiguous 1-D float64 arrays, without model overhead.

        Parameters
        ----------
        box : ((float, float), (float, float)), optional
            Smallest and largest x, smallest and largest y.  Solutions up to 1e-6 px outside are
            moved to its edge.
        fill_value : float, optional
            Value of both coordinates of points outside the box, and without a solution.

        Returns
        -------
        function : callable
            ``function(ra, dec, x, y)`` writes pixels.
        """
        return self.sky._after(self.distortion._plane_map()).from_sky(box, fill_value)

    @property
    def inverse(self):
        """The model from detector pixels to the sky."""
        return DetectorToSky(self.distortion, self.sky)
