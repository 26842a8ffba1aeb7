"""The kernels of stars in NumPy, for installations without a compiler.

A point-spread function is a sum of a few grids of coefficients of cubic B-splines.  All pixels of a
star have the same phase in the grid, so a star needs only 4 x 4 weights and the shares of the
grids.
"""

import numpy as np

__all__ = ["paint_stars", "star_profiles", "star_steps", "take_stars"]

# Number of pixels of stars processed at once, to limit the memory.
_CHUNK = 400_000


def star_profiles(grids, oversampling, phase, shares, half, profiles):
    """Evaluate the point-spread function of stars in the pixels of their cut-outs.

    Parameters
    ----------
    grids : (R, M, M) ndarray
        Coefficients; zero outside.
    oversampling : int
        Knots per pixel.
    phase : (N, 18) ndarray
        For each star: the knot below its central pixel along x, the weights of the knots from one
        before it to two after it, the derivatives of these by the position in knots; the same
        along y.
    shares : (N, R) ndarray
        Shares of the grids.
    half : int
        The cut-outs are 2 half + 1 px wide.
    profiles : (1 or 3, N, (2 half + 1)^2) ndarray
        The values are written here and, if there is room for them, the derivatives with respect to
        the position of the star along x and y.
    """
    base_x, taps_x, slopes_x = phase[:, 0], phase[:, 1:5], phase[:, 5:9]
    base_y, taps_y, slopes_y = phase[:, 9], phase[:, 10:14], phase[:, 14:18]
    outer = [taps_y[:, :, None] * taps_x[:, None, :]]
    if len(profiles) > 1:
        outer.append(-oversampling * taps_y[:, :, None] * slopes_x[:, None, :])
        outer.append(-oversampling * slopes_y[:, :, None] * taps_x[:, None, :])
    outer = np.stack(outer).reshape(len(outer), len(phase), 1, 16) * shares[:, :, None]
    outer = outer.reshape(len(outer), len(phase), 16 * shares.shape[1])
    margin = oversampling * (2 * half + 2) + 8
    padded = np.pad(grids, ((0, 0), (margin, margin), (margin, margin)))
    # Stars that have moved far away see only the padding.
    limit = margin - oversampling * half - 4
    lowest, highest = -limit, grids.shape[-1] + limit
    base_x, base_y = (
        np.clip(np.nan_to_num(base), lowest, highest).astype(int) for base in (base_x, base_y)
    )
    cell = base_y * 10_000 + base_x
    order = np.argsort(cell, kind="stable")
    starts = np.flatnonzero(np.diff(cell[order], prepend=cell[order[:1]] - 1))
    step = margin + oversampling * np.arange(-half, half + 1)
    tap = np.arange(-1, 3)[:, None]
    # The pixels of the stars that share a cell of the grid are one matrix product.
    for rows in np.split(order, starts[1:]) if len(order) else ():
        iy = base_y[rows[0]] + tap + step
        ix = base_x[rows[0]] + tap + step
        table = padded[:, iy[:, None, :, None], ix[None, :, None, :]]
        profiles[:, rows] = outer[:, rows] @ table.reshape(outer.shape[-1], -1)


def paint_stars(grids, oversampling, phase, shares, half, center, flux, image):
    """Add stars to an image.

    Parameters
    ----------
    grids : (R, M, M) ndarray
        This and the next four as for `star_profiles`.
    oversampling : int
        Knots per pixel.
    phase : (N, 18) ndarray
        Knots and their weights.
    shares : (N, R) ndarray
        Shares of the grids.
    half : int
        The cut-outs are 2 half + 1 px wide.
    center : (N, 2) ndarray
        Central pixels of the cut-outs, x and y.
    flux : (N,) ndarray
        Fluxes.
    image : (ny, nx) float32 ndarray
        The image.
    """
    flat, shape = image.reshape(-1), image.shape
    n_pixels = (2 * half + 1) ** 2
    size = max(1, _CHUNK // n_pixels)
    for start in range(0, len(flux), size):
        k = slice(start, start + size)
        model = np.empty((1, len(flux[k]), n_pixels))
        star_profiles(grids, oversampling, phase[k], shares[k], half, model)
        index, inside = _pixels(center[k], half, shape)
        value = (flux[k, None] * model[0]).astype(np.float32)
        np.add.at(flat, index[inside], value[inside])


def take_stars(center, half, first, last, light, image):
    """Subtract light from an image in the pixels of painted stars.

    Parameters
    ----------
    center : (N, 2) ndarray
        Central pixels of the cut-outs, x and y.
    half : int
        The cut-outs are 2 half + 1 px wide.
    first, last : int
        The first row of the image that changes, and the row after the last one.
    light : (ny, nx) float32 ndarray
        The light; it becomes zero in these pixels.
    image : (ny, nx) float32 ndarray
        The image.
    """
    index, inside = _pixels(center, half, image.shape)
    index = np.unique(index[inside])
    row = index // image.shape[1]
    mine = index[(row >= first) & (row < last)]
    image.reshape(-1)[mine] -= light.reshape(-1)[mine]
    light.reshape(-1)[index] = 0


def _pixels(center, half, shape):
    """Find the pixels of cut-outs: indices in a flat image, and whether they are on it."""
    step = np.arange(-half, half + 1)
    xc, yc = center.T.astype(int)
    iy, ix = yc[:, None] + step, xc[:, None] + step
    inside = ((iy >= 0) & (iy < shape[0]))[:, :, None]
    inside = (inside & ((ix >= 0) & (ix < shape[1]))[:, None, :]).reshape(len(center), -1)
    return (iy[:, :, None] * shape[1] + ix[:, None, :]).reshape(inside.shape), inside


def star_steps(profiles, flux, pixels, use, variance, photons, noise, step, covariance, chi2):
    """Solve the normal equations of position and flux of stars.

    Parameters
    ----------
    profiles : (3, N, n) ndarray
        Values and derivatives, see `star_profiles`.
    flux : (N,) ndarray
        Fluxes.
    pixels : (N, n) ndarray
        Measured values.
    use : (N, n) bool ndarray
        Pixels to use.
    variance : (N, n) ndarray
        Variance without the star.
    photons : (N, n) ndarray or None
        Variance of photons relative to that from the gain; 1 for `None`.
    noise : (2,) ndarray
        Counts per electron, and the error of the profile relative to its peak.
    step : (N, 3) ndarray
        Steps of x, y and flux are written here; zero where the equations are singular.
    covariance : (N, 3, 3) ndarray
        The covariance of the steps is written here; NaN where the equations are singular.
    chi2 : (N,) ndarray
        Chi square per degree of freedom is written here.
    """
    model = flux[:, None] * profiles[0]
    light = np.maximum(model, 0)
    peak = light.max(axis=-1, keepdims=True)
    response = 1.0 if photons is None else photons
    weight = use / (variance + light * (noise[0] * response + noise[1] ** 2 * peak))
    residual = pixels - model
    jacobian = np.stack(
        [flux[:, None] * profiles[1], flux[:, None] * profiles[2], profiles[0]], axis=1
    )
    weighted = jacobian * weight[:, None]
    normal = weighted @ jacobian.transpose(0, 2, 1)
    right = (weighted @ residual[:, :, None])[:, :, 0]
    # Scaled to a unit diagonal, so that "singular" has one meaning for all fluxes.
    scale = np.sqrt(np.einsum("sii->si", normal))
    empty = ~(scale > 0).all(axis=1)
    scale[empty] = 1
    scaled = normal / scale[:, :, None] / scale[:, None, :]
    bad = empty | ~(np.linalg.det(scaled) > 1e-6)
    scaled[bad] = np.eye(3)
    covariance[:] = np.linalg.inv(scaled) / scale[:, :, None] / scale[:, None, :]
    step[:] = (covariance @ right[:, :, None])[:, :, 0]
    step[bad] = 0
    covariance[bad] = np.nan
    chi2[:] = (weight * residual**2).sum(axis=1) / np.maximum(use.sum(axis=1) - 3, 1)
