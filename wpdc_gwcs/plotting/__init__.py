"""Figures of residuals, distortion, look-up tables and weights.

There are two kinds of functions.  Neither uses ``pyplot``, so nothing is shown and no global state
changes.  Functions for one frame return a new `matplotlib.figure.Figure`, which
``figure.savefig(path)`` writes.  Functions for a detector or a whole camera, like the figures of
the paper, draw into the given ``axes`` or into new ones, and return them; ``axes.figure`` is the
figure.

=============================  =====================================================================
of a frame                     shows
=============================  =====================================================================
`plot_residual_arrows`         mean residuals as arrows
`plot_residual_maps`           mean residuals and numbers of stars as maps
`plot_residuals_vs_position`   residuals against x and y
`plot_residuals_vs_magnitude`  residuals and their scatter against magnitude
`plot_cdf`                     cumulative distributions
`plot_lookup_table`            a look-up table
=============================  =====================================================================

=============================  =====================================================================
of a detector or a camera      shows
=============================  =====================================================================
`plot_focal_plane`             the distortion of all detectors in the focal plane
`plot_before_after`            residuals before and after the calibration, with their profiles
`plot_slices`                  mean residuals in slices of the detector, for several solutions
`plot_weights`                 distributions with each of the radial weights
`plot_magnitude`               residuals against magnitude, pooled
`plot_centroids`               centroid errors against magnitude, and the photon limit
`plot_sky_offsets`             offsets on the sky with histograms and Gaussian fits
`plot_drift_history`           residuals and drift of a detector over time
`plot_cell_history`            the same, cell by cell
=============================  =====================================================================
"""

from wpdc_gwcs.plotting.before_after import plot_before_after
from wpdc_gwcs.plotting.focal_plane import plot_focal_plane
from wpdc_gwcs.plotting.history import plot_cell_history, plot_drift_history
from wpdc_gwcs.plotting.magnitudes import (
    plot_centroids,
    plot_magnitude,
    plot_residuals_vs_magnitude,
)
from wpdc_gwcs.plotting.maps import plot_lookup_table
from wpdc_gwcs.plotting.residuals import (
    plot_cdf,
    plot_residual_arrows,
    plot_residual_maps,
    plot_residuals_vs_position,
)
from wpdc_gwcs.plotting.sky import plot_sky_offsets
from wpdc_gwcs.plotting.slices import plot_slices
from wpdc_gwcs.plotting.weights import plot_weights

__all__ = [
    "plot_before_after",
    "plot_cell_history",
    "plot_cdf",
    "plot_centroids",
    "plot_drift_history",
    "plot_focal_plane",
    "plot_lookup_table",
    "plot_magnitude",
    "plot_residual_arrows",
    "plot_residual_maps",
    "plot_residuals_vs_magnitude",
    "plot_residuals_vs_position",
    "plot_sky_offsets",
    "plot_slices",
    "plot_weights",
]
