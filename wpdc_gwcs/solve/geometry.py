"""Positions of detectors in the focal plane, and pointings of exposures.

::

    pixel --[place: P + M (x - CRPIX)]--> focal plane (px) --[pointing q, matrix R]--> sky
"""

from dataclasses import dataclass

import numpy as np

from wpdc_gwcs.fitting import fit_attitude
from wpdc_gwcs.models import deproject, project

__all__ = ["Geometry", "mean_direction", "start_geometry"]

# Points along each axis that represent the linear WCS of a frame.
_POINTS = 4

# Step on the tangent plane for measuring its rotation, deg.
_STEP = 1e-3


@dataclass(frozen=True, eq=False)
class Geometry:
    """The linear part of a camera and its exposures.

    The focal plane is in px along the axes of its first detector, so a single detector is its own
    focal plane.

    Parameters
    ----------
    place : (D, 2) ndarray
        Focal plane position of the reference point of each detector, px.
    matrix : (D, 2, 2) ndarray
        Focal plane px per detector px.
    pointing : (E, 2) ndarray
        Right ascension and declination of the origin of the focal plane, deg.
    cd : (E, 2, 2) ndarray
        Tangent plane deg per focal plane px.
    radius : float
        Radius of the focal plane about its origin, px.
    """

    place: np.ndarray
    matrix: np.ndarray
    pointing: np.ndarray
    cd: np.ndarray
    radius: float

    def focal(self, k, detector, x, y):
        """Return the focal plane position of pixels of a detector, without any distortion.

        Parameters
        ----------
        k : int
            Number of the detector.
        detector : Detector
            The detector.
        x : (N,) ndarray
            Pixels along x.
        y : (N,) ndarray
            Pixels along y.
        """
        offset = np.array([x - detector.crpix[0], y - detector.crpix[1]])
        return self.place[k][:, None] + self.matrix[k] @ offset

    def reference(self, exposure, ra, dec):
        """Return the focal plane position of sky positions in one exposure, ``(2, N)``, px.

        Parameters
        ----------
        exposure : int
            Number of the exposure.
        ra : (N,) ndarray
            Right ascensions, deg.
        dec : (N,) ndarray
            Declinations, deg.
        """
        plane = np.array(project(ra, dec, self.pointing[exposure]))
        return np.linalg.solve(self.cd[exposure], plane)

    def sky(self, exposure, focal):
        """Return the sky position of focal plane positions in one exposure, deg.

        Parameters
        ----------
        exposure : int
            Number of the exposure.
        focal : (2, N) ndarray
            Focal plane, px.
        """
        return deproject(*(self.cd[exposure] @ focal), self.pointing[exposure])

    def moved(self, exposure, shift, matrix):
        """Return pointing and CD of an exposure if ``shift + matrix @ focal`` replaces ``focal``.

        Parameters
        ----------
        exposure : int
            Number of the exposure.
        shift : (2,) ndarray
            Shift of the focal plane, px.
        matrix : (2, 2) ndarray
            Linear map of the focal plane.
        """
        cd = self.cd[exposure]
        at = cd @ shift
        # The direction of north depends on the pointing, near a pole by any angle.
        step = at[:, None] + _STEP * np.array([[0.0, 1.0, -1.0, 0.0, 0.0],
                                               [0.0, 0.0, 0.0, 1.0, -1.0]])  # fmt: skip
        sky = np.array(deproject(*step, self.pointing[exposure]))
        plane = np.array(project(*sky, sky[:, 0]))
        turn = np.stack([plane[:, 1] - plane[:, 2], plane[:, 3] - plane[:, 4]], axis=1)
        return sky[:, 0], turn / (2 * _STEP) @ cd @ matrix


def start_geometry(observations):
    """Derive positions of detectors and pointings of exposures from the WCS of the frames.

    Parameters
    ----------
    observations : Observations
        Observations whose frames have CRVAL and CD.

    Returns
    -------
    Geometry
        Geometry that agrees with the attitudes of the frames.
    """
    o = observations
    n_detectors, n_exposures = len(o.detectors), o.n_exposures
    if n_detectors == 1:
        cd = np.array([np.asarray(f.cd, float) for f in o.frames])
        detector = o.detectors[0]
        corners = np.array(detector.grid(2)) - detector.crpix[:, None]
        return Geometry(
            place=np.zeros((1, 2)),
            matrix=np.eye(2)[None],
            pointing=_by_exposure(o, [np.asarray(f.crval, float) for f in o.frames]),
            cd=_by_exposure(o, cd),
            radius=float(np.hypot(*corners).max()),
        )
    return _start_mosaic(o, n_detectors, n_exposures)


def _by_exposure(o, values):
    """One value for each exposure: that of its first frame."""
    return np.array([values[o.frames_of(e)[0]] for e in range(o.n_exposures)])


def _start_mosaic(o, n_detectors, n_exposures):
    # The exposure with the most detectors defines the focal plane; others join by shared detectors.
    size = np.bincount(o.exposure_of, minlength=n_exposures)
    points = [_points(f, o.detector(k)) for k, f in enumerate(o.frames)]
    place, matrix = np.full((n_detectors, 2), np.nan), np.full((n_detectors, 2, 2), np.nan)
    pointing, cd = np.full((n_exposures, 2), np.nan), np.full((n_exposures, 2, 2), np.nan)
    todo = set(range(n_exposures))
    first = int(np.argmax(size))
    while todo:
        known = np.isfinite(place[:, 0])
        shared = {e: int(known[o.detector_of[o.frames_of(e)]].sum()) for e in todo}
        e = max(todo, key=lambda e: (shared[e], size[e]))
        if not shared[e]:
            # Not connected to the others: a separate focal plane about the same origin.
            e = first if first in todo else e
            frames = o.frames_of(e)
            centers = np.array([points[k][1][:, 0] for k in frames])
            pointing[e] = mean_direction(centers)
            cd[e] = _first_matrix(o.frames[frames[0]], pointing[e])
        else:
            frames = [k for k in o.frames_of(e) if known[o.detector_of[k]]]
            pointing[e], cd[e] = _fit_pointing(o, frames, points, place, matrix, cd[first])
        todo.discard(e)
        for k in o.frames_of(e):
            d = o.detector_of[k]
            if not known[d]:
                place[d], matrix[d] = _place_of(points[k], o.detectors[d], pointing[e], cd[e])
    corners = np.concatenate(
        [
            place[d][:, None] + matrix[d] @ (np.array(det.grid(2)) - det.crpix[:, None])
            for d, det in enumerate(o.detectors)
        ],
        axis=1,
    )
    return Geometry(place, matrix, pointing, cd, float(np.hypot(*corners).max()))


def _points(frame, detector):
    """Pixels about the reference point, and their sky positions by the linear WCS of the frame."""
    x, y = detector.grid(_POINTS)
    x, y = np.append(detector.center[0], x), np.append(detector.center[1], y)
    offset = np.array([x, y]) - detector.crpix[:, None]
    return offset, np.array(deproject(*(np.asarray(frame.cd, float) @ offset), frame.crval))


def mean_direction(sky):
    """Compute the mean of directions as vectors, which is correct across 0 h and at the poles.

    Parameters
    ----------
    sky : (N, 2) array_like
        Right ascensions and declinations, deg.

    Returns
    -------
    (2,) ndarray
        Right ascension and declination, deg.
    """
    ra, dec = np.radians(np.asarray(sky)).T
    x, y, z = np.mean([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)], axis=1)
    return np.degrees([np.arctan2(y, x) % (2 * np.pi), np.arctan2(z, np.hypot(x, y))])


def _first_matrix(frame, pointing):
    """CD of the first frame on the tangent plane about another point."""
    cd, crval = np.asarray(frame.cd, float), np.asarray(frame.crval, float)
    step = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    plane = np.array(project(*deproject(*(cd @ step), crval), pointing))
    return plane[:, 1:] - plane[:, :1]


def _fit_pointing(o, frames, points, place, matrix, start):
    focal = np.concatenate(
        [
            place[o.detector_of[k]][:, None] + matrix[o.detector_of[k]] @ points[k][0]
            for k in frames
        ],
        axis=1,
    )
    sky = np.concatenate([points[k][1] for k in frames], axis=1)
    fit = fit_attitude(
        *focal, *sky, crpix=(0.0, 0.0), crval=mean_direction(sky.T), cd=_turned(focal, sky, start),
        clip=np.inf,
    )  # fmt: skip
    return fit.crval, fit.cd


def _turned(focal, sky, start):
    """Fit the starting CD of an exposure of any roll, on the plane about its center."""
    plane = np.array(project(*sky, mean_direction(sky.T)))
    a = focal - focal.mean(1, keepdims=True)
    b = plane - plane.mean(1, keepdims=True)
    matrix = np.linalg.lstsq(a.T, b.T, rcond=None)[0].T
    return matrix if np.linalg.matrix_rank(matrix) == 2 else start


def _place_of(points, detector, pointing, cd):
    offset, sky = points
    focal = np.linalg.solve(cd, np.array(project(*sky, pointing)))
    rows = np.stack([np.ones(offset.shape[1]), *offset], axis=1)
    fit = np.linalg.lstsq(rows, focal.T, rcond=None)[0]
    return fit[0], fit[1:].T
