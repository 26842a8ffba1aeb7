"""The terms of a solution: linear displacements of the focal plane, with priors that are learned.

A term is plain data: a name, a scope, its shapes and the group of each coefficient.  The solver
knows scopes (camera, detector, exposure) and groups, not names: a new term is one more function
that returns a `Term`.  Displacements are in px of the focal plane, along its axes.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

__all__ = [
    "Block",
    "Design",
    "Term",
    "attitude",
    "lateral_color",
    "legendre_products",
    "optics",
    "place",
    "polynomial",
    "refraction",
    "tilt",
]


@dataclass(frozen=True, eq=False)
class Block:
    """Coordinates of some stars of one frame, as the designs need them.

    Parameters
    ----------
    u, v : (N,) ndarray
        Position on the detector, -1 to 1 along each side.
    aspect : (2,) ndarray
        Sides in units of the longer one.
    focal : (2, N) ndarray
        Position in the focal plane in units of its radius.
    color : (N,) ndarray
        Color minus the reference color.
    """

    u: np.ndarray
    v: np.ndarray
    aspect: np.ndarray
    focal: np.ndarray
    color: np.ndarray


@dataclass(frozen=True, eq=False)
class Term:
    """One kind of displacement.

    Parameters
    ----------
    name : str
        Name, for logs and statistics.
    scope : {'camera', 'detector', 'exposure'}
        Whether the camera, each detector or each exposure has its own coefficients.
    groups : (K,) ndarray of int
        Group of each coefficient: the coefficients of one group share a variance.
    start : (G,) ndarray
        Standard deviation of each group before anything is learned, px.
    decay : float
        Factor by which a group is expected to be smaller than the one before, for a sequence
        of groups (degrees); 0 for independent groups.
    shapes : callable
        ``shapes(block) -> (p, N)``: functions of position, of which displacements along both axes
        are composed.
    mix : (2 p, K) ndarray or None
        Weight of each shape in the displacement of each coefficient, along the first axis and then
        along the second; `None` for one coefficient per shape.
    chromatic : bool, optional
        Whether the displacement vanishes at the reference color.
    """

    name: str
    scope: str
    groups: np.ndarray
    start: np.ndarray
    decay: float
    shapes: Callable
    mix: np.ndarray | None = None
    chromatic: bool = False

    @property
    def size(self):
        """Number of coefficients."""
        return len(self.groups)

    def displacement(self, block, coefficients):
        """Return displacements for given coefficients.

        Parameters
        ----------
        block : Block
            Stars.
        coefficients : (K,) ndarray
            Px.

        Returns
        -------
        (2, N) ndarray
            Px of the focal plane.
        """
        shapes = self.shapes(block)
        each = coefficients if self.mix is None else self.mix @ coefficients
        return each.reshape(2, -1) @ shapes

    def design(self, block):
        """Return displacements of unit coefficients.

        Parameters
        ----------
        block : Block
            Stars.

        Returns
        -------
        Design
            Px of the focal plane.
        """
        each = np.eye(self.size) if self.mix is None else self.mix
        return Design(self.shapes(block), each.reshape(2, -1, self.size))


@dataclass(frozen=True, eq=False)
class Design:
    """Displacements of unit coefficients, in factors.

    Coefficient k shifts star n by ``mix[a, p, k] shapes[p, n]``, summed over p, along axis a.
    There are at most half as many shapes as coefficients, so products of shapes take a quarter of
    the time of products of columns, most of which are zero along one axis.

    Parameters
    ----------
    shapes : (p, N) ndarray
        Functions of the place.
    mix : (2, p, K) ndarray
        Weight of each shape in the displacement of each coefficient, along both axes.
    """

    shapes: np.ndarray
    mix: np.ndarray

    @classmethod
    def joined(cls, parts):
        """Put the coefficients of several designs side by side.

        Parameters
        ----------
        parts : sequence of Design
            Designs for the same stars.

        Returns
        -------
        Design
            Design of all coefficients.
        """
        mix = np.zeros((2, *np.sum([part.mix.shape[1:] for part in parts], axis=0)))
        p = k = 0
        for part in parts:
            _, q, m = part.mix.shape
            mix[:, p : p + q, k : k + m] = part.mix
            p, k = p + q, k + m
        return cls(np.concatenate([part.shapes for part in parts]), mix)

    @property
    def rows(self):
        """The displacements themselves, ``(2, N, K)``."""
        return np.moveaxis(np.tensordot(self.mix, self.shapes, (1, 0)), 1, 2)


# Expected ratio of one degree of a polynomial to the degree before.
_DECAY = 1.8

# Broad start values, px, which are replaced by learned ones: distortion of degree 2 of a single
# detector, and of a detector in a mosaic, where the optics have most of it; optics; shift and
# rotation of a detector.
_START, _START_MOSAIC, _START_OPTICS, _START_PLACE = 100.0, 3.0, 300.0, 10.0

# The same for terms in color, px per magnitude.
_START_COLOR = 0.1


def _degrees(first, last):
    return np.array([n for n in range(first, last + 1) for _ in range(n + 1)])


def legendre_products(a, b, first, last, aspect=(1.0, 1.0)):
    """Return products of Legendre polynomials of total degrees first to last.

    Parameters
    ----------
    a, b : (N,) ndarray
        Position, -1 to 1 along each side.
    first, last : int
        Total degrees.
    aspect : (2,) array_like, optional
        Sides in units of the longer one.

    Returns
    -------
    (p, N) ndarray
        Products, degree by degree, with increasing powers of ``b``.

    Notes
    -----
    All shapes of a degree share one variance, so they are scaled to the same mean square over the
    detector, as in a homogeneous field.  With equal coefficients instead, mixed terms would be
    smaller than they are in lenses, and the center would vary less than the edge.  Along a short
    side, a polynomial of the same curvature is smaller, so shapes are scaled with the sides.
    """
    p, q = (_normalized(c, last, side) for c, side in zip((a, b), aspect))
    degrees = _degrees(first, last)
    out = np.empty((len(degrees), len(a)))
    orders = [(n - j, j) for n in range(first, last + 1) for j in range(n + 1)]
    for row, (i, j) in enumerate(orders):
        np.multiply(p[i], q[j], out=out[row])
    out /= np.sqrt(2 * degrees + 1)[:, None]
    return out


def _normalized(a, last, side):
    """Legendre polynomials of the same mean square, those of a short side scaled, ``(n, N)``."""
    out = np.ones((last + 1, len(a)))
    out[1] = a
    for n in range(2, last + 1):
        out[n] = ((2 * n - 1) * a * out[n - 1] - (n - 1) * out[n - 2]) / n
    degrees = np.arange(last + 1)
    out *= (np.sqrt(2 * degrees + 1) * side**degrees)[:, None]
    return out


def polynomial(degree, *, mosaic=False):
    """Distortion of a detector: a polynomial about its own center.

    Parameters
    ----------
    degree : int
        Largest total degree.  The constant and the linear terms belong to the place of the detector
        or to the attitudes.
    mosaic : bool, optional
        Whether the detector is one of several.

    Returns
    -------
    Term
        Products of Legendre polynomials, a group for each degree.
    """
    degrees = np.tile(_degrees(2, degree), 2)
    start = (_START_MOSAIC if mosaic else _START) / _DECAY ** (np.arange(2, degree + 1) - 2.0)
    # For a detector of a mosaic, the keystone of the second degree is a separate term, see `tilt`.
    mix = None
    if mosaic:
        mix = np.eye(len(degrees))
        rest, second = _keystone()[:, 2:], np.flatnonzero(degrees == 2)
        higher = mix[:, degrees > 2]
        mix = np.zeros((len(degrees), rest.shape[1] + higher.shape[1]))
        mix[second, : rest.shape[1]] = rest
        mix[:, rest.shape[1] :] = higher
        degrees = np.concatenate([np.full(rest.shape[1], 2), degrees[degrees > 2]])
    return Term(
        "polynomial",
        "detector",
        degrees - 2,
        start,
        _DECAY,
        lambda b: legendre_products(b.u, b.v, 2, degree, b.aspect),
        mix,
    )


def _keystone():
    """Orthogonal combinations of the six columns of degree 2: two keystones, and the other four.

    The keystones of the two directions are (p^2, p q) and (p q, q^2).  Except for a constant, which
    belongs to a shift, p^2 is two thirds of the Legendre polynomial.  The other factors are those
    of `legendre_products`.
    """
    columns = np.zeros((6, 6))
    square, mixed = 2 / 3, np.sqrt(5) / 3
    columns[[0, 4], 0] = square, mixed
    columns[[1, 5], 1] = mixed, square
    columns[[0, 4], 2] = mixed, -square
    columns[[1, 5], 3] = square, -mixed
    columns[2, 4] = columns[3, 5] = 1
    return columns / np.linalg.norm(columns, axis=0)


def place():
    """Place of a detector in the focal plane of a mosaic.

    Returns
    -------
    Term
        Columns shift x, shift y, rotation, scale, stretch, shear; the last three vary less from
        detector to detector than the first three.
    """
    # 1, p, q along the first axis, then along the second.
    mix = np.zeros((6, 6))
    mix[[0, 3], [0, 1]] = 1
    mix[2, 2], mix[4, 2] = -1, 1
    mix[1, 3], mix[5, 3] = 1, 1
    mix[1, 4], mix[5, 4] = 1, -1
    mix[2, 5], mix[4, 5] = 1, 1
    return Term(
        "place",
        "detector",
        np.array([0, 0, 1, 2, 3, 3]),
        np.full(4, _START_PLACE),
        0.0,
        lambda b: np.array([np.ones_like(b.u), b.aspect[0] * b.u, b.aspect[1] * b.v]),
        mix,
    )


def tilt():
    """Tilt of a detector with respect to the focal plane of a mosaic, which appears as a keystone.

    Returns
    -------
    Term
        One column for each direction.
    """
    return Term(
        "tilt",
        "detector",
        np.zeros(2, int),
        np.array([1.0]),
        0.0,
        lambda b: legendre_products(b.u, b.v, 2, 2, b.aspect),
        _keystone()[:, :2],
    )


def optics(degree):
    """Distortion of the camera over its focal plane.

    Parameters
    ----------
    degree : int
        Largest total degree.  Constant and linear terms belong to the attitudes.

    Returns
    -------
    Term
        Products of Legendre polynomials, a group for each degree.
    """
    degrees = _degrees(2, degree)
    start = _START_OPTICS / _DECAY ** (np.arange(2, degree + 1) - 2.0)
    return Term(
        "optics",
        "camera",
        np.tile(degrees - 2, 2),
        start,
        _DECAY,
        lambda b: legendre_products(*b.focal, 2, degree),
    )


def attitude():
    """Six numbers of each exposure: shift and linear map of the focal plane.

    Returns
    -------
    Term
        Columns (ax, bxx, bxy, ay, byx, byy), positions in units of the radius.
    """
    return Term(
        "attitude",
        "exposure",
        np.zeros(6, int),
        np.array([1e4]),
        0.0,
        lambda b: np.array([np.ones_like(b.u), *b.focal]),
    )


def refraction():
    """Shift of each exposure in proportion to color: differential refraction of the atmosphere.

    Returns
    -------
    Term
        One column for each axis, px per magnitude.
    """
    return Term(
        "refraction",
        "exposure",
        np.zeros(2, int),
        np.array([_START_COLOR]),
        0.0,
        lambda b: b.color[None],
        chromatic=True,
    )


def lateral_color():
    """Scale of the camera in proportion to color: lateral color.

    Returns
    -------
    Term
        Radial columns of the first and third power, px per magnitude at the edge.
    """

    def shapes(b):
        radial = b.color * b.focal
        return np.concatenate([radial, radial * np.sum(b.focal**2, axis=0)])

    # Along the first axis the first component of each power, along the second the second one.
    mix = np.zeros((8, 2))
    mix[[0, 5], 0] = mix[[2, 7], 1] = 1
    return Term(
        "lateral color",
        "camera",
        np.zeros(2, int),
        np.array([_START_COLOR]),
        0.0,
        shapes,
        mix,
        chromatic=True,
    )
