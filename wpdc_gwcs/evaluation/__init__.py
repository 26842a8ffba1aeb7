"""Residuals: statistics, maps, the radial weights side by side, drift of a stored table."""

from wpdc_gwcs.evaluation.drift import Drift, detect_drift
from wpdc_gwcs.evaluation.residuals import (
    ResidualStatistics,
    binned_residuals,
    d80,
    evaluate,
    running_statistics,
)
from wpdc_gwcs.evaluation.uncorrected import uncorrected_residuals
from wpdc_gwcs.evaluation.weights import WeightResult, compare_weights, tabulate_weights
from wpdc_gwcs.robust import robust_scatter

__all__ = [
    "Drift",
    "ResidualStatistics",
    "WeightResult",
    "binned_residuals",
    "compare_weights",
    "d80",
    "detect_drift",
    "evaluate",
    "robust_scatter",
    "running_statistics",
    "tabulate_weights",
    "uncorrected_residuals",
]
