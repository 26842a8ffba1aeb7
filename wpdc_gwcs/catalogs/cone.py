"""The part of a catalog near a position."""

import numpy as np

__all__ = ["select_cone"]


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
    all_dec = np.asarray(catalog["dec"], float)
    # A cut in declination leaves few stars for the trigonometry.
    near = np.flatnonzero(np.abs(all_dec - dec) <= radius)
    near_ra, near_dec = (
        np.radians(np.asarray(catalog["ra"], float)[near]),
        np.radians(all_dec[near]),
    )
    # Haversine, which keeps its accuracy at small separations.
    h = (
        np.sin(0.5 * (near_dec - np.radians(dec))) ** 2
        + np.cos(near_dec) * np.cos(np.radians(dec)) * np.sin(0.5 * (near_ra - np.radians(ra))) ** 2
    )
    inside = h <= np.sin(np.radians(min(radius, 180.0)) / 2) ** 2 * (1 + 1e-12)
    return catalog[near[inside]]
