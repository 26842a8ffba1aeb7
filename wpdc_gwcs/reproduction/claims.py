"""The numbers of the paper and where they appear in it."""

from dataclasses import dataclass

__all__ = ["CLAIMS", "DETECTORS", "Claim"]


@dataclass(frozen=True)
class Claim:
    """A number of the paper.

    Parameters
    ----------
    part : str
        Part of the reproduction.
    item : str
        A detector, a weight, or "all".
    quantity, unit : str
        Quantity and its unit.
    value : float
        The number.
    source : str
        Table, figure or section.

    Examples
    --------
    >>> from wpdc_gwcs.reproduction import CLAIMS
    >>> [claim.value for claim in CLAIMS if claim.part == "weights"]
    [0.6]
    >>> CLAIMS[-1].item, CLAIMS[-1].quantity, CLAIMS[-1].unit, CLAIMS[-1].source
    ('scamp', 'sigma_delta', 'mas', 'figure 10, section 4.2')
    """

    part: str
    item: str
    quantity: str
    unit: str
    value: float
    source: str


# Table 2: means and standard deviations of dx and dy after 3-sigma clipping, px.
_TABLE_2 = {
    "y-1": (-0.001, 0.023, 0.004, 0.034),
    "y-2": (0.006, 0.034, -0.005, 0.047),
    "y-3": (-0.006, 0.047, -0.005, 0.051),
    "y-4": (-0.006, 0.018, 0.004, 0.026),
    "NUV-1": (0.005, 0.013, 0.003, 0.021),
    "NUV-2": (0.003, 0.032, -0.001, 0.044),
    "NUV-3": (-0.004, 0.029, -0.006, 0.031),
    "NUV-4": (-0.010, 0.034, 0.007, 0.085),
    "u-1": (-0.009, 0.022, -0.001, 0.061),
    "u-2": (0.005, 0.028, -0.003, 0.038),
    "g-1": (-0.004, 0.029, -0.005, 0.025),
    "g-2": (-0.018, 0.049, 0.004, 0.107),
    "r-1": (-0.002, 0.023, -0.001, 0.053),
    "r-2": (-0.008, 0.055, 0.016, 0.052),
    "i-1": (0.003, 0.029, 0.001, 0.020),
    "i-2": (-0.013, 0.038, 0.002, 0.035),
    "z-1": (0.002, 0.018, 0.002, 0.026),
    "z-2": (-0.004, 0.033, 0.005, 0.022),
}
_MOMENTS = ("mean_dx", "sigma_dx", "mean_dy", "sigma_dy")
# In the order of the paper's table.
DETECTORS = tuple(_TABLE_2)

_OTHERS = (
    ("detectors", "all", "largest_distortion", "pix", 200.0, "figure 1, section 2"),
    ("detectors", "g-1", "share_below_0p01", "", 0.90, "section 3.3"),
    ("detectors", "g-1", "share_of_cells_below_0p01", "", 0.90, "section 3.3, figure 6"),
    ("detectors", "g-1", "table_dx_first", "pix", 5.157, "table 1"),
    ("detectors", "g-1", "table_dy_first", "pix", 2.848, "table 1"),
    ("detectors", "g-1", "table_dx_last", "pix", 0.884, "table 1"),
    ("detectors", "g-1", "table_dy_last", "pix", -1.053, "table 1"),
    ("weights", "w1", "share_within_0p1", "", 0.60, "figure 4, section 3.2"),
    ("centroids", "g < 20", "sigma_dx", "pix", 0.02, "figure 2, section 3.1"),
    ("centroids", "g < 20", "sigma_dy", "pix", 0.02, "figure 2, section 3.1"),
    ("centroids", "g = 25", "sigma_dx", "pix", 0.07, "figure 2, section 3.1"),
    ("centroids", "g = 25", "sigma_dy", "pix", 0.07, "figure 2, section 3.1"),
    ("cluster", "g-1", "mean_dx", "pix", -0.016, "figure 8, section 4.1"),
    ("cluster", "g-1", "sigma_dx", "pix", 0.051, "figure 8, section 4.1"),
    ("cluster", "g-1", "mean_dy", "pix", 0.029, "figure 8, section 4.1"),
    ("cluster", "g-1", "sigma_dy", "pix", 0.053, "figure 8, section 4.1"),
    ("cluster", "g = 19", "sigma_total", "pix", 0.048, "figure 9, section 4.1"),
    ("cluster", "g = 23.75", "sigma_total", "pix", 0.089, "figure 9, section 4.1"),
    ("bass", "all", "mean_alpha", "mas", -0.016, "figure 10, section 4.2"),
    ("bass", "all", "sigma_alpha", "mas", 5.494, "figure 10, section 4.2"),
    ("bass", "all", "mean_delta", "mas", 0.163, "figure 10, section 4.2"),
    ("bass", "all", "sigma_delta", "mas", 9.981, "figure 10, section 4.2"),
    ("bass", "scamp", "mean_alpha", "mas", -11.669, "figure 10, section 4.2"),
    ("bass", "scamp", "sigma_alpha", "mas", 24.596, "figure 10, section 4.2"),
    ("bass", "scamp", "mean_delta", "mas", -44.489, "figure 10, section 4.2"),
    ("bass", "scamp", "sigma_delta", "mas", 29.320, "figure 10, section 4.2"),
)
#: All numbers, in the order of the paper.
CLAIMS = tuple(
    Claim("detectors", detector, quantity, "pix", value, "table 2")
    for detector, values in _TABLE_2.items()
    for quantity, value in zip(_MOMENTS, values, strict=True)
) + tuple(Claim(*one) for one in _OTHERS)
