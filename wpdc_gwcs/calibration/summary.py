"""The summary of a run: one row per frame, solved or not."""

from dataclasses import replace

import numpy as np
from astropy.table import QTable

from wpdc_gwcs.calibration.measure import quality_of
from wpdc_gwcs.calibration.start import detector_center, sky_of
from wpdc_gwcs.models import project

__all__ = ["header_error", "summarize", "summary_row"]

_UNITS = {
    "rms_mas": "mas", "seconds": "s", "fwhm": "pix", "epoch": "yr",
    "header_offset": "pix", "header_rotation": "deg",
}  # fmt: skip


def summary_row(frame, result, calibration, failure, settings):
    """Build the row of a frame.

    Parameters
    ----------
    frame : Frame
        The frame.
    result : MatchedFrame or FailedFrame
        Match of the frame.
    calibration : Calibration or None
        Result of the frame.
    failure : WPDCError or None
        Reason of a failure.
    settings : Settings
        Settings, with the criteria for sources.

    Returns
    -------
    dict
        Values by column.
    """
    statistics = {} if calibration is None else calibration.statistics
    row = {
        "frame": frame.name,
        "detector": frame.detector,
        "camera": frame.camera or "",
        "exposure": frame.exposure or "",
        "status": "failed" if calibration is None else statistics["status"],
        "reason": " ".join(str(failure).split())
        if calibration is None
        else "; ".join(statistics["reasons"]),
        "n_sources": result.n_sources,
        "n_matched": statistics.get("n_matched", 0),
    }
    # A frame may be matched with good evidence and fail afterwards.
    evidence = getattr(result, "diagnostics", None)
    for name in ("n_pairs", "n_ambiguous"):
        row[name] = getattr(evidence, name, 0)
    for name in ("expected_by_chance", "purity", "completeness", "significance"):
        row[name] = getattr(evidence, name, np.nan)
    inside, outside = (statistics.get(key, {}) for key in ("residuals", "holdout"))
    for name in ("mean_dx", "sigma_dx", "mean_dy", "sigma_dy"):
        row[name] = inside.get(name, np.nan)
    for name in ("sigma_dx", "sigma_dy"):
        row[f"holdout_{name}"] = outside.get(name, np.nan)
    row["rms_mas"] = statistics.get("rms_mas", np.nan)
    row["seconds"] = statistics.get("seconds", result.seconds)
    epoch = np.nan if frame.epoch is None else float(frame.epoch)
    counts = getattr(result, "left_out", None)
    row |= quality_of(frame, result.sources, settings, counts=counts) | {"epoch": epoch}
    offset, rotation = np.nan, np.nan
    if calibration is not None:
        # A copy, because a calibration keeps the WCS that it makes, which is larger than the rest.
        offset, rotation = header_error(frame.wcs, replace(calibration))
    return row | {"header_offset": offset, "header_rotation": rotation}


def header_error(wcs, calibration):
    """Measure how far the WCS of a header is off.

    Parameters
    ----------
    wcs : object
        WCS of the header, with ``pixel_to_world_values``.
    calibration : Calibration
        Calibration of the frame.

    Returns
    -------
    offset : float
        Distance at the center of the detector, px.
    rotation : float
        Degrees, counterclockwise in pixels from the calibration to the header.
    """
    shape = calibration.solution.image_shape
    # The center, and points around it that tell the rotation of the whole detector.
    quarter = np.array(shape[::-1]) / 4
    step = np.array([[0, 1, -1, 0, 0], [0, 0, 0, 1, -1]]) * quarter[:, None]
    x, y = detector_center(shape)[:, None] + step
    true = calibration.wcs(x, y)
    center = [c[0] for c in true]
    there, here = (np.array(project(*sky, center)) for sky in (sky_of(wcs, x, y), true))
    shift = np.linalg.solve(calibration.cd, there[:, 0] - here[:, 0])
    axes = [plane[:, [1, 3]] - plane[:, [2, 4]] for plane in (here, there)]
    turn = np.linalg.solve(*axes)
    # In px of equal size along both axes.
    turn = np.diag(quarter) @ turn @ np.diag(1 / quarter)
    rotation = np.degrees(np.arctan2(turn[1, 0] - turn[0, 1], turn[0, 0] + turn[1, 1]))
    return float(np.hypot(*shift)), float(rotation)


def summarize(rows, run_id):
    """Build a table from rows.

    Parameters
    ----------
    rows : list of dict
        Rows as from `summary_row`; at least one.
    run_id : str
        Identity of the run, for the metadata.

    Returns
    -------
    `~astropy.table.QTable`
        Table with units.
    """
    table = QTable(rows, meta={"run": run_id})
    for name in table.colnames:
        if "_d" in name:
            table[name].unit = "pix"
        elif name in _UNITS:
            table[name].unit = _UNITS[name]
    return table
