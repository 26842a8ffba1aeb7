"""Kernel, degree and smoothing of the table, chosen from the data."""

import logging
from dataclasses import replace
from itertools import chain

import numpy as np

from wpdc_gwcs.counts import counted
from wpdc_gwcs.exceptions import FitError
from wpdc_gwcs.lookup._smoother import (
    MAX_DEGREE,
    Bins,
    Smoother,
    Spectrum,
    TableChoice,
    n_terms,
    pilot_surface,
)
from wpdc_gwcs.threads import map_threads, one_blas_thread

__all__ = [
    "MIN_STARS_TABLE",
    "best_of",
    "carries_table",
    "choose_table",
    "first_choice",
    "first_choices",
    "join_bins",
]

log = logging.getLogger(__name__)


# Kernel, shape parameter and least degree of its polynomial.  A Gaussian of length l has
# epsilon = 1 / (sqrt(2) l); lengths go from three times the detector to a thirteenth of it.
BROAD_KERNELS = tuple(("gaussian", epsilon, 1) for epsilon in (0.25, 0.5, 1.0, 2.0))
OPEN_KERNELS = (("thin_plate_spline", 1.0, 1), ("gaussian", 4.0, 1))
NARROW_KERNELS = tuple(("gaussian", epsilon, 1) for epsilon in (3.0, 5.0, 6.0, 7.5, 9.0))

# Smoothings that are tried, in units of the largest eigenvalue: from almost none to almost flat.
_SMOOTHINGS = 10.0 ** np.arange(-10.0, 3.01, 0.5)

# Gain in generalized cross-validation above which kernels of short length are tried.
_NARROW_GAIN = 0.998

# Candidates that generalized cross-validation passes on to cross-validation over exposures.
_N_SHORTLIST = 4

# If bins have fewer stars than this, they are joined further for the choice of settings.
_STARS_PER_BIN = 4

# With fewer stars, or all of them in fewer bins, there is no table.
MIN_STARS_TABLE = 60
_MIN_BINS_TABLE = 20


def carries_table(residual_map):
    """Return whether there are enough residuals for a look-up table.

    Parameters
    ----------
    residual_map : ResidualMap
        Residuals of one detector.

    Returns
    -------
    bool
        Whether there are enough stars, and not all of them in a few bins.
    """
    if residual_map.n_stars < MIN_STARS_TABLE:
        return False
    return int(np.sum(join_bins(residual_map).counts > 0)) >= _MIN_BINS_TABLE


@one_blas_thread
def choose_table(residual_map, *, lut="auto"):
    """Choose kernel, degree and smoothing of a look-up table by cross-validation.

    Parameters
    ----------
    residual_map : ResidualMap
        Residuals of one detector.
    lut : {'auto', 'always'}, optional
        With ``auto``, having no table may turn out best.

    Returns
    -------
    choice : TableChoice
        The best settings, for `build_lookup_table`.
    candidates : tuple of TableChoice
        All settings that were compared by cross-validation, best first.

    Raises
    ------
    FitError
        If ``lut`` is ``always`` and the map has too few stars.

    Examples
    --------
    >>> import numpy as np
    >>> from wpdc_gwcs import ResidualMap
    >>> from wpdc_gwcs.lookup import choose_table
    >>> rng = np.random.default_rng(1)
    >>> x, y = rng.uniform(0, 2047, (2, 4000))
    >>> dx, dy = np.sin(x / 300) + rng.normal(0, 0.05, (2, 4000))
    >>> bins = ResidualMap.from_residuals(
    ...     x, y, dx, dy, x_err=0.05, y_err=0.05, image_shape=(2048, 2048)
    ... )
    >>> choice, candidates = choose_table(bins)
    >>> choice == candidates[0], choice.kernel == "none"
    (True, False)
    """
    if not carries_table(residual_map):
        if lut == "always":
            raise FitError(
                f"{counted(residual_map.n_stars, 'star')} in "
                f"{counted(np.sum(residual_map.counts > 0), 'bin')} cannot determine a look-up "
                f"table; {MIN_STARS_TABLE} all over the detector are needed"
            )
        return TableChoice("none"), ()
    return _choose(join_bins(residual_map), allow_none=lut == "auto")


def join_bins(residual_map):
    """Join bins into larger ones for the choice of settings: a smoother on M bins costs M^3.

    Parameters
    ----------
    residual_map : ResidualMap
        Residuals of one detector.

    Returns
    -------
    ResidualMap
        The same residuals in bins two to four times as large, with at least four stars each if
        there are enough.
    """
    my, mx = residual_map.shape
    factors = [k for k in (2, 3, 4) if my % k == 0 and mx % k == 0] or [1]
    enough = [k for k in factors if residual_map.n_stars * k * k >= _STARS_PER_BIN * my * mx]
    return residual_map.coarsen(enough[0] if enough else factors[-1])


def _choose(coarse, *, allow_none):
    """Choose the settings by generalized cross-validation, then by groups of exposures."""
    bins = Bins(coarse)
    quintic = Spectrum(bins, "quintic", 1.0, 2)
    pilot = pilot_surface(bins, first_choice(bins, quintic))
    value = bins.debiased(pilot)
    narrow = best_of(quintic, value)
    del quintic

    def try_all(kernels):
        found = map_threads(lambda kernel: best_of(Spectrum(bins, *kernel), value), kernels)
        return list(chain.from_iterable(found))

    broad = try_all(BROAD_KERNELS)
    narrow += try_all(OPEN_KERNELS)
    # Splines and the medium length fit structure of every size.  If they are no better than the
    # broad kernels, there is none that the narrow ones could fit.
    if min(c.score for c in narrow) < _NARROW_GAIN * min(c.score for c in broad):
        narrow += try_all(NARROW_KERNELS)
    found = broad + narrow
    found.sort(key=lambda c: c.score)
    candidates = [TableChoice("none"), *_distinct(found)]
    scores = _cross_validate(coarse, candidates, pilot)
    ranked = sorted(
        (replace(c, score=float(s)) for c, s in zip(candidates, scores)), key=lambda c: c.score
    )
    best = next(c for c in ranked if allow_none or c.kernel != "none")
    log.debug("look-up table: %s", best)
    return best, tuple(ranked)


def first_choice(bins, spectrum=None):
    """Choose reasonable settings fast: one kernel, generalized cross-validation.

    Parameters
    ----------
    bins : Bins
        Occupied bins.
    spectrum : Spectrum, optional
        A kernel diagonalized on the bins.  Default: the quintic.

    Returns
    -------
    TableChoice
        Degree and smoothing with the least score.
    """
    if spectrum is None:
        spectrum = Spectrum(bins, "quintic", 1.0, 2)
    return best_of(spectrum, bins.value)[0]


def first_choices(residual_maps):
    """Choose reasonable settings for several maps of the same stars.

    Parameters
    ----------
    residual_maps : sequence of ResidualMap
        Maps of different residuals of the same stars.  They have the same bins, so the costly part,
        to diagonalize the kernel on the bins, is done once.

    Returns
    -------
    list of TableChoice
        Result of `first_choice` for each map; no table if there are too few stars.
    """
    found, spectrum = [], None
    for residual_map in residual_maps:
        if not carries_table(residual_map):
            found.append(TableChoice("none"))
            continue
        bins = Bins(join_bins(residual_map))
        if spectrum is None:
            spectrum = Spectrum(bins, "quintic", 1.0, 2)
        found.append(first_choice(bins, spectrum))
    return found


def best_of(spectrum, value):
    """Choose the best smoothing of each degree.

    Parameters
    ----------
    spectrum : Spectrum
        A kernel diagonalized on the bins.
    value : (M, 2) ndarray
        Values of the bins, px.

    Returns
    -------
    list of TableChoice
        One for each degree of the polynomial, best first.
    """
    found = []
    smoothing = spectrum.eigenvalues.max() * _SMOOTHINGS
    degrees = [
        d for d in range(spectrum.least_degree, MAX_DEGREE + 1) if 2 * n_terms(d) <= spectrum.n
    ]
    for degree, (score, freedom) in zip(degrees, spectrum.scores(value, smoothing, degrees)):
        # A smoother that follows nearly every bin leaves no residuals to judge it by.
        score = np.where(freedom < 0.9 * spectrum.n, score, np.inf)
        k = int(np.argmin(score))
        found.append(
            TableChoice(
                spectrum.kernel,
                degree,
                float(smoothing[k]),
                spectrum.epsilon,
                float(score[k]),
                float(freedom[k]),
            )
        )
    return sorted(found, key=lambda c: c.score)


def _distinct(found):
    """Keep the best few, of different kernels or lengths: neighbors in degree hardly differ."""
    best = {}
    for c in found:
        best.setdefault((c.kernel, c.epsilon), c)
    kept = {}
    for kind, c in best.items():
        # All flat ones of a degree are the same.
        kept.setdefault(c.degree if c.flat else kind, c)
    return list(kept.values())[:_N_SHORTLIST]


def _cross_validate(coarse, candidates, pilot):
    """Mean square of the normalized residuals of left-out groups, for each candidate."""
    folds = coarse.folds
    total = np.zeros(len(candidates))
    if len(folds) < 2:
        # With a single group, generalized cross-validation decides, and having no table is judged
        # by the raw means.
        bins = Bins(coarse)
        raw = np.sum(bins.value**2 * bins.weight[:, None]) / (2 * len(bins))
        return np.array([raw if c.kernel == "none" else c.score for c in candidates])
    n = 0
    for fold in folds:
        train, test = Bins(coarse.without(fold)), Bins(coarse.only(fold))
        value, truth = train.debiased(pilot), test.debiased(pilot)
        n += 2 * len(test)

        def error_of(candidate, train=train, test=test, value=value, truth=truth):
            predicted = 0.0
            if candidate.kernel != "none":
                predicted = Smoother(train, candidate)(value)(test.u, test.v)
            return np.sum((truth - predicted) ** 2 * test.weight[:, None])

        total += map_threads(error_of, candidates)
    return total / n
