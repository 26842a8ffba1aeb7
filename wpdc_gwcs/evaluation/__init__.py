"""Residuals of calibrated frames: statistics, maps, drift of a stored table."""

from wpdc_gwcs.evaluation.drift import Drift, detect_drift
from wpdc_gwcs.evaluation.residuals import (
    ResidualStatistics,
    binned_residuals,
    d80,
    evaluate,
    robust_scatter,
)

__all__ = [
    "Drift",
    "ResidualStatistics",
    "binned_residuals",
    "d80",
    "detect_drift",
    "evaluate",
    "robust_scatter",
]
