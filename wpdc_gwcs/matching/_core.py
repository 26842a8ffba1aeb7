"""The core of the match: from two lists of plane positions to one-to-one pairs with evidence."""

import time

import numpy as np

from wpdc_gwcs.matching._diagnostics import MatchDiagnostics
from wpdc_gwcs.matching._growth import pair, sample_rows
from wpdc_gwcs.matching._hypotheses import find_seeds
from wpdc_gwcs.matching._mapping import turn_and_scale
from wpdc_gwcs.matching._options import MatchOptions
from wpdc_gwcs.matching._problem import prepare_problem
from wpdc_gwcs.matching._verdict import (
    Attempts,
    carry_to_frame,
    header_error,
    is_explained,
    judge_pairs,
    prefer,
    refusal,
    without_rival,
)
from wpdc_gwcs.threads import one_blas_thread

__all__ = ["match_planes"]

# Search radius about a given mapping, px.
_START_RADIUS = 20.0
# Maximum number of starts that match except in a part of the frame.
_MOST_PARTIAL = 3
# Groups with at least this fraction of the support of a successful group are followed, too.
_RIVAL_SUPPORT = 0.3


@one_blas_thread
def match_planes(
    xs,
    ys,
    xr,
    yr,
    *,
    image_shape,
    flux=None,
    mag=None,
    x_err=None,
    y_err=None,
    start=None,
    **options,
):
    """Find which source is which reference star, from positions in one plane.

    Parameters
    ----------
    xs, ys : (N,) array_like
        Positions of the sources in pixels of the starting WCS, zero based.
    xr, yr : (M,) array_like
        Positions of the reference stars in the same pixels: projected about the tangent point of
        the starting WCS.
    image_shape : (int, int)
        Shape of the frame, ``(ny, nx)``.
    flux : (N,) array_like, optional
        Brightness of the sources in any linear unit: brighter is larger.
    mag : (M,) array_like, optional
        Magnitudes of the reference stars.  With both, bright stars are matched first; without, all
        at once.
    x_err, y_err : (N,) array_like, optional
        Errors of the source positions, px; they set the final radius star by star.
    start : SmoothMap, optional
        A mapping to begin with (``mapping`` of earlier diagnostics) in place of the search by
        patterns.
    **options
        Fields of `MatchOptions`: the range of the search, the evidence needed.

    Returns
    -------
    i_src, i_ref : (n,) ndarray of int
        Rows of the pairs in the inputs, in order of the source row.
    diagnostics : MatchDiagnostics
        Evidence, mapping and timings.

    Raises
    ------
    MatchError
        If the evidence for a match is insufficient; the message says what is missing.
    ValueError
        If lengths or options are not valid.

    Notes
    -----
    The stages are described in `wpdc_gwcs.matching`.

    Examples
    --------
    >>> import numpy as np
    >>> from wpdc_gwcs.matching import match_planes
    >>> rng = np.random.default_rng(1)
    >>> x, y = rng.uniform(0, 1000, (2, 200))
    >>> turned = x + 20 - 0.01 * y, y - 12 + 0.01 * x
    >>> i, j, diagnostics = match_planes(x[::-1], y[::-1], *turned, image_shape=(1000, 1000))
    >>> bool((i == 199 - j).all()), len(i), round(diagnostics.rotation, 3)
    (True, 200, 0.573)
    """
    clock = _Clock()
    problem = prepare_problem(
        xs,
        ys,
        xr,
        yr,
        image_shape=image_shape,
        flux=flux,
        mag=mag,
        x_err=x_err,
        y_err=y_err,
        options=MatchOptions(**options),
    )
    clock.lap("prepare")
    found = _search(problem, clock) if start is None else _match_from_start(problem, start, clock)
    evidence, mapping, (i, j) = found.evidence, found.mapping, found.pairs
    shift, matrix = mapping.linear_part()
    if found.parity < 0:
        matrix = matrix @ np.diag([-1, 1])
    rotation, scale = turn_and_scale(matrix, problem.shape)
    return (
        *_in_source_order(problem.source_rows[i], problem.reference_rows[j]),
        MatchDiagnostics(
            n_sources=evidence.n_sources,
            n_reference=evidence.n_reference,
            n_pairs=evidence.n_pairs,
            expected_by_chance=evidence.expected_by_chance,
            purity=evidence.purity,
            completeness=evidence.completeness,
            significance=evidence.significance,
            n_ambiguous=found.n_ambiguous,
            n_duplicates=problem.n_duplicates,
            scatter=found.scatter,
            radius=float(np.median(found.radius)),
            mapping=mapping,
            shift=(float(shift[0]), float(shift[1])),
            rotation=rotation,
            scale=scale,
            parity=found.parity,
            areas=evidence.areas,
            timings=clock.laps,
            search_significance=evidence.search_significance,
        ),
    )


def _match_from_start(problem, start, clock):
    """Match from a mapping that is known to be nearly right."""
    part = sample_rows(len(problem.sources))
    mapped = np.column_stack(start(*problem.sources[part].T))
    radius = np.minimum(problem.limit[part], _START_RADIUS)
    pairs, _ = pair(mapped, radius, problem.limit[part], problem.stars)
    clock.lap("start")
    pairs = part[pairs[0]], pairs[1]
    found, attempts = judge_pairs(problem, pairs, Attempts(), clock)
    if found is None:
        raise refusal(problem, attempts, hint=False)
    return without_rival(found, clock)


def _search(problem, clock):
    """Search patterns of neighbors until a group of hypotheses leads to a match."""
    attempts, seen = Attempts(), frozenset()
    for seeds in find_seeds(problem):
        clock.lap("patterns")
        found, attempts, seen = _follow(problem, seeds, attempts, seen, clock)
        if found is not None:
            return found
    raise refusal(problem, attempts)


def _follow(problem, seeds, attempts, seen, clock):
    """Follow groups of hypotheses until one has evidence, and those that could rival it."""
    best, best_support, beyond = None, 0.0, None
    for seed in seeds:
        if best is not None and (
            seed.support < _RIVAL_SUPPORT * best_support
            or is_explained(best, *seed.rows((seed.hypotheses.source, seed.hypotheses.reference)))
        ):
            continue
        for first in seed.pairs_to_try():
            found, attempts, seen = _try_pairs(seed, first, attempts, seen, clock)
            if found is None:
                if attempts.n_partial >= _MOST_PARTIAL and best is None:
                    raise refusal(problem, attempts, hint=False)
                continue
            error = header_error(found)
            if error is not None:
                beyond = beyond or error
            elif best is None:
                best, best_support = found, seed.support
            else:
                best = prefer(best, found)
            break
    if best is not None:
        return without_rival(best, clock), attempts, seen
    if beyond is not None:
        raise beyond
    return None, attempts, seen


def _try_pairs(seed, first, attempts, seen, clock):
    """Grow first pairs of a seed to the frame and judge them, unless that has been done."""
    pairs, attempts = carry_to_frame(seed, first, attempts, clock)
    if pairs is None:
        return None, attempts, seen
    key = seed.problem.turn.tobytes(), pairs[0].tobytes(), pairs[1].tobytes()
    if key in seen:
        return None, attempts, seen
    found, attempts = judge_pairs(seed.problem, pairs, attempts, clock)
    return found, attempts, seen | {key}


class _Clock:
    """Seconds by stage; repeated stages add up."""

    def __init__(self):
        self.laps = {}
        self._last = time.perf_counter()

    def lap(self, name):
        now = time.perf_counter()
        self.laps[name] = self.laps.get(name, 0.0) + now - self._last
        self._last = now


def _in_source_order(i, j):
    order = np.argsort(i, kind="stable")
    return i[order], j[order]
