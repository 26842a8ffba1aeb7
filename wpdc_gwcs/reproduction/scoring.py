"""Results of a reproduction compared with the truth of its simulation."""

import numpy as np

from wpdc_gwcs.evaluation import score_frame

__all__ = ["CLOSE_PX", "score_run", "sky_error"]

#: Limit of the paper for the area with a good solution, px.
CLOSE_PX = 0.01
_MAS = 3.6e6  # per deg


def score_run(simulation, run, *, images=False):
    """Score the frames of a run.

    Parameters
    ----------
    simulation : Simulation
        Simulation of the frames.
    run : CalibrationRun
        Their calibration.
    images : bool, optional
        Whether sources were measured on images instead of taken from lists.

    Returns
    -------
    list of TruthScore
        One for each solved frame.
    """
    truths = {exposure.name: exposure for exposure in simulation.exposures}
    scores = []
    for calibration in run.calibrations:
        stars = truths[calibration.frame].observe()[1]
        stars.rename_column("reference_index", "catalog_index")
        if images:
            stars.remove_column("source_index")
        scores.append(score_frame(calibration, truths[calibration.frame], stars, limit=CLOSE_PX))
    return scores


def sky_error(solved):
    """Return the WCS error along east and north, over all frames and detectors.

    Parameters
    ----------
    solved : sequence of (FrameTruth, callable)
        Truth of each frame, and its WCS as for `FrameTruth.wcs_error`.

    Returns
    -------
    alpha, delta : float
        Root mean squares, mas.
    """
    errors = [truth.linear_wcs.wcs.cd @ truth.wcs_error(wcs)[2:] * _MAS for truth, wcs in solved]
    return tuple(float(v) for v in np.sqrt(np.mean(np.concatenate(errors, axis=1) ** 2, axis=1)))
