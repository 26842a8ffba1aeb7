"""Options of a match."""

from dataclasses import dataclass

from wpdc_gwcs.matching._mapping import MAX_ORDER

__all__ = ["MatchOptions"]


@dataclass(frozen=True)
class MatchOptions:
    """Range of the search for a match, and the evidence needed.

    Parameters
    ----------
    blind : bool
        Also search mirrored frames, all rotations, scales off by up to 6 % and pointings off by up
        to 0.3 of the frame.
    max_shift : float, optional
        Largest error of the pointing, px; default 0.15 of the longer side, at least 450 px.
    max_rotation : float
        Largest error of the rotation at the center of the frame, deg.  A blind search accepts any
        rotation, unless the stars are so few that mappings are counted: then it is the largest
        difference from a multiple of 45 deg.
    max_scale : float
        Largest relative error of the scale at the center of the frame.
    max_distortion : float, optional
        Largest displacement by distortion on the frame, px; default 250, and at most 0.12 of the
        longer side.
    max_order : int
        Highest order of the smooth mapping.
    min_significance : float
        Minimum significance of the pairs over chance, sigma; 0.58 times this is enough if there are
        so few stars that all possible mappings are counted.
    min_purity : float
        Minimum fraction of correct pairs.

    Raises
    ------
    ValueError
        If a value is out of its range.

    Examples
    --------
    >>> import numpy as np
    >>> from wpdc_gwcs.matching import MatchOptions, match_planes
    >>> MatchOptions().max_rotation
    3.0
    >>> x, y = np.random.default_rng(1).uniform(0, 1000, (2, 200))
    >>> i, j, found = match_planes(x, y, 1000 - x, y, image_shape=(1000, 1000), blind=True)
    >>> found.n_pairs, found.parity  # mirrored
    (200, -1)
    """

    blind: bool = False
    max_shift: float | None = None
    max_rotation: float = 3.0
    max_scale: float = 0.03
    max_distortion: float | None = None
    max_order: int = MAX_ORDER
    # A probability of 3e-18: nine orders of magnitude remain for the choices of the search.
    min_significance: float = 9.0
    # A fit with clipping tolerates one wrong pair in ten.
    min_purity: float = 0.9

    def __post_init__(self):
        for name in ("max_shift", "max_rotation", "max_scale", "max_distortion"):
            value = getattr(self, name)
            if value is not None and not value >= 0:
                raise ValueError(f"{name} must be 0 or more, got {value}")
        if not 1 <= self.max_order <= MAX_ORDER or self.max_order != int(self.max_order):
            raise ValueError(f"max_order must be 1 to {MAX_ORDER}, got {self.max_order}")
        if not 0 <= self.min_purity <= 1:
            raise ValueError(f"min_purity must be between 0 and 1, got {self.min_purity}")
