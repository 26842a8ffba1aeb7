"""Self-repeating fields: other shifts at which the same sources have partners."""

import numpy as np

__all__ = ["find_rival_offset"]

# Maximum number of offsets between sources and stars, and minimum number of paired sources.
_MOST_OFFSETS = 50_000
_FEWEST_SOURCES = 50
_MOST_SOURCES = 1000
# Widths of the boxes in which offsets are counted, in pairing radii.  The offsets of a repeated
# pattern may agree much better than the scatter of the mapping.
_BOX_WIDTHS = (2.0, 0.5, 0.125)
# Fraction of the paired sources that must have a partner at the rival offset, too.
_LEAST_SHARE = 0.5
_LEAST_COUNT = 5


def find_rival_offset(mapped, partner, tree, radius, *, center, max_offset):
    """Find the shift that brings most paired sources to other reference stars.

    Parameters
    ----------
    mapped : (N, 2) ndarray
        Mapped positions of the paired sources, px.
    partner : (N,) ndarray of int
        Row of the reference star of each source.
    tree : `~scipy.spatial.cKDTree`
        Tree of all reference stars.
    radius : float
        Pairing radius, px.
    center : (2,) ndarray
        Center of the search for other offsets, px.
    max_offset : float
        Range of the search, px.

    Returns
    -------
    (2,) ndarray or None
        The offset, px; `None` if no other offset fits half of the sources.

    Notes
    -----
    The offsets of all reference stars from all sources are counted in boxes, wide ones first.  The
    box with the most improbable count is the rival.
    """
    area = np.pi * max_offset**2
    rows = _spread(len(mapped), _FEWEST_SOURCES)
    about = tree.query_ball_point(mapped[rows] + center, max_offset, return_length=True).mean()
    rows = _spread(len(mapped), np.clip(_MOST_OFFSETS / max(about, 1), len(rows), _MOST_SOURCES))
    found = tree.query_ball_point(mapped[rows] + center, max_offset, return_sorted=False)
    owner = np.repeat(np.arange(len(rows)), [len(f) for f in found])
    star = np.concatenate([np.asarray(f, int) for f in found])
    offset = tree.data[star] - mapped[rows[owner]]
    other = (star != partner[rows[owner]]) & (np.hypot(*offset.T) > radius)
    offset = offset[other]
    density = len(offset) / area
    least = max(_LEAST_COUNT, _LEAST_SHARE * len(rows))
    best, best_score = None, 0.0
    low = np.asarray(center) - max_offset
    for width in np.multiply(_BOX_WIDTHS, radius):
        per_row = int(2 * max_offset / width) + 3
        expected = density * width**2
        promising = np.zeros(len(offset), bool)
        # Four staggered grids: an offset cannot be at the edge of a box on all of them.
        for edge in ((0.0, 0.0), (0.0, 0.5), (0.5, 0.0), (0.5, 0.5)):
            column, row = ((offset - low) / width + edge).astype(np.int64).T
            _, box, count = np.unique(
                row * per_row + column, return_inverse=True, return_counts=True
            )
            promising |= count[box] >= least
            score = count * (np.log(count / expected) - 1) if len(count) else np.zeros(1)
            if count.max(initial=0) >= least and score.max() > best_score:
                best_score = score.max()
                best = np.median(offset[box == np.argmax(score)], axis=0)
        offset = offset[promising]
    return best


def _spread(n, most):
    """Rows of a list, evenly spread."""
    return np.unique(np.linspace(0, n - 1, min(n, int(most))).astype(int))
