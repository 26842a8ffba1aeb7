"""Positions at another epoch: proper motion, parallax, and the growth of errors."""

import numpy as np
from scipy.spatial import cKDTree

from wpdc_gwcs.catalogs.units import unit_column
from wpdc_gwcs.columns import numbers_or_nan
from wpdc_gwcs.robust import robust_scatter
from wpdc_gwcs.sky import annual_parallax, directions, move, radial_motion

__all__ = ["fill_motions", "propagate"]

# Number of neighbors whose median replaces an unknown motion.  Fewer than the minimum do not tell
# their scatter, and so not the error of a star that is moved by them.
_NEIGHBORS = 30
_LEAST_NEIGHBORS = 5
# Number of stars whose neighbors are looked up at once: about 30 MB.
_BLOCK = 20000


def fill_motions(catalog):
    r"""Fill in unknown proper motions from neighboring stars.

    Parameters
    ----------
    catalog : `~astropy.table.Table`
        As returned by `read_catalog`; the whole catalog, because a part has other neighbors.

    Returns
    -------
    catalog : `~astropy.table.Table`
        A copy with ``pmra``, ``pmdec``, ``pmra_error`` and ``pmdec_error`` filled in where the
        motion was not known, and the boolean column ``pm_from_neighbors``.  The catalog itself
        if there is nothing to fill, if it has been filled before, or if fewer than five stars have
        a motion.

    Notes
    -----
    The motion is the median of that of the n = 30 nearest stars on the sky that have one (all of
    them, where they are fewer), its error on each axis

    .. math::
        \sigma_\mu = 1.4826\,\mathrm{MAD}\,\frac{n}{n - 0.8}\sqrt{1 + \frac{\pi}{2 n}}

    from the scatter of these stars about their median, with the correction of the MAD for few of
    them [1]_ and the variance of the median itself.  Directions are those at the star, also at the
    poles.

    References
    ----------
    .. [1] Croux, C. & Rousseeuw, P. J., 1992, Time-efficient algorithms for two highly robust
       estimators of scale, Computational Statistics 1, 411.

    Examples
    --------
    >>> import numpy as np
    >>> from astropy.table import Table
    >>> from wpdc_gwcs.catalogs import fill_motions, read_catalog
    >>> table = Table({"ra": np.linspace(10.0, 10.1, 6), "dec": np.full(6, -5.0)})
    >>> table["pmra"] = [1.0, 2.0, 3.0, 4.0, 100.0, np.nan]
    >>> table["pmdec"], table["ref_epoch"] = -1.0, 2016.0
    >>> catalog = fill_motions(read_catalog(table))
    >>> round(float(catalog["pmra"][5]), 2), bool(catalog["pm_from_neighbors"][5])
    (3.0, True)
    """
    names = set(catalog.colnames)
    if not {"pmra", "pmdec"} <= names or "pm_from_neighbors" in names:
        return catalog
    motion = np.array([catalog["pmra"], catalog["pmdec"]], float)
    unknown = ~np.isfinite(motion)
    lacking = unknown.any(axis=0)
    if not lacking.any() or np.sum(~lacking) < _LEAST_NEIGHBORS:
        return catalog
    median, error = _motion_of_neighbors(catalog, motion, ~lacking, np.flatnonzero(lacking))
    filled = catalog.copy()
    for k, name in enumerate(("pmra", "pmdec")):
        for column, new in ((name, median[k]), (f"{name}_error", error[k])):
            values = numbers_or_nan(catalog, column)
            # One of the two may be known and is kept.
            values[unknown[k]] = new[unknown[k, lacking]]
            filled[column] = unit_column(column, values)
    filled["pm_from_neighbors"] = lacking
    return filled


def propagate(catalog, epoch, *, parallax=False):
    r"""Move a catalog to another epoch.

    Parameters
    ----------
    catalog : `~astropy.table.Table`
        As returned by `read_catalog`; call `fill_motions` before you select a part of it.
    epoch : float or `~astropy.time.Time`
        Julian year (TCB and TDB need not be told apart here).
    parallax : bool, optional
        Add the annual parallax as seen from the Earth's center, so that the positions are
        *apparent* directions rather than barycentric ones.  Off by default; a calibration uses it.

    Returns
    -------
    catalog : `~astropy.table.Table`
        A copy with ``ra``, ``dec``, ``pmra``, ``pmdec`` and ``ref_epoch`` at the new epoch,
        position errors grown by the errors of the proper motion, and the correlations that these
        change with them.  Stars without proper motion move with their neighbors (see
        `fill_motions`); where too few stars have one, and without an epoch, they stay put.

    Notes
    -----
    Linear motion in space on unit vectors (The Hipparcos and Tycho Catalogues, ESA SP-1200, vol. 1,
    sect. 1.5.5):

    .. math::
        u(t) = \langle r (1 + \mu_r t) + \mu\,t \rangle, \qquad
        \mu = \mu_{\alpha*} p + \mu_\delta q, \qquad \mu_r = v_r \varpi / A

    where r is the direction at the reference epoch, p and q the unit vectors toward East and
    North, and A = 4.7405 km yr / s.  The radial velocity counts as zero where it or the parallax
    is not known.  It is exact at the poles and across RA 0.  The variance of a position grows on
    each axis by

    .. math::
        \sigma^2(t) = \sigma^2 + 2 \rho\,\sigma\,\sigma_\mu t + \sigma_\mu^2 t^2

    with the correlation :math:`\rho` of position and motion, zero where the catalog gives none.
    An error that is not known counts as zero; columns of position errors are made where the
    catalog has only those of the motions.  The covariance of the two axes grows likewise, with all
    four correlations of positions and motions that Gaia gives.

    For a parallax :math:`\varpi` with the error :math:`\sigma_\varpi`, the value

    .. math::
        \varpi \left(1 - \sigma_\varpi^2 / \varpi^2\right) \quad
        \text{where } \varpi > \sigma_\varpi, \quad 0 \text{ elsewhere,}

    is used, because most faint stars are too far away for a measurable parallax, and a negative
    parallax is pure noise.  Without an error, the parallax is used as it is.  The column itself is
    not changed.

    Examples
    --------
    >>> from astropy.table import Table
    >>> from wpdc_gwcs.catalogs import propagate, read_catalog
    >>> star = Table({"ra": [10.0], "dec": [60.0], "pmra": [1000.0], "pmdec": [0.0]})
    >>> star["ref_epoch"] = 2016.0
    >>> moved = propagate(read_catalog(star), 2026.0)
    >>> round(float(moved["ra"][0] - 10.0) * 3600, 4)  # 10 arcsec / cos(60 deg)
    20.0
    """
    epoch = float(getattr(epoch, "jyear", epoch))
    if not np.isfinite(epoch):
        raise ValueError(f"epoch must be a finite Julian year, got {epoch}")
    catalog = fill_motions(catalog)
    moved = catalog.copy()
    ra, dec = np.array(catalog["ra"], float), np.array(catalog["dec"], float)
    if {"pmra", "pmdec", "ref_epoch"} <= set(catalog.colnames):
        pmra, pmdec = np.array(catalog["pmra"], float), np.array(catalog["pmdec"], float)
        years = epoch - np.asarray(catalog["ref_epoch"], float)
        k = np.isfinite(pmra) & np.isfinite(pmdec) & np.isfinite(years)
        radial = _radial_motion(catalog)
        ra[k], dec[k], pmra[k], pmdec[k] = move(
            ra[k], dec[k], pmra[k], pmdec[k], years[k], radial=radial[k]
        )
        moved["pmra"], moved["pmdec"] = unit_column("pmra", pmra), unit_column("pmdec", pmdec)
        years = np.where(k, years, 0.0)
        for axis in ("ra", "dec"):
            for name, values in _grown_errors(catalog, axis, years).items():
                moved[name] = unit_column(name, values)
        if "ra_dec_corr" in catalog.colnames:
            for name, values in _grown_correlations(catalog, moved, years).items():
                moved[name] = unit_column(name, values)
    if parallax and "parallax" in catalog.colnames:
        plx = _measured_parallax(catalog)
        k = np.isfinite(plx)
        ra[k], dec[k] = annual_parallax(ra[k], dec[k], plx[k], epoch)
    moved["ra"], moved["dec"] = unit_column("ra", ra), unit_column("dec", dec)
    if "ref_epoch" in catalog.colnames:
        moved["ref_epoch"] = unit_column("ref_epoch", np.full(len(catalog), epoch))
    return moved


def _motion_of_neighbors(catalog, motion, known, rows):
    """Median motion of the nearest stars with a motion, and its error, each (2, rows)."""
    r, east, north = directions(np.asarray(catalog["ra"], float), np.asarray(catalog["dec"], float))
    # As vectors in space, because East is not the same direction everywhere.
    vectors = (motion[0, known] * east[:, known] + motion[1, known] * north[:, known]).T
    tree = cKDTree(r[:, known].T)
    n = min(_NEIGHBORS, len(vectors))
    median, scatter = np.empty((2, len(rows))), np.empty((2, len(rows)))
    for start in range(0, len(rows), _BLOCK):
        block = slice(start, start + _BLOCK)
        near = vectors[tree.query(r[:, rows[block]].T, k=n)[1]]
        for k, axis in enumerate((east, north)):
            values = np.einsum("snc,cs->sn", near, axis[:, rows[block]])
            median[k, block] = np.median(values, axis=1)
            scatter[k, block] = robust_scatter(values, axis=1)
    return median, scatter * n / (n - 0.8) * np.sqrt(1 + np.pi / 2 / n)


def _grown_errors(catalog, axis, years):
    """Error of the position on one axis and its correlation with the motion, `years` later.

    Unknown errors count as zero, so that an unknown position error does not hide what the motion
    adds to it; the sum is NaN where nothing is known.
    """
    error, motion_error, correlation = f"{axis}_error", f"pm{axis}_error", f"{axis}_pm{axis}_corr"
    if motion_error not in catalog.colnames:
        return {}
    given = numbers_or_nan(catalog, error)
    position, motion = np.nan_to_num(given), np.nan_to_num(numbers_or_nan(catalog, motion_error))
    rho = np.clip(np.nan_to_num(numbers_or_nan(catalog, correlation)), -1.0, 1.0)
    growth = motion * years
    # Rounding must not make it negative if rho is -1.
    variance = np.maximum(position**2 + 2 * rho * position * growth + growth**2, 0.0)
    later = np.where(np.isnan(given) & (growth == 0), np.nan, np.sqrt(variance))
    # The correlation changes too: moving back restores the original error.
    product = np.nan_to_num(later) * motion
    with np.errstate(invalid="ignore", divide="ignore"):
        rho = np.where(product > 0, (rho * position * motion + motion * growth) / product, rho)
    return {error: later, correlation: rho}


def _grown_correlations(catalog, moved, years):
    """Correlations of the two axes `years` later, for a catalog whose errors have been grown."""

    def covariance(a, b):
        names = f"{a}_{b}_corr", f"{a}_error", f"{b}_error"
        rho, *errors = (np.nan_to_num(numbers_or_nan(catalog, name)) for name in names)
        return rho * errors[0] * errors[1]

    between = covariance("pmra", "pmdec") * years
    crossed = {(a, b): covariance(a, b) for a, b in (("ra", "pmdec"), ("dec", "pmra"))}
    later = {pair: one + between for pair, one in crossed.items()}
    later["ra", "dec"] = covariance("ra", "dec") + (sum(crossed.values()) + between) * years
    found = {}
    for (a, b), value in later.items():
        name = f"{a}_{b}_corr"
        product = 1.0
        for one in (a, b):
            product = product * numbers_or_nan(moved, f"{one}_error")
        if name in catalog.colnames:
            with np.errstate(invalid="ignore", divide="ignore"):
                found[name] = np.where(
                    product > 0, np.clip(value / product, -1.0, 1.0), catalog[name]
                )
    return found


def _radial_motion(catalog):
    """Radial motion of every star, mas / yr; zero where it is not known."""
    if not {"radial_velocity", "parallax"} <= set(catalog.colnames):
        return np.zeros(len(catalog))
    return radial_motion(numbers_or_nan(catalog, "radial_velocity"), _measured_parallax(catalog))


def _measured_parallax(catalog):
    """Parallax shrunk by its expected noise.

    For parallaxes distributed as exp(-p / 0.4 mas) with errors of 0.05 to 1 mas (log-uniform), the
    error that remains is 0.29 mas rms; with the raw parallaxes it is 0.41, with only those above
    three errors 0.36, with none at all 0.56.  With errors of 0.5 to 1 mas: 0.51, 0.76, 0.55, 0.56.
    """
    parallax = np.array(catalog["parallax"], float)
    error = np.nan_to_num(numbers_or_nan(catalog, "parallax_error"))
    noisy = error > 0
    above = noisy & (parallax > error)
    parallax[noisy & (parallax <= error)] = 0.0
    parallax[above] -= error[above] ** 2 / parallax[above]
    return parallax
