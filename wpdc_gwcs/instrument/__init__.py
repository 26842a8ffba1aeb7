"""One instrument, many exposures: PV and table of a detector, six numbers for each frame.

::

    pairs of all exposures --align--> attitudes, outliers, errors
        --+--> PV (distance-weighted) --> residual maps --> table --> attitudes --+--> solution
          +------------------------- until nothing moves -------------------------+

The distortion is a property of the detector and stable; CRVAL and CD belong to the exposure.  A
polynomial of its own for each exposure, the paper's first phase, carries that exposure's star noise
into the corners; one for all does not.

Gauge: the PV polynomial has no constant and unit linear terms, so that CRVAL is the sky at CRPIX
and CD the local scale there.  What a fit puts into these terms is moved into the attitudes,
exactly.
"""

from wpdc_gwcs.instrument.exposure import Exposure, ExposureFit, InstrumentResult
from wpdc_gwcs.instrument.solve import solve_instrument

__all__ = ["Exposure", "ExposureFit", "InstrumentResult", "solve_instrument"]
