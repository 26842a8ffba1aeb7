"""The tangent plane: gnomonic projection about a point of the sky, and its model."""

from functools import cached_property

import numpy as np
from astropy.modeling import Model, Parameter

from wpdc_gwcs import kernels
from wpdc_gwcs.models.blocks import evaluate_blocks
from wpdc_gwcs.models.mapping import TOLERANCE_PX, PlaneMap

__all__ = ["SkyTangent", "TangentSky", "deproject", "local_plane", "project"]


def _projection(crval, matrix=((1.0, 0.0), (0.0, 1.0)), offset=(0.0, 0.0)):
    """Return a function that writes pixels of positions on the sky."""
    tangent = kernels.tangent_numbers(crval, matrix, offset)
    return lambda ra, dec, x, y: kernels.from_sky(tangent, ra, dec, x, y)


def _deprojection(crval, matrix=((1.0, 0.0), (0.0, 1.0)), origin=(0.0, 0.0)):
    """Return a function that writes positions on the sky of pixels."""
    plane = _linear_map(matrix, origin).plane
    tangent = kernels.tangent_numbers(crval)
    return lambda x, y, ra, dec: kernels.to_sky(plane, None, tangent, None, x, y, ra, dec)


def _linear_map(matrix, origin):
    """Return the map from pixels to the plane in radians, for a matrix in degrees per pixel."""
    polynomial = np.zeros((2, 2, 2))
    polynomial[:, 1, 0], polynomial[:, 0, 1] = np.radians(matrix).T
    return PlaneMap(polynomial, origin)


def project(ra, dec, crval):
    """Project the sky onto the plane that touches it at a point (gnomonic, TAN).

    Parameters
    ----------
    ra, dec : array_like
        Positions in degrees.
    crval : (float, float)
        Tangent point in degrees.

    Returns
    -------
    xi, eta : ndarray
        Standard coordinates in degrees, east and north; NaN for points 90 degrees or more from the
        tangent point.

    Examples
    --------
    >>> from wpdc_gwcs.models import project
    >>> xi, eta = project(10.0, 21.0, (10.0, 20.0))
    >>> float(xi), float(eta)
    (0.0, 1.0001015)
    """
    return evaluate_blocks(_projection(crval), ra, dec)


def deproject(xi, eta, crval):
    """Project the plane that touches the sky at a point back onto the sky (gnomonic, TAN).

    Parameters
    ----------
    xi, eta : array_like
        Standard coordinates in degrees, east and north.
    crval : (float, float)
        Tangent point in degrees.

    Returns
    -------
    ra, dec : ndarray
        Positions in degrees, right ascension from 0 to 360.

    Notes
    -----
    With xi, eta in radians::

        tan(ra - ra0) = xi / (cos dec0 - eta sin dec0)
        tan(dec) = (sin dec0 + eta cos dec0) / hypot(xi, cos dec0 - eta sin dec0)

    which are exact at the poles, too.

    Examples
    --------
    >>> from wpdc_gwcs.models import deproject
    >>> ra, dec = deproject(0.0, 1.0, (10.0, 89.5))
    >>> float(ra), float(dec)
    (190.0, 89.5001)
    """
    return evaluate_blocks(_deprojection(crval), xi, eta)


def _check_linear(crpix, cd, crval):
    crpix, cd, crval = (np.array(value, dtype=float) for value in (crpix, cd, crval))
    for label, value, shape in (("crpix", crpix, (2,)), ("cd", cd, (2, 2)), ("crval", crval, (2,))):
        if value.shape != shape:
            raise ValueError(f"{label} must have the shape {shape}, not {value.shape}")
        if not np.all(np.isfinite(value)):
            raise ValueError(f"{label} must be finite, not {value.tolist()}")
    if abs(crval[1]) > 90:
        raise ValueError(f"the declination in crval must lie between -90 and 90, not {crval[1]}")
    check_invertible("cd", cd)
    return crpix, cd, crval


def check_invertible(label, matrix):
    """Raise an error unless a 2 x 2 matrix has an accurate inverse.

    Parameters
    ----------
    label : str
        Name of the argument for the message.
    matrix : (2, 2) ndarray
        The matrix.

    Raises
    ------
    ValueError
        If it is singular.
    """
    singular = np.linalg.svd(matrix, compute_uv=False)
    if not singular[1] > 1e-10 * singular[0]:
        raise ValueError(f"{label} must be invertible, not {np.asarray(matrix).tolist()}")


class _Linear(Model):
    """Common ground of the tangent-plane model and its inverse: the parameters."""

    crpix = Parameter(default=[0.0, 0.0], description="reference point, zero-based pixels")
    cd = Parameter(default=[[1.0, 0.0], [0.0, 1.0]], description="degrees per pixel")
    crval = Parameter(default=[0.0, 0.0], description="tangent point in degrees")

    n_inputs = 2
    n_outputs = 2
    _separable = False
    standard_broadcasting = False

    def __init__(self, crpix=(0.0, 0.0), cd=((1.0, 0.0), (0.0, 1.0)), crval=(0.0, 0.0), **kwargs):
        crpix, cd, crval = _check_linear(crpix, cd, crval)
        super().__init__(crpix=crpix, cd=cd, crval=crval, **kwargs)
        pixel, sky = ("x_undistorted", "y_undistorted"), ("ra", "dec")
        self.inputs, self.outputs = (pixel, sky) if self._to_sky else (sky, pixel)

    @staticmethod
    def _arrays(crpix, cd, crval):
        return np.reshape(crpix, 2), np.reshape(cd, (2, 2)), np.reshape(crval, 2)


class TangentSky(_Linear):
    """Undistorted pixels to the sky: linear to the tangent plane, then gnomonic.

    Parameters
    ----------
    crpix : (float, float)
        Reference point in zero-based pixels, (x, y).
    cd : (2, 2) array_like
        Matrix from pixels to the tangent plane, degrees per pixel.
    crval : (float, float)
        Right ascension and declination of the tangent point in degrees.
    **kwargs
        ``name`` and ``meta`` of the model.

    Raises
    ------
    ValueError
        If a shape is wrong, a number is not finite, ``cd`` is singular, or the declination is not
        between -90 and 90.

    Notes
    -----
    LONPOLE is 180 deg at every declination.  (In FITS, its default at a declination of exactly
    +90 deg is 0; such a header has to be rotated by 180 deg.)

    Examples
    --------
    >>> from wpdc_gwcs.models import TangentSky
    >>> sky = TangentSky(crpix=(99.5, 99.5), cd=[[-1e-4, 0], [0, 1e-4]], crval=(0.0, 60.0))
    >>> ra, dec = sky(109.5, 99.5)
    >>> float(ra), float(dec)
    (359.998, 59.9999999)
    """

    _to_sky = True

    _cache = None

    def evaluate(self, x, y, crpix, cd, crval):
        """Map undistorted pixels to the sky.

        Parameters
        ----------
        x, y : array_like
            Undistorted pixel coordinates, zero based.
        crpix, cd, crval : array_like
            The parameters.

        Returns
        -------
        ra, dec : ndarray
            Positions in degrees, right ascension from 0 to 360.
        """
        crpix, cd, crval = self._arrays(crpix, cd, crval)
        return evaluate_blocks(_deprojection(crval, cd, crpix), x, y)

    def _after(self, plane_map):
        """Return the complete map to the sky, a `_SkyMap`.

        It is cached for requests with the same map and the same parameters.
        """
        crpix, cd, crval = self.crpix.value, self.cd.value, self.crval.value
        key = (crpix.tobytes(), cd.tobytes(), crval.tobytes())
        cache = self._cache
        if cache is None or cache[0] is not plane_map or cache[1] != key:
            cache = self._cache = (plane_map, key, _SkyMap(plane_map, crpix, cd, crval))
        return cache[2]

    def __getstate__(self):
        return {**self.__dict__, "_cache": None}

    @property
    def inverse(self):
        """The exact inverse (a `SkyTangent`)."""
        return SkyTangent(self.crpix.value, self.cd.value, self.crval.value)


# Error allowed where cells lead to the sky (px), and the most cells that are made for it.
_CELL_TOLERANCE_PX = 1e-7
_MOST_CELLS = 40_000


class _SkyMap:
    """The complete map to the sky and back, on blocks: a map of the plane, then the projection.

    If there are cells that map to the sky itself with sufficient accuracy, they are used for the
    points inside them.
    """

    def __init__(self, plane_map, crpix, cd, crval):
        self._plane_map = plane_map
        self._scale = np.sqrt(abs(np.linalg.det(cd)))
        matrix = np.radians(cd)
        self._to_plane = plane_map.transformed(matrix, -matrix @ crpix)
        self._tangent = kernels.tangent_numbers(crval, np.linalg.inv(cd), crpix)
        # The last request and its function: making it takes longer than a single point.
        self._last_to_sky = self._last_from_sky = (None, None)

    @cached_property
    def _grid(self):
        return _cells_to_sky(self._to_plane, self._tangent, self._scale)

    @cached_property
    def _cells(self):
        return None if self._grid is None else PlaneMap(grid=self._grid).plane

    def to_sky(self, box, fill_value):
        """Return ``function(x, y, ra, dec)`` for points, with a bounding box or without."""
        last = self._last_to_sky
        if last[0] != (box, fill_value):
            plane, cells, tangent = self._to_plane.plane, self._cells, self._tangent
            numbers = kernels.box_numbers(box, fill_value)

            def function(x, y, ra, dec):
                kernels.to_sky(plane, cells, tangent, numbers, x, y, ra, dec)

            last = self._last_to_sky = ((box, fill_value), function)
        return last[1]

    def from_sky(self, box, fill_value):
        """Return ``function(ra, dec, x, y)`` for points, with a bounding box or without."""
        last = self._last_from_sky
        if last[0] != (box, fill_value):
            function = self._plane_map.inverse(
                tolerance=TOLERANCE_PX, tangent=self._tangent, box=box, fill_value=fill_value
            )
            last = self._last_from_sky = ((box, fill_value), function)
        return last[1]

    def row_function(self, x, y):
        """Return ``function(start, stop, ra, dec)`` for rows of an image."""
        plane, tangent = self._to_plane.plane, self._tangent
        cells = self._cells if self._grid is not None and self._grid.covers(x, y) else None

        def function(start, stop, ra, dec):
            kernels.rows_to_sky(plane, cells, tangent, x, y[start:stop], ra, dec)

        return function


def _cells_to_sky(to_plane, tangent, scale):
    """Return the cells of a map with the projection included, or `None`.

    In a cell of a look-up table, the sky is so flat that the projection is bicubic, too, to about
    1e-8 px.  It then takes no additional time.  If cells are large or a pole is close, this is not
    the case, and `None` is returned.
    """
    grid = to_plane.grid
    if grid is None or to_plane.polynomial is not None or grid.nx * grid.ny > _MOST_CELLS:
        return None

    plane = to_plane.plane
    # About a right ascension of 180 degrees, so that none of them wraps.
    middle = tangent.copy()
    middle[0] = 180.0

    def function(x, y):
        ra, dec = np.empty((2, len(x)))
        kernels.to_sky(plane, None, middle, None, x, y, ra, dec)
        ra += tangent[0] - 180.0
        return ra, dec

    grid = grid.interpolate(function)
    # Where the error of the interpolation is greatest.
    points = grid.points([0.0, 0.5, 1.0])
    exact = np.array(function(*points))
    error = np.subtract(PlaneMap(grid=grid)(*points), exact)
    error[0] *= np.cos(np.radians(exact[1]))
    # Written so that NaN counts as too much.
    return grid if np.abs(error).max() <= _CELL_TOLERANCE_PX * scale else None


class SkyTangent(_Linear):
    """The sky to undistorted pixels: the inverse of `TangentSky`, with the same parameters.

    The result is NaN for points 90 degrees or more from the tangent point.

    Parameters
    ----------
    crpix : (float, float)
        Reference point in zero-based pixels, (x, y).
    cd : (2, 2) array_like
        Matrix from pixels to the tangent plane, degrees per pixel.
    crval : (float, float)
        Right ascension and declination of the tangent point in degrees.
    **kwargs
        ``name`` and ``meta`` of the model.

    Examples
    --------
    >>> from wpdc_gwcs.models import TangentSky
    >>> sky = TangentSky(crpix=(99.5, 99.5), cd=[[-1e-4, 0], [0, 1e-4]], crval=(0.0, 60.0))
    >>> type(sky.inverse).__name__
    'SkyTangent'
    >>> x, y = sky.inverse([0.0, 180.0], [60.01, -60.0])  # the second one is behind the observer
    >>> x.round(4).tolist(), y.round(4).tolist()
    ([99.5, nan], [199.5, nan])
    """

    _to_sky = False

    def evaluate(self, ra, dec, crpix, cd, crval):
        """Map the sky to undistorted pixels.

        Parameters
        ----------
        ra, dec : array_like
            Positions in degrees.
        crpix, cd, crval : array_like
            The parameters.

        Returns
        -------
        x, y : ndarray
            Undistorted pixel coordinates, zero based.
        """
        crpix, cd, crval = self._arrays(crpix, cd, crval)
        return evaluate_blocks(_projection(crval, np.linalg.inv(cd), crpix), ra, dec)

    @property
    def inverse(self):
        """The model from undistorted pixels to the sky (a `TangentSky`)."""
        return TangentSky(self.crpix.value, self.cd.value, self.crval.value)


def local_plane(sky, x, y, *, step=1.0):
    """Return the linear map and the tangent point of a WCS at a pixel.

    Parameters
    ----------
    sky : callable
        Pixels ``x, y`` to RA and Dec in degrees.
    x, y : float
        The pixel.
    step : float, optional
        Pixels over which the derivatives are taken.

    Returns
    -------
    crval : (2,) ndarray
        RA and Dec of the pixel, deg.
    cd : (2, 2) ndarray
        Derivatives of the standard coordinates about it with respect to x and y, deg / px.

    Examples
    --------
    >>> from wpdc_gwcs.models import TangentSky, local_plane
    >>> sky = TangentSky(crpix=(99.5, 99.5), cd=[[-1e-4, 0], [0, 1e-4]], crval=(10.0, 60.0))
    >>> crval, cd = local_plane(sky, 99.5, 99.5)
    >>> crval.round(9).tolist(), (1e4 * cd).round(6).tolist()
    ([10.0, 60.0], [[-1.0, 0.0], [0.0, 1.0]])
    """
    at = (
        x + step * np.array([0.0, 1.0, -1.0, 0.0, 0.0]),
        y + step * np.array([0.0, 0, 0, 1.0, -1.0]),
    )
    ra, dec = sky(*at)
    crval = np.array([ra[0], dec[0]])
    xi, eta = project(ra, dec, crval)
    cd = np.array([[xi[1] - xi[2], xi[3] - xi[4]], [eta[1] - eta[2], eta[3] - eta[4]]])
    return crval, cd / (2 * step)
