"""The problem of a match: two clean lists, and how wrong the start may be."""

from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from scipy.spatial import cKDTree

from wpdc_gwcs.exceptions import MatchError
from wpdc_gwcs.matching._mapping import SmoothMap
from wpdc_gwcs.matching._options import MatchOptions
from wpdc_gwcs.matching._orientations import HALF_STEP
from wpdc_gwcs.matching._pairs import find_nearest

__all__ = [
    "BLIND_SCALE",
    "MAX_CROWDING",
    "MIN_STARS",
    "Limits",
    "Problem",
    "Stars",
    "prepare_problem",
]

# Fewer stars than this in either list cannot be evidence.
MIN_STARS = 8
# Maximum number of stars expected by chance within a radius.
MAX_CROWDING = 0.25
# Largest displacement by distortion in the search, px, and as a fraction of the side of a small
# detector, where the limit in px would allow too much scale and rotation.
_MAX_DISTORTION = 250.0
_MAX_DISTORTION_SHARE = 0.12
# Largest error of the pointing in the search: px, and fraction of the longer side; the fraction in
# a blind search.
_MAX_SHIFT, _MAX_SHIFT_SHARE, _BLIND_SHIFT_SHARE = 450.0, 0.15, 0.3
# Minimum scale error allowed in a blind search: some headers have the scale of another binning.
BLIND_SCALE = 0.06


@dataclass(frozen=True, eq=False)
class Stars:
    """A list of stars: positions, tree, and the maximum radius at each star."""

    points: np.ndarray
    tree: cKDTree
    limit: np.ndarray

    @classmethod
    def build(cls, points):
        tree = cKDTree(points)
        return cls(points, tree, _crowding_limit(points, tree))


@dataclass(frozen=True)
class Limits:
    """How wrong the start may be."""

    max_shift: float
    max_rotation: float
    max_turn: float  # of patterns, in deg: larger in a blind search, which tries steps of rotation
    max_scale: float
    max_distortion: float
    half_diagonal: float

    @property
    def curvature(self):
        return 2 * self.max_distortion / self.half_diagonal**2

    @property
    def gradient(self):
        return 2 * self.max_distortion / self.half_diagonal

    def reach(self, distance):
        """Largest displacement at a distance from the center of the frame."""
        linear = np.deg2rad(self.max_rotation) + self.max_scale
        return (
            self.max_shift
            + linear * distance
            + self.max_distortion * (distance / self.half_diagonal) ** 2
        )


@dataclass(frozen=True, eq=False)
class Problem:
    """Two lists in one plane and the rules of their match.

    In a blind search, there is one problem for each `turn` of the reference stars about the center
    of the frame.  The sources stay on the frame, whose shape they fill.
    """

    sources: np.ndarray
    limit: np.ndarray  # largest meaningful radius at each source
    stars: Stars  # the reference
    source_rows: np.ndarray  # rows of the inputs
    reference_rows: np.ndarray
    n_duplicates: int
    flux: np.ndarray | None
    brightness: np.ndarray | None
    errors: np.ndarray | None
    shape: tuple
    frame: SmoothMap  # the identity on the frame: center and scale of all mappings
    limits: Limits
    options: MatchOptions
    turn: np.ndarray = field(default_factory=partial(np.eye, 2))

    def turned(self, turn):
        """Turn the reference stars about the center of the frame: an orthogonal matrix."""
        points = (self.stars.points - self.frame.center) @ turn.T + self.frame.center
        stars = Stars(points, cKDTree(points), self.stars.limit)
        return replace(self, stars=stars, turn=turn @ self.turn)

    def turned_back(self, points):
        """Return places among the turned reference stars as places in the original plane."""
        return (points - self.frame.center) @ self.turn + self.frame.center


def prepare_problem(
    xs, ys, xr, yr, *, image_shape, options, flux=None, mag=None, x_err=None, y_err=None
):
    """Check and clean the two lists: the first stage of `match_planes`, which has the parameters.

    Returns
    -------
    Problem
        The lists and the rules, ready for the stages that follow.
    """
    ny, nx = (int(n) for n in image_shape)
    if min(ny, nx) < 1:
        raise ValueError(f"image_shape must be two positive numbers (ny, nx); got {image_shape}")
    sources, rows_s, flux, duplicates_s = _prepare("xs", "ys", xs, ys, flux, "flux")
    brightness = None if mag is None else -np.asarray(mag, float)
    reference, rows_r, brightness, duplicates_r = _prepare("xr", "yr", xr, yr, brightness, "mag")
    errors = _combine_errors(x_err, y_err, len(np.atleast_1d(xs)))
    errors = None if errors is None else errors[rows_s]
    limits = _limits_of(options, (ny, nx))
    frame = SmoothMap.identity((ny, nx))
    outer = limits.half_diagonal + limits.reach(limits.half_diagonal)
    near = np.hypot(*(reference - frame.center).T) < outer
    reference, rows_r = reference[near], rows_r[near]
    brightness = None if brightness is None else brightness[near]
    for name, points in (
        ("sources", sources),
        ("reference stars in reach of the frame", reference),
    ):
        if len(points) < MIN_STARS:
            raise MatchError(
                f"too few {name} to match: {len(points)} with usable positions; "
                f"{MIN_STARS} are needed"
            )
    return Problem(
        sources=sources,
        limit=_crowding_limit(sources, cKDTree(sources)),
        stars=Stars.build(reference),
        source_rows=rows_s,
        reference_rows=rows_r,
        n_duplicates=duplicates_s + duplicates_r,
        flux=flux,
        brightness=brightness,
        errors=errors,
        shape=(ny, nx),
        frame=frame,
        limits=limits,
        options=options,
    )


def _limits_of(options, shape):
    longer = max(shape)
    max_shift, max_scale = options.max_shift, options.max_scale
    if options.blind:
        max_shift = max(_BLIND_SHIFT_SHARE * longer, max_shift or 0.0)
        max_scale = max(BLIND_SCALE, max_scale)
    elif max_shift is None:
        max_shift = max(_MAX_SHIFT, _MAX_SHIFT_SHARE * longer)
    max_distortion = options.max_distortion
    if max_distortion is None:
        max_distortion = min(_MAX_DISTORTION, _MAX_DISTORTION_SHARE * longer)
    half_diagonal = 0.5 * np.hypot(*shape)
    max_turn = max(options.max_rotation, HALF_STEP if options.blind else 0.0)
    return Limits(
        max_shift, options.max_rotation, max_turn, max_scale, max_distortion, half_diagonal
    )


def _prepare(name_x, name_y, x, y, brightness, name_brightness):
    """Finite, distinct positions with their rows; brightness only if it orders the stars."""
    x, y = np.asarray(x, float), np.asarray(y, float)
    if x.ndim != 1 or x.shape != y.shape:
        raise ValueError(
            f"{name_x} and {name_y} must be one-dimensional and of equal length; "
            f"got {x.shape}, {y.shape}"
        )
    rows = np.flatnonzero(np.isfinite(x) & np.isfinite(y))
    points = np.column_stack([x[rows], y[rows]])
    order = np.lexsort(points.T)
    again = np.zeros(len(rows), bool)
    again[order[1:]] = (np.diff(points[order], axis=0) == 0).all(axis=1)
    first = np.flatnonzero(~again)
    n_duplicates = len(rows) - len(first)
    points, rows = points[first], rows[first]
    if brightness is not None:
        brightness = np.asarray(brightness, float)
        if brightness.shape != x.shape:
            raise ValueError(
                f"{name_brightness} must have one value per star; "
                f"got {brightness.shape} for {x.shape}"
            )
        brightness = brightness[rows]
        known = np.isfinite(brightness)
        # With ties or gaps in more than half of the values, the order is useless.
        if known.sum() < 0.5 * len(rows) or len(np.unique(brightness[known])) < 0.5 * known.sum():
            brightness = None
        else:
            brightness = np.where(known, brightness, -np.inf)
    return points, rows, brightness, n_duplicates


def _combine_errors(x_err, y_err, n):
    """One error per star, or None."""
    given = [np.asarray(e, float) for e in (x_err, y_err) if e is not None]
    for e in given:
        if e.shape != (n,):
            raise ValueError(
                f"x_err and y_err must have one value per source; got {e.shape} for {n} sources"
            )
    if not given:
        return None
    errors = np.sqrt(np.mean(np.square(given), axis=0))
    good = np.isfinite(errors) & (errors > 0)
    if not good.any():
        return None
    return np.where(good, errors, np.max(errors[good]))


def _crowding_limit(points, tree):
    """Radius within which `MAX_CROWDING` stars are expected, by the sixth neighbor."""
    k = min(6, tree.n - 1)
    if k < 1:
        return np.full(tree.n, np.inf)
    distance = find_nearest(tree, points, [k + 1])[0][:, 0]
    return distance * np.sqrt(MAX_CROWDING / k)
