"""The tangent plane: gnomonic projection about a point of the sky, and its model."""

import numpy as np
from astropy.modeling import Model, Parameter

from wpdc_gwcs.blocks import evaluate_blocks
from wpdc_gwcs.models.mapping import PlaneMap
from wpdc_gwcs.sky import Tangent

__all__ = ["SkyTangent", "TangentSky"]


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
        tangent = Tangent(crval)

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
        """Return the whole way to the sky as a map, and a function for what is left to do then.

        The map leads to the sky itself where that is as good, else to the tangent plane in radians.
        Both are kept for as long as they are asked for with the same map and the same parameters.
        """
        crpix, cd, crval = self.crpix.value, self.cd.value, self.crval.value
        numbers = np.concatenate([crpix, np.ravel(cd), crval])
        cache = self._cache
        if cache is None or cache[0] is not plane_map or not np.array_equal(cache[1], numbers):
            matrix = np.radians(cd)
            to_plane = plane_map.transformed(matrix, -matrix @ crpix)
            tangent = Tangent(crval)
            to_sky = _cells_to_sky(to_plane, tangent, np.sqrt(abs(np.linalg.det(cd))))
            if to_sky is None:
                cache = (plane_map, numbers, to_plane, tangent.deproject_radians)
            else:
                cache = (plane_map, numbers, to_sky, tangent.wrap)
            self._cache = cache
        return cache[2:]

    def __getstate__(self):
        return {**self.__dict__, "_cache": None}

    @property
    def inverse(self):
        """The exact inverse (a `SkyTangent`)."""
        return SkyTangent(self.crpix.value, self.cd.value, self.crval.value)


# Error allowed where cells lead to the sky (px), and the most cells that are made for it.
_CELL_TOLERANCE_PX = 1e-7
_MOST_CELLS = 40_000


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
        tangent = Tangent(crval)

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
