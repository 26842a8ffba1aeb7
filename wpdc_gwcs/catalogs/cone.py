"""The part of a catalog near a position."""

import numpy as np

__all__ = ["select_cone", "separations"]


def select_cone(catalog, ra, dec, radius):
    """Select the part of a catalog within a radius of a position.

    Parameters
    ----------
    catalog : `~astropy.table.Table`
        As returned by `read_catalog`.
    ra, dec : float
        Center, deg.
    radius : float
        Radius, deg; stars exactly on the edge are included.

    Returns
    -------
    catalog : `~astropy.table.Table`
        The rows inside, in their original order.

    Examples
    --------
    >>> from astropy.table import Table
    >>> from wpdc_gwcs.catalogs import read_catalog, select_cone
    >>> catalog = read_catalog(Table({"ra": [359.9, 0.1, 180.0], "dec": [0.0, 0.0, 0.0]}))
    >>> len(select_cone(catalog, 0.0, 0.0, 0.2))
    2
    """
    if not (np.isfinite([ra, dec, radius]).all() and radius >= 0):
        raise ValueError(
            "the cone needs a finite center and a radius >= 0, "
            f"got ra={ra}, dec={dec}, radius={radius}"
        )
    # A cut in declination leaves few stars for the trigonometry.
    near = np.flatnonzero(np.abs(np.asarray(catalog["dec"], float) - dec) <= radius)
    inside = separations(catalog, ra, dec, near) <= min(radius, 180.0) * (1 + 1e-12)
    return catalog[near[inside]]


def separations(catalog, ra, dec, rows=slice(None)):
    """Compute the distances of stars from a position.

    Parameters
    ----------
    catalog : `~astropy.table.Table`
        As returned by `read_catalog`.
    ra, dec : float
        Position, deg.
    rows : index, optional
        Which stars; default all.

    Returns
    -------
    (N,) ndarray
        Deg.
    """
    at_ra, at_dec = (np.radians(np.asarray(catalog[c], float)[rows]) for c in ("ra", "dec"))
    ra, dec = np.radians([ra, dec])
    # Haversine, which keeps its accuracy at small separations.
    h = np.sin(0.5 * (at_dec - dec)) ** 2
    h += np.cos(at_dec) * np.cos(dec) * np.sin(0.5 * (at_ra - ra)) ** 2
    return np.degrees(2 * np.arcsin(np.sqrt(np.minimum(h, 1.0))))
