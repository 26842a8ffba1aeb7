"""Variances of groups of coefficients, learned from the coefficients and their covariance."""

import numpy as np

__all__ = ["inflation", "learn_sequence", "truncation"]

# Scatter of the logarithm of the size of a group about its expectation from the group before.  It
# is broad, because one degree of a distortion may well be ten times as large as another.
_LOG_SCATTER = 1.2

_NEWTON_STEPS = 30

# Number of independent values that the coefficients of one degree of a detector count as.  It is
# small: for a radial distortion, all coefficients of all degrees follow from a single value.
_INDEPENDENT = 0.5

# Degrees whose sizes tell how the spectrum of a distortion goes on beyond the last one, and the
# largest ratio of one degree to the next that is believed: the sum of all has a limit.
_LAST_DEGREES, _LARGEST_RATIO = 4, 0.95

# Places with stars for each coefficient below which all of what is beyond the last degree remains
# unknown; with more, fields and tables show it.
_PLACES_PER_COEFFICIENT = 4.0


def learn_sequence(square, count, sigma, decay):
    """Learn the standard deviations of a sequence of groups: one step of expectation maximization.

    Parameters
    ----------
    square : (G,) ndarray
        Expected sum of squares of the coefficients of each group: value^2 + variance.
    count : (G,) ndarray
        Number of coefficients of each group.
    sigma : (G,) ndarray
        Standard deviations before the step.
    decay : float
        Factor by which a group is expected to be smaller than the one before it.

    Returns
    -------
    (G,) ndarray
        Standard deviations after it.

    Notes
    -----
    The step maximizes ``sum(-n ln s - S / (2 s^2))`` with a Gaussian random walk of ``ln s`` as
    prior.  A degree that the stars do not constrain is therefore assumed to be somewhat smaller
    than the one below it, and never zero.
    """
    # Precision of a random walk of the logarithm.
    step = np.diff(np.eye(len(count)), axis=0)
    walk = step.T @ step / _LOG_SCATTER**2
    # (l_i - l_{i-1} + ln decay)^2 / (2 scatter^2), its gradient at zero
    offset = np.zeros(len(count))
    offset[1:] += np.log(decay) / _LOG_SCATTER**2
    offset[:-1] -= np.log(decay) / _LOG_SCATTER**2
    log = np.log(sigma)
    for _ in range(_NEWTON_STEPS):
        chi = square * np.exp(-2 * log)
        gradient = count - chi + walk @ log + offset
        step = np.linalg.solve(walk + np.diag(2 * chi + 1e-9), gradient)
        log = log - np.clip(step, -1.0, 1.0)
        if np.abs(step).max() < 1e-6:
            break
    return np.exp(log)


def inflation(determined):
    """Return the factor by which standard deviations grow because they are uncertain.

    Parameters
    ----------
    determined : (D, G) ndarray
        Number of coefficients of each group that the stars determine, for each detector.

    Returns
    -------
    float
        Factor: near 1 if many detectors determine the sizes of the groups, larger if less is known.

    Notes
    -----
    With n independent values, the logarithm of a standard deviation has the variance v = 1 / (2 n).
    If the logarithm has a normal distribution, the mean of the variance is exp(2 v) times its mode.
    """
    known = 1.0 / (1.0 / np.maximum(determined, 1e-3) + 1.0 / _INDEPENDENT)
    return float(np.exp(0.5 / np.sum(known)))


def truncation(sigma, n_places):
    """Return the factor by which errors grow because a distortion does not end at a degree.

    Parameters
    ----------
    sigma : (G,) ndarray
        Standard deviations of the coefficients of each degree, from the second on.
    n_places : float
        Number of places with stars.

    Returns
    -------
    float
        Factor on standard deviations: near 1 if the size of the degrees falls quickly, or if there
        are many stars.

    Notes
    -----
    If each degree is r times the one before, all of them have ``1 / (1 - r^2)`` times the power of
    the last one.  Those beyond it are fitted by none of the coefficients, so few stars hide them in
    the others.
    """
    last = np.log(sigma[-_LAST_DEGREES:])
    if len(last) < 2:
        return 1.0
    ratio = min(np.exp((last[-1] - last[0]) / (len(last) - 1)), _LARGEST_RATIO)
    terms = np.sum(np.arange(len(sigma) + 2) + 1)
    unknown = min(_PLACES_PER_COEFFICIENT * terms / max(n_places, 1.0), 1.0)
    return float(np.sqrt(1.0 + unknown * ratio**2 / (1.0 - ratio**2)))
