"""Models to a `gwcs.WCS`, and the same in stock astropy models.

::

    detector (px) --DistortionCorrection--> undistorted (px) --TangentSky--> icrs (deg)
"""

import math
import os
import pickle

import numpy as np
from astropy import coordinates as coord
from astropy import units as u
from astropy.modeling.bounding_box import ModelBoundingBox
from astropy.modeling.models import (
    AffineTransformation2D,
    Const2D,
    Identity,
    Mapping,
    Pix2Sky_TAN,
    Polynomial1D,
    Polynomial2D,
    RotateNative2Celestial,
    Scale,
    Shift,
    Tabular2D,
)
from astropy.modeling.rotations import RotationSequence3D
from astropy.utils.masked import Masked
from gwcs import WCS
from gwcs import coordinate_frames as cf
from gwcs.geometry import CartesianToSpherical, SphericalToCartesian
from scipy.interpolate import make_interp_spline

from wpdc_gwcs.models import DetectorToSky, DistortionCorrection, TangentSky
from wpdc_gwcs.models.blocks import evaluate_blocks, run_blocks
from wpdc_gwcs.models.mapping import RIM_PX, PlaneMap
from wpdc_gwcs.models.powers import fit_polynomial

__all__ = ["DetectorWCS", "build_wcs", "sky_map", "to_stock_wcs"]


class DetectorWCS(WCS):
    """A `gwcs.WCS` of a detector whose inverse decides validity by pixels.

    It differs from its base class in these points only:

    - `invert` (and with it ``world_to_pixel``) does not mask positions by the range of right
      ascension and declination of the detector's corners, which loses good points wherever the
      image of the detector is not a rectangle on the sky, up to all of them at a pole.  Every
      answer comes from an exact inverse; those that lie outside the bounding box are masked, both
      coordinates together, and answers within 1e-6 px of the rim count as on it.
    - The two steps and the bounding box are evaluated in one pass.

    All else, including the parameters, is that of the base class.
    """

    def _models(self):
        """Return both models if they are those of `build_wcs`, else `None`."""
        steps = self.pipeline
        if len(steps) != 3:
            return None
        models = steps[0].transform, steps[1].transform
        if type(models[0]) is DistortionCorrection and type(models[1]) is TangentSky:
            return models
        return None

    @property
    def forward_transform(self):
        """The transform from the first to the last frame, with the bounding box."""
        models = self._models()
        if models is None:
            return super().forward_transform
        fused = DetectorToSky(*models)
        box = self.bounding_box
        if box is not None:
            fused.bounding_box = box
        return fused

    def _limits(self, distortion):
        """Return least and greatest x, least and greatest y, `None` without a bounding box."""
        try:
            box = distortion.bounding_box
        except NotImplementedError:
            return None
        if isinstance(box, ModelBoundingBox) and len(box.intervals) == 2:
            return box.intervals[0], box.intervals[1]
        return box.bounding_box(order="F")

    def __call__(self, *args, with_bounding_box=True, fill_value=np.nan, **kwargs):
        """Map detector pixels to the last frame.

        Parameters
        ----------
        *args : array_like
            Pixel coordinates, zero based.
        with_bounding_box : bool, optional
            Whether points outside the bounding box become ``fill_value``.
        fill_value : float, optional
            What they become.
        **kwargs
            Passed on to the transform.

        Returns
        -------
        result : tuple of array_like
            Coordinates in the last frame.
        """
        models = self._models()
        if models is None or kwargs or len(args) != 2:
            return super().__call__(
                *args, with_bounding_box=with_bounding_box, fill_value=fill_value, **kwargs
            )
        distortion, sky = models
        box = self._limits(distortion) if with_bounding_box else None
        function = sky._after(distortion._plane_map()).to_sky(box, fill_value)
        return _evaluate(function, args, self.input_frame, self.output_frame)

    def invert(self, *args, with_bounding_box=True, fill_value=np.nan, **kwargs):
        """Map positions in the last frame to detector pixels.

        Parameters
        ----------
        *args : array_like
            Coordinates in the last frame.
        with_bounding_box : bool, optional
            Whether points outside the bounding box become ``fill_value``.
        fill_value : float, optional
            What both coordinates become, there and where there is no answer.
        **kwargs
            Passed on to the base class.

        Returns
        -------
        result : tuple of array_like
            Pixel coordinates, zero based.
        """
        models = self._models()
        if models is None or kwargs or len(args) != 2:
            return super().invert(
                *args, with_bounding_box=with_bounding_box, fill_value=fill_value, **kwargs
            )
        distortion, sky = models
        box = self._limits(distortion) if with_bounding_box else None
        function = sky._after(distortion._plane_map()).from_sky(box, fill_value)
        return _evaluate(function, args, self.output_frame, self.input_frame)

    @property
    def _has_our_inverse(self):
        """Whether the way back is exact, so that pixels can tell what is outside."""
        return any(isinstance(step.transform, DistortionCorrection) for step in self.pipeline)

    def outside_footprint(self, world_arrays):
        """Return the positions as they are: the inverse itself tells what is outside.

        Parameters
        ----------
        world_arrays : sequence of array_like
            Coordinates in the last frame.

        Returns
        -------
        world_arrays : sequence of array_like
            The same; for pipelines without a `~wpdc_gwcs.models.DistortionCorrection` what gwcs
            makes of them.
        """
        if not self._has_our_inverse:
            return super().outside_footprint(world_arrays)
        return world_arrays

    def out_of_bounds(self, pixel_arrays, fill_value=np.nan):
        """Mask pixels outside the bounding box, both coordinates together.

        Parameters
        ----------
        pixel_arrays : sequence of array_like
            Pixel coordinates.
        fill_value : float, optional
            What points outside become.

        Returns
        -------
        pixel_arrays : tuple of array_like
            Pixel coordinates; those within 1e-6 px outside the rim are put on it.  For pipelines
            without a `~wpdc_gwcs.models.DistortionCorrection` what gwcs makes of them.
        """
        if not self._has_our_inverse:
            return super().out_of_bounds(pixel_arrays, fill_value=fill_value)
        limits = self.bounding_box.bounding_box(order="F")
        values = [getattr(value, "unmasked", np.asarray(value)) for value in pixel_arrays]
        if all(
            value.size and value.min() >= low and value.max() <= high
            for value, (low, high) in zip(values, limits, strict=True)
        ):
            return tuple(pixel_arrays)
        outside = False
        for k, (low, high) in enumerate(limits):
            # NaN stays NaN, and is outside.
            near = np.clip(values[k], low, high)
            values[k] = np.where(np.abs(near - values[k]) <= RIM_PX, near, values[k])
            outside = outside | ~((values[k] >= low) & (values[k] <= high))
        values = [np.where(outside, fill_value, value)[()] for value in values]
        for k, given in enumerate(pixel_arrays):
            if isinstance(given, np.ma.MaskedArray):
                values[k] = np.ma.array(values[k], mask=given.mask)
            elif hasattr(given, "mask"):
                values[k] = Masked(values[k], mask=given.mask)
        return tuple(values)


# `str` and `repr` of a WCS call it what they call that of gwcs, also where astropy writes them.
DetectorWCS.__name__ = WCS.__name__


def _evaluate(function, args, input_frame, output_frame):
    """Evaluate a function of blocks for arguments with units or without; scalars become floats."""
    with_units = any(isinstance(value, u.Quantity) for value in args)
    if with_units:
        args = input_frame.remove_units(args)
    result = tuple(
        value if value.ndim or hasattr(value, "mask") else value.item()
        for value in evaluate_blocks(function, *args)
    )
    return output_frame.add_units(result) if with_units else result


def build_wcs(
    *, crpix, cd, crval, pv=None, pv_cd=None, lookup_table=None, image_shape=None, v2v3=None
):
    """Build the WCS of a detector from its distortion and attitude.

    Parameters
    ----------
    crpix : (float, float)
        Reference point in zero-based pixels, (x, y).
    cd : (2, 2) array_like
        Matrix of the exposure, degrees per pixel.
    crval : (float, float) or `~astropy.coordinates.SkyCoord`
        Right ascension and declination of the tangent point in degrees.
    pv : PVPolynomial, optional
        The distortion; none by default.
    pv_cd : (2, 2) array_like, optional
        Matrix in which the polynomial stands, degrees per pixel; ``cd`` by default.
    lookup_table : LookupTable, optional
        Subtracted after the polynomial.
    image_shape : (int, int), optional
        Shape of the detector, (ny, nx).  The bounding box then covers all of it, -0.5 ... n - 0.5.
    v2v3 : (float, float, float), optional
        V2 and V3 of the reference point in arcseconds, and the position angle of the V3 axis there
        (north through east) in degrees, as ``v2_ref``, ``v3_ref``, ``roll_ref`` of JWST and Roman.
        The WCS then has the frame ``v2v3``, in arcseconds, in front of ``icrs``, where the
        correctors of tweakwcs and stcal put theirs.

    Returns
    -------
    wcs : DetectorWCS
        A `gwcs.WCS` with the frames ``detector``, ``undistorted``, ``icrs``, with ``v2v3`` before
        the last one where it is asked for.

    Raises
    ------
    ValueError
        If a shape is wrong, a number is not finite or a matrix is singular.
    TypeError
        If ``pv`` or ``lookup_table`` is of another type.

    Notes
    -----
    ::

        X'' = CD0^-1 PV(CD0 (x - CRPIX)) + CRPIX - table(x),    CD0 = pv_cd
        sky = TAN^-1(CD (X'' - CRPIX)) about CRVAL

    Examples
    --------
    >>> from wpdc_gwcs import PVPolynomial, build_wcs
    >>> wcs = build_wcs(crpix=(511.5, 511.5), cd=[[-1e-4, 0], [0, 1e-4]], crval=(0.0, 45.0),
    ...                 pv=PVPolynomial(pv1_7=0.1, pv2_7=0.1), image_shape=(1024, 1024))
    >>> ra, dec = wcs(511.5, 511.5)
    >>> float(ra), float(dec)
    (0.0, 45.0)
    >>> x, y = wcs.invert(*wcs(10.0, 20.0))
    >>> float(x), float(y)
    (10.0, 20.0)
    """
    if isinstance(crval, coord.SkyCoord):
        crval = (crval.icrs.ra.deg, crval.icrs.dec.deg)
    distortion = DistortionCorrection(crpix, cd if pv_cd is None else pv_cd, pv, lookup_table)
    sky = TangentSky(crpix, cd, crval)
    steps = _steps(distortion, sky)
    if v2v3 is not None:
        (undistorted, _), (icrs, _) = steps[1:]
        steps[1:] = [*_v2v3_steps(undistorted, sky, v2v3), (icrs, None)]
    wcs = DetectorWCS(steps)
    _set_shape(wcs, image_shape)
    return wcs


def _v2v3_steps(undistorted, sky, v2v3):
    """Return the steps from undistorted pixels over the frame v2v3 to the sky."""
    v2v3 = np.array(v2v3, dtype=float)
    if v2v3.shape != (3,) or not np.all(np.isfinite(v2v3)) or abs(v2v3[1]) >= 90 * 3600:
        raise ValueError(
            "v2v3 must be V2 and V3 in arcsec, V3 within a quarter of a circle, and an angle in "
            f"deg, not {v2v3.tolist()}"
        )
    v2, v3, roll = v2v3 / (3600, 3600, 1)
    c, s = np.cos(np.radians(roll)), np.sin(np.radians(roll))
    along_v2v3 = np.array([[c, -s], [s, c]])
    crpix, (ra, dec) = sky.crpix.value, sky.crval.value
    to_v2v3 = (
        Shift(-crpix[0]) & Shift(-crpix[1])
        | AffineTransformation2D(along_v2v3 @ sky.cd.value, translation=[0.0, 0.0])
        | Pix2Sky_TAN()
        | RotateNative2Celestial(v2, v3, 180.0)
        # For V2 on both sides of zero.
        | SphericalToCartesian(wrap_lon_at=360)
        | CartesianToSpherical(wrap_lon_at=180)
        | Scale(3600.0) & Scale(3600.0)
    )
    # Not by way of native latitudes: an arc sine near 90 degrees has no more than eight digits.
    to_sky = (
        Scale(1 / 3600) & Scale(1 / 3600)
        | SphericalToCartesian(wrap_lon_at=180)
        | RotationSequence3D([v2, -v3, roll, dec, -ra], "zyxyz")
        | CartesianToSpherical(wrap_lon_at=360)
    )
    to_v2v3.name, to_sky.name = "undistorted_to_v2v3", "v2v3_to_sky"
    frame = cf.Frame2D(
        name="v2v3",
        axes_order=(0, 1),
        axes_names=("v2", "v3"),
        axes_type=("SPATIAL", "SPATIAL"),
        unit=(u.arcsec, u.arcsec),
    )
    return [(undistorted, to_v2v3), (frame, to_sky)]


def _steps(distortion, sky):
    pixel_axes = {"axes_order": (0, 1), "unit": (u.pix, u.pix)}
    detector = cf.Frame2D(name="detector", axes_names=("x", "y"), **pixel_axes)
    undistorted = cf.Frame2D(
        name="undistorted", axes_names=("x_undistorted", "y_undistorted"), **pixel_axes
    )
    icrs = cf.CelestialFrame(
        name="icrs",
        reference_frame=coord.ICRS(),
        axes_names=("ra", "dec"),
        unit=(u.deg, u.deg),
    )
    return [(detector, distortion), (undistorted, sky), (icrs, None)]


def _set_shape(wcs, image_shape):
    if image_shape is None:
        return
    ny, nx = (int(n) for n in image_shape)
    if ny < 1 or nx < 1:
        raise ValueError(f"image_shape must be positive, not {tuple(image_shape)}")
    wcs.pixel_shape = (nx, ny)
    # Last: inserting frames drops it.
    wcs.bounding_box = ((-0.5, nx - 0.5), (-0.5, ny - 0.5))


def sky_map(wcs, *, image_shape=None, out=None):
    """Compute the sky coordinates of every pixel of an image, block by block.

    Parameters
    ----------
    wcs : `gwcs.WCS`
        The WCS, from pixels to two world coordinates.
    image_shape : (int, int), optional
        Shape of the image, (ny, nx); that of the WCS by default.
    out : array_like or path, optional
        Where to write: an array (or memory map) of the shape (2, ny, nx), a pair of (ny, nx)
        arrays, or the path of a new ``.npy`` file of the shape (2, ny, nx), which is memory-mapped.

    Returns
    -------
    ra, dec : (ny, nx) ndarray
        Coordinates of the pixel centers in degrees; views of ``out`` where it was given.

    Raises
    ------
    ValueError
        If the shape of the image is not known, or that of ``out`` does not fit.
    FileExistsError
        If ``out`` is the path of a file that is there already.

    Notes
    -----
    Beside the outputs it needs some megabytes, whatever the size of the image.

    Examples
    --------
    >>> from wpdc_gwcs.wcs import build_wcs, sky_map
    >>> cd = [[-1e-4, 0], [0, 1e-4]]
    >>> wcs = build_wcs(crpix=(2, 1), cd=cd, crval=(10, 20), image_shape=(3, 5))
    >>> ra, dec = sky_map(wcs)
    >>> ra.shape, float(ra[1, 2]), float(dec[1, 2])
    ((3, 5), 10.0, 20.0)
    """
    if image_shape is None:
        image_shape = wcs.array_shape
        if image_shape is None:
            raise ValueError("image_shape must be given: the WCS does not know its shape")
    ny, nx = (int(n) for n in image_shape)
    if isinstance(out, (str, os.PathLike)):
        if os.path.exists(out):
            raise FileExistsError(f"out must be a new file; {os.fspath(out)!r} is there already")
        out = np.lib.format.open_memmap(out, mode="w+", dtype=np.float64, shape=(2, ny, nx))
    ra, dec = (np.empty((ny, nx)), np.empty((ny, nx))) if out is None else out
    for array in (ra, dec):
        if array.shape != (ny, nx):
            raise ValueError(f"out must hold two arrays of the shape {(ny, nx)}, not {array.shape}")
    transform = wcs.forward_transform
    columns, rows = np.arange(nx, dtype=float), np.arange(ny, dtype=float)
    if isinstance(transform, DetectorToSky):
        function = transform.row_function(columns, rows)
    else:
        function = _any_rows(transform, columns, rows)
    # Threads take bands of rows.
    band = max(1, _BAND_SIZE // nx)

    def fill(first, last):
        for start in range(first * band, min(last * band, ny), band):
            stop = min(start + band, ny)
            targets = ra[start:stop], dec[start:stop]
            if all(t.flags.c_contiguous and t.dtype == np.float64 for t in targets):
                function(start, stop, *targets)
            else:
                values = np.empty((2, stop - start, nx))
                function(start, stop, *values)
                ra[start:stop], dec[start:stop] = values

    run_blocks(fill, math.ceil(ny / band), weight=band * nx)
    return ra, dec


# Pixels in a band of rows that a thread takes.
_BAND_SIZE = 524_288


def _any_rows(transform, x, y):
    """Return a function for rows of any transform."""

    def function(start, stop, ra, dec):
        with np.errstate(all="ignore"):
            ra[...], dec[...] = transform(*np.broadcast_arrays(x, y[start:stop, np.newaxis]))

    return function


def to_stock_wcs(wcs):
    """Build the same WCS of stock astropy models only.

    Such a WCS can be stored as ASDF and opened where wpdc_gwcs is not installed.

    Parameters
    ----------
    wcs : DetectorWCS
        As returned by `build_wcs`.

    Returns
    -------
    stock : `gwcs.WCS`
        With the same frames, pixel shape and bounding box.

    Raises
    ------
    ValueError
        If the steps of ``wcs`` are not those that `build_wcs` makes.

    Notes
    -----
    The PV chain becomes a `~astropy.modeling.models.Polynomial2D` of the pixels for each axis
    (radial terms: a `~astropy.modeling.models.Polynomial1D` of the radius), the table a
    `~astropy.modeling.models.Tabular2D` with the same nodes (``splinef2d``, which is the same
    bicubic spline, or ``linear``), so the two agree to rounding, about 1e-8 px.

    The inverse of the first step is a polynomial followed by a table of what the polynomial leaves;
    it is stored with the WCS, and it is good to 1e-4 px unless the look-up table is as rough as its
    nodes.  gwcs itself masks positions outside the range of right ascension and declination of the
    corners, so near a pole ask for ``stock.invert(ra, dec, with_bounding_box=False)``.
    """
    transforms = [step.transform for step in wcs.pipeline[:-1]]
    if list(map(type, transforms)) != [DistortionCorrection, TangentSky]:
        raise ValueError(
            "wcs must consist of the steps DistortionCorrection and TangentSky, not "
            f"{[type(transform).__name__ for transform in transforms]}"
        )
    distortion, sky = transforms
    stock = WCS(_steps(_stock_first_step(distortion, wcs.array_shape), _stock_sky(sky)))
    if wcs.pixel_shape is not None:
        stock.pixel_shape = wcs.pixel_shape
    if wcs.bounding_box is not None:
        stock.bounding_box = wcs.bounding_box.bounding_box(order="F")
    return stock


# The last first step, pickled, and what it was made of: all frames of a detector have it in common,
# and its inverse takes a while.  A pickle makes a new one in half the time that a copy takes.
_last_first_step = (None, None)


def _stock_first_step(distortion, image_shape):
    global _last_first_step
    table = distortion.lookup_table
    made_of = pickle.dumps(
        (
            distortion.parameters,
            (distortion.pv.degree, distortion.pv.radial, distortion.pv.parameters),
            table and (table.x_grid, table.y_grid, table.method, table.parameters),
            image_shape,
        )
    )
    if _last_first_step[0] != made_of:
        model = _stock_distortion(distortion)
        inverse = _stock_inverse(distortion, image_shape)
        if inverse is not None:
            model.inverse = inverse
        model.name = "distortion_correction"
        _last_first_step = (made_of, pickle.dumps(model))
    return pickle.loads(_last_first_step[1])


def stock_polynomial(coefficients):
    """Return a stock polynomial.

    Parameters
    ----------
    coefficients : (n, n) ndarray
        Of ``x^p y^q`` at ``[p, q]``; those of a total degree of n and more are left out.

    Returns
    -------
    `~astropy.modeling.models.Polynomial2D`
        Of total degree n - 1.
    """
    n = len(coefficients)
    terms = {f"c{p}_{q}": coefficients[p, q] for p in range(n) for q in range(n - p)}
    return Polynomial2D(n - 1, **terms)


def _pair(first, second):
    """Return a 2-in 2-out model of two 2-in 1-out models."""
    return Mapping((0, 1, 0, 1)) | first & second


def _stock_distortion(distortion):
    polynomial, radial = distortion.expand()
    crpix = distortion.crpix.value
    centered = Shift(-crpix[0]) & Shift(-crpix[1])
    model = centered | _pair(*map(stock_polynomial, polynomial))
    if radial is not None:
        matrix = distortion.cd.value
        metric = matrix.T @ matrix
        squared = np.zeros((3, 3))
        squared[2, 0], squared[1, 1], squared[0, 2] = metric[0, 0], 2 * metric[0, 1], metric[1, 1]
        radius = stock_polynomial(squared) ** Const2D(0.5)
        in_radius = (
            radius | Polynomial1D(len(row) - 1, **{f"c{s}": value for s, value in enumerate(row)})
            for row in radial
        )
        model = model + (centered | _pair(*in_radius))
    table = distortion.lookup_table
    if table is None:
        return model
    return model - _stock_table(*_with_outer_nodes(table), table.method)


def _with_outer_nodes(table):
    """Return grids and values of a table with one more node at every end.

    Stock tables have no values outside their nodes, and what needs the corners of an image asks for
    some half a pixel outside.  Of a spline without knots next to its ends the outer cubics go on to
    the new nodes, and the spline through all of them is the same.
    """
    degree = 3 if table.method == "cubic" else 1
    grids, values = [], np.array([table.dx, table.dy])
    for grid, axis in ((table.x_grid, 2), (table.y_grid, 1)):
        step = (grid[-1] - grid[0]) / (len(grid) - 1)
        wider = np.concatenate([[grid[0] - step], grid, [grid[-1] + step]])
        values = make_interp_spline(grid, values, k=degree, axis=axis)(wider)
        grids.append(wider)
    return *grids, values


def _stock_table(x_grid, y_grid, values, method):
    # The same for both, so that files have them once.
    points = (np.array(x_grid), np.array(y_grid))
    return _pair(
        *(
            Tabular2D(
                points=points,
                lookup_table=np.ascontiguousarray(value.T),
                method="splinef2d" if method == "cubic" else "linear",
                # The spline does not extrapolate, and an error at the first point outside helps
                # nobody.
                bounds_error=False,
                fill_value=np.nan,
            )
            for value in values
        )
    )


def _stock_sky(sky):
    crpix, cd, crval = sky.crpix.value, sky.cd.value, sky.crval.value
    return (
        Shift(-crpix[0]) & Shift(-crpix[1])
        | AffineTransformation2D(cd, translation=[0.0, 0.0])
        | Pix2Sky_TAN()
        | RotateNative2Celestial(crval[0], crval[1], 180.0)
    )


# The stock inverse: degree of its polynomial, nodes along each axis it is fitted to, and the
# numbers of nodes of its table tried in turn until it is as good as asked for (px).
_INVERSE_DEGREE = 7
_INVERSE_FIT_NODES = 33
_INVERSE_TABLE_NODES = (51, 101, 201)
_INVERSE_ERROR_PX = 5e-5


def _stock_inverse(distortion, image_shape):
    """Return a stock model of the inverse: a polynomial, then a table of what it leaves.

    `None` where there is none: no range to make it for, or an image that is folded over.
    """
    plane_map = distortion._plane_map()
    grid = plane_map.grid
    if grid is not None:
        x_range, y_range = (grid.x_low, grid.x_high), (grid.y_low, grid.y_high)
    elif image_shape is not None:
        x_range, y_range = (-0.5, image_shape[1] - 0.5), (-0.5, image_shape[0] - 0.5)
    else:
        return None
    x, y = (v.ravel() for v in np.meshgrid(*_axes(x_range, y_range, _INVERSE_FIT_NODES)))
    images = plane_map(x, y)
    polynomial, origin = fit_polynomial(images, (x, y), _INVERSE_DEGREE)
    approximate = PlaneMap(polynomial, origin)
    leftover = np.abs(np.subtract(approximate(*images), (x, y))).max()
    margin = 1.0 + 2.0 * leftover
    wide_x = (x_range[0] - margin, x_range[1] + margin)
    wide_y = (y_range[0] - margin, y_range[1] + margin)
    check = [v.ravel() for v in np.meshgrid(*_axes(x_range, y_range, 2 * _INVERSE_FIT_NODES))]
    model = Shift(-origin[0]) & Shift(-origin[1]) | _pair(*map(stock_polynomial, polynomial))
    for n_nodes in _INVERSE_TABLE_NODES:
        x_nodes, y_nodes = _axes(wide_x, wide_y, n_nodes)
        x, y = (v.ravel() for v in np.meshgrid(x_nodes, y_nodes))
        # Where the polynomial takes which image to this node, and which pixel has that image.
        image = approximate.invert(x, y, tolerance=1e-10)
        pixel = plane_map.invert(*image, tolerance=1e-10)
        left = np.subtract(pixel, (x, y)).reshape(2, n_nodes, n_nodes)
        if not np.all(np.isfinite(left)):
            return None
        inverse = model | (Identity(2) + _stock_table(x_nodes, y_nodes, left, "cubic"))
        found = inverse(*plane_map(*check))
        if np.abs(np.subtract(found, check)).max() <= _INVERSE_ERROR_PX:
            break
    return inverse


def _axes(x_range, y_range, n):
    return np.linspace(*x_range, n), np.linspace(*y_range, n)
