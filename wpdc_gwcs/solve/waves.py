"""The structure of a detector: a few shapes out of many, found by sparse Bayesian learning.

The residual structure of a detector is neither noise nor a smooth random field: it consists of some
waves and high-degree polynomials, and most others are absent.  Each shape has its own variance,
learned from the stars.  Shapes without evidence shrink to zero, so the many candidates add no
noise.

::

    places, residuals, errors --normal matrix--> variance of each wave --> coefficients, covariance
"""

from dataclasses import dataclass

import numpy as np
from numpy.polynomial.legendre import legvander
from scipy.interpolate import CubicSpline
from scipy.linalg import lapack

from wpdc_gwcs.solve.normal import posterior_factor

__all__ = ["Waves", "candidates", "count_places", "fit_waves"]

# Size of the patch of the waves, in units of the detector.  It makes the steps of the wave number
# finer, because a wave of the sensor does not end at its edge.
_OVERSIZE = 1.6

# Shortest wave in units of the longer side.
_SHORTEST = 0.1

# Largest degree of the polynomials, and of those that other terms have and that are fitted freely
# beside the waves, because they have taken a part of them already.
_DEGREE = 9
_FREE_DEGREE = 5

# Places with stars for each coefficient that they determine, free polynomials included.  With
# fewer, shapes that are right at the stars are wrong by many times their errors between them and in
# the corners: a few shapes of many always fit few places.  Waves whose mean square is below this
# part of that of the errors at a place do no harm.
_PLACES_PER_TERM = 60
_WEAK = 0.5

# Stars closer to each other than this are at one place, in units of the longer side.
_PLACE = 0.25 * _SHORTEST

# Detectors have edge effects within some pixels.  A table represents them as far as its outermost
# nodes can, so these are shapes as well, for a table with this many nodes.
_NODES, _RIMS = 50, 4
_OUTERMOST = CubicSpline(np.arange(_NODES), np.eye(_NODES)[0])

# Share of the variance that a coefficient has by itself, from its stars, which is left to a wave
# that is not seen, and the number of coefficients that this guess is worth.  In noise alone a
# quarter of a coefficient for each ten candidates remains, in units of its error.
_FLOOR, _GUESS_WEIGHT = 0.02, 1.0

# Number of updates of the variances; the last ones change them by a few percent.
_STEPS = 8

# How often the step of the wave numbers is halved, around waves of which the stars determine this
# many coefficients: otherwise, a wave between two candidates would need many of them.
_ZOOMS, _SEEN = 2, 0.5

# Maximum number of waves refined by a finer step: those with the largest power.
_MOST_ZOOMED = 60

# With more stars than this, they are averaged in cells, this many per shortest wave.
_MOST_STARS, _CELLS_PER_WAVE = 20_000, 16

# Number of stars whose columns are in memory at once.
_BLOCK = 2048


@dataclass(frozen=True, eq=False)
class Waves:
    """Displacements of the focal plane: plane waves, polynomials, and edge effects.

    Parameters
    ----------
    center, size : (2,) ndarray
        Center and sides of the part of the focal plane that the detector covers, px.
    orders : (2, M) ndarray of int
        Wave vectors in units of the step.
    step : (2,) ndarray
        Rad / px.
    least_degree : int
        Lowest degree of the polynomials; lower ones are in other terms.
    coefficients : (2, K) ndarray
        Coefficients of cosines, sines, polynomials and edges, for each axis, px.
    taken : (F, K) ndarray
        Response of the lower polynomials to each shape, at the stars.
    half : (K, K) ndarray
        Square root H of the covariance H^T H of the coefficients of an axis.
    """

    center: np.ndarray
    size: np.ndarray
    orders: np.ndarray
    step: np.ndarray
    least_degree: int
    coefficients: np.ndarray
    taken: np.ndarray
    half: np.ndarray

    def __call__(self, focal):
        """Return the displacement at focal plane positions.

        Parameters
        ----------
        focal : (2, N) ndarray
            Focal plane, px.

        Returns
        -------
        (2, N) ndarray
            Px.
        """
        return self.coefficients @ self._shapes(focal)

    def covariance(self, focal):
        """Return the posterior covariance, including the response of other terms.

        Parameters
        ----------
        focal : (2, N) ndarray
            Focal plane, px.

        Returns
        -------
        (2, 2, N) ndarray
            Px^2.
        """
        free = _polynomials(self.center, self.size, focal, range(self.least_degree))
        rows = self.half @ (self._shapes(focal) - self.taken.T @ free)
        out = np.zeros((2, 2, focal.shape[1]))
        out[0, 0] = out[1, 1] = np.sum(rows**2, axis=0)
        return out

    @property
    def wave(self):
        """Wave vectors ``(2, M)``, rad / px."""
        return self.orders * self.step[:, None]

    def _shapes(self, focal):
        return _shapes(self.center, self.size, self.orders, self.step, self.least_degree, focal)


def _shapes(center, size, orders, step, least_degree, focal):
    """Cosines, sines, high-degree polynomials and edges, ``(K, N)``."""
    # A wave along the plane is the product of waves along its axes.
    reach = np.abs(orders).max(1)
    along, across = (
        np.exp(1j * np.outer(np.arange(-n, n + 1) * s, f))
        for n, s, f in zip(reach, step, focal - center[:, None])
    )
    waves = along[orders[0] + reach[0]]
    waves *= across[orders[1] + reach[1]]
    high = _polynomials(center, size, focal, range(least_degree, _DEGREE + 1))
    return np.concatenate([waves.real, waves.imag, high, _rims(center, size, focal)])


def _rims(center, size, focal):
    """Splines that are one at one side of the detector and zero at all other nodes."""
    node = (_NODES - 1) * ((focal - center[:, None]) / size[:, None] + 0.5)
    return np.array([
        _OUTERMOST(np.clip(n, 0, _NODES - 1)) for along in node for n in (along, _NODES - 1 - along)
    ])  # fmt: skip


def _polynomials(center, size, focal, degrees):
    """Products of Legendre polynomials."""
    u, v = (legvander(m, _DEGREE).T for m in 2.0 * (focal - center[:, None]) / size[:, None])
    rows = [u[i] * v[n - i] for n in degrees for i in range(n + 1)]
    return np.array(rows) if rows else np.zeros((0, focal.shape[1]))


def candidates(low, high):
    """Return the wave vectors of all candidate waves of a detector, and their step.

    Parameters
    ----------
    low, high : (2,) ndarray
        Corners of its part of the focal plane, px.

    Returns
    -------
    orders : (2, M) ndarray of int
        Wave vectors in units of the step; one of each pair of opposite vectors.
    step : (2,) ndarray
        Rad / px.
    """
    size = np.asarray(high, float) - low
    step = 2 * np.pi / (_OVERSIZE * size)
    largest = 2 * np.pi / (_SHORTEST * size.max())
    n = (largest / step).astype(int)
    j, k = (a.ravel() for a in np.meshgrid(np.arange(-n[0], n[0] + 1), np.arange(n[1] + 1)))
    one_of_two = (k > 0) | (j > 0)
    short = np.hypot(j * step[0], k * step[1]) > largest
    return np.array([j, k])[:, one_of_two & ~short], step


def _finer(orders, strong):
    """Orders for half the step: the same ones, and neighbors of strong ones, once each."""
    around = np.array(np.meshgrid([-1, 0, 1], [-1, 0, 1])).reshape(2, 1, 9)
    every = np.hstack([2 * orders, (2 * strong[:, :, None] + around).reshape(2, -1)])
    # One of opposite vectors; the constant is not a wave.
    every = np.where((every[1] < 0) | ((every[1] == 0) & (every[0] < 0)), -every, every)
    return np.unique(every[:, np.any(every != 0, axis=0)], axis=1)


def count_places(positions):
    """Count the places with stars on a detector.

    Parameters
    ----------
    positions : (2, N) ndarray
        Positions of stars in units of the longer side.

    Returns
    -------
    float
        Number of places: that of the stars, if they are not at the same places again and again.
    """
    if not positions.shape[1]:
        return 0.0
    cells = positions / _PLACE
    low, high = np.floor(cells.min(1)), np.floor(cells.max(1)) + 1
    total = float(np.prod(high - low))
    number = np.floor(cells - low[:, None]).astype(int)
    occupied = len(np.unique(number[0] * int(high[1] - low[1]) + number[1]))
    # Stars far from each other share a cell by chance; if they fill all cells, there is no telling.
    free = 1.0 - occupied / total
    return float(
        positions.shape[1] if free == 0 else min(positions.shape[1], -total * np.log(free))
    )


def fit_waves(low, high, focal, residual, variance):
    """Find the waves of a detector.

    Parameters
    ----------
    low, high : (2,) ndarray
        Corners of its part of the focal plane, px.
    focal, residual, variance : (2, N) ndarray
        Positions, residuals and their variances, px.

    Returns
    -------
    Waves or None
        The waves, without polynomials of low degree; `None` if there are too few places with stars
        to tell them.

    Notes
    -----
    The four coefficients of a wave, or the two of any other shape, have the variance p.  The
    evidence is largest for p = m^2 / g, where m^2 is the sum of the squares of their posterior
    means, and g is the number of them that the stars determine (MacKay's step).  Both axes use the
    mean of their weights.

    References
    ----------
    MacKay (1992), Neural Computation 4, 415; Tipping (2001), JMLR 1, 211.
    """
    low, high = np.asarray(low, float), np.asarray(high, float)
    center, size = 0.5 * (low + high), high - low
    weight = np.mean(1.0 / variance, axis=0)
    n_places = count_places((focal - low[:, None]) / size.max())
    terms = np.cumsum(np.arange(_FREE_DEGREE + 1) + 1)
    if n_places < _PLACES_PER_TERM * terms[1]:
        return None
    least_degree = int(np.searchsorted(terms, n_places / _PLACES_PER_TERM, side="right"))
    if focal.shape[1] > _MOST_STARS:
        side = _SHORTEST * size.max() / _CELLS_PER_WAVE
        focal, residual, weight = _averaged(focal, residual, weight, side)
    orders, step = candidates(low, high)
    for zoom in range(_ZOOMS + 1):
        shape = center, size, orders, step, least_degree
        normal, right, taken, told = _normal_equations(shape, focal, residual, weight)
        root, known = _learned(normal, right, told, orders.shape[1])
        seen = np.flatnonzero(known[: orders.shape[1]] > _SEEN)
        if zoom == _ZOOMS or not seen.size:
            break
        strong = seen[np.argsort(-root[seen], kind="stable")[:_MOST_ZOOMED]]
        orders, step = _finer(orders[:, seen], orders[:, strong]), 0.5 * step
    half = lapack.dtrtrs(posterior_factor(normal, root)[0], np.diag(root), lower=1)[0]
    coefficients = (half.T @ (half @ right)).T
    # Mean square of both axes over that of the errors at each place.
    power = np.sum(coefficients * (coefficients @ normal)) / (2 * n_places)
    n_terms = terms[least_degree - 1] + 0.5 * known.sum()
    if power > _WEAK and n_places < _PLACES_PER_TERM * n_terms:
        return None
    return Waves(*shape, coefficients, taken, half.astype(np.float32))


def _learned(normal, right, told, n):
    """Prior standard deviation of each coefficient, and how many of each shape are determined."""
    own = np.arange(n, len(normal) - n)
    # A detector with an edge effect has it at all its edges.
    group = np.concatenate([np.arange(n), np.arange(n), np.minimum(own, own[-_RIMS])])
    # Information of the stars of each shape: few at an edge, half of all stars for a wave.
    least = _FLOOR * np.bincount(group) / np.bincount(group, 2.0 * told)
    power = 10.0 * least
    for _ in range(_STEPS):
        root = np.sqrt(power)[group]
        factor, _ = posterior_factor(normal, root)
        half, _ = lapack.dtrtri(factor, lower=1, overwrite_c=1)
        scaled = half.T @ (half @ (root[:, None] * right))
        square = np.bincount(group, np.sum((root[:, None] * scaled) ** 2, axis=1))
        known = np.bincount(group, 2 * (1.0 - np.einsum("ij,ij->j", half, half)))
        power = (_GUESS_WEIGHT * least + square) / (_GUESS_WEIGHT + known)
    return np.sqrt(power)[group], known


def _normal_equations(shape, focal, residual, weight):
    """Eliminate free polynomials from the normal matrix and the right-hand sides."""
    total = 0.0
    for start in range(0, len(weight), _BLOCK):
        s = slice(start, start + _BLOCK)
        rows = [
            _shapes(*shape, focal[:, s]),
            _polynomials(*shape[:2], focal[:, s], range(shape[-1])),
            residual[:, s],
        ]
        rows = np.concatenate(rows) * np.sqrt(weight[s])
        total = total + rows @ rows.T
    k, f = len(total) - 2, sum(range(shape[-1] + 1))
    shapes, free = slice(k - f), slice(k - f, k)
    cross = total[free, shapes]
    solved = np.linalg.lstsq(total[free, free], np.hstack([cross, total[free, k:]]), rcond=1e-12)[0]
    taken = solved[:, :-2]
    return (
        total[shapes, shapes] - cross.T @ taken,
        total[shapes, k:] - cross.T @ solved[:, -2:],
        taken,
        np.diagonal(total)[shapes],
    )


def _averaged(focal, residual, weight, side):
    """Average the stars of each cell."""
    cell = ((focal - focal.min(1, keepdims=True)) / side).astype(int)
    _, number = np.unique(cell[0] * (cell[1].max() + 1) + cell[1], return_inverse=True)
    total = np.bincount(number, weight)
    mean = [[np.bincount(number, weight * c) / total for c in part] for part in (focal, residual)]
    return np.array(mean[0]), np.array(mean[1]), total
