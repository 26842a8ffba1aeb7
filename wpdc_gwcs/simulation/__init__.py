"""Exposures with a known distortion: star fields, source lists and rendered images.

The truth is independent of the models it is used to test: no PV polynomial and no look-up table,
but a closed form in the complex plane with an exact inverse, followed by `astropy.wcs`::

    detector px --[Distortion]--> undistorted px --[astropy.wcs TAN, true attitude]--> ICRS
         |                                                                              |
      sources (noise, spurious and lost stars), render()          reference (noise, proper motion)

The header of an exposure holds the nominal attitude; the true one differs from it by the pointing,
roll and scale errors.
"""

from wpdc_gwcs.simulation.distortion import Distortion
from wpdc_gwcs.simulation.exposure import SimulatedExposure
from wpdc_gwcs.simulation.field import Simulation, simulate
from wpdc_gwcs.simulation.files import write_simulation

__all__ = ["Distortion", "SimulatedExposure", "Simulation", "simulate", "write_simulation"]
