"""One self-contained HTML page about a calibration: numbers and figures.

::

    summary, solutions, matches --pooled by detector, then frame by frame: evaluation, plotting-->
    tables, figures --template--> HTML
"""

from wpdc_gwcs.report.page import write_report

__all__ = ["write_report"]
