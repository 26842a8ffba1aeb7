"""WPDC-2P exactly as published: ``method="paper"``.

::

    pairs --each exposure: weighted cubic about the header's tangent point,
            ten steps of 50 %, matched again after each--> PV polynomials, residuals
    residuals of all exposures of a detector --raw RBF--> 50 x 50 nodes from 0 to n, bilinear

It is for comparison.  By default, the package uses `wpdc_gwcs.solve`.
"""

from wpdc_gwcs.paper.polynomial import DAMPING, MAX_STEPS, ExposurePolynomial, fit_exposure
from wpdc_gwcs.paper.solution import solve_literally
from wpdc_gwcs.paper.table import build_raw_table

__all__ = [
    "DAMPING",
    "MAX_STEPS",
    "ExposurePolynomial",
    "build_raw_table",
    "fit_exposure",
    "solve_literally",
]
