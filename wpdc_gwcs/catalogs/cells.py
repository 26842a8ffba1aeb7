"""Cells of the sky: HEALPix in the nested scheme, by which large catalogs are divided."""

import numpy as np

from wpdc_gwcs.sky import directions

__all__ = ["cells_in", "cells_of", "circles_of"]

# Degrees that the corners of a cell may be off by rounding.
_MARGIN = 1e-6


def _healpix(order):
    from astropy_healpix import HEALPix

    return HEALPix(nside=2**order, order="nested")


def cells_of(order, ra, dec):
    """Tell the cells of positions.

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
    """Give the circles around cells.

    Parameters
    ----------
    order : int
        The sky has 12 * 4**order cells.
    cells : (N,) array_like of int
        Numbers of the cells.

    Returns
    -------
    ra, dec, radius : (N,) ndarray
        Center and radius of the least circle about it that holds the cell, deg.
    """
    healpix, cells = _healpix(order), np.asarray(cells, int)
    ra, dec = (c.to_value("deg") for c in healpix.healpix_to_lonlat(cells))
    # The rim is curved: its points, not its corners alone.
    lon, lat = (c.to_value("deg") for c in healpix.boundaries_lonlat(cells, 8))
    rim = directions(lon, lat)[0]
    chord = np.linalg.norm(rim - directions(ra, dec)[0][..., None], axis=0).max(axis=-1)
    # What the rim may stick out between its points is a hundredth of a cell at most.
    return ra, dec, np.degrees(2 * np.arcsin(np.minimum(chord / 2, 1))) * 1.01 + _MARGIN


def cells_in(region, order, cells=None):
    """Tell which cells a region touches.

    Parameters
    ----------
    region : Region
        Part of the sky.
    order : int
        The sky has 12 * 4**order cells.
    cells : (N,) array_like of int, optional
        Cells that come into question; default all.

    Returns
    -------
    (M,) ndarray of int
        Numbers of the cells; a few that are touched only nearly may be among them.
    """
    healpix = _healpix(order)
    cells = np.arange(healpix.npix) if cells is None else np.asarray(cells, int)
    ra, dec = (c.to_value("deg") for c in healpix.healpix_to_lonlat(cells))
    # No corner is farther from the center than 1.05 sides of a square of the same area.
    reach = 1.1 * healpix.pixel_resolution.to_value("deg")
    cells = cells[region.contains(ra, dec, reach=reach)]
    ra, dec, radius = circles_of(order, cells)
    return cells[region.contains(ra, dec, reach=radius.max(initial=0.0))]
