"""Basis functions of fields: sine waves on a patch of the focal plane, and polynomials."""

from dataclasses import dataclass

import numpy as np

from wpdc_gwcs.solve.terms import legendre_products

__all__ = ["BEND_DEGREES", "Basis", "inner_products", "patch"]

# The patch is this much larger than the part of the focal plane where stars are used: the waves
# vanish at its edge.
_PATCH = 1.2

# Degrees of the polynomials, for changes by focus, filter and flexure, not turbulence.
BEND_DEGREES = (2, 3)


@dataclass(frozen=True, eq=False)
class Basis:
    """Sine waves on a rectangle of the focal plane, and optional low-degree polynomials.

    Parameters
    ----------
    center, half : (2,) ndarray
        Center and half sides of the rectangle, px.
    orders : (2, M) ndarray of int
        Numbers of half waves along each axis, in order of increasing wave number.
    bends : bool
        Whether polynomials of degree 2 and 3 are included.
    """

    center: np.ndarray
    half: np.ndarray
    orders: np.ndarray
    bends: bool = False

    @property
    def wave(self):
        """Wave vectors ``(2, M)``, rad / px."""
        return 0.5 * np.pi * self.orders / self.half[:, None]

    def shapes(self, focal, kind="curl-free"):
        """Return the displacements of unit coefficients, ``(K, 2, N)``.

        Parameters
        ----------
        focal : (2, N) ndarray
            Focal plane, px.
        kind : {'curl-free', 'axes'}, optional
            Whether displacements are the gradient of a potential or independent along each axis.

        Returns
        -------
        ndarray
            First M or 2 M waves; then, if there are bends, 14 polynomials, degree by degree along
            each axis; finally a constant along each axis.
        """
        parts = self.along(focal, kind)
        out = np.zeros((1 + max(mine.max() for mine, _ in parts), 2, focal.shape[1]))
        for a, (mine, rows) in enumerate(parts):
            out[mine, a] = rows
        return out

    def along(self, focal, kind="curl-free"):
        """Return the nonzero displacements of unit coefficients along each axis.

        Parameters
        ----------
        focal : (2, N) ndarray
            Focal plane, px.
        kind : {'curl-free', 'axes'}, optional
            As for `shapes`.

        Returns
        -------
        list of (ndarray, ndarray)
            For each axis, the numbers of the coefficients ``(m,)`` and displacements ``(m, N)``.
        """
        phases = [
            np.outer(
                np.arange(self.orders[a].max() + 1),
                (focal[a] - self.center[a] + self.half[a]) * (0.5 * np.pi / self.half[a]),
            )
            for a in range(2)
        ]
        m = self.orders.shape[1]
        norm = 1.0 / np.sqrt(np.prod(self.half))
        bends = self._bends(focal)
        p = len(bends)
        size = m if kind == "curl-free" else 2 * m
        sines = [np.sin(phase) for phase in phases]
        parts = []
        for a in range(2):
            rows = np.empty((m + p + 1, focal.shape[1]))
            if kind == "curl-free":
                waves = np.cos(phases[a])[self.orders[a]]
                waves *= (self.wave[a] * norm)[:, None]
                np.multiply(waves, sines[1 - a][self.orders[1 - a]], out=rows[:m])
            elif a == 0:
                np.multiply(sines[0][self.orders[0]], sines[1][self.orders[1]], out=rows[:m])
                rows[:m] *= norm
            else:
                rows[:m] = parts[0][1][:m]
            rows[m:-1], rows[-1] = bends, 1.0
            first = 0 if kind == "curl-free" else a * m
            mine = [first + np.arange(m), size + a * p + np.arange(p), [size + 2 * p + a]]
            parts.append((np.concatenate(mine), rows))
        return parts

    def _bends(self, focal):
        if not self.bends:
            return np.zeros((0, focal.shape[1]))
        place = (focal - self.center[:, None]) / (self.half[:, None] / _PATCH)
        return legendre_products(*place, BEND_DEGREES[0], BEND_DEGREES[-1])


def inner_products(parts):
    """Compute the products of all pairs of shapes, summed over stars and axes.

    Parameters
    ----------
    parts : list of (ndarray, ndarray)
        As from `Basis.along`, weighted.

    Returns
    -------
    (K, K) ndarray
        Symmetric matrix of the sums.
    """
    n = 1 + max(mine.max() for mine, _ in parts)
    total = np.zeros((n, n))
    for mine, rows in parts:
        total[np.ix_(mine, mine)] += rows @ rows.T
    return total


def patch(low, high, n_waves, *, bends=False):
    """Build the basis for the part of the focal plane between two corners.

    Parameters
    ----------
    low, high : (2,) array_like
        Corners, px.
    n_waves : int
        Number of waves to keep; the longest ones are kept.
    bends : bool, optional
        Whether to include polynomials of degree 2 and 3.

    Returns
    -------
    Basis
        Basis on a rectangle that is a fifth larger.
    """
    low, high = np.asarray(low, float), np.asarray(high, float)
    half = 0.5 * _PATCH * (high - low)
    # Enough orders along each axis, even for the shortest side.
    reach = 2 * np.sqrt(n_waves / np.pi / np.prod(half)) * half * 1.3 + 2
    j, k = (a.ravel() for a in np.meshgrid(*(np.arange(1, int(r) + 2) for r in reach)))
    order = np.argsort((j / half[0]) ** 2 + (k / half[1]) ** 2, kind="stable")[:n_waves]
    return Basis(0.5 * (low + high), half, np.array([j[order], k[order]]), bends)
