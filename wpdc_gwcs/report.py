"""One self-contained HTML page about a calibration: numbers and figures.

::

    CalibrationRun --plotting--> figures --template--> HTML text
"""

import base64
import io

import numpy as np

from wpdc_gwcs import plotting

__all__ = ["write_report"]

_PAGE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<title>{{ title }}</title>
<style>
body { font-family: sans-serif; margin: 2em auto; max-width: 75em; padding: 0 1em; color: #222; }
table { border-collapse: collapse; font-size: 90%; }
th, td { border-bottom: 1px solid #ccc; padding: 0.3em 0.7em; text-align: right; }
th:first-child, td:first-child { text-align: left; }
tr.failed td { color: #b00; }
img { max-width: 100%; }
figure { margin: 1em 0; }
</style>
</head>
<body>
<h1>{{ title }}</h1>
<p>{{ n_solved }} of {{ rows | length }} frames solved. Residuals in px after 3-sigma clipping.</p>
<table>
<tr>{% for name in names %}<th>{{ name }}</th>{% endfor %}</tr>
{% for row in rows %}<tr class="{{ row.status }}">
{% for cell in row.cells %}<td>{{ cell }}</td>{% endfor %}</tr>
{% endfor %}</table>
{% for section in sections %}<h2>{{ section.title }}</h2>
{% for figure in section.figures %}<figure><img alt="{{ figure.alt }}"
 src="data:image/png;base64,{{ figure.data }}"></figure>
{% endfor %}{% endfor %}</body>
</html>
"""


def write_report(summary, solutions, matches, file, *, title="Calibration report"):
    """Write a page with the summary, the look-up tables and the residuals of every frame.

    Parameters
    ----------
    summary : `~astropy.table.Table`
        One row per frame, as in ``summary.ecsv``.
    solutions : dict
        Detector name to `DistortionSolution`.
    matches : dict
        Frame name to match table, of the frames that were solved.
    file : text file object
        Where the page goes.
    title : str, optional
        Heading of the page.

    Notes
    -----
    Everything is in the one page: it can be mailed, and opened without a network.
    """
    from jinja2 import Environment

    sections = [_detector_section(solutions[name]) for name in solutions]
    sections += [_frame_section(name, table) for name, table in matches.items()]
    page = Environment(autoescape=True).from_string(_PAGE)
    file.write(
        page.render(
            title=title,
            names=summary.colnames,
            rows=[
                {"status": row["status"], "cells": [_cell(row[n]) for n in summary.colnames]}
                for row in summary
            ],
            n_solved=int(np.sum(np.asarray(summary["status"]) == "solved")),
            sections=sections,
        )
    )


def _cell(value):
    value = getattr(value, "value", value)
    if isinstance(value, float | np.floating):
        return f"{value:.4f}" if np.isfinite(value) else ""
    return str(value)


def _detector_section(solution):
    figures = []
    if solution.lookup_table is not None:
        figure = plotting.plot_lookup_table(solution.lookup_table)
        figures.append(_embed(figure, f"look-up table of {solution.detector}"))
    return {"title": f"Detector {solution.detector}", "figures": figures}


def _frame_section(name, table):
    figures = [
        _embed(plotting.plot_residuals_vs_position(table), f"residuals of {name}"),
        _embed(plotting.plot_cdf(table), f"distribution of the residuals of {name}"),
    ]
    return {"title": f"Frame {name}", "figures": figures}


def _embed(figure, alt):
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=80)
    return {
        "alt": alt,
        "data": base64.b64encode(buffer.getvalue()).decode("ascii"),
    }
