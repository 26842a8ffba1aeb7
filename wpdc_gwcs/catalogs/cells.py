"""HEALPix cells of the sky (nested scheme), into which large catalogs are divided."""

import numpy as np

from wpdc_gwcs.sky import directions

__all__ = ["cells_in", "cells_of", "circles_of"]

# Rounding error of the corners of a cell, deg.
_MARGIN = 1e-6


def _healpix(order):
    from astropy_healpix import HEALPix

    return HEALPix(nside=2**order, order="nested")


def cells_of(order, ra, dec):
    """Return the cells that positions lie in.

    Parameters
    ----------
    order : int
        The sky has 12 * 4**order cells.
    ra, dec : (N,) array_like
        Positions, deg.

    Returns
    -------
    (N,) ndarray of int
        Numbers of the cells.
    """
    from astropy import units as u

    return _healpix(order).lonlat_to_healpix(
        np.asarray(ra, float) * u.deg, np.asarray(dec, float) * u.deg
    )


def circles_of(order, cells):
    """Return the smallest circles around cells.

    Parameters
    ----------
    order : int
        The sky has 12 * 4**order cells.
    cells : (N,) array_like of int
        Numbers of the cells.

    Returns
    -------
    ra, dec, radius : (N,) ndarray
        Center and radius of the smallest circle about the center that contains the cell, deg.
    """
    healpix, cells = _healpix(order), np.asarray(cells, int)
    ra, dec = (c.to_value("deg") for c in healpix.healpix_to_lonlat(cells))
    # The rim is curved, so points along it are needed, not only its corners.
    lon, lat = (c.to_value("deg") for c in healpix.boundaries_lonlat(cells, 8))
    rim = directions(lon, lat)[0]
    chord = np.linalg.norm(rim - directions(ra, dec)[0][..., None], axis=0).max(axis=-1)
    # Between these points, the rim bulges by at most a hundredth of a cell.
    return ra, dec, np.degrees(2 * np.arcsin(np.minimum(chord / 2, 1))) * 1.01 + _MARGIN


def cells_in(region, order, cells=None):
    """Return the cells that a region touches.

    Parameters
    ----------
    region : Region
        Part of the sky.
    order : int
        The sky has 12 * 4**order cells.
    cells : (N,) array_like of int, optional
        Candidate cells; all by default.

    Returns
    -------
    (M,) ndarray of int
        Numbers of the cells, perhaps with a few that the region only comes close to.
    """
    healpix = _healpix(order)
    cells = np.arange(healpix.npix) if cells is None else np.asarray(cells, int)
    ra, dec = (c.to_value("deg") for c in healpix.healpix_to_lonlat(cells))
    # No corner is farther from the center than 1.05 sides of a square of the same area.
    reach = 1.1 * healpix.pixel_resolution.to_value("deg")
    cells = cells[region.contains(ra, dec, reach=reach)]
    ra, dec, radius = circles_of(order, cells)
    return cells[region.contains(ra, dec, reach=radius.max(initial=0.0))]
