"""Matching (DiGStar): which source is which reference star, with evidence.

::

    sources, reference --prepare--> clean lists --density ratio--> sizes of neighborhoods
        --patterns--> hypotheses --coherence--> groups --grow--> smooth mapping + pairs
        --final radius--> one-to-one pairs --evidence--> accepted, or MatchError

The stages:

1. **Preparation.**  Sources that are faint, flagged or not round are not used.  Reference stars are
   kept if they are within reach of the frame.  If both lists have magnitudes, the 500 brightest
   sources are tried first, then 2000, cut to about the depth of the shallower list, then all.
   Otherwise all are used at once.
2. **Density ratio.**  The number of sources is divided by the number of reference stars on a grid
   over the frame.  In the list with more stars, correspondingly more neighbors are used: 8
   neighbors in the sparser list correspond to 8 times the ratio in the other one.
3. **Patterns.**  Some sources spread over the frame are anchors (16, then 49, then 196 with more
   neighbors).  The neighbors of each anchor are described by (log d, theta), with distances in
   units of the local scale.  The same is done for every reference star that the anchor may be.  A
   rotation and a scale common to the neighborhood shift the whole pattern in that plane.  So the
   shift at which most neighbors coincide gives the local rotation and scale.  The number of
   coincidences is compared with the number expected by chance.  Three box widths are tried, and
   the most improbable count is used (adaptive threshold).  The second-best candidates, which must
   be wrong, show which counts occur by chance.
4. **Coherence.**  Hypotheses are grouped if they agree: the rotation and scale of one predicts the
   position of the other, within the curvature that a distortion may have.  The group with most
   support is tried first.
5. **Growth.**  The stars of the group and their neighbors are the first pairs.  A polynomial is
   fitted to them.  Its order is chosen by leave-one-out errors, and outliers are clipped by their
   median absolute deviation.  Then all sources are paired again within a radius of five times the
   error of the prediction.  This error is large where there are no pairs yet, so the mapping grows
   from the known part of the frame to the rest.  The order grows with it until the pairs stop
   changing; lower orders are tried if it gets stuck.  Then the same is done with all stars of both
   lists, without clipping, and with a larger radius where stars are sparse, so that the mapping
   follows steep distortion into the corners.  The common part of the residuals of neighboring
   pairs (a moving local plane) is subtracted if this lowers the scatter of left-out pairs.
6. **Pairs.**  The final radius follows from the scatter and the error of each star.  A pair is
   accepted only if neither side has a second candidate within the radius.
7. **Evidence.**  The sources are shifted against the reference stars by many radii and paired
   again, which gives the number of pairs by chance.  The number of pairs, minus one for each term
   of the polynomial, must exceed it with a given significance in the whole frame.  It must also do
   so in every part of the frame with enough stars (overlapping circles with about 16 pairs each),
   where it must not be far below that of the better parts of the frame.  For a short list, the
   mappings that the search could have found are counted instead, together with the order of
   brightness.  If a group fails, the next one is tried.  If all fail,
   `~wpdc_gwcs.exceptions.MatchError` says what was missing.

If the position of a frame is known to within a few star distances (from the other detectors of a
camera), `match_nearby` needs no patterns and only as many stars as can prove the match.

A blind search does all this for sixteen orientations, the mirrored ones included, and with wider
limits for pointing and scale.  Patterns are compared over all rotations in between, so any rotation
is found, and accepted if the pairs prove it by their number.
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
