"""Numbers that describe a match."""

from dataclasses import dataclass, field

from wpdc_gwcs.frozen import freeze_attributes
from wpdc_gwcs.matching._mapping import SmoothMap

__all__ = ["MatchDiagnostics"]


@dataclass(frozen=True, eq=False)
class MatchDiagnostics:
    """The result of a match and its evidence.

    Parameters
    ----------
    n_sources, n_reference : int
        Usable sources, and usable reference stars that fall on the frame.
    n_pairs : int
        Number of pairs.
    expected_by_chance : float
        Pairs expected by chance at the final radius, counted at shifted positions.
    purity : float
        Estimated fraction of correct pairs.
    completeness : float
        Pairs per star of the list that has fewer on the frame.
    significance : float
        Significance of the pairs above chance, sigma.
    n_ambiguous : int
        Sources left out because there were two candidates within the tolerance.
    n_duplicates : int
        Rows of either list left out because an earlier row has the same position.
    scatter : float
        Robust 1-sigma scatter of the pairs about the smooth mapping per axis, px.
    radius : float
        Median pairing radius, px.
    mapping : SmoothMap
        The smooth mapping from starting to reference pixels; `match_planes` can start from it.
    shift : (float, float)
        Displacement of the center of the frame, px.
    rotation, scale : float
        Rotation in deg and scale of the header at the center of the frame, from `mapping`.
    parity : int
        -1 if the frame is mirrored, else 1.
    areas : tuple of AreaEvidence
        Evidence in the parts of the frame.
    timings : dict
        Seconds spent in each stage.
    search_significance : float
        Significance that takes into account all mappings that the search could have found, with a
        lower limit; NaN if there are too many stars for this to matter.

    Examples
    --------
    >>> import numpy as np
    >>> from wpdc_gwcs.matching import match_planes
    >>> x, y = np.random.default_rng(1).uniform(0, 1000, (2, 200))
    >>> i, j, found = match_planes(x, y, x + 15, y - 8, image_shape=(1000, 1000))
    >>> found.n_pairs, [round(v, 6) for v in found.shift], found.purity
    (200, [15.0, -8.0], 1.0)
    >>> found.to_dict()["parity"]
    1
    """

    n_sources: int
    n_reference: int
    n_pairs: int
    expected_by_chance: float
    purity: float
    completeness: float
    significance: float
    n_ambiguous: int
    n_duplicates: int
    scatter: float
    radius: float
    mapping: SmoothMap
    shift: tuple
    rotation: float
    scale: float
    parity: int
    areas: tuple
    timings: dict = field(default_factory=dict)
    search_significance: float = float("nan")

    def __post_init__(self):
        freeze_attributes(self, "areas", "timings")

    def to_dict(self):
        """Return plain numbers for tables and files: no mapping, and a summary of the areas."""
        judged = [a for a in self.areas if a.judged]
        plain = {
            name: getattr(self, name)
            for name in self.__dataclass_fields__
            if name not in ("mapping", "areas", "timings", "shift")
        }
        plain["shift_x"], plain["shift_y"] = self.shift
        plain["n_areas"] = len(judged)
        plain["lowest_area_completeness"] = min(
            (a.n_pairs / a.expected for a in judged), default=float("nan")
        )
        plain["seconds"] = sum(self.timings.values())
        return plain
