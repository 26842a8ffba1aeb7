"""Results in words: lines of a label and a text, for terminals and notebooks."""

from html import escape

import numpy as np

from wpdc_gwcs.counts import counted
from wpdc_gwcs.detector import UNNAMED

__all__ = ["Described", "as_html", "as_text", "describe"]

# Frames of a run that are named.
_MOST_FRAMES = 50

# Width of the labels, if all are this short.
_LABEL = 11


def describe(result):
    """Describe a result.

    Parameters
    ----------
    result : Calibration, DistortionSolution, Camera or CalibrationRun
        The result.

    Returns
    -------
    list of (str, str)
        Labels and texts.

    Raises
    ------
    TypeError
        If it is of another type.

    Examples
    --------
    >>> from wpdc_gwcs import calibrate, simulate
    >>> from wpdc_gwcs.description import describe
    >>> sky = simulate(1, image_shape=(512, 512), density=60.0, distortion=5.0)
    >>> run = calibrate(sky.exposures[0].frame(), sky.reference)
    >>> describe(run.calibrations[0])[0]
    ('frame', 'sim-01, solved')
    """
    if hasattr(result, "calibrations"):
        return _of_run(result)
    if hasattr(result, "solutions"):
        return _of_camera(result)
    if hasattr(result, "solution"):
        return _of_calibration(result)
    if hasattr(result, "pv"):
        return _of_solution(result)
    raise TypeError(f"cannot describe a {type(result).__name__}")


class Described:
    """Result that shows itself in words, because its arrays would fill the screen."""

    def __repr__(self):
        words = [f"    {line}" for line in as_text(describe(self))]
        return "\n".join([f"<{type(self).__name__}", *words]) + ">"

    def _repr_html_(self):
        return as_html(self)


def as_html(result):
    """Format a description as an HTML table for notebooks.

    Parameters
    ----------
    result : object
        As for `describe`.

    Returns
    -------
    str
        HTML.
    """
    rows = "".join(
        f"<tr><th style='text-align:left'>{escape(label)}</th>"
        f"<td style='text-align:left'>{escape(text)}</td></tr>"
        for label, text in describe(result)
    )
    return f"<table><caption>{type(result).__name__}</caption>{rows}</table>"


def as_text(lines):
    r"""Align labels and texts in two columns.

    Parameters
    ----------
    lines : list of (str, str)
        Labels and texts, as from `describe`.

    Returns
    -------
    list of str
        One line each; the texts begin below each other, however long a label is.

    Examples
    --------
    >>> from wpdc_gwcs.description import as_text
    >>> print(*as_text([("frame", "solved"), ("csst-msc-01-g-1", "failed")]), sep="\n")
    frame           solved
    csst-msc-01-g-1 failed
    """
    width = max([_LABEL, *(len(label) for label, _ in lines)])
    return [f"{label:<{width}} {text}" for label, text in lines]


def _of_calibration(calibration):
    statistics = calibration.statistics
    status = statistics.get("status")
    lines = [("frame", calibration.frame + (f", {status}" if status else ""))]
    lines += [("lacks", reason) for reason in statistics.get("reasons", ())]
    ra, dec = calibration.crval
    lines.append(("pointing", f"RA {ra:.6f}, Dec {dec:.6f} deg at the reference point"))
    lines.append(("scale", _scale(calibration.cd)))
    if "n_used" in statistics:
        lines.append(
            (
                "stars",
                f"{statistics['n_used']} of {statistics['n_matched']} matched ones used, "
                f"{counted(statistics['n_sources'], 'source')}",
            )
        )
    residuals = statistics.get("residuals", {})
    if "sigma_dx" in residuals:
        lines.append(
            (
                "residuals",
                f"{residuals['sigma_dx']:.4f} and {residuals['sigma_dy']:.4f} px in x and y, "
                f"{statistics['rms_mas']:.2f} mas",
            )
        )
    held = statistics.get("holdout", {})
    if "sigma_dx" in held:
        text = f"{held['sigma_dx']:.4f} and {held['sigma_dy']:.4f} px"
        lines.append(("held out", text))
    if calibration.sigma is not None:
        sigma = np.hypot(calibration.sigma[0], calibration.sigma[1])
        text = f"map known to {np.median(sigma):.4f} px, {np.max(sigma):.4f} px at worst"
        lines.append(("certain", text))
    if calibration.field is not None:
        lines.append(("field", "a smooth distortion of this exposure alone (atmosphere)"))
    if calibration.color_shift is not None:
        lines.append(("color", f"for stars of color {calibration.reference_color:.2f}"))
    return [*lines, *_of_solution(calibration.solution)]


def _of_solution(solution):
    shape = solution.image_shape
    size = "" if shape is None else f"{shape[1]} x {shape[0]} px"
    name = "without a name" if solution.detector == UNNAMED else solution.detector
    lines = [("detector", ", ".join(part for part in (name, size) if part))]
    if shape is not None:
        x, y = np.meshgrid(np.linspace(0, shape[1] - 1, 21), np.linspace(0, shape[0] - 1, 21))
        u, v = solution.undistort(x.ravel(), y.ravel())
        shift = np.hypot(u - x.ravel(), v - y.ravel())
        table = "" if solution.lookup_table is None else " and a look-up table of the rest"
        lines.append(
            (
                "distortion",
                f"up to {np.nanmax(shift):.2f} px: a polynomial of degree {solution.pv.degree}"
                f"{table}",
            )
        )
    lines.append(("valid", solution.validity))
    inputs = solution.provenance.get("inputs") or ()
    if len(inputs):
        made = f"{counted(len(inputs), 'frame')}, {solution.provenance.get('created')}"
        lines.append(("made of", made))
    return lines


def _of_camera(camera):
    lines = [("camera", f"{camera.name}, {counted(len(camera.detectors), 'detector')}")]
    lines.append(("reference", f"{camera.reference}, {_scale(camera.cd)}"))
    for name, solution in camera.solutions.items():
        lines.append((name, dict(_of_solution(solution)).get("distortion", "")))
    return lines


def _of_run(run):
    states = [str(status) for status in run.summary["status"]]
    counts = ", ".join(f"{states.count(s)} {s}" for s in dict.fromkeys(states))
    lines = [("run", f"{run.run_id}: {counted(len(states), 'frame')}, {counts}")]
    for row in run.summary[:_MOST_FRAMES]:
        sigma = np.hypot(float(row["sigma_dx"].value), float(row["sigma_dy"].value)) / np.sqrt(2)
        stars = counted(row["n_matched"], "star")
        good = f"{stars}, {sigma:.4f} px, {float(row['rms_mas'].value):.2f} mas"
        reason = str(row["reason"])
        parts = [str(row["status"]), good if row["n_matched"] else "", reason]
        lines.append((str(row["frame"]), "; ".join(part for part in parts if part)))
    if len(run.summary) > _MOST_FRAMES:
        lines.append(("...", f"{len(run.summary) - _MOST_FRAMES} more frames: see its summary"))
    for name, solution in run.solutions.items():
        lines.append((name, dict(_of_solution(solution)).get("distortion", "")))
    return lines


def _scale(cd):
    scale = np.sqrt(abs(np.linalg.det(cd))) * 3600
    x, y = np.linalg.solve(cd, [0.0, 1.0])
    north = np.degrees(np.arctan2(-x, y))
    mirrored = "" if np.linalg.det(cd) < 0 else ", mirrored"
    return f"{scale:.6g} arcsec / px, North {north:.3f} deg from the y axis{mirrored}"
