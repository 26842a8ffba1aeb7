"""Description of a run in words, stage by stage, for ``-v`` and ``wpdc explain``."""

import logging
from collections import Counter

import numpy as np

from wpdc_gwcs.calibration.matched import FailedFrame
from wpdc_gwcs.calibration.measure import rules_of
from wpdc_gwcs.counts import counted
from wpdc_gwcs.selection import left_out

__all__ = [
    "say",
    "tell_catalog",
    "tell_frames",
    "tell_match",
    "tell_outcome",
    "tell_result",
    "tell_solution",
    "tell_sources",
]

log = logging.getLogger(__name__)

_GAIN = {
    "given": "as given",
    "header": "from the header, confirmed by the noise",
    "noise": "from the noise in its stars",
}
# Optional columns of a catalog, and their names in words.
_COLUMNS = {
    "pmra": "proper motions",
    "parallax": "parallaxes",
    "ra_error": "errors",
    "phot_g_mean_mag": "magnitudes",
    "bp_rp": "colors",
}


def say(tell, *what):
    """Log the lines of a stage; they are made only if they are logged.

    Parameters
    ----------
    tell : callable
        Function that returns the lines.
    *what
        Its arguments.
    """
    if log.isEnabledFor(logging.INFO):
        for line in tell(*what):
            log.info("%s", line)


def tell_frames(frames, groups):
    """Describe the frames.

    Parameters
    ----------
    frames : list of Frame
        All frames.
    groups : list of list of Frame
        Frames that are solved together.

    Returns
    -------
    list of str
        A line.
    """
    images = sum(frame.load_image is not None for frame in frames)
    kinds = Counter({"image": images, "source list": len(frames) - images})
    kinds = " and ".join(counted(n, what) for what, n in kinds.items() if n)
    exposures = {(f.camera, f.exposure or f.name) for f in frames}
    detectors = {(f.camera, f.detector) for f in frames}
    return [
        f"frames: {kinds} of {counted(len(detectors), 'detector')}, "
        f"{counted(len(exposures), 'exposure')}; solved in {counted(len(groups), 'group')}"
    ]


def tell_catalog(catalog, seconds):
    """Describe the reference catalog.

    Parameters
    ----------
    catalog : `~astropy.table.Table`
        The catalog, or the needed part of it.
    seconds : float
        How long it took.

    Returns
    -------
    list of str
        A line.
    """
    have = [word for name, word in _COLUMNS.items() if name in catalog.colnames]
    text = f"catalog: {counted(len(catalog), 'star')} with {', '.join(['positions', *have])}"
    if "ref_epoch" in catalog.colnames and len(catalog):
        text += f", of {float(np.nanmedian(np.asarray(catalog['ref_epoch'], float))):.1f}"
    return [f"{text} ({seconds:.1f} s)"]


def tell_sources(sources, frame, settings):
    """Describe the sources of a frame, and which are used.

    Parameters
    ----------
    sources : `~astropy.table.Table`
        As from `measure_sources`.
    frame : Frame
        The frame, for its shape.
    settings : Settings
        Settings, with the criteria for sources.

    Returns
    -------
    list of str
        Counts, and for an image FWHM and gain.
    """
    rules = rules_of(sources, frame, settings)
    usable = int(np.sum(~np.any(list(rules.values()), axis=0)))
    lines = [f"{usable} of {counted(len(sources), 'source')} used ({left_out(rules)})"]
    fwhm = sources.meta.get("fwhm")
    if fwhm is not None and np.isfinite(float(getattr(fwhm, "value", fwhm))):
        lines.append(f"stars have a FWHM of {float(getattr(fwhm, 'value', fwhm)):.2f} px")
    gain, origin = sources.meta.get("gain"), sources.meta.get("gain_from")
    if origin in _GAIN:
        lines.append(f"gain of {gain:.3g} electrons per count, {_GAIN[origin]}")
    return lines


def tell_match(found):
    """Describe the match of a frame and its evidence.

    Parameters
    ----------
    found : MatchDiagnostics
        Diagnostics of the match.

    Returns
    -------
    list of str
        Pairs and evidence, errors of the header, sources left out.
    """
    return [
        f"{counted(found.n_pairs, 'pair')}, {found.expected_by_chance:.1f} expected by chance "
        f"({found.significance:.0f} sigma), purity {found.purity:.3f}",
        f"the header is off by {found.shift[0]:z.1f}, {found.shift[1]:z.1f} px, turned by "
        f"{found.rotation:z.3f} deg, scaled by {found.scale:.5f}"
        + (", mirrored" if found.parity < 0 else ""),
        f"{counted(found.n_ambiguous, 'source')} with two candidates left out, pairs scatter by "
        f"{found.scatter:.2f} px about a smooth mapping",
    ]


def tell_result(frame, result, settings):
    """Describe the measurement and match of a frame.

    Parameters
    ----------
    frame : Frame
        The frame.
    result : MatchedFrame or FailedFrame
        Its match.
    settings : Settings
        What sources are judged by.

    Returns
    -------
    list of str
        A line for its sources and one for its match, with the time.
    """
    lines = []
    if result.sources is not None:
        told = "; ".join(tell_sources(result.sources, frame, settings))
        lines.append(f"{frame.name}: sources: {told}")
    if isinstance(result, FailedFrame):
        text = f"failed: {result.error}"
    else:
        text = f"match: {'; '.join(tell_match(result.diagnostics)[:2])}"
    return [*lines, f"{frame.name}: {text} ({result.seconds:.1f} s)"]


def tell_solution(solution):
    """Describe the solution of a detector.

    Parameters
    ----------
    solution : DistortionSolution
        Its solution.

    Returns
    -------
    str
        A line.
    """
    statistics = solution.statistics
    text = f"{solution.detector}: polynomial of degree {solution.pv.degree}"
    table = statistics.get("table") or {}
    lookup = solution.lookup_table
    if lookup is None:
        text += ", no table"
    else:
        text += f" and table of {len(lookup.x_grid)} x {len(lookup.y_grid)} nodes"
    if table.get("kernel") == "none":
        text += " (the residuals show nothing beyond the terms of the camera)"
    elif table.get("kernel"):
        text += f" ({table['kernel']} of {table['freedom']:.0f} degrees of freedom)"
    if "n_used" in statistics:
        text += (
            f", from {counted(statistics['n_used'], 'pair')} in "
            f"{counted(statistics['n_exposures'], 'exposure')}"
        )
    if "error_scale" in statistics:
        text += f"; errors of the stars x {statistics['error_scale']:.2f}"
    return text


def tell_outcome(outcome, seconds):
    """Describe the outcome of frames that were solved together.

    Parameters
    ----------
    outcome : Outcome
        What was found.
    seconds : float
        How long it took.

    Returns
    -------
    list of str
        A line for each detector, and one for the frames.
    """
    states = Counter(row["status"] for row in outcome.rows)
    told = ", ".join(f"{states[s]} {s}" for s in ("solved", "degraded", "failed") if states[s])
    return [
        *(f"solution: {tell_solution(one)}" for one in outcome.solutions.values()),
        f"solution: {counted(len(outcome.rows), 'frame')}: {told}; {outcome.n_fields} with a "
        f"field of their own ({seconds:.1f} s)",
    ]
