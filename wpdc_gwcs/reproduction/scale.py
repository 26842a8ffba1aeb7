"""How large a reproduction is: the paper's own size, or one for tests."""

from dataclasses import dataclass, field

import astropy.units as u
import numpy as np
from astropy.coordinates import SkyCoord

from wpdc_gwcs.reproduction.claims import DETECTORS

__all__ = ["FULL", "QUICK", "SEED", "Scale"]

#: The seed of the reproduction: the number of the paper, arXiv 2603.09193.  The cameras were made
#: ready with other ones.
SEED = 9193


@dataclass(frozen=True)
class Scale:
    """How large a reproduction is.

    Parameters
    ----------
    detectors : tuple of str
        Detectors of the camera, in the order of the paper's table.
    n_fields : int
        Fields of each detector.
    densities : (float, float)
        Stars per square arcmin in the poorest and in the richest field, as g sees them.
    camera : dict
        Options of the camera ``csst-msc``, empty for its own size.
    r0 : float
        Radius within which all stars weigh the same, px.
    slice_width : float
        Width of the slices of the detector, px.
    n_bass : int
        Exposures of the four chips of 90Prime.
    r0_bass : float
        The same radius on its chips, px.
    bass : dict
        Options of the camera ``bass-90prime`` and of its field, empty for its own size.
    n_headers : int or None
        Real headers of 90Prime at most; `None` for all that there are.
    scamp : bool
        Whether SCAMP runs beside, where it is installed; it takes seconds for each list.
    n_images, n_cluster : int
        Images whose centroids are measured, and images of the cluster.
    images : dict
        Options of the camera ``csst-msc`` and of its field for images, empty for its own size.
    """

    detectors: tuple[str, ...] = DETECTORS
    n_fields: int = 25
    densities: tuple[float, float] = (36.0, 500.0)
    camera: dict = field(default_factory=dict)
    r0: float = 4000.0
    slice_width: float = 512.0
    n_bass: int = 10
    r0_bass: float = 2000.0
    bass: dict = field(default_factory=dict)
    n_headers: int | None = None
    scamp: bool = True
    n_images: int = 3
    n_cluster: int = 18
    images: dict = field(default_factory=dict)

    def fields(self, seed):
        """Choose where on the sky the fields are, and how rich.

        Parameters
        ----------
        seed : int
            Seed of the choice.

        Returns
        -------
        dict
            ``center`` and ``density`` for `~wpdc_gwcs.simulation.simulate`.
        """
        rng = np.random.default_rng(seed)
        ra = rng.uniform(0, 360, self.n_fields)
        dec = np.rad2deg(np.arcsin(rng.uniform(-1, 1, self.n_fields)))
        return {
            "center": SkyCoord(ra, dec, unit="deg"),
            "density": np.geomspace(*self.densities, self.n_fields),
        }


FULL = Scale()
# A ninth of the side at four times the angle of a pixel: as many stars in a hundredth of the time.
QUICK = Scale(
    detectors=("y-1", "NUV-1", "g-1", "z-2"),
    n_fields=4,
    densities=(60.0, 120.0),
    camera={"image_shape": (1026, 1024), "pixel_scale": 0.3 * u.arcsec, "distortion": 22.0},
    r0=444.0,
    slice_width=57.0,
    n_bass=3,
    r0_bass=250.0,
    bass={"image_shape": (512, 504), "distortion": 5.0, "density": 100.0},
    n_headers=1,
    scamp=False,
    n_images=1,
    n_cluster=2,
    images={"image_shape": (1026, 1024), "distortion": 22.0, "density": 600.0},
)
