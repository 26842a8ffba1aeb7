"""Sky and plane: directions, motions in space, the tangent plane; arrays of plain degrees."""

import numpy as np

from wpdc_gwcs.blocks import evaluate_blocks

__all__ = [
    "Tangent",
    "angles",
    "annual_parallax",
    "deproject",
    "directions",
    "local_plane",
    "move",
    "project",
]


def directions(ra, dec):
    """Give unit vectors towards stars, East and North of them.

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
    """Give the position that a vector points at.

    Parameters
    ----------
    vector : (3, N) array_like
        Of any length.

    Returns
    -------
    ra, dec : (N,) ndarray
        Position, deg; right ascension from 0 to 360.
    """
    x, y, z = vector
    return np.degrees(np.arctan2(y, x)) % 360.0, np.degrees(np.arctan2(z, np.hypot(x, y)))


def move(ra, dec, pmra, pmdec, years):
    """Move stars straight on in space, with a radial velocity of zero.

    Parameters
    ----------
    ra, dec : (N,) ndarray
        Positions, deg.
    pmra, pmdec : (N,) ndarray
        Proper motions, mas / yr; that in right ascension includes cos Dec.
    years : (N,) ndarray or float
        How long, yr.

    Returns
    -------
    ra, dec : (N,) ndarray
        Positions, deg.
    pmra, pmdec : (N,) ndarray
        The motion as it is seen then, mas / yr: moving on or back starts from there.
    """
    r, east, north = directions(ra, dec)
    mas = np.pi / 180.0 / 3.6e6
    motion = (pmra * east + pmdec * north) * mas
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


def annual_parallax(ra, dec, parallax, epoch):
    """Shift stars by their annual parallax as seen from the Earth's centre.

    Parameters
    ----------
    ra, dec : (N,) ndarray
        Positions seen from the barycentre, deg.
    parallax : (N,) ndarray
        Parallaxes, mas.
    epoch : float
        Julian year.

    Returns
    -------
    ra, dec : (N,) ndarray
        Apparent positions, deg.
    """
    # erfa's Earth needs no ephemeris file, hence no network.
    import erfa

    barycentric = erfa.epv00(2451545.0, (epoch - 2000.0) * 365.25)[1]["p"]
    r, _, _ = directions(ra, dec)
    mas = np.pi / 180.0 / 3.6e6
    return angles(r - parallax * mas * np.asarray(barycentric)[:, None])


class Tangent:
    """Gnomonic projection about one point, on contiguous blocks.

    Parameters
    ----------
    crval : (float, float)
        RA and Dec of the point, deg.
    """

    def __init__(self, crval):
        self.ra0, self.dec0 = (float(value) for value in crval)
        self.sin0, self.cos0 = np.sin(np.radians(self.dec0)), np.cos(np.radians(self.dec0))

    def project(self, ra, dec):
        """Sky in degrees to the plane in degrees, NaN on the far hemisphere.

        Parameters
        ----------
        ra, dec : (N,) ndarray
            Positions, deg.

        Returns
        -------
        xi, eta : (N,) ndarray
            Standard coordinates, deg.
        """
        # Sines and cosines from the tangents of the half angles, which numpy has in vector
        # instructions; numerators and denominator share the factor (1 + tan_ra^2) (1 + tan_dec^2).
        tan_ra = ra - self.ra0
        tan_ra *= np.pi / 360
        np.tan(tan_ra, out=tan_ra)
        tan_dec = dec * (np.pi / 360)
        np.tan(tan_dec, out=tan_dec)
        square = tan_ra * tan_ra
        cos_dec = tan_dec * tan_dec
        np.subtract(1.0, cos_dec, out=cos_dec)
        xi = 2.0 * tan_ra
        xi *= cos_dec
        ahead = 1.0 - square
        ahead *= cos_dec
        square += 1.0
        eta = tan_dec
        eta *= 2.0
        eta *= square
        depth = self.sin0 * eta
        depth += self.cos0 * ahead
        eta *= self.cos0
        ahead *= self.sin0
        eta -= ahead
        # The horizon itself is infinitely far away.
        square *= 1e-12
        hidden = ~(depth > square)
        if hidden.any():
            depth[hidden] = np.nan
        np.divide(180 / np.pi, depth, out=depth)
        xi *= depth
        eta *= depth
        return xi, eta

    def deproject(self, xi, eta):
        """Plane in degrees to the sky in degrees; right ascension from 0 to 360.

        Parameters
        ----------
        xi, eta : (N,) ndarray
            Standard coordinates, deg.

        Returns
        -------
        ra, dec : (N,) ndarray
            Positions, deg.
        """
        return self.deproject_radians(xi * (np.pi / 180), eta * (np.pi / 180))

    def deproject_radians(self, xi, eta):
        """Plane in radians, which is overwritten, to the sky in degrees.

        Parameters
        ----------
        xi, eta : (N,) ndarray
            Standard coordinates, rad.

        Returns
        -------
        ra, dec : (N,) ndarray
            Positions, deg.
        """
        ra, dec = self.offsets(xi, eta)
        ra += self.ra0
        return self.wrap(ra, dec)

    def offsets(self, xi, eta):
        """Plane in radians, which is overwritten, to RA from RA0 and Dec in degrees.

        Parameters
        ----------
        xi, eta : (N,) ndarray
            Standard coordinates, rad.

        Returns
        -------
        ra, dec : (N,) ndarray
            Right ascension less that of the point, and declination, deg.
        """
        # Axes of the tangent plane's point: toward RA0 in the equator's plane, east, and north.
        ahead = eta * -self.sin0
        ahead += self.cos0
        north = eta
        north *= self.cos0
        north += self.sin0
        if xi.size and ahead.min() > 0:
            # Of one argument it is the faster one.
            ra = xi / ahead
            np.arctan(ra, out=ra)
        else:
            ra = np.arctan2(xi, ahead)
        xi *= xi
        ahead *= ahead
        xi += ahead
        np.sqrt(xi, out=xi)
        # At the pole itself it is the arc tangent of infinity.
        north /= xi
        dec = np.arctan(north, out=north)
        dec *= 180 / np.pi
        ra *= 180 / np.pi
        return ra, dec

    @staticmethod
    def wrap(ra, dec):
        """Bring right ascensions, which are overwritten, into the range from 0 to 360 degrees.

        Parameters
        ----------
        ra, dec : (N,) ndarray
            Positions, deg.

        Returns
        -------
        ra, dec : (N,) ndarray
            The same arrays.
        """
        if ra.size and not (ra.min() >= 0.0 and ra.max() < 360.0):
            np.mod(ra, 360.0, out=ra)
            # A tiny negative angle is rounded up to 360 by the modulus.
            ra[ra == 360.0] = 0.0
        return ra, dec


def project(ra, dec, crval):
    """Project the sky onto the plane that touches it at a point (gnomonic, TAN).

    Parameters
    ----------
    ra, dec : array_like
        Positions in degrees.
    crval : (float, float)
        Tangent point in degrees.

    Returns
    -------
    xi, eta : ndarray
        Standard coordinates in degrees, east and north; NaN for points 90 degrees or more from the
        tangent point.

    Examples
    --------
    >>> from wpdc_gwcs.sky import project
    >>> xi, eta = project(10.0, 21.0, (10.0, 20.0))
    >>> float(xi), float(eta)
    (0.0, 1.0001015)
    """
    return evaluate_blocks(Tangent(crval).project, ra, dec)


def deproject(xi, eta, crval):
    """Project the plane that touches the sky at a point back onto the sky (gnomonic, TAN).

    Parameters
    ----------
    xi, eta : array_like
        Standard coordinates in degrees, east and north.
    crval : (float, float)
        Tangent point in degrees.

    Returns
    -------
    ra, dec : ndarray
        Positions in degrees, right ascension from 0 to 360.

    Notes
    -----
    With xi, eta in radians::

        tan(ra - ra0) = xi / (cos dec0 - eta sin dec0)
        tan(dec) = (sin dec0 + eta cos dec0) / hypot(xi, cos dec0 - eta sin dec0)

    which is exact at the poles, too.

    Examples
    --------
    >>> from wpdc_gwcs.sky import deproject
    >>> ra, dec = deproject(0.0, 1.0, (10.0, 89.5))
    >>> float(ra), float(dec)
    (190.0, 89.5001)
    """
    return evaluate_blocks(Tangent(crval).deproject, xi, eta)


def local_plane(sky, x, y, *, step=1.0):
    """Give the linear map and the tangent point of a WCS at a pixel.

    Parameters
    ----------
    sky : callable
        Pixels ``x, y`` to RA and Dec in degrees.
    x, y : float
        The pixel.
    step : float, optional
        Pixels over which the derivatives are taken.

    Returns
    -------
    crval : (2,) ndarray
        RA and Dec of the pixel, deg.
    cd : (2, 2) ndarray
        Derivatives of the standard coordinates about it with respect to x and y, deg / px.
    """
    at = (
        x + step * np.array([0.0, 1.0, -1.0, 0.0, 0.0]),
        y + step * np.array([0.0, 0, 0, 1.0, -1.0]),
    )
    ra, dec = sky(*at)
    crval = np.array([ra[0], dec[0]])
    xi, eta = project(ra, dec, crval)
    cd = np.array([[xi[1] - xi[2], xi[3] - xi[4]], [eta[1] - eta[2], eta[3] - eta[4]]])
    return crval, cd / (2 * step)
