"""Comparison of the five radial weights: the solution with each of them.

::

    pairs of all frames of a detector, in their attitudes
        --each weight--> polynomial --> residuals --> table --> residuals
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from astropy.table import QTable

from wpdc_gwcs.evaluation.residuals import ResidualStatistics, evaluate
from wpdc_gwcs.exceptions import FitError
from wpdc_gwcs.fitting import RadialWeight, WPDCFitter
from wpdc_gwcs.lookup import ResidualMap, build_lookup_table
from wpdc_gwcs.lookup.choice import first_choices
from wpdc_gwcs.models import PVPolynomial, project
from wpdc_gwcs.threads import one_blas_thread

__all__ = ["WeightResult", "compare_weights", "tabulate_weights"]


@dataclass(frozen=True, eq=False)
class WeightResult:
    """Residuals of the solution with one radial weight.

    Parameters
    ----------
    weight : RadialWeight
        The weight.
    dx, dy : (N,) ndarray
        Residuals of the polynomial alone, px.
    table_dx, table_dy : (N,) ndarray
        Residuals with a look-up table for the residuals of this polynomial, px.
    statistics, table_statistics : ResidualStatistics
        Statistics of the former and of the latter.
    held_out : bool
        Whether the residuals are of held-out stars; otherwise of the stars in the fit.
    x, y : (N,) ndarray, optional
        Pixels of the stars, zero based.
    distance : (N,) ndarray, optional
        Their distances from the reference point, px.

    Examples
    --------
    >>> from wpdc_gwcs import Settings, calibrate, compare_weights, simulate
    >>> sky = simulate(1, image_shape=(256, 256), density=120, distortion=2, seed=1)
    >>> run = calibrate([sky.exposures[0].frame()], sky.reference, settings=Settings(lut="none"))
    >>> result = compare_weights(run.calibrations, weights=["uniform"])[0]
    >>> result.weight.name, result.held_out, result.statistics.n == len(result.dx)
    ('uniform', False, True)
    """

    weight: RadialWeight
    dx: np.ndarray
    dy: np.ndarray
    table_dx: np.ndarray
    table_dy: np.ndarray
    statistics: ResidualStatistics
    table_statistics: ResidualStatistics
    held_out: bool
    x: np.ndarray | None = None
    y: np.ndarray | None = None
    distance: np.ndarray | None = None

    def within(self, radius):
        """Select the stars within a distance of the reference point.

        Parameters
        ----------
        radius : float
            Distance in px, such as ``weight.r0``.

        Returns
        -------
        WeightResult
            Result for these stars alone.

        Raises
        ------
        ValueError
            If the distances of the stars are unknown, or no star is that near.
        """
        near = None if self.distance is None else self.distance <= radius
        if near is None or not near.any():
            raise ValueError(f"no star is within {radius:g} px of the reference point")
        return self.select(near)

    def select(self, chosen):
        """Select some of the stars.

        Parameters
        ----------
        chosen : (N,) ndarray of bool
            Mask of the stars.

        Returns
        -------
        WeightResult
            Result for these stars alone.
        """
        columns = ("dx", "dy", "table_dx", "table_dy", "x", "y", "distance")
        arrays = {name: getattr(self, name)[chosen] for name in columns}
        return replace(
            self,
            **arrays,
            statistics=evaluate(arrays["dx"], arrays["dy"]),
            table_statistics=evaluate(arrays["table_dx"], arrays["table_dy"]),
        )


@one_blas_thread
def compare_weights(calibrations, *, weights=RadialWeight.names, r0=None, degree=3):
    """Fit the polynomial and a table with each of the radial weights.

    Parameters
    ----------
    calibrations : Calibration or iterable of them
        Calibrated frames of one detector, with their ``matches``: columns ``x``, ``y``, ``x_err``,
        ``y_err`` in px, ``ra``, ``dec`` in deg, ``used`` and ``holdout``.
    weights : sequence of str, optional
        Names of the weights.
    r0 : float, optional
        Radius within which all stars have the same weight, px; by default that of the solution's
        settings, or else 0.87 times half the shorter side.
    degree : int, optional
        Degree of the polynomial.

    Returns
    -------
    list of WeightResult
        One for each weight, in the order of the names.  The residuals are those of held-out stars
        if there are any.

    Raises
    ------
    ValueError
        If the frames have no matches, or are of different detectors.
    FitError
        If the stars within ``r0`` do not determine the polynomial.

    Notes
    -----
    The attitudes of the frames are kept, except for a common linear part.  Tables are built as by
    ``build_lookup_table(draft=True)``, with one kernel smoothed by generalized cross-validation.

    References
    ----------
    WPDC-2P, arXiv:2603.09193, section 3.2, equations 6 to 9.

    Examples
    --------
    >>> from wpdc_gwcs import calibrate, read_catalog, simulate
    >>> from wpdc_gwcs.evaluation import compare_weights
    >>> sky = simulate(2, image_shape=(1000, 1000), density=30, distortion=10, seed=2)
    >>> run = calibrate([e.frame() for e in sky.exposures], read_catalog(sky.reference))
    >>> results = compare_weights(run.calibrations)
    >>> [r.weight.name for r in results]
    ['exp-sqrt', 'gaussian', 'inverse', 'inverse-square', 'uniform']
    >>> all(r.table_statistics.sigma_dx <= r.statistics.sigma_dx for r in results)
    True
    """
    calibrations = list(calibrations) if isinstance(calibrations, Iterable) else [calibrations]
    if not calibrations or any(c.matches is None for c in calibrations):
        raise ValueError("compare_weights needs calibrated frames with their matches")
    solution = calibrations[0].solution
    for c in calibrations:
        s = c.solution
        if s.detector != solution.detector or s.image_shape != solution.image_shape:
            raise ValueError(
                f"frames must be of one detector, got {solution.detector!r} {solution.image_shape} "
                f"and {s.detector!r} {s.image_shape}"
            )
    stars = [_stars_of(c) for c in calibrations]
    offset, reference, sigma, place = (
        np.concatenate([s[k] for s in stars], axis=1) for k in range(4)
    )
    used, held = (np.concatenate([s[k] for s in stars]) for k in (4, 5))
    fold = np.repeat(np.arange(len(stars)), [s[0].shape[1] for s in stars])
    if len(stars) < 3:
        fold = np.random.default_rng(0).integers(0, 5, used.size)
    if r0 is None:
        r0 = solution.settings.get("r0") or RadialWeight.for_shape(solution.image_shape).r0
    shown = held if held.any() else used
    cd, residuals, maps = solution.cd, [], []
    weights = [RadialWeight(name, r0=float(r0)) for name in weights]
    for weight in weights:
        fitter = WPDCFitter(weight=weight, pixel_scale=cd)
        try:
            pv = fitter(
                PVPolynomial(degree),
                *(cd @ offset[:, used]),
                *(cd @ reference[:, used]),
                weights=1.0 / np.sqrt(cd**2 @ sigma[:, used] ** 2),
            )
        except FitError as err:
            raise FitError(f"weight {weight.name} with r0 = {r0:.6g} px: {err}") from err
        residual = np.linalg.solve(cd, np.array(pv(*(cd @ offset)))) - reference
        residuals.append(residual)
        maps.append(
            ResidualMap.from_residuals(
                *place[:, used], *residual[:, used], x_err=sigma[0, used], y_err=sigma[1, used],
                image_shape=solution.image_shape, fold=fold[used],
            )
        )  # fmt: skip
    results = []
    for weight, residual, bins, choice in zip(weights, residuals, maps, first_choices(maps)):
        table, _ = build_lookup_table(bins, choice=choice, draft=True)
        left = residual if table is None else residual - np.array(table(*place))
        results.append(
            WeightResult(
                weight,
                *residual[:, shown],
                *left[:, shown],
                evaluate(*residual[:, shown]),
                evaluate(*left[:, shown]),
                bool(held.any()),
                *place[:, shown],
                np.hypot(*offset[:, shown]),
            )
        )
    return results


def _stars_of(calibration):
    """Offsets, reference positions and errors of the stars of a frame (px), and the fit mask."""
    m, s = calibration.matches, calibration.solution
    columns = {
        name: np.asarray(m[name], dtype=float) for name in ("x", "y", "x_err", "y_err", "ra", "dec")
    }
    place = np.array([columns["x"], columns["y"]])
    sigma = np.array([columns["x_err"], columns["y_err"]])
    plane = np.array(project(columns["ra"], columns["dec"], calibration.crval))
    reference = np.linalg.solve(calibration.cd, plane)
    good = np.isfinite(place + reference + sigma).all(axis=0) & (sigma > 0).all(axis=0)
    held = np.asarray(m["holdout"], bool) if "holdout" in m.colnames else np.zeros(len(m), bool)
    used = np.asarray(m["used"], bool) if "used" in m.colnames else ~held
    arrays = [place - s.crpix[:, None], reference, sigma, place]
    return [a[:, good] for a in arrays] + [(used & ~held)[good], held[good]]


def tabulate_weights(results):
    """Tabulate the residuals with each weight, without and with a look-up table.

    Parameters
    ----------
    results : list of WeightResult
        As returned by `compare_weights`.

    Returns
    -------
    `~astropy.table.QTable`
        Two rows for each weight: ``weight``, ``r0``, ``table`` (``no`` or ``yes``), ``stars``
        (``used`` or ``holdout``) and the fields of `ResidualStatistics`.

    Examples
    --------
    >>> from wpdc_gwcs import Settings, calibrate, compare_weights, simulate
    >>> from wpdc_gwcs.evaluation import tabulate_weights
    >>> sky = simulate(1, image_shape=(256, 256), density=120, distortion=2, seed=1)
    >>> run = calibrate([sky.exposures[0].frame()], sky.reference, settings=Settings(lut="none"))
    >>> table = tabulate_weights(compare_weights(run.calibrations, weights=["uniform"]))
    >>> print(table["weight", "table", "stars"])
     weight table stars
    ------- ----- -----
    uniform    no  used
    uniform   yes  used
    """
    return QTable(
        [
            {
                "weight": r.weight.name,
                "r0": r.weight.r0,
                "table": table,
                "stars": "holdout" if r.held_out else "used",
                **vars(statistics),
            }
            for r in results
            for table, statistics in (("no", r.statistics), ("yes", r.table_statistics))
        ]
    )
