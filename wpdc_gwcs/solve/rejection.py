"""Exposures that are left out because of wrong pairs."""

import logging
from dataclasses import replace

import numpy as np

from wpdc_gwcs.exceptions import FitError
from wpdc_gwcs.solve.errors import worse_scatter
from wpdc_gwcs.solve.state import all_residuals
from wpdc_gwcs.solve.stored import StoredMap

__all__ = ["without_aliens", "without_wrong"]

log = logging.getLogger(__name__)

# Scatter that no model leaves for correct pairs, px.
_MAX_SCATTER = 2.0

# An exposure with this many times the scatter of the others has wrong pairs.
_REJECT_RATIO = 4.0

# Before a solution, distortion increases the residuals, but not beyond this ratio to those of other
# frames, and not beyond this many px.  Frames with fewer pairs than a linear map needs are not
# tested.
_ALIEN_RATIO, _ALIEN_SCATTER, _LINEAR_TERMS = 10.0, 50.0, 6


def without_aliens(o, state):
    """Leave out frames whose pairs no linear map can reconcile with those of other frames.

    Such a frame would spoil the polynomial for all.

    Parameters
    ----------
    o : Observations
        All stars.
    state : State
        State before a solution.

    Returns
    -------
    State
        State with the reasons for the frames that were left out.

    Raises
    ------
    FitError
        If no frame is left.
    """
    residual = all_residuals(o, state)
    reasons, scatter = list(state.reason), {}
    for f in state.active:
        s = o.slices[f]
        r = residual[:, s][:, o.valid[s]]
        seen = np.isfinite(r).all(0)
        if not seen.size:
            reasons[f] = "none of its pairs can be used"
        elif not seen.mean() > 0.5:
            reasons[f] = "its stars are not where it points: wrong pairs"
        elif seen.sum() > _LINEAR_TERMS:
            x, y = o.x[s][o.valid[s]][seen], o.y[s][o.valid[s]][seen]
            rows = np.stack([np.ones_like(x), x, y], axis=1)
            left = r[:, seen].T - rows @ np.linalg.lstsq(rows, r[:, seen].T, rcond=None)[0]
            scatter[f] = worse_scatter(left.T)
    typical = np.median(list(scatter.values())) if scatter else 0.0
    for f, value in scatter.items():
        if len(scatter) > 2 and value > max(_ALIEN_RATIO * typical, _ALIEN_SCATTER):
            reasons[f] = (
                f"its residuals scatter by {value:.3g} px, those of the others by "
                f"{typical:.3g} px: {_causes(o, state, f)}"
            )
    return _left_out(o, state, reasons)


def without_wrong(o, state):
    """Leave out frames with the scatter of wrong pairs.

    Parameters
    ----------
    o : Observations
        All stars.
    state : State
        State with all terms solved.

    Returns
    -------
    State
        State with the reasons for the frames that were left out.

    Raises
    ------
    FitError
        If no frame is left.
    """
    residual = all_residuals(o, state)
    scatter = {}
    for f in state.active:
        valid = o.valid[o.slices[f]]
        if valid.any():
            scatter[f] = worse_scatter(residual[:, o.slices[f]][:, valid])
    reasons = list(state.reason)
    typical = np.median(list(scatter.values()))
    for f in state.active:
        if f not in scatter:
            reasons[f] = "none of its pairs can be used"
        elif scatter[f] > _MAX_SCATTER:
            reasons[f] = f"its residuals scatter by {scatter[f]:.3g} px: {_causes(o, state, f)}"
        elif len(scatter) > 2 and scatter[f] > max(_REJECT_RATIO * typical, 0.1):
            reasons[f] = (
                f"its residuals scatter by {scatter[f]:.3g} px, those of the others by "
                f"{typical:.3g} px: {_causes(o, state, f)}"
            )
    return _left_out(o, state, reasons)


def _causes(o, state, f):
    """Name what may make the residuals of a frame large."""
    if isinstance(state.model.tables[o.detector_of[f]], StoredMap):
        return "wrong pairs, bad positions, or a stored solution that is not valid"
    return "wrong pairs or bad positions"


def _left_out(o, state, reasons):
    kept = state.kept.copy()
    for f, reason in enumerate(reasons):
        if reason is not None and state.reason[f] is None:
            log.warning("exposure %s left out: %s", o.frames[f].name, reason)
            kept[o.slices[f]] = False
    if all(reasons):
        own = {frame.name: r for frame, r in zip(o.frames, reasons)}
        listed = "; ".join(f"{name}: {r}" for name, r in own.items())
        raise FitError(
            f"exposure {listed}"
            if len(own) == 1
            else f"all {len(own)} exposures were left out: {listed}",
            reasons=own,
        )
    return replace(state, kept=kept, reason=tuple(reasons))
