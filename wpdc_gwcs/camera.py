"""A camera: the positions of its detectors in the focal plane, and the solution of each.

::

    detector px --[its solution]--> undistorted px --[place + matrix]--> focal plane px
"""

import dataclasses
from dataclasses import dataclass

import numpy as np

from wpdc_gwcs.description import Described
from wpdc_gwcs.frozen import freeze_attributes, frozen_array
from wpdc_gwcs.models import deproject, project

__all__ = ["Camera", "build_camera"]


@dataclass(frozen=True, eq=False, repr=False)
class Camera(Described):
    """Detectors that were solved together.

    Parameters
    ----------
    name : str
        Name of the camera.
    detectors : tuple of str
        Names of its detectors.
    reference : str
        Detector whose undistorted px, from its reference point, are the units of the focal plane.
    places : (D, 2) ndarray
        Reference point of each detector in the focal plane, px, on the tangent plane about that of
        ``reference``.
    matrices : (D, 2, 2) ndarray
        Focal plane px per undistorted px of each detector.
    image_shapes : (D, 2) ndarray of int
        Shape ``(ny, nx)`` of each detector.
    cd : (2, 2) ndarray
        Nominal matrix of the reference, deg / px.
    learned : dict
        Standard deviations (px) of the terms of the model, estimated from the stars.
    files : dict
        Solution file of each detector, relative to that of the camera.
    solutions : dict
        `DistortionSolution` of each detector; on disk, these are separate files.
    provenance : dict
        Origin of the camera.

    Examples
    --------
    >>> from wpdc_gwcs import calibrate, simulate
    >>> sky = simulate(1, camera="bass-90prime", image_shape=(512, 512), density=30, distortion=12,
    ...                seed=2)
    >>> run = calibrate([exposure.frame() for exposure in sky.exposures], sky.reference)
    >>> camera = run.cameras[0]
    >>> camera.detectors
    ('CCD1', 'CCD2', 'CCD3', 'CCD4')
    >>> x, y = camera.focal_plane("CCD1", 100.0, 200.0)
    """

    name: str
    detectors: tuple
    reference: str
    places: np.ndarray
    matrices: np.ndarray
    image_shapes: np.ndarray
    cd: np.ndarray
    learned: dict = dataclasses.field(default_factory=dict)
    files: dict = dataclasses.field(default_factory=dict)
    solutions: dict = dataclasses.field(default_factory=dict, repr=False)
    provenance: dict = dataclasses.field(default_factory=dict)

    def __post_init__(self):
        n = len(self.detectors)
        frozen_array(self, "places", shape=(n, 2))
        frozen_array(self, "matrices", shape=(n, 2, 2))
        frozen_array(self, "image_shapes", shape=(n, 2), dtype=int)
        frozen_array(self, "cd", shape=(2, 2))
        freeze_attributes(self, "learned", "files", "solutions", "provenance")
        if self.reference not in self.detectors:
            raise ValueError(f"reference must be one of the detectors, got {self.reference!r}")

    def focal_plane(self, detector, x, y):
        """Return the focal plane position of pixels of a detector.

        Parameters
        ----------
        detector : str
            Name of the detector.
        x, y : array_like
            Detector pixels, zero based.

        Returns
        -------
        x, y : ndarray
            Focal plane, px; also defined outside the detector.

        Raises
        ------
        KeyError
            If the camera has no such detector.
        """
        if detector not in self.detectors:
            raise KeyError(f"camera {self.name!r} has no detector {detector!r}")
        k = self.detectors.index(detector)
        solution = self.solutions[detector]
        ux, uy = solution.undistort(x, y)
        offset = np.array([ux - solution.crpix[0], uy - solution.crpix[1]])
        place = np.tensordot(self.matrices[k], offset, axes=1)
        return tuple(p + q for p, q in zip(place, self.places[k]))


def build_camera(name, exposures, solutions, *, provenance=None):
    """Build a camera from calibrated exposures.

    Parameters
    ----------
    name : str
        Name of the camera.
    exposures : sequence of list of Calibration
        Frames of each exposure.
    solutions : dict
        Solution of each detector.
    provenance : dict, optional
        Origin of the camera.

    Returns
    -------
    Camera
        Camera with the mean places over the exposures; detectors that are not connected to the
        others by exposures, even indirectly, are left out.

    Examples
    --------
    >>> import numpy as np
    >>> from wpdc_gwcs import Calibration, DistortionSolution, PVPolynomial
    >>> from wpdc_gwcs.camera import build_camera
    >>> cd, pv, center = np.diag([-1e-4, 1e-4]), PVPolynomial(), np.array([499.5, 499.5])
    >>> solutions, frames = {}, []
    >>> for name, ra in (("a", 10.0), ("b", 9.89)):  # the second one 0.11 deg to the west
    ...     sky = np.array([ra, 0.0])
    ...     solutions[name] = DistortionSolution(name, (1000, 1000), center, cd, sky, pv)
    ...     frames.append(Calibration(name, solutions[name], crval=sky, cd=cd))
    >>> camera = build_camera("pair", [frames], solutions)
    >>> camera.places.round(2).tolist()
    [[0.0, 0.0], [1100.0, 0.0]]
    """
    by_detector = [{c.solution.detector: c for c in frames} for frames in exposures]
    names = [n for n in solutions if any(n in frames for frames in by_detector)]
    partners = {n: sum(len(f) - 1 for f in by_detector if n in f) for n in names}
    reference = max(names, key=partners.get)
    found = {reference: (np.zeros(2), np.eye(2))}
    waiting = [reference]
    while waiting:
        known = waiting.pop(0)
        for n in names:
            pairs = [_relative(f[known], f[n]) for f in by_detector if known in f and n in f]
            if n in found or not pairs:
                continue
            place, matrix = (np.mean([p[i] for p in pairs], axis=0) for i in range(2))
            base, turn = found[known]
            found[n] = base + turn @ place, turn @ matrix
            waiting.append(n)
    kept = tuple(n for n in names if n in found)
    return Camera(
        name=name,
        detectors=kept,
        reference=reference,
        places=np.array([found[n][0] for n in kept]),
        matrices=np.array([found[n][1] for n in kept]),
        image_shapes=np.array([solutions[n].image_shape for n in kept]),
        cd=np.asarray(solutions[reference].cd, float),
        learned=solutions[reference].statistics.get("learned", {}),
        solutions={n: solutions[n] for n in kept},
        provenance=provenance or {},
    )


def _relative(base, other):
    """Give reference point and linear map of a frame in the undistorted px of another one."""
    step = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    sky = deproject(*(np.asarray(other.cd) @ step), other.crval)
    at = np.linalg.solve(base.cd, np.array(project(*sky, base.crval)))
    return at[:, 0], at[:, 1:] - at[:, :1]
