"""One self-contained HTML page about a calibration: numbers and figures.

::

    summary, solutions, matches --evaluation, plotting--> tables, figures --template--> HTML
"""

import base64
import io

import numpy as np

from wpdc_gwcs import plotting
from wpdc_gwcs.evaluation import evaluate

__all__ = ["write_report"]

_PAGE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<title>{{ title }}</title>
<style>
body { font-family: sans-serif; margin: 2em auto; max-width: 75em; padding: 0 1em; color: #222; }
table { border-collapse: collapse; display: block; font-size: 90%; overflow-x: auto; }
th, td { border-bottom: 1px solid #ccc; padding: 0.3em 0.7em; text-align: right; }
th:first-child, td:first-child { text-align: left; }
tr.failed td { color: #b00; }
img { max-width: 100%; }
figure { margin: 1em 0; }
</style>
</head>
<body>
<h1>{{ title }}</h1>
<p>{{ n_solved }} of {{ table.rows | length }} frames solved.
Means and sigmas of the residuals are after 3-sigma clipping.</p>
{% macro show(table) %}<table>
<tr>{% for name in table.names %}<th>{{ name }}</th>{% endfor %}</tr>
{% for row in table.rows %}<tr class="{{ row.status }}">
{% for cell in row.cells %}<td>{{ cell }}</td>{% endfor %}</tr>
{% endfor %}</table>
{% endmacro %}{{ show(table) }}
{% for section in sections %}<h2>{{ section.title }}</h2>
{% if section.text %}<p>{{ section.text }}</p>
{% endif %}{% if section.table %}{{ show(section.table) }}{% endif %}
{% for figure in section.figures %}<figure><img alt="{{ figure.alt }}"
 src="data:image/png;base64,{{ figure.data }}"></figure>
{% endfor %}{% endfor %}</body>
</html>
"""

# Field of ResidualStatistics and heading of its column.
_STATISTICS = {
    "n": "number",
    "n_clipped": "after clipping",
    "mean_dx": "mean dx [px]",
    "mean_dy": "mean dy [px]",
    "sigma_dx": "sigma dx [px]",
    "sigma_dy": "sigma dy [px]",
    "scatter_dx": "1.48 MAD dx [px]",
    "scatter_dy": "1.48 MAD dy [px]",
    "d80_dx": "d80 dx [px]",
    "d80_dy": "d80 dy [px]",
}


def write_report(summary, solutions, matches, file, *, title="Calibration report"):
    """Write a page with the summary, the look-up tables and the residuals of every frame.

    Parameters
    ----------
    summary : `~astropy.table.Table`
        One row per frame, as in ``summary.ecsv``, with at least ``frame``, ``detector`` and
        ``status``.
    solutions : dict
        Detector name to `DistortionSolution`.  Frames of other detectors have no map.
    matches : dict
        Frame name to match table (``x``, ``y``, ``dx``, ``dy``, ``used``, ``holdout``), of the
        frames that were solved.
    file : text file object
        Where the page goes.
    title : str, optional
        Heading of the page.

    Notes
    -----
    Everything is in the one page: it can be mailed, and opened without a network.
    """
    from jinja2 import Environment

    shapes = {
        str(row["frame"]): solutions[row["detector"]].image_shape
        for row in summary
        if row["detector"] in solutions
    }
    sections = [_detector_section(solution) for solution in solutions.values()]
    sections += [
        _frame_section(name, table, image_shape=shapes.get(name)) for name, table in matches.items()
    ]
    rows = [
        {"status": row["status"], "cells": [_cell(row[name]) for name in summary.colnames]}
        for row in summary
    ]
    page = Environment(autoescape=True).from_string(_PAGE)
    file.write(
        page.render(
            title=title,
            table={"names": summary.colnames, "rows": rows},
            n_solved=int(np.sum(np.asarray(summary["status"]) == "solved")),
            sections=sections,
        )
    )


def _cell(value):
    if np.ma.is_masked(value):
        return ""
    value = getattr(value, "value", value)
    if isinstance(value, float | np.floating):
        return f"{value:.4f}" if np.isfinite(value) else ""
    return str(value)


def _detector_section(solution):
    ny, nx = solution.image_shape
    text = f"{nx} x {ny} px"
    if "n_used" in solution.statistics:
        stars, exposures = (solution.statistics[name] for name in ("n_used", "n_exposures"))
        text += f"; {stars} residuals of {exposures} exposures"
    table = solution.lookup_table
    if table is None:
        return {"title": f"Detector {solution.detector}", "text": f"{text}; no look-up table."}
    size = np.hypot(table.dx, table.dy)
    text += (
        f"; look-up table of {len(table.x_grid)} x {len(table.y_grid)} nodes, "
        f"{np.sqrt(np.mean(size**2)):.3g} px rms, {size.max():.3g} px at most."
    )
    figure = plotting.plot_lookup_table(table)
    return {
        "title": f"Detector {solution.detector}",
        "text": text,
        "figures": [_embed(figure, f"look-up table of {solution.detector}")],
    }


def _frame_section(name, table, *, image_shape):
    used, holdout = (np.asarray(table[name], bool) for name in ("used", "holdout"))
    groups = {"in the fit": used & ~holdout, "held out": holdout}
    figures = [
        _embed(plotting.plot_residuals_vs_position(table), f"residuals of {name}"),
        _embed(plotting.plot_cdf(table), f"distribution of the residuals of {name}"),
    ]
    if {"phot_g_mean_mag", "snr"} & set(table.colnames):
        figure = plotting.plot_residuals_vs_magnitude(table)
        figures.append(_embed(figure, f"residuals of {name} against magnitude"))
    if image_shape is not None:
        figure = plotting.plot_residual_maps(table, image_shape=image_shape)
        figures.insert(0, _embed(figure, f"maps of the residuals of {name}"))
    return {
        "title": f"Frame {name}",
        "table": {
            "names": ["stars", *_STATISTICS.values()],
            "rows": [
                {"cells": [label, *_statistics(table[chosen])]}
                for label, chosen in groups.items()
                if chosen.any()
            ],
        },
        "figures": figures,
    }


def _statistics(matches):
    statistics = evaluate(
        *(np.asarray(getattr(matches[name], "value", matches[name])) for name in ("dx", "dy"))
    )
    return [_cell(getattr(statistics, name)) for name in _STATISTICS]


def _embed(figure, alt):
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=80)
    return {
        "alt": alt,
        "data": base64.b64encode(buffer.getvalue()).decode("ascii"),
    }
