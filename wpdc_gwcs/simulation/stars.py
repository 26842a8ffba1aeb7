"""Stars of a simulation: true positions, and the reference catalog of them."""

from dataclasses import dataclass

import astropy.units as u
import numpy as np
from astropy.table import QTable, Table

from wpdc_gwcs.simulation.camera import require, value_of
from wpdc_gwcs.sky import angles, directions

__all__ = ["KingCluster", "make_reference", "make_stars", "offset_positions"]

_MAS = np.deg2rad(1 / 3.6e6)  # rad
# Maximum number of stars, for the memory of most machines.
_MOST_STARS = 100_000_000
CATALOG_EPOCH = 2016.0


@dataclass(frozen=True)
class KingCluster:
    r"""A star cluster with the surface density of King (1962).

    Parameters
    ----------
    density : float
        Members per square arcmin at the center.
    core_radius, tidal_radius : `~astropy.units.Quantity`
        Radius at which the density is about half, and radius at which it ends.

    Raises
    ------
    ValueError
        If a value is invalid.
    TypeError
        If a radius has no unit of an angle.

    Notes
    -----
    .. math::
        f(r) \propto \left[(1 + r^2/r_c^2)^{-1/2} - (1 + r_t^2/r_c^2)^{-1/2}\right]^2

    References
    ----------
    King, I. 1962, AJ 67, 471.

    Examples
    --------
    >>> import astropy.units as u
    >>> from wpdc_gwcs import simulate
    >>> from wpdc_gwcs.simulation import KingCluster
    >>> cluster = KingCluster(density=2000, core_radius=5 * u.arcsec, tidal_radius=30 * u.arcsec)
    >>> field = simulate(1, image_shape=(256, 256), density=30, seed=1)
    >>> crowded = simulate(1, image_shape=(256, 256), density=30, cluster=cluster, seed=1)
    >>> len(crowded.reference) > len(field.reference)
    True
    """

    density: float
    core_radius: u.Quantity
    tidal_radius: u.Quantity

    def __post_init__(self):
        require("density", self.density, 0 <= self.density < np.inf, "not negative")
        core, tidal = self._radii()
        require("core_radius", self.core_radius, core > 0, "positive")
        require("tidal_radius", self.tidal_radius, tidal > core, "above core_radius")

    def _radii(self):
        names = ("core_radius", "tidal_radius")
        return tuple(float(value_of(name, getattr(self, name), u.arcmin)) for name in names)

    def _profile(self):
        """Return radii in arcmin, and the number of members within each."""
        core, tidal = self._radii()
        r = np.concatenate([[0], np.geomspace(core / 100, tidal, 2000)])
        edge = 1 / np.hypot(1, tidal / core)
        shape = ((1 / np.hypot(1, r / core) - edge) / (1 - edge)) ** 2
        ring = 2 * np.pi * r * self.density * shape
        inside = np.concatenate([[0], np.cumsum((ring[1:] + ring[:-1]) / 2 * np.diff(r))])
        return r, inside

    def draw(self, rng):
        """Draw the positions of the members.

        Parameters
        ----------
        rng : `numpy.random.Generator`
            Random number generator.

        Returns
        -------
        east, north : (N,) ndarray
            Offsets from the center, deg.
        """
        radius, inside = self._profile()
        n = rng.poisson(inside[-1])
        r = np.interp(rng.uniform(0, inside[-1], n), inside, radius) / 60
        angle = rng.uniform(0, 2 * np.pi, n)
        return r * np.cos(angle), r * np.sin(angle)


def offset_positions(ra, dec, east, north):
    """Return positions at offsets in a tangent plane.

    Parameters
    ----------
    ra, dec : float
        Tangent point, deg.
    east, north : float or (N,) ndarray
        Offsets, deg.

    Returns
    -------
    ra, dec : float or (N,) ndarray
        Positions, deg.
    """
    p, e, n = directions(np.asarray(ra, float), np.asarray(dec, float))
    east, north = np.deg2rad(east), np.deg2rad(north)
    shape = (3,) + (1,) * np.ndim(east)
    v = p.reshape(shape) + e.reshape(shape) * east + n.reshape(shape) * north
    return angles(v)


def make_stars(
    rng, extra, center, reach, *, density, magnitudes, slope, cluster, proper_motion, colors
):
    """Draw the stars of a field.

    Parameters
    ----------
    rng, extra : `numpy.random.Generator`
        Random number generators; the second one is for clusters and colors.
    center : (float, float)
        Right ascension and declination, deg.
    reach : float
        Half the side of the field, deg.
    density : float
        Stars per square arcmin.
    magnitudes : (float, float)
        Magnitudes of the brightest and of the faintest star.
    slope : float
        Slope of the luminosity function.
    cluster : KingCluster or None
        Additional cluster at the center.
    proper_motion : float
        Scatter of the motions per axis, mas / yr.
    colors : (float, float) or None
        Mean and scatter of the colors.

    Returns
    -------
    `~astropy.table.Table`
        Columns ``ra``, ``dec``, ``pmra``, ``pmdec``, ``magnitude``, perhaps ``color``.
    """
    expected = density * (2 * reach * 60) ** 2
    if not expected < _MOST_STARS:
        raise ValueError(
            f"density must give fewer than {_MOST_STARS:,} stars in a field, gives {expected:,.0f}"
        )
    n = rng.poisson(expected)
    east, north = rng.uniform(-reach, reach, (2, n))
    if cluster is not None:
        members = cluster.draw(extra)
        near = np.maximum(*np.abs(members)) < reach
        east, north = (np.append(a, m[near]) for a, m in zip((east, north), members, strict=True))
        n = len(east)
    bright, faint = 10 ** (slope * np.asarray(magnitudes, float))
    ra, dec = offset_positions(*center, east, north)
    order = rng.permutation(n)
    stars = Table(
        {
            "ra": ra[order],
            "dec": dec[order],
            "pmra": rng.normal(0, proper_motion, n),
            "pmdec": rng.normal(0, proper_motion, n),
            "magnitude": np.log10(rng.uniform(bright, faint, n)) / slope,
        }
    )
    if colors is not None:
        stars["color"] = extra.normal(*colors, n)
    return stars


def make_reference(rng, stars, *, noise, errors):
    """Make the reference catalog of stars, at epoch 2016.

    Parameters
    ----------
    rng : `numpy.random.Generator`
        Generator for the errors.
    stars : `~astropy.table.Table`
        The stars, as from `make_stars`.
    noise : bool
        Whether positions scatter by their errors.
    errors : bool
        Whether the catalog has errors like those of Gaia; otherwise it is exact.

    Returns
    -------
    dict
        Columns with Gaia's names.
    """
    n = len(stars)
    ra, dec, magnitude = (stars[name].data for name in ("ra", "dec", "magnitude"))
    columns = {"ra": ra * u.deg, "dec": dec * u.deg}
    if errors:
        # Errors like Gaia's: constant for bright stars, then growing with decreasing flux.
        error = 0.02 * 10 ** (0.2 * np.clip(magnitude - 14.5, 0, None))
        shift = rng.normal(size=(4, n))[:2] * noise * error * _MAS
        p, e, n_ = directions(ra, dec)
        ra, dec = angles(p + e * shift[0] + n_ * shift[1])
        columns = {
            "ra": ra * u.deg,
            "dec": dec * u.deg,
            "ra_error": error * u.mas,
            "dec_error": error * u.mas,
        }
    columns |= {
        "pmra": stars["pmra"].data * u.mas / u.yr,
        "pmdec": stars["pmdec"].data * u.mas / u.yr,
    }
    if errors:
        columns |= {
            "pmra_error": 1.1 * error * u.mas / u.yr,
            "pmdec_error": 1.1 * error * u.mas / u.yr,
        }
    columns |= {
        "ref_epoch": np.full(n, CATALOG_EPOCH) * u.yr,
        "phot_g_mean_mag": magnitude * u.mag,
    }
    if "color" in stars.colnames:
        columns["bp_rp"] = stars["color"].data * u.mag
    return QTable(columns)
