"""The kernels of the WCS in NumPy, for installations without a compiler.

They repeat the C sources operation by operation, so that the results are identical to the last bit.
A change of one needs the same change of the other; the tests compare them.
"""

import math
import threading

import numpy as np

from wpdc_gwcs.kernels.levels_in_numpy import count_levels, put_cubics
from wpdc_gwcs.kernels.peaks_in_numpy import mark_cells
from wpdc_gwcs.kernels.stars_in_numpy import paint_stars, star_profiles, star_steps, take_stars

__all__ = [
    "CELL_ORDER",
    "count_levels",
    "evaluate",
    "from_sky",
    "invert",
    "jacobian",
    "mark_cells",
    "paint_stars",
    "put_cubics",
    "rows_to_sky",
    "star_profiles",
    "star_steps",
    "take_stars",
    "to_sky",
]

#: Cells in memory, ``[q, k, j, i, p]``: the four powers of s side by side, since fetching them 32
#: bytes at a time is what costs least, and both outputs in one array, for half as many calls.
CELL_ORDER = "qkjip"

_RADIAN = np.pi / 180
_DEGREE = 180 / np.pi

# Larger angles, degrees, are not coordinates.
_GREATEST_ANGLE = 1e9

_MAX_NEWTON = 25

# Number of points whose coefficients are processed at a time: a compromise, because fewer points
# stay in the cache, and more keep threads from waiting for each other.
_PART_SIZE = 16384

# Number of pixels in whole rows of an image that are processed at a time.
_PIECE_SIZE = 65536

# Coefficients of the highest power last (fdlibm).
_SINE = (
    -1.66666666666666324348e-01,
    8.33333333332248946124e-03,
    -1.98412698298579493134e-04,
    2.75573137070700676789e-06,
    -2.50507602534068634195e-08,
    1.58969099521155010221e-10,
)
_COSINE = (
    4.16666666666666019037e-02,
    -1.38888888888741095749e-03,
    2.48015872894767294178e-05,
    -2.75573143513906633035e-07,
    2.08757232129817482790e-09,
    -1.13596475577881948265e-11,
)
_ARC_TANGENT = (
    3.33333333333329318027e-01,
    -1.99999999998764832476e-01,
    1.42857142725034663711e-01,
    -1.11111104054623557880e-01,
    9.09088713343650656196e-02,
    -7.69187620504482999495e-02,
    6.66107313738753120669e-02,
    -5.83357013379057348645e-02,
    4.97687799461593236017e-02,
    -3.65315727442169155270e-02,
    1.62858201153657823623e-02,
)


class _Scratch(threading.local):
    """Work space that each thread reuses from block to block.

    Otherwise the system would map and unmap arrays of this size for every block, which takes longer
    than filling them.
    """

    space = np.empty(0)

    def get(self, shape):
        size = math.prod(shape)
        if len(self.space) < size:
            self.space = np.empty(size)
        return self.space[:size].reshape(shape)


_scratch = _Scratch()


# ---- angles --------------------------------------------------------------------------------------


def _series(coefficients, z):
    """Return the sum of ``coefficients[p] z**p``."""
    total = coefficients[-1] * z
    for value in coefficients[-2:0:-1]:
        total += value
        total *= z
    total += coefficients[0]
    return total


def _sin_cos(angle):
    """Return sine and cosine of angles in degrees."""
    angle = np.where(np.abs(angle) <= _GREATEST_ANGLE, angle, np.nan)
    # Quarter turns are subtracted in degrees, where they are exact.
    quarters = np.rint(angle * (1.0 / 90.0))
    x = angle - quarters * 90.0
    x *= _RADIAN
    z = x * x
    s = _series(_SINE, z)
    s *= z * x
    s += x
    half = 0.5 * z
    w = 1.0 - half
    c = _series(_COSINE, z)
    c *= z
    c *= z
    c += (1.0 - w) - half
    c += w
    turn = quarters - 4.0 * np.rint(quarters * 0.25)
    size = np.abs(turn)
    odd, opposite = size == 1.0, size == 2.0
    sine, cosine = np.where(odd, c, s), np.where(odd, s, c)
    np.negative(sine, out=sine, where=(turn == -1.0) | opposite)
    np.negative(cosine, out=cosine, where=(turn == 1.0) | opposite)
    return sine, cosine


# Lower limits of y / x, the angle to which the arc tangent is added, and the rest of its digits.
_STEPS = (
    (0.4375, 4.63647609000806093515e-01, 2.26987774529616870924e-17),
    (0.6875, 7.85398163397448278999e-01, 3.06161699786838301793e-17),
    (1.1875, 9.82793723247329054082e-01, 1.39033110312309984516e-17),
    (2.4375, 1.57079632679489655800e00, 6.12323399573676603587e-17),
)


def _arc_tangent(y, x):
    """Return the angle of the direction (x, y) in degrees, -180 to 180; 0 where both are 0."""
    up, along = np.abs(y), np.abs(x)
    numerator, denominator = up.copy(), along.copy()
    base, rest = np.zeros_like(up), np.zeros_like(up)
    reduced = (
        lambda u, a: (2.0 * u - a, 2.0 * a + u),
        lambda u, a: (u - a, a + u),
        lambda u, a: (u - 1.5 * a, a + 1.5 * u),
        lambda u, a: (-a, u),
    )
    for (limit, step, lacking), reduce in zip(_STEPS, reduced, strict=True):
        far = up > limit * along
        if not far.any():
            break
        for target, values in zip((numerator, denominator), reduce(up, along), strict=True):
            np.copyto(target, values, where=far)
        base[far], rest[far] = step, lacking
    numerator /= denominator
    z = numerator * numerator
    total = _series(_ARC_TANGENT, z)
    total *= z
    total *= numerator
    total -= rest
    total -= numerator
    np.subtract(base, total, out=base)
    base *= _DEGREE
    base[up == 0.0] = 0.0
    np.subtract(180.0, base, out=base, where=x < 0.0)
    np.negative(base, out=base, where=y < 0.0)
    return base


def _wrap(ra):
    """Bring right ascensions from -180 to 540 degrees into the range from 0 to 360, in place."""
    turns = (ra < 0.0).astype(float)
    turns -= ra >= 360.0
    turns *= 360.0
    ra += turns
    # A tiny negative angle is rounded up to 360.
    ra[ra >= 360.0] = 0.0


# ---- maps of the plane ---------------------------------------------------------------------------


def _locate(x, low, step, n):
    s = x - low
    s *= 1.0 / step
    # Points farther out belong to the outer cells; NaN stays NaN in s.
    i = np.floor(np.minimum(np.maximum(s, -1.0), n))
    s -= i
    i += 1.0
    return i, s


def _number(j, i, nx):
    """Return the number of a cell; NaN is in no cell, and its local coordinate is NaN in any."""
    number = j * (nx + 2.0)
    number += i
    number[np.isnan(number)] = 0.0
    return number.astype(np.intp)


def _locate_both(head, x, y):
    x_low, _, x_step, y_low, _, y_step, nx, ny = head[:8]
    i, s = _locate(x, x_low, x_step, nx)
    j, t = _locate(y, y_low, y_step, ny)
    return _number(j, i, nx), s, t


def _in_cells(head, x, y):
    return (x >= head[0]) & (x <= head[1]) & (y >= head[3]) & (y <= head[4])


def _horner_columns(columns, s, total, slope=None):
    """Write the sum of ``columns[..., p] s**p``, and its derivative by s when asked for."""
    n = columns.shape[-1]
    np.multiply(columns[..., n - 1], s, out=total)
    total += columns[..., n - 2]
    if slope is not None:
        slope[:] = columns[..., n - 1]
    for p in range(n - 3, -1, -1):
        if slope is not None:
            slope *= s
            slope += total
        total *= s
        total += columns[..., p]


def _parts(n):
    return (slice(start, min(start + _PART_SIZE, n)) for start in range(0, n, _PART_SIZE))


def _work_space(t, n_arrays):
    """Return arrays ``[output, point, power of s]``, and t repeated for all powers of s."""
    space = _scratch.get((2 * n_arrays + 1, len(t), 4))
    wide_t = space[-1]
    for column in wide_t.T:
        column[:] = t
    return space[:-1].reshape(n_arrays, 2, len(t), 4), wide_t


def _rows(plane):
    """Return the coefficients by power of t, each ``[output, cell, power of s]``."""
    return plane.table.reshape(4, 2, -1, 4)


def _cells(plane, x, y):
    """Return both values of the cells."""
    cell, s, t = _locate_both(plane.head, x, y)
    outputs = np.empty((2, len(s)))
    *lower, highest = _rows(plane)
    for part in _parts(len(s)):
        (total, term), wide_t = _work_space(t[part], 2)
        highest.take(cell[part], axis=1, out=total, mode="clip")
        for row in reversed(lower):
            total *= wide_t
            row.take(cell[part], axis=1, out=term, mode="clip")
            total += term
        _horner_columns(total, s[part], outputs[:, part])
    return outputs


def _cells_jacobian(plane, x, y):
    """Return both values of the cells and their derivatives, a, b, a_x, a_y, b_x, b_y."""
    cell, s, t = _locate_both(plane.head, x, y)
    outputs = np.empty((6, len(s)))
    values, by_s, by_t = outputs[:2], outputs[2::2], outputs[3::2]
    *lower, highest = _rows(plane)
    for part in _parts(len(s)):
        (total, slope, term), wide_t = _work_space(t[part], 3)
        highest.take(cell[part], axis=1, out=total, mode="clip")
        for step, row in enumerate(reversed(lower)):
            if step == 0:
                slope[:] = total
            else:
                slope *= wide_t
                slope += total
            total *= wide_t
            row.take(cell[part], axis=1, out=term, mode="clip")
            total += term
        _horner_columns(total, s[part], values[:, part], by_s[:, part])
        _horner_columns(slope, s[part], by_t[:, part])
    by_s *= 1.0 / plane.head[2]
    by_t *= 1.0 / plane.head[5]
    return outputs


def _horner(coefficients, u, v):
    """Sum up ``coefficients[p, q] u**p v**q`` with p + q < n."""
    n = len(coefficients)
    total = np.full(u.shape, coefficients[n - 1, 0])
    for p in range(n - 2, -1, -1):
        row = coefficients[p]
        inner = np.full(u.shape, row[n - 1 - p])
        for q in range(n - 2 - p, -1, -1):
            inner *= v
            inner += row[q]
        total *= u
        total += inner
    return total


def _radial_series(coefficients, r):
    total = np.full(r.shape, coefficients[-1])
    for value in coefficients[-2::-1]:
        total *= r
        total += value
    return total


def _polynomial(plane, x, y, n_outputs):
    head = plane.head
    u, v = x - head[8], y - head[9]
    outputs = np.array([_horner(c, u, v) for c in plane.polynomial[:n_outputs]])
    if plane.radial.size:
        m00, m01, m10, m11 = head[10:]
        first, second = m00 * u + m01 * v, m10 * u + m11 * v
        r = np.sqrt(first * first + second * second)
        outputs[:2] += [_radial_series(c, r) for c in plane.radial[:2]]
        if n_outputs > 2:
            # r has no derivative at 0; its one-sided slopes average to nothing there.
            inverse = np.divide(1.0, r, out=np.zeros_like(r), where=r > 0)
            r_x = (first * m00 + second * m10) * inverse
            r_y = (first * m01 + second * m11) * inverse
            for k in (0, 1):
                slope = _radial_series(plane.radial[2 + k], r)
                outputs[2 + 2 * k] += slope * r_x
                outputs[3 + 2 * k] += slope * r_y
    return outputs


def _values(plane, x, y):
    """Return both images of points."""
    if not plane.polynomial.size:
        return _cells(plane, x, y)
    images = _polynomial(plane, x, y, 2)
    if plane.table.size:
        images += _cells(plane, x, y)
    return images


def _values_and_derivatives(plane, x, y):
    """Return a, b, a_x, a_y, b_x, b_y of points."""
    if not plane.polynomial.size:
        return _cells_jacobian(plane, x, y)
    outputs = _polynomial(plane, x, y, 6)
    if plane.table.size:
        outputs += _cells_jacobian(plane, x, y)
    return outputs


def evaluate(plane, x, y, a, b):
    """Map points of the plane.

    Parameters
    ----------
    plane : Plane
        The map.
    x, y : (N,) ndarray
        Points.
    a, b : (N,) ndarray
        Their images are written here.
    """
    with np.errstate(all="ignore"):
        a[:], b[:] = _values(plane, x, y)


def jacobian(plane, x, y, a, b, a_x, a_y, b_x, b_y):
    """Map points of the plane and differentiate.

    Parameters
    ----------
    plane : Plane
        The map.
    x, y : (N,) ndarray
        Points.
    a, b, a_x, a_y, b_x, b_y : (N,) ndarray
        Their images and the derivatives of these by x and y are written here.
    """
    with np.errstate(all="ignore"):
        a[:], b[:], a_x[:], a_y[:], b_x[:], b_y[:] = _values_and_derivatives(plane, x, y)


# ---- the sky -------------------------------------------------------------------------------------


def _deproject(tangent, xi, eta):
    """Return RA and Dec in degrees of points of the plane in radians."""
    ra0, sin0, cos0 = tangent[:3]
    ahead = eta * -sin0
    ahead += cos0
    north = eta * cos0
    north += sin0
    ra = _arc_tangent(xi, ahead)
    ra += ra0
    _wrap(ra)
    ahead *= ahead
    ahead += xi * xi
    return ra, _arc_tangent(north, np.sqrt(ahead))


def to_sky(plane, cells, tangent, box, x, y, ra, dec):
    """Map detector pixels to the sky.

    Parameters
    ----------
    plane : Plane
        Map to the tangent plane in radians.
    cells : Plane or None
        Map to the sky itself in degrees, for points inside its cells.
    tangent : (9,) ndarray
        Tangent point, see `tangent_numbers`.
    box : (5,) ndarray or None
        Smallest and largest x, smallest and largest y, and value of points outside.
    x, y : (N,) ndarray
        Pixels.
    ra, dec : (N,) ndarray
        Their positions in degrees are written here.
    """
    with np.errstate(all="ignore"):
        # Written so that NaN counts as outside.
        inside = None if box is None else _in_box(box, x, y)
        if cells is None:
            ra[:], dec[:] = _deproject(tangent, *_values(plane, x, y))
        else:
            ra[:], dec[:] = _cells(cells, x, y)
            _wrap(ra)
            beyond = ~_in_cells(cells.head, x, y)
            if inside is not None:
                beyond &= inside
            if beyond.any():
                images = _values(plane, x[beyond], y[beyond])
                ra[beyond], dec[beyond] = _deproject(tangent, *images)
        if inside is not None and not inside.all():
            ra[~inside] = box[4]
            dec[~inside] = box[4]


def _in_box(box, x, y):
    return (x >= box[0]) & (x <= box[1]) & (y >= box[2]) & (y <= box[3])


def rows_to_sky(plane, cells, tangent, x, y, ra, dec):
    """Map whole rows of an image to the sky.

    Parameters
    ----------
    plane : Plane
        Map to the tangent plane in radians.
    cells : Plane or None
        Map to the sky itself in degrees, if all pixels are inside its cells.
    tangent : (9,) ndarray
        Tangent point, see `tangent_numbers`.
    x, y : (N,), (M,) ndarray
        Columns and rows.
    ra, dec : (M, N) ndarray
        Positions of their pixels in degrees are written here.
    """
    used = plane if cells is None else cells
    collapsed = {}
    step = max(1, _PIECE_SIZE // max(1, len(x)))
    with np.errstate(all="ignore"):
        for start in range(0, len(y), step):
            rows = slice(start, min(start + step, len(y)))
            if used.polynomial.size:
                n = rows.stop - rows.start
                values = _values(used, np.tile(x, n), np.repeat(y[rows], len(x)))
                values = values.reshape(2, n, -1)
            else:
                values = _cells_of_rows(used, x, y[rows], collapsed)
            if cells is None:
                ra[rows], dec[rows] = _deproject(tangent, *values)
            else:
                ra[rows], dec[rows] = values
                _wrap(ra[rows])


def _cells_of_rows(plane, x, y, collapsed):
    """Return the values of the cells along rows; the coefficients of a row of cells are kept."""
    x_low, _, x_step, y_low, _, y_step, nx, ny = plane.head[:8]
    j, t = _locate(y, y_low, y_step, ny)
    j[np.isnan(j)] = 0.0
    values = np.empty((2, len(y), len(x)))
    for first in np.unique(j):
        if first not in collapsed:
            collapsed.clear()
            i, s = _locate(x, x_low, x_step, nx)
            i[np.isnan(i)] = 0.0
            cell = (first * (nx + 2.0) + i).astype(np.intp)
            coefficients = np.empty((2, 4, len(x)))
            for q, row in enumerate(_rows(plane)):
                _horner_columns(row.take(cell, axis=1), s, coefficients[:, q])
            collapsed[first] = coefficients
        rows = j == first
        t_rows = t[rows, np.newaxis]
        for output, (*lower, highest) in zip(values, collapsed[first], strict=True):
            value = highest * t_rows
            for coefficient in lower[:0:-1]:
                value += coefficient
                value *= t_rows
            value += lower[0]
            output[rows] = value
    return values


def _project(tangent, ra, dec):
    """Return pixels of positions on the sky in degrees, NaN on the far hemisphere."""
    ra0, sin0, cos0, m00, m01, m10, m11, x0, y0 = tangent
    xi, ahead = _sin_cos(ra - ra0)
    sin_dec, cos_dec = _sin_cos(dec)
    ahead *= cos_dec
    depth = sin0 * sin_dec
    depth += cos0 * ahead
    # The horizon itself is infinitely far away.
    depth[~(depth > 1e-12)] = np.nan
    scale = np.divide(_DEGREE, depth, out=depth)
    xi *= cos_dec
    xi *= scale
    eta = cos0 * sin_dec
    eta -= sin0 * ahead
    eta *= scale
    return m00 * xi + m01 * eta + x0, m10 * xi + m11 * eta + y0


def from_sky(tangent, ra, dec, x, y):
    """Map the sky to undistorted pixels.

    Parameters
    ----------
    tangent : (9,) ndarray
        Tangent point and matrix, see `tangent_numbers`.
    ra, dec : (N,) ndarray
        Positions in degrees.
    x, y : (N,) ndarray
        Their pixels are written here, NaN for those of the far hemisphere.
    """
    with np.errstate(all="ignore"):
        x[:], y[:] = _project(tangent, ra, dec)


# ---- the inverse ---------------------------------------------------------------------------------


def invert(plane, start, limits, tangent, box, a, b, x, y):
    """Invert a map of the plane by Newton's method, with the projection in front.

    Parameters
    ----------
    plane : Plane
        The map.
    start : Plane or None
        Approximate inverse for the starting points; the images themselves for `None`.
    limits : (4,) ndarray
        Largest residual, bound of the second derivatives inside the cells, sign of the Jacobian
        determinant in the middle, and distance outside the box within which solutions are moved to
        its edge.
    tangent : (9,) ndarray or None
        If given, a and b are positions on the sky, see `from_sky`.
    box : (5,) ndarray or None
        Smallest and largest x, smallest and largest y, and value of solutions outside.
    a, b : (N,) ndarray
        Images to invert.
    x, y : (N,) ndarray
        The points are written here, each verified by its residual or a bound of it; NaN where there
        is none.
    """
    with np.errstate(all="ignore"):
        if tangent is not None:
            a, b = _project(tangent, a, b)
        x[:] = y[:] = np.nan
        good = np.flatnonzero(np.isfinite(a) & np.isfinite(b))
        _solve_near_and_far(plane, start, limits, a[good], b[good], good, x, y)
        if box is not None:
            x_near, y_near = _hold(x, *box[:2]), _hold(y, *box[2:4])
            np.copyto(x, x_near, where=np.abs(x_near - x) <= limits[3])
            np.copyto(y, y_near, where=np.abs(y_near - y) <= limits[3])
            outside = ~_in_box(box, x, y)
            x[outside] = y[outside] = box[4]


def _hold(values, low, high):
    return np.minimum(np.maximum(values, low), high)


def _solve_near_and_far(plane, start, limits, a, b, index, x_out, y_out):
    x, y = a, b
    if start is not None:
        if start.table.size:
            # Clipped to the edge: points farther out have no solution anyway.
            x, y = _hold(a, *start.head[:2]), _hold(b, *start.head[3:5])
        x, y = _values(start, x, y)
    if plane.table.size:
        x, y = _hold_near(plane, x, y)
        _solve(plane, limits, a, b, x, y, index, x_out, y_out, bounded=True)
        far = np.isnan(x_out[index])
        a, b, x, y, index = (values[far] for values in (a, b, x, y, index))
    _solve(plane, limits, a, b, x, y, index, x_out, y_out, bounded=False)


def _hold_near(plane, x, y):
    """Move points onto the cells and one cell around them."""
    x_low, x_high, x_step, y_low, y_high, y_step = plane.head[:6]
    margin = max(x_step, y_step)
    return _hold(x, x_low - margin, x_high + margin), _hold(y, y_low - margin, y_high + margin)


def _solve(plane, limits, a, b, x, y, index, x_out, y_out, *, bounded):
    """Newton's method from x, y; points without a solution keep the NaN of the outputs."""
    tolerance, curvature, sign = limits[:3]
    for _ in range(_MAX_NEWTON):
        if not len(a):
            break
        left_a, left_b, a_x, a_y, b_x, b_y = _values_and_derivatives(plane, x, y)
        np.subtract(a, left_a, out=left_a)
        np.subtract(b, left_b, out=left_b)
        determinant = a_x * b_y - a_y * b_x
        dx = (b_y * left_a - a_y * left_b) / determinant
        dy = (a_x * left_b - b_x * left_a) / determinant
        x_new, y_new = x + dx, y + dy
        determinant *= sign
        # The remaining error of a step is bounded by its length.
        residual = (dx * dx + dy * dy) * (0.5 * curvature)
        certain = residual <= tolerance
        certain &= _in_cells(plane.head, x_new, y_new)
        if not certain.all():
            # The bound is not tight enough: evaluate the map.
            unsure = ~certain
            x_unsure, y_unsure = x_new[unsure], y_new[unsure]
            if bounded:
                x_unsure, y_unsure = _hold_near(plane, x_unsure, y_unsure)
                x_new[unsure], y_new[unsure] = x_unsure, y_unsure
            left_a, left_b = _values(plane, x_unsure, y_unsure)
            residual[unsure] = np.maximum(np.abs(a[unsure] - left_a), np.abs(b[unsure] - left_b))
        # Rounding errors of the map set the limit.
        limit = tolerance + 16 * np.finfo(float).eps * np.maximum(np.abs(a), np.abs(b))
        done = residual <= limit
        answer = done & (determinant > 0)
        x_out[index[answer]], y_out[index[answer]] = x_new[answer], y_new[answer]
        # A point that no longer moves, or has diverged, has no solution.
        going = (x_new != x) | (y_new != y)
        going &= np.isfinite(x_new) & np.isfinite(y_new)
        going &= ~done
        a, b, x, y, index = (values[going] for values in (a, b, x_new, y_new, index))
