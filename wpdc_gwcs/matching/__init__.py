"""Matching (DiGStar): which source is which reference star, with evidence.

::

    sources, reference --prepare--> clean lists --density ratio--> sizes of neighborhoods
        --patterns--> hypotheses --coherence--> groups --grow--> smooth mapping + pairs
        --final radius--> one-to-one pairs --evidence--> accepted, or MatchError

The stages, in plain words:

1. **Preparation.**  Sources that are not round, faint or flagged take no part; reference stars are
   kept within reach of the frame.  Where both lists have a brightness, the 500 brightest sources
   are tried first, then 2000, cut to about the depth of the shallower list, then all; otherwise
   all at once.
2. **Density ratio.**  On a grid over the frame the number of sources is divided by the number of
   reference stars.  The list with more stars must look at that many more neighbors: 8 in the
   sparser list stand for 8 times the ratio in the other one.
3. **Patterns.**  Around each of some sources spread over the frame (anchors: 16, then 49, then 196
   with more neighbors) the neighbors are noted as (log d, theta), distances in units of the local
   scale, and the same around every reference star that the anchor may be.  A
   rotation and a scale common to the neighborhood shift the whole pattern in that plane, so the
   shift at which most neighbors coincide gives the local rotation and scale, and the number of
   coincidences, against the number that the data give by chance, says how surprising it is.  Three
   box widths are tried, and the most surprising one counts (adaptive threshold).  The second-best
   candidates, wrong by necessity, show how surprising chance can be.
4. **Coherence.**  Hypotheses that tell one story - the rotation and scale of one predicts where the
   star of the other is, up to what the curvature of the distortion may add - form groups.  The
   group with most support is tried first.
5. **Growth.**  The group's stars and neighbors are the first pairs.  A polynomial is fitted to
   them, its order chosen by leave-one-out errors, outliers clipped by their median absolute
   deviation; then all sources are paired again within a radius that is five times the error of the
   prediction.  That error is large where there are no pairs yet, so the mapping grows from where it
   is known to where it is not, and the order grows with it, until the pairs stop changing; lower
   orders are tried when it is stuck.  Then the same with all stars of both lists, without clipping
   and, where stars are sparse, with a wider radius, so that the mapping follows steep distortion
   into the corners; what neighboring pairs have in common (a moving local plane) is taken off
   where that lowers the scatter of pairs left out.
6. **Pairs.**  The final radius follows the scatter and the error of each star.  A pair is delivered
   only if neither side has a second candidate within the radius.
7. **Evidence.**  The sources are shifted against the reference by many radii and paired again: that
   is what chance gives.  The pairs, less one for each term of the polynomial, must exceed it by a
   stated significance in the frame, and in every part of the frame with enough stars (overlapping
   circles that hold some 16 pairs each), where they must not be far fewer than the better parts of
   the frame promise either.  Of a short list the mappings that the search could have found are
   counted instead, and the order of brightness with them.  If a group fails, the next is tried;
   if all fail, `~wpdc_gwcs.exceptions.MatchError` says what was missing.

Where the place of a frame is known to within a few star distances (from the other detectors of a
camera), `match_nearby` needs no patterns and is content with as few stars as can prove anything.

A blind search does all this for the eight ways to read the axes of the frame, with wider limits for
pointing and scale.
"""

from wpdc_gwcs.matching._again import pair_again
from wpdc_gwcs.matching._core import match_planes
from wpdc_gwcs.matching._diagnostics import MatchDiagnostics
from wpdc_gwcs.matching._evidence import AreaEvidence
from wpdc_gwcs.matching._high_level import match_sources, pair_table
from wpdc_gwcs.matching._mapping import SmoothMap
from wpdc_gwcs.matching._nearby import match_nearby
from wpdc_gwcs.matching._options import MatchOptions
from wpdc_gwcs.matching._pairs import pair_nearest
from wpdc_gwcs.selection import select_sources

__all__ = [
    "AreaEvidence",
    "MatchDiagnostics",
    "MatchOptions",
    "SmoothMap",
    "match_nearby",
    "match_planes",
    "match_sources",
    "pair_again",
    "pair_nearest",
    "pair_table",
    "select_sources",
]
