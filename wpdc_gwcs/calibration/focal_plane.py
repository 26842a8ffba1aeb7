"""The focal plane of a camera according to its headers, common to all exposures.

::

    pixel --header WCS--> sky --project about the exposure's center--> header plane
          --linear, per exposure--> focal plane of the camera (px)
"""

from dataclasses import dataclass, replace

import numpy as np

from wpdc_gwcs.calibration.start import sky_of
from wpdc_gwcs.models import deproject, project

__all__ = ["NODES", "FocalPlane", "focal_planes", "node_pixels"]

# Positions where frames are compared: a grid that distinguishes a quadratic displacement from a
# linear one.
NODES = 0.8 * np.array([(i, j) for i in (-1.0, 0.0, 1.0) for j in (-1.0, 0.0, 1.0)])
# Headers whose geometries differ by more than this, px, are not those of one camera.
_DIFFERENT = 30.0


@dataclass(frozen=True, eq=False)
class _Exposure:
    """One exposure: tangent point, and the linear mapping of the header plane (px) to the focal."""

    crval: np.ndarray
    offset: np.ndarray
    matrix: np.ndarray


@dataclass(frozen=True, eq=False)
class FocalPlane:
    """Frames whose headers have the same camera geometry, up to a linear mapping per exposure.

    Parameters
    ----------
    frames : dict
        Frames by name.
    exposures : dict
        Tangent point of each exposure, and its linear mapping to the focal plane.
    centers : dict
        Center of each detector in the focal plane, px.
    halves : dict
        Half diagonal of each detector, px.
    scale : float
        Pixel scale, deg / px.
    radius : float
        Radius of the camera, px.
    """

    frames: dict
    exposures: dict
    centers: dict
    halves: dict
    scale: float
    radius: float

    def of(self, exposure):
        """Return the focal plane of a single exposure.

        Parameters
        ----------
        exposure : str
            Key of the exposure.

        Returns
        -------
        FocalPlane
            The same focal plane with only the frames of this exposure.
        """
        frames = {n: f for n, f in self.frames.items() if f.exposure == exposure}
        return replace(self, frames=frames, exposures={exposure: self.exposures[exposure]})

    def header_place(self, frame, x, y):
        """Return the focal plane position of pixels according to the header.

        Parameters
        ----------
        frame : Frame
            One of the frames.
        x, y : (N,) array_like
            Pixels, zero based.

        Returns
        -------
        (N, 2) ndarray
            Positions, px.
        """
        exposure = self.exposures[frame.exposure]
        plane = np.column_stack(project(*sky_of(frame.wcs, x, y), exposure.crval)) / self.scale
        return exposure.offset + plane @ exposure.matrix.T


def focal_planes(frames):
    """Group the frames of a camera into focal planes whose headers agree.

    Parameters
    ----------
    frames : list of Frame
        Frames of one camera; each belongs to an exposure.

    Returns
    -------
    list of FocalPlane
        Usually one; several if exposures have no detector in common, or a different geometry.
    """
    exposures, planes = {}, []
    for frame in frames:
        nodes = np.array(sky_of(frame.wcs, *node_pixels(frame)))
        if np.isfinite(nodes).all():
            exposures.setdefault(frame.exposure, {})[frame.detector] = frame, nodes
    left = sorted(exposures, key=lambda e: -len(exposures[e]))
    while left:
        plane, left = _collect(exposures, left)
        planes.append(plane)
    return planes


def _collect(exposures, left):
    """Focal plane of the first exposure and of all that agree with it; the exposures left."""
    first, rest = left[0], list(left[1:])
    nodes = {d: n for d, (_, n) in exposures[first].items()}
    crval = _mean_direction(nodes.values())
    frame, at = next(iter(exposures[first].values()))
    scale = _pixel_scale(frame, at, crval)
    focal = {d: np.column_stack(project(*n, crval)) / scale for d, n in nodes.items()}
    found = {first: _Exposure(crval, np.zeros(2), np.eye(2))}
    again = True
    while again:
        again = False
        for exposure in list(rest):
            members = exposures[exposure]
            common = [d for d in members if d in focal]
            if not common:
                continue
            rest.remove(exposure)
            mapped = _header_mapping(
                [members[d][1] for d in common], [focal[d] for d in common], scale
            )
            if mapped is None:
                continue
            again = True
            found[exposure] = mapped
            for d in members:
                if d not in focal:
                    plane = np.column_stack(project(*members[d][1], mapped.crval)) / scale
                    focal[d] = mapped.offset + plane @ mapped.matrix.T
    centers = {d: p[len(p) // 2] for d, p in focal.items()}
    halves = {d: np.hypot(*(p - p[len(p) // 2]).T).max() / 0.8 for d, p in focal.items()}
    radius = max(np.hypot(*c) + halves[d] for d, c in centers.items())
    frames = {f.name: f for e in found for f, _ in exposures[e].values()}
    plane = FocalPlane(frames, found, centers, halves, scale, float(radius))
    return plane, [e for e in left if e not in found]


def _header_mapping(nodes, focal, scale):
    """Linear mapping of an exposure's header plane to the focal plane; `None` if it has none."""
    to = np.concatenate(focal)
    crval = _mean_direction(nodes)
    # Repeated: the plane has to touch the sky at the same point as that of the first exposure.
    for _ in range(3):
        plane = np.concatenate([np.column_stack(project(*n, crval)) for n in nodes]) / scale
        design = np.column_stack([np.ones(len(plane)), plane])
        fit = np.linalg.lstsq(design, to, rcond=None)[0]
        offset, matrix = fit[0], fit[1:].T
        if abs(np.linalg.det(matrix)) < 0.1:
            return None
        origin = np.linalg.solve(matrix, -offset) * scale
        crval = np.array([float(c) for c in deproject(*origin, crval)])
    plane = np.concatenate([np.column_stack(project(*n, crval)) for n in nodes]) / scale
    left = to - offset - plane @ matrix.T - (to - offset - plane @ matrix.T).mean(axis=0)
    if np.median(np.hypot(*left.T)) > _DIFFERENT:
        return None
    offset = (to - plane @ matrix.T).mean(axis=0)
    return _Exposure(crval, offset, matrix)


def node_pixels(frame):
    """Return the pixels of the nodes of a frame.

    Parameters
    ----------
    frame : Frame
        Any frame.

    Returns
    -------
    x, y : (9,) ndarray
        Pixels, zero based.
    """
    ny, nx = frame.image_shape
    return 0.5 * (nx - 1) + 0.5 * nx * NODES[:, 0], 0.5 * (ny - 1) + 0.5 * ny * NODES[:, 1]


def _mean_direction(nodes):
    ra, dec = np.deg2rad(np.concatenate([np.asarray(n) for n in nodes], axis=1))
    v = np.array([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)]).mean(axis=1)
    return np.rad2deg([np.arctan2(v[1], v[0]) % (2 * np.pi), np.arctan2(v[2], np.hypot(*v[:2]))])


def _pixel_scale(frame, nodes, crval):
    plane = np.column_stack(project(*nodes, crval))
    pixels = np.column_stack(node_pixels(frame))
    # The vectors between the middles of opposite sides span the detector.
    steps = np.array([plane[7] - plane[1], plane[5] - plane[3]])
    sizes = np.array([pixels[7] - pixels[1], pixels[5] - pixels[3]])
    return float(np.sqrt(abs(np.linalg.det(steps) / np.linalg.det(sizes))))
