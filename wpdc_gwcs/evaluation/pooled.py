"""Pooled residuals of all frames of a detector, and of a run.

::

    matches of frames --cuts--> residuals of a detector --3-sigma clipping--> mean, sigma, area
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from astropy.table import QTable

from wpdc_gwcs.evaluation.cuts import Cuts
from wpdc_gwcs.evaluation.residuals import (
    ResidualStatistics,
    binned_residuals,
    evaluate,
    within_sigma,
)

__all__ = ["DetectorResiduals", "format_table", "pool_residuals", "tabulate_detectors"]

# Name of the row of a whole run.
_ALL = "all"
_MAS = 3.6e6  # per deg
# Columns of table 2 of the paper and their names there.
_PAPER = {
    "mean_dx": r"$\mu_{\delta x}$",
    "sigma_dx": r"$\sigma_{\delta x}$",
    "mean_dy": r"$\mu_{\delta y}$",
    "sigma_dy": r"$\sigma_{\delta y}$",
}


@dataclass(frozen=True, eq=False)
class DetectorResiduals:
    """Pooled residuals of all frames of a detector.

    Parameters
    ----------
    detector : str
        Name of the detector; "all" for a whole run.
    n_frames : int
        Number of frames.
    stars : str
        "used" or "holdout".
    x, y : (N,) ndarray
        Pixels of the stars, zero based.
    dx, dy : (N,) ndarray
        Residuals in px.
    d_alpha, d_delta : (N,) ndarray
        Residuals on the sky, measured minus reference, east and north, in mas.
    statistics : ResidualStatistics
        Statistics of the residuals in px.
    mean_alpha, sigma_alpha, mean_delta, sigma_delta : float
        Moments on the sky after clipping, mas.
    share_below : float
        Fraction of the area (cells with stars) whose mean residual is shorter than the limit; for a
        run, the mean over its detectors.
    limit : float
        The limit, px.

    Examples
    --------
    >>> from wpdc_gwcs import Settings, calibrate, simulate
    >>> from wpdc_gwcs.evaluation import pool_residuals
    >>> sky = simulate(1, image_shape=(256, 256), density=120, distortion=2, seed=1)
    >>> run = calibrate([sky.exposures[0].frame()], sky.reference, settings=Settings(lut="none"))
    >>> (pooled,) = pool_residuals(run.calibrations)
    >>> pooled.detector, pooled.statistics.n == len(pooled.x)
    ('sim', True)
    >>> round(pooled.sigma_alpha / pooled.statistics.sigma_dx / 300)  # the pixel scale is 300 mas
    1
    """

    detector: str
    n_frames: int
    stars: str
    x: np.ndarray
    y: np.ndarray
    dx: np.ndarray
    dy: np.ndarray
    d_alpha: np.ndarray
    d_delta: np.ndarray
    statistics: ResidualStatistics
    mean_alpha: float
    sigma_alpha: float
    mean_delta: float
    sigma_delta: float
    share_below: float
    limit: float


def pool_residuals(calibrations, *, cuts=None, stars="used", limit=0.01, n_bins=20):
    """Pool the residuals of calibrated frames by detector, and over all detectors.

    Parameters
    ----------
    calibrations : Calibration or iterable of them
        Calibrated frames with their ``matches``.
    cuts : Cuts, optional
        Limits on the stars; distances are from the reference point of the frame's solution.
    stars : {"used", "holdout"}, optional
        Stars in the fit, or stars held out of it.
    limit : float, optional
        Limit of the mean residual for ``share_below``, px; the paper uses 0.01.
    n_bins : int, optional
        Cells of the area along each axis; the paper shows 20 x 20.

    Returns
    -------
    list of DetectorResiduals
        One for each detector with such stars, sorted by name; if there are several, the last one
        is for all.

    Raises
    ------
    ValueError
        If the frames have no matches, or an argument is invalid.

    Notes
    -----
    The mean of a few stars cannot be smaller than its own error: with 0.05 px of centroid noise, a
    cell needs about a hundred stars for a limit of 0.01 px.

    Examples
    --------
    >>> from wpdc_gwcs import calibrate, simulate
    >>> from wpdc_gwcs.evaluation import Cuts, pool_residuals
    >>> sky = simulate(2, image_shape=(1000, 1000), density=30, distortion=10, seed=2)
    >>> run = calibrate([e.frame() for e in sky.exposures], sky.reference)
    >>> (inner,) = pool_residuals(run.calibrations, cuts=Cuts(max_radius=400))
    >>> inner.detector, inner.n_frames, bool(abs(inner.statistics.mean_dx) < 0.01)
    ('sim', 2, True)
    """
    calibrations = list(calibrations) if isinstance(calibrations, Iterable) else [calibrations]
    if not calibrations or any(c.matches is None for c in calibrations):
        raise ValueError("pool_residuals needs calibrated frames with their matches")
    if stars not in ("used", "holdout"):
        raise ValueError(f"stars must be 'used' or 'holdout', got {stars!r}")
    if not limit > 0:
        raise ValueError(f"limit must be positive, in px, got {limit}")
    cuts = Cuts() if cuts is None else cuts
    groups = {}
    for c in calibrations:
        groups.setdefault(c.solution.detector, []).append(c)
    found = []
    for detector, group in sorted(groups.items()):
        columns = np.concatenate([_residuals_of(c, cuts, stars) for c in group], axis=1)
        if columns.shape[1]:
            shape = group[0].solution.image_shape
            found.append(_pooled(detector, len(group), stars, columns, shape, limit, n_bins))
    if len(found) > 1:
        columns = np.concatenate(
            [[d.x, d.y, d.dx, d.dy, d.d_alpha, d.d_delta] for d in found], axis=1
        )
        share = float(np.mean([d.share_below for d in found]))
        n_frames = sum(d.n_frames for d in found)
        found.append(_pooled(_ALL, n_frames, stars, columns, None, limit, n_bins, share))
    return found


def _residuals_of(calibration, cuts, stars):
    m = calibration.matches
    x, y, dx, dy = (np.asarray(m[name], float) for name in ("x", "y", "dx", "dy"))
    chosen = np.asarray(m[stars], bool) & np.isfinite(dx) & np.isfinite(dy)
    chosen &= cuts.select(m, calibration.solution.crpix)
    x, y, dx, dy = (values[chosen] for values in (x, y, dx, dy))
    return np.array([x, y, dx, dy, *(calibration.cd @ [dx, dy] * _MAS)])


def _pooled(detector, n_frames, stars, columns, image_shape, limit, n_bins, share=None):
    x, y, dx, dy, alpha, delta = columns
    keep = within_sigma(dx, dy)
    if share is None:
        mean_dx, mean_dy, count = binned_residuals(
            x[keep], y[keep], dx[keep], dy[keep], image_shape=image_shape, n_bins=n_bins
        )
        share = float(np.mean(np.hypot(mean_dx, mean_dy)[count > 0] < limit))
    moments = [f(v[within_sigma(alpha, delta)]) for v in (alpha, delta) for f in (np.mean, np.std)]
    return DetectorResiduals(
        detector, n_frames, stars, *columns, evaluate(dx, dy), *map(float, moments), share, limit
    )


def tabulate_detectors(residuals):
    """Tabulate the statistics of detectors.

    Parameters
    ----------
    residuals : list of DetectorResiduals
        As returned by `pool_residuals`.

    Returns
    -------
    `~astropy.table.QTable`
        One row each: ``detector``, ``n_frames``, ``stars``, the fields of `ResidualStatistics` in
        px, ``mean_alpha``, ``sigma_alpha``, ``mean_delta``, ``sigma_delta`` in mas,
        ``share_below`` and its ``limit`` in px.

    Examples
    --------
    >>> from wpdc_gwcs import Settings, calibrate, simulate
    >>> from wpdc_gwcs.evaluation import pool_residuals, tabulate_detectors
    >>> sky = simulate(1, image_shape=(256, 256), density=120, distortion=2, seed=1)
    >>> run = calibrate([sky.exposures[0].frame()], sky.reference, settings=Settings(lut="none"))
    >>> table = tabulate_detectors(pool_residuals(run.calibrations))
    >>> print(table["detector", "n_frames", "stars"])
    detector n_frames stars
    -------- -------- -----
         sim        1  used
    """
    moments = ("mean_alpha", "sigma_alpha", "mean_delta", "sigma_delta", "share_below", "limit")
    return QTable(
        [
            {
                "detector": r.detector,
                "n_frames": r.n_frames,
                "stars": r.stars,
                **vars(r.statistics),
                **{name: getattr(r, name) for name in moments},
            }
            for r in residuals
        ]
    )


def format_table(residuals, *, form="ascii"):
    """Format the table of detectors like table 2 of the paper.

    Parameters
    ----------
    residuals : list of DetectorResiduals
        As returned by `pool_residuals`.
    form : {"ascii", "latex"}, optional
        Plain text, or a LaTeX table with rules between the bands.

    Returns
    -------
    str
        The table: means and standard deviations after 3-sigma clipping, px, of detectors alone.

    Raises
    ------
    ValueError
        If `form` is neither.

    References
    ----------
    WPDC-2P, arXiv:2603.09193, table 2.

    Examples
    --------
    >>> from wpdc_gwcs import Settings, calibrate, simulate
    >>> from wpdc_gwcs.evaluation import format_table, pool_residuals
    >>> sky = simulate(1, image_shape=(256, 256), density=120, distortion=2, seed=1)
    >>> run = calibrate([sky.exposures[0].frame()], sky.reference, settings=Settings(lut="none"))
    >>> print(format_table(pool_residuals(run.calibrations)))
    Detector ID   mean_dx  sigma_dx   mean_dy  sigma_dy
    ---------------------------------------------------
    sim            -0.002     0.054    -0.001     0.052
    """
    if form not in ("ascii", "latex"):
        raise ValueError(f"form must be 'ascii' or 'latex', got {form!r}")
    rows = [
        # Adding zero removes the sign of a value that is rounded to zero.
        (r.detector, [f"{round(getattr(r.statistics, name), 3) + 0.0:.3f}" for name in _PAPER])
        for r in residuals
        if r.detector != _ALL or len(residuals) == 1
    ]
    if form == "ascii":
        width = max([len("Detector ID"), *(len(name) for name, _ in rows)])
        head = f"{'Detector ID':<{width}}" + "".join(f"  {name:>8}" for name in _PAPER)
        lines = [f"{name:<{width}}" + "".join(f"  {v:>8}" for v in row) for name, row in rows]
        return "\n".join([head, "-" * len(head), *lines]) + "\n"
    lines = []
    for k, (name, row) in enumerate(rows):
        if k and _band(name) != _band(rows[k - 1][0]):
            lines.append(r"    \midrule")
        cells = [f"${v}$" if v.startswith("-") else v for v in row]
        lines.append(f"    {_in_latex(name)} & {' & '.join(cells)} \\\\")
    return "\n".join(
        [
            r"\begin{table}[htbp]",
            r"  \centering",
            r"  \caption{Positional residual statistics after $3\sigma$ clipping (units: pixels).}",
            r"  \begin{tabular}{lrrrr}",
            r"    \toprule",
            f"    Detector ID & {' & '.join(_PAPER.values())} \\\\",
            r"    \midrule",
            *lines,
            r"    \bottomrule",
            r"  \end{tabular}",
            r"\end{table}",
            "",
        ]
    )


def _band(detector):
    return detector.rsplit("-", 1)[0] if "-" in detector else ""


def _in_latex(text):
    marks = {c: "\\" + c for c in "#$%&_{}"}
    marks |= {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"}
    return "".join(marks.get(c, c) for c in text)
