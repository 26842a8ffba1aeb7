"""The terms of a solution: linear displacements of the focal plane, with priors that are learnt.

A term is plain data: a name, a scope, the columns of its design and the group of each.  The solver
knows scopes (camera, detector, exposure) and groups, not names: a new term is one more function
that returns a `Term`.  Displacements are in px of the focal plane, along its axes.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.polynomial.legendre import legvander

__all__ = [
    "Block",
    "Term",
    "attitude",
    "lateral_color",
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
        Place on the detector, -1 to 1 along each side.
    aspect : (2,) ndarray
        Sides in units of the longer one.
    focal : (2, N) ndarray
        Place in the focal plane in units of its radius.
    color : (N,) ndarray
        Color less the reference color.
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
        What has coefficients of its own.
    groups : (K,) ndarray of int
        Group of each coefficient: the coefficients of one group share a variance.
    start : (G,) ndarray
        Standard deviation of each group before anything is learnt, px.
    decay : float
        Factor by which a group is expected to be smaller than the one before, where there is a
        sequence of them (degrees); 0 for groups of their own.
    design : callable
        ``design(block) -> (2, N, K)``.
    chromatic : bool, optional
        Whether it vanishes at the reference color.
    """

    name: str
    scope: str
    groups: np.ndarray
    start: np.ndarray
    decay: float
    design: Callable
    chromatic: bool = False

    @property
    def size(self):
        """Number of coefficients."""
        return len(self.groups)


# How much smaller a degree of a polynomial is expected to be than the degree before it.
_DECAY = 1.8

# Broad starts, px: what is learnt replaces them.  Distortion of degree 2 of one detector alone, and
# of a detector in a mosaic, whose optics take the most; optics; shift and turn of a detector.
_START, _START_MOSAIC, _START_OPTICS, _START_PLACE = 100.0, 3.0, 300.0, 10.0

# The same of terms in color, px per magnitude.
_START_COLOR = 0.1


def _degrees(first, last):
    return np.array([n for n in range(first, last + 1) for _ in range(n + 1)])


def _legendre(a, b, first, last, aspect=(1.0, 1.0)):
    """Products of Legendre polynomials of the total degrees first to last, ``(N, p)``.

    Along a short side a polynomial of the same curvature is smaller: columns are scaled by the
    sides, so that one variance serves all columns of a degree.
    """
    degrees = np.arange(last + 1)
    p, q = legvander(a, last) * aspect[0] ** degrees, legvander(b, last) * aspect[1] ** degrees
    return np.stack(
        [p[:, n - j] * q[:, j] for n in range(first, last + 1) for j in range(n + 1)], axis=1
    )


def _both_axes(columns):
    """Repeat columns for each axis by itself, ``(2, N, 2 p)``."""
    n, p = columns.shape
    out = np.zeros((2, n, 2 * p))
    out[0, :, :p] = columns
    out[1, :, p:] = columns
    return out


def polynomial(degree, *, mosaic=False):
    """Distortion of a detector: a polynomial about its own center.

    Parameters
    ----------
    degree : int
        Largest total degree; the constant and the linear terms are those of its place, or of the
        attitudes.
    mosaic : bool, optional
        Whether the detector is one of several.

    Returns
    -------
    Term
        Products of Legendre polynomials, a group for each degree.
    """
    degrees = np.tile(_degrees(2, degree), 2)
    start = (_START_MOSAIC if mosaic else _START) / _DECAY ** (np.arange(2, degree + 1) - 2.0)
    # Of the second degree, a detector of a mosaic has its keystone apart, see `tilt`.
    mix = np.eye(len(degrees))
    if mosaic:
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
        lambda b: _both_axes(_legendre(b.u, b.v, 2, degree, b.aspect)) @ mix,
    )


def _keystone():
    """Orthogonal combinations of the six columns of degree 2: two keystones, and the other four.

    A keystone of one direction is (p^2, p q), of the other (p q, q^2); less constants, which a
    shift takes, p^2 is two thirds of the Legendre polynomial.
    """
    columns = np.zeros((6, 6))
    columns[[0, 4], 0] = 2 / 3, 1
    columns[[1, 5], 1] = 1, 2 / 3
    columns[[0, 4], 2] = 1, -2 / 3
    columns[[1, 5], 3] = 2 / 3, -1
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

    def design(b):
        zero, one = np.zeros_like(b.u), np.ones_like(b.u)
        p, q = b.aspect[0] * b.u, b.aspect[1] * b.v
        return np.array(
            [
                np.stack([one, zero, -q, p, p, q], axis=1),
                np.stack([zero, one, p, q, -q, p], axis=1),
            ]
        )

    return Term("place", "detector", np.array([0, 0, 1, 2, 3, 3]), np.full(4, _START_PLACE), 0.0,
                design)  # fmt: skip


def tilt():
    """Tilt of a detector against the focal plane of a mosaic, which it sees as a keystone.

    Returns
    -------
    Term
        One column for each direction.
    """
    mix = _keystone()[:, :2]

    def design(b):
        return _both_axes(_legendre(b.u, b.v, 2, 2, b.aspect)) @ mix

    return Term("tilt", "detector", np.zeros(2, int), np.array([1.0]), 0.0, design)


def optics(degree):
    """Distortion of the camera over its focal plane.

    Parameters
    ----------
    degree : int
        Largest total degree; constant and linear terms are the attitudes'.

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
        lambda b: _both_axes(_legendre(*b.focal, 2, degree)),
    )


def attitude():
    """Six numbers of each exposure: shift and linear map of the focal plane.

    Returns
    -------
    Term
        Columns (ax, bxx, bxy, ay, byx, byy), positions in units of the radius.
    """

    def design(b):
        return _both_axes(np.stack([np.ones_like(b.u), *b.focal], axis=1))

    return Term("attitude", "exposure", np.zeros(6, int), np.array([1e4]), 0.0, design)


def refraction():
    """Shift of each exposure in proportion to color: differential refraction of the atmosphere.

    Returns
    -------
    Term
        One column for each axis, px per magnitude.
    """

    def design(b):
        return _both_axes(b.color[:, None])

    return Term(
        "refraction",
        "exposure",
        np.zeros(2, int),
        np.array([_START_COLOR]),
        0.0,
        design,
        chromatic=True,
    )


def lateral_color():
    """Scale of the camera in proportion to color: lateral chromatism.

    Returns
    -------
    Term
        Radial columns of the first and third power, px per magnitude at the rim.
    """

    def design(b):
        radial = b.color * b.focal
        square = np.sum(b.focal**2, axis=0)
        return np.stack([radial, radial * square], axis=2)

    return Term(
        "lateral color",
        "camera",
        np.zeros(2, int),
        np.array([_START_COLOR]),
        0.0,
        design,
        chromatic=True,
    )
