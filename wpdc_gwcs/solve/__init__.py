"""One solution from a few stars to a whole camera: terms with learned priors.

::

    pairs --observations--> flat columns --linear step--> all terms at once, variances learned
        --+--> tables (what is left on the detector) --> spectra and fields of the exposures --+
          +----------------------------- again with the fields ---------------------------------+
        --represent--> PV polynomial + table, attitude, table of the exposure

The solution is a set of linear terms with Gaussian priors: the polynomial of each detector, the
optics and the positions of the detectors in a mosaic, six numbers and a smooth field for each
exposure, and color.  It is stored in the form of the paper.  One detector with one exposure is the
smallest camera.

Gauge: the PV polynomial has zero constant and unit linear terms, so that CRVAL is the sky position
of CRPIX and CD is the local scale there.
"""

from wpdc_gwcs.solve.camera import solve
from wpdc_gwcs.solve.exposure import Exposure, ExposureFit, SolveResult

__all__ = ["Exposure", "ExposureFit", "SolveResult", "solve"]
