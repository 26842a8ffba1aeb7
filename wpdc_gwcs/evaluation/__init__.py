"""Residuals of frames, detectors and runs; radial weights; drift; comparison with a truth."""

from wpdc_gwcs.evaluation.attitude import has_map_of, residuals_of_attitude
from wpdc_gwcs.evaluation.cuts import Cuts
from wpdc_gwcs.evaluation.drift import Drift, detect_drift
from wpdc_gwcs.evaluation.history import (
    DriftHistory,
    split_periods,
    track_drift,
)
from wpdc_gwcs.evaluation.pooled import (
    DetectorResiduals,
    format_table,
    pool_residuals,
    tabulate_detectors,
)
from wpdc_gwcs.evaluation.residuals import (
    ResidualStatistics,
    binned_residuals,
    d80,
    evaluate,
    running_statistics,
)
from wpdc_gwcs.evaluation.truth import TruthScore, pool_scores, score_frame, tabulate_scores
from wpdc_gwcs.evaluation.uncorrected import uncorrected_residuals
from wpdc_gwcs.evaluation.weights import WeightResult, compare_weights, tabulate_weights
from wpdc_gwcs.robust import robust_scatter

__all__ = [
    "Cuts",
    "DetectorResiduals",
    "Drift",
    "DriftHistory",
    "ResidualStatistics",
    "TruthScore",
    "WeightResult",
    "binned_residuals",
    "compare_weights",
    "d80",
    "detect_drift",
    "evaluate",
    "format_table",
    "has_map_of",
    "pool_residuals",
    "pool_scores",
    "residuals_of_attitude",
    "robust_scatter",
    "running_statistics",
    "score_frame",
    "split_periods",
    "tabulate_detectors",
    "tabulate_scores",
    "tabulate_weights",
    "track_drift",
    "uncorrected_residuals",
]
