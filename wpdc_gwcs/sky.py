"""Positions on the sky in plain degrees: directions, motions in space, parallax."""

import numpy as np

__all__ = [
    "angles",
    "annual_parallax",
    "directions",
    "move",
    "radial_motion",
]


def directions(ra, dec):
    """Return the unit vectors toward stars, and east and north of them.

    Parameters
    ----------
    ra, dec : (N,) array_like
        Positions, deg.

    Returns
    -------
    outward, east, north : (3, N) ndarray
        Unit vectors.
    """
    a, d = np.radians(ra), np.radians(dec)
    ca, sa, cd, sd = np.cos(a), np.sin(a), np.cos(d), np.sin(d)
    zero = np.zeros_like(ca)
    return (
        np.stack([cd * ca, cd * sa, sd]),
        np.stack([-sa, ca, zero]),
        np.stack([-sd * ca, -sd * sa, cd]),
    )


def angles(vector):
    """Return the position that a vector points at.

    Parameters
    ----------
    vector : (3, N) array_like
        Vectors of any length.

    Returns
    -------
    ra, dec : (N,) ndarray
        Position, deg; right ascension from 0 to 360.
    """
    x, y, z = vector
    return np.degrees(np.arctan2(y, x)) % 360.0, np.degrees(np.arctan2(z, np.hypot(x, y)))


def move(ra, dec, pmra, pmdec, years, *, radial=0.0):
    """Move stars linearly in space.

    Parameters
    ----------
    ra, dec : (N,) ndarray
        Positions, deg.
    pmra, pmdec : (N,) ndarray
        Proper motions, mas / yr; that in right ascension includes cos Dec.
    years : (N,) ndarray or float
        Time, yr.
    radial : (N,) ndarray or float, optional
        Radial velocity over distance, mas / yr, as from `radial_motion`.

    Returns
    -------
    ra, dec : (N,) ndarray
        Positions, deg.
    pmra, pmdec : (N,) ndarray
        Proper motions at the new time, mas / yr, from which stars can be moved further.
    """
    r, east, north = directions(ra, dec)
    mas = np.pi / 180.0 / 3.6e6
    motion = (pmra * east + pmdec * north + radial * r) * mas
    later = r + motion * years
    length = np.sqrt((later**2).sum(axis=0))
    new = later / length
    new_ra, new_dec = angles(new)
    motion = (motion - new * (new * motion).sum(axis=0)) / length
    _, east, north = directions(new_ra, new_dec)
    return (
        new_ra,
        new_dec,
        (motion * east).sum(axis=0) / mas,
        (motion * north).sum(axis=0) / mas,
    )


def radial_motion(velocity, parallax):
    """Convert radial velocities to the unit of proper motions.

    Parameters
    ----------
    velocity : (N,) array_like
        Radial velocity, km / s; positive away from the Sun.
    parallax : (N,) array_like
        Parallax, mas.

    Returns
    -------
    (N,) ndarray
        Radial velocity over distance, mas / yr; zero if either is unknown.
    """
    # 1 au / yr is 4.740470446 km / s: over a parallax in mas this is mas / yr.
    return np.nan_to_num(np.asarray(velocity) * np.maximum(parallax, 0.0) / 4.740470446)


def annual_parallax(ra, dec, parallax, epoch):
    """Shift stars by their annual parallax as seen from the Earth's center.

    Parameters
    ----------
    ra, dec : (N,) ndarray
        Positions seen from the barycenter, deg.
    parallax : (N,) ndarray
        Parallaxes, mas.
    epoch : float
        Julian year.

    Returns
    -------
    ra, dec : (N,) ndarray
        Apparent positions, deg.
    """
    # The Earth of erfa needs no ephemeris file and no network.
    import erfa

    barycentric = erfa.epv00(2451545.0, (epoch - 2000.0) * 365.25)[1]["p"]
    r, _, _ = directions(ra, dec)
    mas = np.pi / 180.0 / 3.6e6
    return angles(r - parallax * mas * np.asarray(barycentric)[:, None])
