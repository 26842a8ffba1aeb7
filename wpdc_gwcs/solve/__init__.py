"""One solution from a few stars to a whole camera: terms with learned priors.

::

    pairs --observations--> flat columns --linear step--> all terms at once, variances learned
        --+--> tables (what is left on the detector) --> spectra and fields of the exposures --+
          +----------------------------- again with the fields ---------------------------------+
        --represent--> PV polynomial + table, attitude, table of the exposure

What is found out is a set of linear terms with Gaussian priors: the polynomial of each detector,
the optics and the places of a mosaic, six numbers and a smooth field for each exposure, color.
What is written down is the paper's form.  One detector with one exposure is the smallest camera.

Gauge: the PV polynomial has no constant and unit linear terms, so that CRVAL is the sky at CRPIX
and CD the local scale there.
"""

from wpdc_gwcs.solve.camera import solve
from wpdc_gwcs.solve.exposure import Exposure, ExposureFit, SolveResult

__all__ = ["Exposure", "ExposureFit", "SolveResult", "solve"]
