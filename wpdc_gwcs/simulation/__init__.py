"""Exposures with a known distortion: star fields, source lists and rendered images.

The truth is independent of the models it is used to test: no PV polynomial and no look-up table,
but a closed form in the complex plane with an exact inverse, followed by `astropy.wcs`::

    detector px --[Distortion]--> undistorted px --[astropy.wcs TAN, true attitude]--> ICRS
         |                                                                              |
      sources (noise, spurious and lost stars), render()          reference (noise, proper motion)

The header of an exposure holds the nominal attitude; the true one differs from it by the pointing,
roll and scale errors.
"""

from importlib import import_module

from wpdc_gwcs.simulation.camera import SimulatedCamera, SimulatedDetector
from wpdc_gwcs.simulation.distortion import Distortion
from wpdc_gwcs.simulation.exposure import SimulatedExposure
from wpdc_gwcs.simulation.field import Simulation, simulate
from wpdc_gwcs.simulation.presets import CAMERAS, make_camera
from wpdc_gwcs.simulation.stars import KingCluster
from wpdc_gwcs.simulation.truth import FrameTruth

__all__ = [
    "CAMERAS",
    "Distortion",
    "FrameTruth",
    "KingCluster",
    "SimulatedCamera",
    "SimulatedDetector",
    "SimulatedExposure",
    "Simulation",
    "make_camera",
    "read_truth",
    "simulate",
    "write_simulation",
]

# What touches files stands with the files, above this package; resolved on first use.
_IN_FILES = ("read_truth", "write_simulation")


def __getattr__(name):
    if name in _IN_FILES:
        return getattr(import_module("wpdc_gwcs.io.simulations"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
