"""PSF profiles as cubic B-splines on an oversampled grid, evaluated for many stars at once."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.ndimage import spline_filter, uniform_filter1d

from wpdc_gwcs import kernels

__all__ = [
    "Models",
    "Profile",
    "moffat_samples",
    "shift_matrix",
    "spline_coefficients",
    "spline_taps",
]


@dataclass(frozen=True, eq=False)
class Profile:
    r"""Effective PSF: the fraction of the flux of a star in a pixel, as a function of the offset.

    Parameters
    ----------
    coefficients : (G, M, M) ndarray
        Coefficients of cubic B-splines, M odd, for each of G places on the detector.
    oversampling : int
        Grid steps per pixel.
    x_nodes, y_nodes : (gx,), (gy,) ndarray
        Columns and rows of the places; G = gy gx, row by row.

    Notes
    -----
    With k the oversampling, :math:`c = (M - 1) / 2`, and u, v the offset of a pixel from the star,

    .. math::
        \psi(u, v) = \sum_{qp} C_{qp} B_3(k u + c - p) B_3(k v + c - q) .

    All pixels of a star have the same phase with respect to the grid.  For all stars with the same
    grid cell, the pixels are therefore a single matrix product of the 16 spline weights of each
    star with a table of coefficients.
    """

    coefficients: np.ndarray
    oversampling: int
    x_nodes: np.ndarray
    y_nodes: np.ndarray

    @classmethod
    def constant(cls, samples, oversampling):
        """Make a profile from samples on the grid, constant over the detector."""
        zero = np.zeros(1)
        return cls(spline_coefficients(samples)[None], oversampling, zero, zero)

    @property
    def radius(self):
        """Greatest distance from the star, in whole pixels, at which the profile is defined."""
        return (self.coefficients.shape[-1] - 1) // 2 // self.oversampling

    def samples(self):
        """Values at the nodes of the grid, (G, M, M)."""
        c = np.pad(self.coefficients, ((0, 0), (1, 1), (1, 1)))
        c = (c[:, :-2] + 4 * c[:, 1:-1] + c[:, 2:]) / 6
        return (c[:, :, :-2] + 4 * c[:, :, 1:-1] + c[:, :, 2:]) / 6

    def wobble(self):
        r"""Compute how far the center of light moves about the star with the pixel phase.

        Returns
        -------
        float
            Root mean square over all places, along one axis, in px.

        Notes
        -----
        With :math:`\psi_x` the profile summed along the other axis, that is :math:`\sqrt 2\,
        |\int u\, \psi_x(u)\, e^{-2 \pi i u} du|`, which measures structure at one cycle per pixel.
        """
        samples = self.samples().mean(axis=0)
        step = (np.arange(len(samples)) - self._center) / self.oversampling
        wave = step * np.exp(-2j * np.pi * step) / samples.sum()
        return float(
            np.sqrt(np.mean([np.abs(wave @ samples.sum(axis=k)) ** 2 for k in (0, 1)]) * 2)
        )

    @cached_property
    def _components(self):
        """A few grids of coefficients, and their shares (G, R) in the grids of all places.

        Neighboring places differ by a few shapes.  With these, the cost of a star does not depend
        on the number of places.
        """
        n = len(self.coefficients)
        flat = self.coefficients.reshape(n, -1)
        if n == 1:
            return self.coefficients, np.ones((1, 1))
        left, sizes, right = np.linalg.svd(flat, full_matrices=False)
        keep = sizes > 1e-4 * sizes[0]
        shares = left[:, keep] * sizes[keep]
        return right[keep].reshape(-1, *self.coefficients.shape[1:]), shares

    def shares(self, x, y):
        """Compute the shares (N, R) of the component grids for stars at x, y.

        Parameters
        ----------
        x, y : (N,) ndarray
            Positions in px.  Between places, the profile is interpolated linearly; outside, it is
            that of the nearest edge.

        Returns
        -------
        (N, R) ndarray
            Shares.
        """
        wx, wy = _hat(x, self.x_nodes), _hat(y, self.y_nodes)
        return (wy[:, :, None] * wx[:, None, :]).reshape(
            len(x), len(self.coefficients)
        ) @ self._components[1]

    def evaluate(self, dx, dy, half, shares, *, gradient=True):
        """Evaluate the profile of each star in the pixels of its cut-out.

        Parameters
        ----------
        dx, dy : (N,) ndarray
            Position of the star relative to the central pixel of its cut-out.
        half : int
            The cut-outs are 2 half + 1 px wide.
        shares : (N, R) ndarray
            See `shares`.
        gradient : bool, optional
            Whether to return the derivatives with respect to the position as well.

        Returns
        -------
        (3, N, n) or (1, N, n) ndarray
            Values and optionally derivatives with respect to x and y, in n = (2 half + 1)^2 pixels.
        """
        result = np.empty((3 if gradient else 1, len(dx), (2 * half + 1) ** 2))
        kernels.star_profiles(*self._numbers(dx, dy, shares), half, result)
        return result

    def models(self, x, y, flux, half):
        """Make models of stars that can be drawn.

        Parameters
        ----------
        x, y, flux : (N,) ndarray
            Positions in px, and fluxes.
        half : int
            Stars are 2 half + 1 px wide.

        Returns
        -------
        Models
            The models.
        """
        order = np.argsort(np.rint(y), kind="stable")
        x, y, flux = x[order], y[order], np.ascontiguousarray(flux[order], dtype=float)
        center = np.rint(np.column_stack([x, y]))
        numbers = self._numbers(x - center[:, 0], y - center[:, 1], self.shares(x, y))
        return Models(*numbers, half, center, flux)

    def _numbers(self, dx, dy, shares):
        """Grids, oversampling, phases and shares for the kernels."""
        n = len(dx)
        position = np.concatenate([dx, dy]) * -self.oversampling + self._center
        phase = np.empty((n, 18))
        for first, column in zip((0, 1, 5), spline_taps(position), strict=True):
            width = 1 if column.ndim == 1 else column.shape[1]
            for part in (0, 1):
                values = column[part * n : (part + 1) * n].reshape(n, width)
                phase[:, 9 * part + first : 9 * part + first + width] = values
        grids, shares = (
            np.ascontiguousarray(values, dtype=float) for values in (self._components[0], shares)
        )
        return grids, self.oversampling, phase, shares

    @property
    def _center(self):
        return (self.coefficients.shape[-1] - 1) // 2


@dataclass(frozen=True, eq=False)
class Models:
    """Models of stars that can be drawn, in ascending order of their rows.

    Parameters
    ----------
    grids, oversampling, phase, shares, half, center, flux
        Arguments of `wpdc_gwcs.kernels.paint_stars`.
    """

    grids: np.ndarray
    oversampling: int
    phase: np.ndarray
    shares: np.ndarray
    half: int
    center: np.ndarray
    flux: np.ndarray

    def paint(self, image, *, first_row=0):
        """Add the models to some rows of an image.

        Parameters
        ----------
        image : (n, nx) float32 ndarray
            Rows of the image.
        first_row : int, optional
            Number of the first row.
        """
        k, center = self._within(first_row, len(image))
        if len(center):
            numbers = self.grids, self.oversampling, self.phase[k], self.shares[k], self.half
            kernels.paint_stars(*numbers, center, self.flux[k], image)

    def take(self, light, image, rows, *, first_row=0):
        """Subtract light from some rows of an image in the pixels of these models.

        Parameters
        ----------
        light : (n, nx) float32 ndarray
            The light of all models; on return, it is zero in the pixels of these models.
        image : (n, nx) float32 ndarray
            Rows of the image.
        rows : (int, int)
            The first row that changes, and the row after the last one.
        first_row : int, optional
            Number of the first row.
        """
        center = self._within(first_row, len(image))[1]
        if len(center):
            kernels.take_stars(center, self.half, *rows, light, image)

    def _within(self, first_row, n_rows):
        """Models with light in some rows, and their centers in these rows."""
        ends = [first_row - self.half, first_row + n_rows + self.half]
        k = slice(*np.searchsorted(self.center[:, 1], ends))
        return k, self.center[k] - [0, first_row]


def spline_taps(position):
    """Compute the four weights of cubic B-splines, and their slopes, at positions in grid steps.

    Parameters
    ----------
    position : (N,) ndarray
        Positions.

    Returns
    -------
    base : (N,) int ndarray
        Knot below; the weights are those of knots base - 1 to base + 2.
    weights, slopes : (N, 4) ndarray
        Values of the splines, and their derivatives with respect to the position.
    """
    base = np.floor(position)
    t = position - base
    square, rest = t * t, (1 - t) ** 2
    cube = square * t
    weights, slopes = np.empty((2, len(t), 4))
    weights[:, 0] = rest * (1 - t) / 6
    weights[:, 1] = 0.5 * cube - square + 2 / 3
    weights[:, 2] = 0.5 * (square + t - cube) + 1 / 6
    weights[:, 3] = cube / 6
    slopes[:, 0] = -0.5 * rest
    slopes[:, 1] = 1.5 * square - 2 * t
    slopes[:, 2] = t - 1.5 * square + 0.5
    slopes[:, 3] = 0.5 * square
    return base.astype(int), weights, slopes


def spline_coefficients(samples):
    """Compute the coefficients of the cubic B-splines through samples, which are zero outside.

    Parameters
    ----------
    samples : (..., M, M) ndarray
        Values at the nodes.

    Returns
    -------
    (..., M, M) ndarray
        Coefficients.
    """
    samples = np.asarray(samples, dtype=float)
    flat = samples.reshape(-1, *samples.shape[-2:])
    return np.stack([spline_filter(s, order=3, mode="grid-constant") for s in flat]).reshape(
        samples.shape
    )


def moffat_samples(shape, half, oversampling):
    """Sample an elliptical Moffat profile, integrated over pixels, on a grid.

    Parameters
    ----------
    shape : (4,) array_like
        Logarithm of half the FWHM in px, logarithm of beta - 1, and two ellipticities.
    half : int
        Half-width of the grid in px.
    oversampling : int
        Grid steps per pixel.

    Returns
    -------
    (M, M) ndarray
        Samples, M = 2 half oversampling + 1.
    """
    width, beta = np.exp(shape[0]), 1 + np.exp(shape[1])
    # Number of points within a pixel: enough for cores much narrower than a pixel.
    fine = 4
    n = (half + 1) * oversampling * fine
    u = np.arange(-n, n + 1) / (oversampling * fine)
    # An area-preserving stretch.
    e1, e2 = shape[2], shape[3]
    norm = 1 / np.sqrt(max(1 - e1**2 - e2**2, 0.05))
    r2 = norm * ((1 - e1) * u**2 + (1 + e1) * (u**2)[:, None] - 2 * e2 * u[:, None] * u)  # (y, x)
    values = (1 + r2 * (2 ** (1 / beta) - 1) / width**2) ** -beta
    box = oversampling * fine
    for axis in (0, 1):
        # With an even number of points, take the mean of both ways to center the box.
        values = 0.5 * (
            uniform_filter1d(values, box, axis=axis)
            + uniform_filter1d(values, box, axis=axis, origin=-1)
        )
    samples = values[oversampling * fine : -oversampling * fine : fine][
        :, oversampling * fine : -oversampling * fine : fine
    ]
    return samples / samples.sum() * oversampling**2


def shift_matrix(size, shift):
    """Make the matrix from spline coefficients to values on a shifted grid.

    Parameters
    ----------
    size : int
        Number of coefficients.
    shift : float
        Shift of the grid, in grid steps.

    Returns
    -------
    (size, size) ndarray
        Matrix.
    """
    base, taps, _ = spline_taps(np.arange(size) + shift)
    column = base[:, None] + np.arange(-1, 3)
    inside = (column >= 0) & (column < size)
    matrix = np.zeros((size, size))
    row = np.broadcast_to(np.arange(size)[:, None], column.shape)
    matrix[row[inside], column[inside]] = taps[inside]
    return matrix


def _hat(position, nodes):
    """Weights of linear interpolation between nodes, constant beyond them."""
    if len(nodes) == 1:
        return np.ones((len(position), 1))
    position = np.clip(position, nodes[0], nodes[-1])
    cell = np.clip(np.searchsorted(nodes, position) - 1, 0, len(nodes) - 2)
    t = (position - nodes[cell]) / (nodes[cell + 1] - nodes[cell])
    weights = np.zeros((len(position), len(nodes)))
    rows = np.arange(len(position))
    weights[rows, cell], weights[rows, cell + 1] = 1 - t, t
    return weights
