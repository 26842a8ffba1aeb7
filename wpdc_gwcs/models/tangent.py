"""The tangent plane: gnomonic projection about a point of the sky, and its model."""

import numpy as np
from astropy.modeling import Model, Parameter

from wpdc_gwcs.models.blocks import evaluate_blocks
from wpdc_gwcs.models.mapping import PlaneMap

__all__ = ["SkyTangent", "TangentSky", "deproject", "local_plane", "project"]


class _Tangent:
    """Gnomonic projection about one point, on contiguous blocks."""

    def __init__(self, crval):
        self.ra0, self.dec0 = (float(value) for value in crval)
        self.sin0, self.cos0 = np.sin(np.radians(self.dec0)), np.cos(np.radians(self.dec0))

    def project(self, ra, dec):
        """Sky in degrees to the plane in degrees, NaN on the far hemisphere."""
        # Sines and cosines from the tangents of the half angles, which numpy has in vector
        # instructions; numerators and denominator share the factor (1 + tan_ra^2) (1 + tan_dec^2).
        tan_ra = ra - self.ra0
        tan_ra *= np.pi / 360
        np.tan(tan_ra, out=tan_ra)
        tan_dec = dec * (np.pi / 360)
        np.tan(tan_dec, out=tan_dec)
        square = tan_ra * tan_ra
        cos_dec = tan_dec * tan_dec
        np.subtract(1.0, cos_dec, out=cos_dec)
        xi = 2.0 * tan_ra
        xi *= cos_dec
        ahead = 1.0 - square
        ahead *= cos_dec
        square += 1.0
        eta = tan_dec
        eta *= 2.0
        eta *= square
        depth = self.sin0 * eta
        depth += self.cos0 * ahead
        eta *= self.cos0
        ahead *= self.sin0
        eta -= ahead
        # The horizon itself is infinitely far away.
        square *= 1e-12
        hidden = ~(depth > square)
        if hidden.any():
            depth[hidden] = np.nan
        np.divide(180 / np.pi, depth, out=depth)
        xi *= depth
        eta *= depth
        return xi, eta

    def deproject(self, xi, eta):
        """Plane in degrees to the sky in degrees; right ascension from 0 to 360."""
        return self.deproject_radians(xi * (np.pi / 180), eta * (np.pi / 180))

    def deproject_radians(self, xi, eta):
        """Plane in radians, which is overwritten, to the sky in degrees."""
        ra, dec = self.offsets(xi, eta)
        ra += self.ra0
        return self.wrap(ra, dec)

    def offsets(self, xi, eta):
        """Plane in radians, which is overwritten, to RA from RA0 and Dec in degrees."""
        # Axes of the tangent plane's point: toward RA0 in the equator's plane, east, and north.
        ahead = eta * -self.sin0
        ahead += self.cos0
        north = eta
        north *= self.cos0
        north += self.sin0
        if xi.size and ahead.min() > 0:
            # Of one argument it is the faster one.
            ra = xi / ahead
            np.arctan(ra, out=ra)
        else:
            ra = np.arctan2(xi, ahead)
        xi *= xi
        ahead *= ahead
        xi += ahead
        np.sqrt(xi, out=xi)
        # At the pole itself it is the arc tangent of infinity.
        north /= xi
        dec = np.arctan(north, out=north)
        dec *= 180 / np.pi
        ra *= 180 / np.pi
        return ra, dec

    @staticmethod
    def wrap(ra, dec):
        """Bring right ascensions, which are overwritten, into the range from 0 to 360 degrees."""
        if ra.size and not (ra.min() >= 0.0 and ra.max() < 360.0):
            np.mod(ra, 360.0, out=ra)
            # A tiny negative angle is rounded up to 360 by the modulus.
            ra[ra == 360.0] = 0.0
        return ra, dec


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
    return evaluate_blocks(_Tangent(crval).project, ra, dec)


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

    which is exact at the poles, too.

    Examples
    --------
    >>> from wpdc_gwcs.models import deproject
    >>> ra, dec = deproject(0.0, 1.0, (10.0, 89.5))
    >>> float(ra), float(dec)
    (190.0, 89.5001)
    """
    return evaluate_blocks(_Tangent(crval).deproject, xi, eta)


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
    """Raise an error unless a 2 x 2 matrix can be inverted without losing all digits.

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
        If a shape is wrong, a number is not finite or ``cd`` is singular.

    Notes
    -----
    The native pole stands at LONPOLE = 180 deg at every declination.  (FITS makes 0 the default at
    a declination of exactly +90 deg; such a header has to be turned by half a circle.)

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
        return evaluate_blocks(self._block_function(crpix, cd, crval), x, y)

    def _block_function(self, crpix, cd, crval):
        (x0, y0), cd, crval = self._arrays(crpix, cd, crval)
        (m00, m01), (m10, m11) = np.radians(cd)
        tangent = _Tangent(crval)

        def to_sky(x, y):
            u, v = x - x0, y - y0
            xi = m00 * u
            xi += m01 * v
            u *= m10
            v *= m11
            v += u
            return tangent.deproject_radians(xi, v)

        return to_sky

    def _after(self, plane_map):
        """Return the whole way to the sky, a `_SkyMap`.

        It is kept for as long as it is asked for with the same map and the same parameters.
        """
        crpix, cd, crval = self.crpix.value, self.cd.value, self.crval.value
        numbers = np.concatenate([crpix, np.ravel(cd), crval])
        cache = self._cache
        if cache is None or cache[0] is not plane_map or not np.array_equal(cache[1], numbers):
            matrix = np.radians(cd)
            to_plane = plane_map.transformed(matrix, -matrix @ crpix)
            to_sky = _SkyMap(to_plane, _Tangent(crval), np.sqrt(abs(np.linalg.det(cd))))
            cache = self._cache = (plane_map, numbers, to_sky)
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
    """The whole way to the sky on blocks: a map to the tangent plane in radians, then the sphere.

    Where cells lead to the sky itself as well as that, they are used for what lies inside them.
    """

    def __init__(self, to_plane, tangent, scale):
        self.to_plane = to_plane
        self._tangent = tangent
        self._cells = _cells_to_sky(to_plane, tangent, scale)

    def __call__(self, x, y):
        ra, dec = self.inside(x, y)
        if self._cells is not None:
            outside = self._cells.grid.outside(x, y)
            if outside is not None:
                ra[outside], dec[outside] = self._tangent.deproject_radians(
                    *self.to_plane(x[outside], y[outside])
                )
        return ra, dec

    def inside(self, x, y):
        """Map points of which only those inside the cells matter."""
        if self._cells is None:
            return self._tangent.deproject_radians(*self.to_plane(x, y))
        return self._tangent.wrap(*self._cells(x, y))

    def along_rows(self, x):
        """Return a function ``function(y) -> ra, dec`` for whole rows of an image."""
        slow = self.to_plane.along_rows(x)
        if self._cells is None:
            return lambda y: self._tangent.deproject_radians(*slow(y))
        grid = self._cells.grid
        quick = self._cells.along_rows(x)
        x_ends = np.array([x.min(), x.max()]) if len(x) else np.empty(0)

        def function(y):
            y_ends = np.array([y.min(), y.max()]) if len(y) else np.empty(0)
            if len(x_ends) and len(y_ends) and grid.outside(x_ends, y_ends) is not None:
                return self._tangent.deproject_radians(*slow(y))
            return self._tangent.wrap(*quick(y))

        return function


def _cells_to_sky(to_plane, tangent, scale):
    """Return a map with the tangent plane taken into the cells of a map, or `None`.

    In a cell of a look-up table the sky is so nearly a plane that the projection, too, is bicubic
    to some 1e-8 px, and as quick to evaluate as the table alone.  It is not where cells are large
    or a pole is close; `None` then.
    """
    grid = to_plane.grid
    if grid is None or to_plane.polynomial is not None or grid.nx * grid.ny > _MOST_CELLS:
        return None

    def function(x, y):
        ra, dec = tangent.offsets(*to_plane(x, y))
        ra += tangent.ra0
        return ra, dec

    cells = grid.interpolate(function)
    # Where the error of the interpolation is greatest.
    points = grid.points([0.0, 0.5, 1.0])
    exact = np.array(function(*points))
    to_sky = PlaneMap(grid=cells)
    error = to_sky(*points) - exact
    error[0] *= np.cos(np.radians(exact[1]))
    # Written so that NaN counts as too much.
    return to_sky if np.abs(error).max() <= _CELL_TOLERANCE_PX * scale else None


class SkyTangent(_Linear):
    """The sky to undistorted pixels: the inverse of `TangentSky`, with the same parameters.

    NaN for points 90 degrees or more from the tangent point.

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
        return evaluate_blocks(self._block_function(crpix, cd, crval), ra, dec)

    def _block_function(self, crpix, cd, crval):
        (x0, y0), cd, crval = self._arrays(crpix, cd, crval)
        (m00, m01), (m10, m11) = np.linalg.inv(cd)
        tangent = _Tangent(crval)

        def to_pixels(ra, dec):
            xi, eta = tangent.project(ra, dec)
            x = m00 * xi
            x += m01 * eta
            x += x0
            xi *= m10
            eta *= m11
            eta += xi
            eta += y0
            return x, eta

        return to_pixels

    @property
    def inverse(self):
        """The model from undistorted pixels to the sky (a `TangentSky`)."""
        return TangentSky(self.crpix.value, self.cd.value, self.crval.value)


def local_plane(sky, x, y, *, step=1.0):
    """Give the linear map and the tangent point of a WCS at a pixel.

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
