"""Content of the page: pooled detectors, frames, settings."""

from collections import Counter

import numpy as np
from astropy.table import Table, vstack

from wpdc_gwcs.counts import counted
from wpdc_gwcs.evaluation import evaluate
from wpdc_gwcs.report.figures import detector_figures, frame_figures
from wpdc_gwcs.report.template import PAGE

__all__ = ["write_report"]

# Columns of the summary that are visible at once, and their headings.
_IMPORTANT = {
    "frame": ("frame", None),
    "detector": ("detector", None),
    "status": ("status", None),
    "n_matched": ("stars", "matched"),
    "mean_dx": ("mean dx", "px"),
    "mean_dy": ("mean dy", "px"),
    "sigma_dx": ("sigma dx", "px"),
    "sigma_dy": ("sigma dy", "px"),
    "holdout_sigma_dx": ("held out dx", "sigma, px"),
    "holdout_sigma_dy": ("held out dy", "sigma, px"),
    "rms_mas": ("rms", "mas"),
    "header_offset": ("header off", "px"),
    "header_rotation": ("header turned", "deg"),
    "reason": ("reason", None),
}
_DIGITS = {"rms_mas": 2, "header_offset": 1, "header_rotation": 3}
_TEXTS = {"frame", "detector", "status", "reason", "camera", "exposure"}
# Field of ResidualStatistics and heading of its column.
_STATISTICS = {
    "n": ("stars", None),
    "mean_dx": ("mean dx", "px"),
    "mean_dy": ("mean dy", "px"),
    "sigma_dx": ("sigma dx", "px"),
    "sigma_dy": ("sigma dy", "px"),
    "scatter_dx": ("1.48 MAD dx", "px"),
    "scatter_dy": ("1.48 MAD dy", "px"),
    "d80_dx": ("d80 dx", "px"),
    "d80_dy": ("d80 dy", "px"),
}
# Headings of the table of detectors.
_DETECTOR = (
    ("detector", None), ("frames", None), ("solved", None), ("degraded", None), ("failed", None),
    *(_STATISTICS[n] for n in list(_STATISTICS)[:5]),
    ("held out dx", "sigma, px"), ("held out dy", "sigma, px"), ("rms", "mas"),
)  # fmt: skip
# Maximum number of detectors with all figures; if there are more, each has the most important one.
_FEW_DETECTORS = 6
# Maximum number of pooled frames of a detector, of frames with figures, and of rows in a table; of
# more frames, which do not fit on a page, the most interesting ones are shown.
_MOST_POOLED, _MOST_FIGURES, _MOST_ROWS = 100, 100, 500
# Number of characters in a column above which its texts are wrapped.
_WIDEST = 34
# Maximum number of reasons at the beginning of the page.
_MOST_PROBLEMS = 30
_POOLED = ("x", "y", "dx", "dy", "used", "holdout", "phot_g_mean_mag", "snr")


def write_report(summary, solutions, matches, file, *, title="Calibration report", about=None):
    """Write a page with the detectors, pooled over their frames, then the frames one by one.

    Parameters
    ----------
    summary : `~astropy.table.Table`
        One row per frame, as in ``summary.ecsv``, with at least ``frame``, ``detector`` and
        ``status``.
    solutions : dict
        Detector name to `DistortionSolution`.  Frames of other detectors have no map.
    matches : mapping
        Frame name to match table (``x``, ``y``, ``dx``, ``dy``, ``used``, ``holdout``), of the
        frames that were solved or degraded.  Tables are requested when they are needed and not
        kept, so they can be read then.
    file : text file object
        File to which the page is written.
    title : str, optional
        Heading of the page.
    about : dict, optional
        Description of the run, headings to names and values, such as
        ``{"settings": {"degree": "auto"}}``.  Default: the settings of the solutions.

    Notes
    -----
    The page contains everything, so it can be sent by mail and opened without a network.  The
    sections of the frames are collapsed.  A page of 72 frames, of one detector or of 72, needs less
    than 3 MB.  For a survey, 100 evenly chosen frames of each detector are pooled.  The tables have
    at most 500 frames: those that failed, are degraded or have the largest residuals.  The worst
    100 of them have figures.

    Examples
    --------
    >>> import io
    >>> from wpdc_gwcs import calibrate, simulate, write_report
    >>> sky = simulate(1, image_shape=(512, 512), density=30, distortion=5, seed=2)
    >>> run = calibrate([exposure.frame() for exposure in sky.exposures], sky.reference)
    >>> matches = {c.frame: c.matches for c in run.calibrations}
    >>> file = io.StringIO()
    >>> write_report(run.summary, run.solutions, matches, file, title="Night 1")
    >>> "<title>Night 1</title>" in file.getvalue()
    True
    """
    from jinja2 import Environment

    frames = {str(row["frame"]): str(row["detector"]) for row in summary}
    names = dict.fromkeys([*frames.values(), *solutions])
    alone = Counter(frames.get(name) for name in matches)
    shown = _worst_first(summary, _MOST_ROWS)
    worst = dict.fromkeys(str(name) for name in shown["frame"])
    ids = [f for f in (frames if len(shown) == len(summary) else worst) if f in matches]
    ids = {f: f"frame-{k}" for k, f in enumerate(ids[:_MOST_FIGURES])}
    sections, rows = [], []
    for k, name in enumerate(names):
        mine = [f for f, d in frames.items() if d == name and f in matches]
        chosen = _evenly(mine, _MOST_POOLED)
        table = _pool([matches[f] for f in chosen])
        link = None
        if name in solutions or table is not None:
            link = f"detector-{k}"
            text = _describe(solutions.get(name), table)
            if len(chosen) < len(mine):
                text += f"  Pooled over {len(chosen)} of its {len(mine)} frames, evenly chosen."
            small = len(names) > _FEW_DETECTORS
            figures = detector_figures(name, solutions.get(name), table, small=small)
            heading = f"Detector {name}"
            sections.append({"id": link, "title": heading, "text": text, "figures": figures})
        rows.append(_detector_row(summary, name, table, link))
    problems = _problems(summary, ids)
    page = Environment(autoescape=True).from_string(PAGE)
    file.write(
        page.render(
            title=title,
            counts=_counts(summary),
            problems=problems[:_MOST_PROBLEMS],
            more_problems=max(0, len(problems) - _MOST_PROBLEMS),
            contents=_contents(sections, ids, about or solutions, problems),
            detectors=_without_empty({"columns": _columns(_DETECTOR, _TEXTS), "rows": rows}),
            sections=sections,
            left_out=len(summary) - len(shown),
            summary=_summary_table(shown, ids),
            everything=_every_column(shown),
            frames=[
                {
                    "id": ids[name],
                    "title": name,
                    "table": _frame_table(matches[name]),
                    # The figures of a detector with a single frame already show this frame.
                    "figures": frame_figures(name, matches[name])
                    if alone[frames[name]] > 1 or frames[name] not in solutions
                    else [],
                }
                for name in ids
            ],
            settings=_settings(solutions, about),
        )
    )


def _evenly(names, most):
    """Take some of many, the first and the last among them."""
    if len(names) <= most:
        return names
    return [names[k] for k in np.linspace(0, len(names) - 1, most).round().astype(int)]


def _worst_first(summary, most):
    """Rows of a summary; if there are too many, those that failed, are degraded, or are worst."""
    if len(summary) <= most:
        return summary
    rank = {"failed": 0, "degraded": 1}
    status = np.array([rank.get(str(s), 2) for s in summary["status"]])
    size = np.zeros(len(summary))
    if "rms_mas" in summary.colnames:
        size = _plain_numbers(summary["rms_mas"])
    return summary[np.lexsort([-np.nan_to_num(size), status])[:most]]


def _plain_numbers(column):
    return np.ma.filled(np.ma.asarray(getattr(column, "value", column), float), np.nan)


def _counts(summary):
    states = [str(s) for s in summary["status"]]
    parts = [f"{states.count(s)} {s}" for s in ("solved", "degraded", "failed") if states.count(s)]
    return f"{counted(len(states), 'frame')}: {', '.join(parts)}."


def _problems(summary, ids):
    """List the frames that failed, then those that are degraded, with their reasons."""
    reasons = summary["reason"] if "reason" in summary.colnames else [""] * len(summary)
    found = [
        {
            "frame": str(frame),
            "status": str(status),
            "reason": str(reason),
            "id": ids.get(str(frame)),
        }
        for frame, status, reason in zip(summary["frame"], summary["status"], reasons, strict=True)
        if str(status) != "solved"
    ]
    return sorted(found, key=lambda one: one["status"] != "failed")


def _contents(sections, ids, about, problems):
    entries = [{"id": "detectors", "title": "Detectors"}, *sections]
    if problems:
        entries.insert(0, {"id": "problems", "title": "Failed and degraded frames"})
    entries.append({"id": "frames", "title": "Frames"})
    if ids:
        entries.append({"id": "each", "title": "Frame by frame"})
    if about:
        entries.append({"id": "settings", "title": "Settings"})
    return entries


def _pool(tables):
    """Return the matches of all frames of a detector in one table, or `None`."""
    plain = []
    for table in tables:
        columns = [name for name in _POOLED if name in table.colnames]
        plain.append(Table({n: np.asarray(getattr(table[n], "value", table[n])) for n in columns}))
    # Magnitudes are shown where all frames have them.
    return vstack(plain, join_type="inner", metadata_conflicts="silent") if plain else None


def _masks(table):
    names = table.colnames
    n = len(table)
    holdout = np.asarray(table["holdout"], bool) if "holdout" in names else np.zeros(n, bool)
    used = np.asarray(table["used"], bool) if "used" in names else ~holdout
    return used & ~holdout, holdout


def _statistics(table, chosen):
    residuals = (np.asarray(getattr(table[n], "value", table[n]))[chosen] for n in ("dx", "dy"))
    return evaluate(*residuals)


def _columns(pairs, texts=()):
    return [{"name": n, "unit": u, "text": n in texts} for n, u in pairs]


def _detector_row(summary, name, table, link):
    mine = summary[[str(d) == name for d in summary["detector"]]]
    states = [str(s) for s in mine["status"]]
    fit = held = None
    if table is not None:
        used, holdout = _masks(table)
        fit, held = _statistics(table, used), _statistics(table, holdout)
    cells = [name, len(mine), *(states.count(s) for s in ("solved", "degraded", "failed"))]
    cells += [getattr(fit, n, np.nan) for n in list(_STATISTICS)[:5]]
    cells += [getattr(held, n, np.nan) for n in ("sigma_dx", "sigma_dy")]
    cells.append(_median(mine, "rms_mas"))
    return {"cells": [*map(_cell, cells[:-1]), _cell(cells[-1], 2)], "link": link}


def _median(table, name):
    if name not in table.colnames or len(table) == 0:
        return np.nan
    values = _plain_numbers(table[name])
    return float(np.nanmedian(values)) if np.isfinite(values).any() else np.nan


def _summary_table(summary, ids):
    names = [name for name in _IMPORTANT if name in summary.colnames]
    table = {
        "columns": _columns([_IMPORTANT[n] for n in names], _TEXTS),
        "rows": [
            {
                "status": str(row["status"]),
                "link": ids.get(str(row["frame"])),
                "cells": [_cell(row[n], _DIGITS.get(n, 4)) for n in names],
            }
            for row in summary
        ],
    }
    return _without_empty(table)


def _every_column(summary):
    return {
        "columns": [
            {"name": n, "unit": str(summary[n].unit or ""), "text": n in _TEXTS}
            if hasattr(summary[n], "unit")
            else {"name": n, "unit": None, "text": n in _TEXTS}
            for n in summary.colnames
        ],
        "rows": [
            {"status": str(row["status"]), "cells": [_cell(row[n]) for n in summary.colnames]}
            for row in summary
        ],
    }


def _without_empty(table):
    """Leave out empty columns, for example if nothing was held out and no frame failed."""
    kept = [
        k
        for k in range(len(table["columns"]))
        if k == 0 or any(row["cells"][k] not in ("", "0") for row in table["rows"])
    ]
    columns = [
        {**table["columns"][k], "width": _width(table, k)}
        if table["columns"][k]["text"]
        else table["columns"][k]
        for k in kept
    ]
    rows = [{**row, "cells": [row["cells"][k] for k in kept]} for row in table["rows"]]
    return {"columns": columns, "rows": rows}


def _width(table, k):
    """Minimum width of a column of texts, in characters: only sentences are wrapped."""
    cells = [table["columns"][k]["name"], *(row["cells"][k] for row in table["rows"])]
    return min(max(map(len, cells)) + 1, _WIDEST)


def _frame_table(table):
    rows = []
    for label, chosen in zip(("in the fit", "held out"), _masks(table), strict=True):
        if chosen.any():
            found = _statistics(table, chosen)
            rows.append({"cells": [label, *(_cell(getattr(found, n)) for n in _STATISTICS)]})
    headings = [("", None), *_STATISTICS.values()]
    return {"columns": _columns(headings, _TEXTS), "rows": rows}


def _describe(solution, table):
    """Describe the solution of a detector in a few words."""
    if solution is None:
        return "No solution is stored for it."
    ny, nx = solution.image_shape
    text = f"{nx} x {ny} px"
    if "n_used" in solution.statistics:
        stars, exposures = (solution.statistics[name] for name in ("n_used", "n_exposures"))
        text += f"; {counted(stars, 'residual')} of {counted(exposures, 'exposure')}"
    if solution.settings.get("method") == "paper":
        text += ", by the paper's literal method"
    if solution.valid_from is not None or solution.valid_to is not None:
        text += f"; valid {solution.validity}"
    lookup = solution.lookup_table
    if lookup is None:
        return f"{text}; no look-up table."
    size = np.hypot(lookup.dx, lookup.dy)
    return (
        f"{text}; look-up table of {len(lookup.x_grid)} x {len(lookup.y_grid)} nodes, "
        f"{np.sqrt(np.mean(size**2)):.3g} px rms, {size.max():.3g} px at most."
    )


def _settings(solutions, about):
    """Tables of names and values."""
    if about is None:
        about = {f"detector {name}": s.settings for name, s in solutions.items() if s.settings}
    return [
        {
            "columns": [{"name": heading, "text": True}, {"name": "", "text": True}],
            "rows": [{"cells": [str(k), _plain(v)]} for k, v in values.items()],
        }
        for heading, values in about.items()
        if values
    ]


def _plain(value):
    if isinstance(value, (list, tuple)):
        return ", ".join(map(str, value))
    return "none" if value is None else str(value)


def _cell(value, digits=4):
    if np.ma.is_masked(value):
        return ""
    value = getattr(value, "value", value)
    if isinstance(value, float | np.floating):
        return f"{value:.{digits}f}" if np.isfinite(value) else ""
    return str(value)
