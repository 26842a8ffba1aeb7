"""Conversion of a WCS to stock astropy models."""

import pickle
from collections import OrderedDict
from hashlib import sha256
from threading import Lock

import numpy as np
from astropy.modeling.models import (
    AffineTransformation2D,
    Const2D,
    Identity,
    Mapping,
    Pix2Sky_TAN,
    Polynomial1D,
    Polynomial2D,
    RotateNative2Celestial,
    Shift,
    Tabular2D,
)
from gwcs import WCS
from scipy.interpolate import make_interp_spline

from wpdc_gwcs.models import DistortionCorrection, TangentSky
from wpdc_gwcs.models.mapping import PlaneMap
from wpdc_gwcs.models.powers import fit_polynomial
from wpdc_gwcs.wcs.detector import pipeline_steps

__all__ = ["stock_polynomial", "to_stock_wcs"]


def to_stock_wcs(wcs):
    """Build the same WCS from stock astropy models only.

    Such a WCS can be stored as ASDF and opened where wpdc_gwcs is not installed.

    Parameters
    ----------
    wcs : DetectorWCS
        As returned by `build_wcs`.

    Returns
    -------
    stock : `gwcs.WCS`
        WCS with the same frames, pixel shape and bounding box.

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

    The inverse of the first step is a polynomial followed by a table of its residuals.  It is
    stored with the WCS, and is accurate to 1e-4 px unless the look-up table varies from node to
    node.  gwcs itself masks positions outside the range of right ascension and declination of the
    corners, so near a pole use ``stock.invert(ra, dec, with_bounding_box=False)``.

    Examples
    --------
    >>> import numpy as np
    >>> from wpdc_gwcs import DistortionSolution, PVPolynomial, to_stock_wcs
    >>> solution = DistortionSolution(
    ...     detector="d1", image_shape=(1024, 1024), crpix=np.array([511.5, 511.5]),
    ...     cd=np.array([[-8e-5, 0.0], [0.0, 8e-5]]), crval=np.array([10.0, 45.0]),
    ...     pv=PVPolynomial(pv1_7=4.0, pv2_7=-3.0)
    ... )
    >>> stock = to_stock_wcs(solution.wcs)
    >>> bool(np.allclose(stock(100.0, 900.0), solution.wcs(100.0, 900.0), rtol=0, atol=1e-10))
    True
    """
    transforms = [step.transform for step in wcs.pipeline[:-1]]
    if list(map(type, transforms)) != [DistortionCorrection, TangentSky]:
        raise ValueError(
            "wcs must consist of the steps DistortionCorrection and TangentSky, not "
            f"{[type(transform).__name__ for transform in transforms]}"
        )
    distortion, sky = transforms
    stock = WCS(pipeline_steps(_stock_first_step(distortion, wcs.array_shape), _stock_sky(sky)))
    if wcs.pixel_shape is not None:
        stock.pixel_shape = wcs.pixel_shape
    if wcs.bounding_box is not None:
        stock.bounding_box = wcs.bounding_box.bounding_box(order="F")
    return stock


# Detectors whose first step is kept: all frames of a detector share it, its inverse takes a while,
# and the frames of a camera come exposure by exposure.
_KEPT = 64
# Pickled first steps by a digest of their content, the last used last.
_kept = OrderedDict()
_lock = Lock()


def _stock_first_step(distortion, image_shape):
    table = distortion.lookup_table
    content = pickle.dumps(
        (
            distortion.parameters,
            (distortion.pv.degree, distortion.pv.radial, distortion.pv.parameters),
            table and (table.x_grid, table.y_grid, table.method, table.parameters),
            image_shape,
        )
    )
    # No more than that is kept: the distortion of a frame has tables of a megabyte.
    key = sha256(content).digest()
    with _lock:
        model = _kept.pop(key, None)
    if model is None:
        model = _pickled_model(distortion, image_shape)
    with _lock:
        _kept[key] = model
        while len(_kept) > _KEPT:
            _kept.popitem(last=False)
    # Unpickling takes half the time of a copy.
    return pickle.loads(model)


def _pickled_model(distortion, image_shape):
    model = _stock_distortion(distortion)
    inverse = _stock_inverse(distortion, image_shape)
    if inverse is not None:
        model.inverse = inverse
    model.name = "distortion_correction"
    return pickle.dumps(model)


def stock_polynomial(coefficients):
    """Return a stock polynomial.

    Parameters
    ----------
    coefficients : (n, n) ndarray
        Coefficient of ``x^p y^q`` at ``[p, q]``; total degrees of n and more are ignored.

    Returns
    -------
    `~astropy.modeling.models.Polynomial2D`
        Polynomial of total degree n - 1.

    Examples
    --------
    >>> import numpy as np
    >>> from wpdc_gwcs.wcs import stock_polynomial
    >>> model = stock_polynomial(np.array([[1.0, 3.0], [2.0, 0.0]]))  # 1 + 2 x + 3 y
    >>> model(10.0, 100.0)
    321.0
    """
    n = len(coefficients)
    terms = {f"c{p}_{q}": coefficients[p, q] for p in range(n) for q in range(n - p)}
    return Polynomial2D(n - 1, **terms)


def _pair(first, second):
    """Combine two 2-in 1-out models to a 2-in 2-out model."""
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

    Stock tables have no values outside their nodes, but the corners of an image are half a pixel
    outside.  A spline without knots next to its ends has outer cubics that continue to the new
    nodes, so the spline through all nodes is the same.
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
    # The same objects for both, so that files contain them once.
    points = (np.array(x_grid), np.array(y_grid))
    return _pair(
        *(
            Tabular2D(
                points=points,
                lookup_table=np.ascontiguousarray(value.T),
                method="splinef2d" if method == "cubic" else "linear",
                # The spline does not extrapolate, and an error at the first point outside would
                # not help.
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
# numbers of nodes of its table, tried in turn until it has the required accuracy (px).
_INVERSE_DEGREE = 7
_INVERSE_FIT_NODES = 33
_INVERSE_TABLE_NODES = (51, 101, 201)
_INVERSE_ERROR_PX = 5e-5


def _stock_inverse(distortion, image_shape):
    """Return a stock model of the inverse: a polynomial, then a table of its residuals.

    `None` if there is none: without a known range, or for an image that is folded.
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
        # Find the image that the polynomial maps to this node, and the pixel of this image.
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
