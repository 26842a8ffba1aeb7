"""Geometry of a camera from the detectors that are matched: where the others must be.

::

    pixel --header WCS--> sky --project about the exposure's center--> header plane
          --linear, per exposure--> focal plane of the camera (px)
          --smooth field of the camera + place of the detector--> true focal plane
          --linear, per exposure--> tangent plane --> sky

The header's geometry is common to all exposures of a camera, up to a linear mapping.  What it lacks
is a polynomial of the focal plane (the optics), three numbers per axis for each detector (its
place) and three per axis for each exposure (pointing, rotation, scale).  All of them are found
together from the matched frames, each with a Gaussian prior whose width is learnt from the data, so
that a prediction has an error: small between matched detectors, growing outward.
"""

from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg
import scipy.sparse

from wpdc_gwcs.calibration.start import sky_of
from wpdc_gwcs.models import deproject, project

__all__ = ["FocalPlane", "LocalPairs", "Prediction", "fit_focal_plane", "focal_planes"]

# Where frames are compared: a grid that tells a quadratic from a linear displacement.
_NODES = 0.8 * np.array([(i, j) for i in (-1.0, 0.0, 1.0) for j in (-1.0, 0.0, 1.0)])
# Degree of the field: cameras bend by r^3 to r^7.
_DEGREE = 7
_TERMS = [(d - j, j) for d in range(2, _DEGREE + 1) for j in range(d + 1)]
_TERM_DEGREE = np.array([i + j for i, j in _TERMS])
# Widths of the priors before anything is known: displacement at the rim by degree, as a share of
# the radius of the camera (raw headers of prime-focus cameras are off by up to 5 % there);
# places of detectors in px and turns and stretches as a share; the linear part of an exposure as a
# share of the radius.
_FIELD = {2: 0.01, 3: 0.03, 4: 0.01, 5: 0.01, 6: 0.005, 7: 0.005}
_PLACE, _TURN = 20.0, 1e-3
_POINTING, _ATTITUDE = 1e4, 0.05
# What no smooth field explains within a detector, px, at least.
_LEAST_NOISE = 0.1
_FIRST_NOISE = 1.0
# Pairs from which on the residuals of a frame may have a curvature of their own.
_FOR_QUADRATIC = 30
# Headers whose geometries differ by more than this, px, are not those of one camera.
_DIFFERENT = 30.0
_ROUNDS_OF_VARIANCES = 6


@dataclass(frozen=True, eq=False)
class LocalPairs:
    """Pairs of a matched frame: pixels and sky."""

    x: np.ndarray
    y: np.ndarray
    ra: np.ndarray
    dec: np.ndarray


@dataclass(frozen=True, eq=False)
class _Exposure:
    """One exposure: tangent point, and the linear mapping of the header plane (px) to the focal."""

    crval: np.ndarray
    offset: np.ndarray
    matrix: np.ndarray


@dataclass(frozen=True, eq=False)
class FocalPlane:
    """Frames whose header geometry is one camera's, up to a linear mapping per exposure.

    Parameters
    ----------
    frames : dict
        Frame name to frame.
    exposures : dict
        Exposure to its tangent point and mapping of the header plane.
    centers : dict
        Detector to its center in the focal plane, px.
    halves : dict
        Detector to half of its diagonal, px.
    scale : float
        Degrees per px.
    radius : float
        Radius of the camera, px.
    """

    frames: dict
    exposures: dict
    centers: dict
    halves: dict
    scale: float
    radius: float

    def header_place(self, frame, x, y):
        """Focal plane position of pixels by the header.

        Parameters
        ----------
        frame : Frame
            One of the frames.
        x, y : (N,) array_like
            Pixels.

        Returns
        -------
        (N, 2) ndarray
            Position, px.
        """
        exposure = self.exposures[frame.exposure]
        plane = np.column_stack(project(*sky_of(frame.wcs, x, y), exposure.crval)) / self.scale
        return exposure.offset + plane @ exposure.matrix.T


@dataclass(frozen=True, eq=False)
class Prediction:
    """Where a frame is by the other frames of its camera: a WCS, and how wrong it may be.

    Parameters
    ----------
    geometry : Geometry
        What was found.
    frame : Frame
        The frame.
    shift, bend : float
        Errors of the place as a whole and of the turn and stretch within the frame, px, 1 sigma.
    """

    geometry: "Geometry"
    frame: object
    shift: float
    bend: float

    def pixel_to_world_values(self, x, y):
        """Sky position of pixels.

        Parameters
        ----------
        x, y : (N,) array_like
            Pixels, zero based.

        Returns
        -------
        ra, dec : (N,) ndarray
            ICRS, deg.
        """
        geometry, plane = self.geometry, self.geometry.plane
        target = geometry.true_place(self.frame, np.ravel(x), np.ravel(y))
        offset, matrix = geometry.attitudes[self.frame.exposure]
        t = np.linalg.solve(matrix, (target - offset).T) * plane.scale
        ra, dec = deproject(*t, plane.exposures[self.frame.exposure].crval)
        return np.reshape(ra, np.shape(x)), np.reshape(dec, np.shape(x))


@dataclass(frozen=True, eq=False)
class Geometry:
    """What the matched frames say of a camera.

    Parameters
    ----------
    plane : FocalPlane
        The frames.
    attitudes : dict
        Exposure to the linear mapping (offset, matrix) from tangent to true focal plane.
    field : (n_terms, 2) ndarray
        Coefficients of the smooth field, px.
    places : dict
        Detector to the coefficients (3, 2) of its place, px.
    widths : Widths
        Priors as learnt.
    deviations : dict
        Matched frame to how far it is from where the others predict it: (sigma, px).
    covariance : (n, n) ndarray
        Of all unknowns of one axis, px2.
    columns : dict
        Where the unknowns of exposures and detectors are.
    linear : dict
        Exposure to the mapping about which the attitude was linearized.
    """

    plane: FocalPlane
    attitudes: dict
    field: np.ndarray
    places: dict
    widths: "Widths"
    deviations: dict
    covariance: np.ndarray
    columns: dict
    linear: dict

    def true_place(self, frame, x, y):
        """Focal plane position of pixels, distortion and place of the detector corrected.

        Parameters
        ----------
        frame : Frame
            One of the frames.
        x, y : (N,) array_like
            Pixels.

        Returns
        -------
        (N, 2) ndarray
            Position, px.
        """
        at = self.plane.header_place(frame, x, y)
        place = _place_terms(self.plane, frame.detector, at) @ self.places[frame.detector]
        return at + _field_terms(self.plane, at) @ self.field + place

    def predict(self, frame):
        """Predict where a frame is; `None` where nothing is known of its exposure.

        Parameters
        ----------
        frame : Frame
            A frame of the focal plane.

        Returns
        -------
        Prediction or None
            With its errors.
        """
        if frame.exposure not in self.attitudes:
            return None
        at = self.plane.header_place(frame, *_node_pixels(frame))
        true = self.true_place(frame, *_node_pixels(frame))
        offset, matrix = self.attitudes[frame.exposure]
        t = np.linalg.solve(matrix, (true - offset).T).T
        rows = np.zeros((len(at), len(self.covariance)))
        _fill(rows, self.plane, self.columns, frame, at, self._linearized(frame, t))
        s = rows @ self.covariance @ rows.T
        common = max(float(s.mean()), 0.0)
        bend = max(float(np.trace(s)) / len(s) - common, 0.0)
        noise = self.widths.noise**2
        # the corners are 1.5 times as far out as the rms of the nodes
        return Prediction(self, frame, np.sqrt(common + noise), 1.5 * np.sqrt(bend + noise))

    def _linearized(self, frame, t):
        offset, matrix = self.linear[frame.exposure]
        return offset + t @ matrix.T


@dataclass(frozen=True)
class Widths:
    """Standard deviations of the priors, px: field by degree, places, turns, noise."""

    field: tuple
    place: float
    turn: float
    noise: float


def focal_planes(frames):
    """Sort the frames of a camera into focal planes whose headers agree.

    Parameters
    ----------
    frames : list of Frame
        Of one camera, with exposures.

    Returns
    -------
    list of FocalPlane
        One as a rule; several where exposures have no detector in common or another geometry.
    """
    exposures, planes = {}, []
    for frame in frames:
        nodes = np.array(sky_of(frame.wcs, *_node_pixels(frame)))
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
    # twice: the plane must touch the sky where the first exposure's does, or it is another plane
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


def _node_pixels(frame):
    ny, nx = frame.image_shape
    return 0.5 * (nx - 1) + 0.5 * nx * _NODES[:, 0], 0.5 * (ny - 1) + 0.5 * ny * _NODES[:, 1]


def _mean_direction(nodes):
    ra, dec = np.deg2rad(np.concatenate([np.asarray(n) for n in nodes], axis=1))
    v = np.array([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)]).mean(axis=1)
    return np.rad2deg([np.arctan2(v[1], v[0]) % (2 * np.pi), np.arctan2(v[2], np.hypot(*v[:2]))])


def _pixel_scale(frame, nodes, crval):
    plane = np.column_stack(project(*nodes, crval))
    pixels = np.column_stack(_node_pixels(frame))
    # corners and middles of the sides: two steps that span the detector
    steps = np.array([plane[7] - plane[1], plane[5] - plane[3]])
    sizes = np.array([pixels[7] - pixels[1], pixels[5] - pixels[3]])
    return float(np.sqrt(abs(np.linalg.det(steps) / np.linalg.det(sizes))))


def _field_terms(plane, at):
    u, v = at.T / plane.radius
    return np.column_stack([u**i * v**j for i, j in _TERMS])


def _place_terms(plane, detector, at):
    step = (at - plane.centers[detector]) / plane.halves[detector]
    return np.column_stack([np.ones(len(at)), step])


def _fill(rows, plane, columns, frame, at, t):
    """Write the coefficients of the unknowns for positions of a frame: attitude - field - place."""
    k = columns["exposures"][frame.exposure]
    rows[:, k] = 1.0
    rows[:, k + 1 : k + 3] = t / plane.radius
    k = columns["field"]
    rows[:, k : k + len(_TERMS)] = -_field_terms(plane, at)
    k = columns["detectors"][frame.detector]
    rows[:, k : k + 3] = -_place_terms(plane, frame.detector, at)


def fit_focal_plane(plane, pairs, before=None):
    """Find the geometry of a camera from matched frames.

    Parameters
    ----------
    plane : FocalPlane
        The frames.
    pairs : dict
        Frame name to `LocalPairs` of the matched ones.
    before : Geometry, optional
        What was found from fewer frames: its widths are the first ones.

    Returns
    -------
    Geometry
        Field, places and attitudes with their covariance.
    """
    names = [n for n in plane.frames if n in pairs]
    exposures = list(dict.fromkeys(plane.frames[n].exposure for n in names))
    detectors = list(plane.centers)
    columns = {
        "field": 0,
        "exposures": {e: len(_TERMS) + 3 * k for k, e in enumerate(exposures)},
        "detectors": {d: len(_TERMS) + 3 * (len(exposures) + k) for k, d in enumerate(detectors)},
    }
    size = len(_TERMS) + 3 * (len(exposures) + len(detectors))
    parts = [_nodes_of(plane, plane.frames[n], pairs[n], before) for n in names]
    linear = _first_attitudes(plane, names, parts)
    design = np.zeros((len(_NODES) * len(names), size))
    target = np.zeros((len(design), 2))
    variance = np.zeros(len(design))
    for k, (name, (at, t, var)) in enumerate(zip(names, parts, strict=True)):
        rows, frame = slice(k * len(_NODES), (k + 1) * len(_NODES)), plane.frames[name]
        offset, matrix = linear[frame.exposure]
        moved = offset + t @ matrix.T
        _fill(design[rows], plane, columns, frame, at, moved)
        target[rows], variance[rows] = at - moved, var
    half = float(np.median(list(plane.halves.values())))
    widths = before.widths if before is not None else _first_widths(plane, half)
    for _ in range(_ROUNDS_OF_VARIANCES):
        solution, covariance, residual = _solve(design, target, variance, widths, columns, plane)
        widths = _learn(solution, covariance, residual, widths, columns, half, plane, names)
    solution, covariance, residual = _solve(design, target, variance, widths, columns, plane)
    attitudes = {}
    for e, k in columns["exposures"].items():
        offset, matrix = linear[e]
        extra = solution[k + 1 : k + 3].T / plane.radius
        attitudes[e] = (
            offset + solution[k] + extra @ offset,
            matrix + extra @ matrix,
        )
    geometry = Geometry(
        plane=plane,
        attitudes=attitudes,
        field=solution[: len(_TERMS)],
        places={d: solution[k : k + 3] for d, k in columns["detectors"].items()},
        widths=widths,
        deviations={},
        covariance=covariance,
        columns=columns,
        linear=linear,
    )
    noise = variance + 3 * widths.noise**2
    return replace(geometry, deviations=_deviations(names, design, residual, noise, covariance))


def _nodes_of(plane, frame, pairs, before):
    """Header and tangent-plane positions of the nodes of a matched frame, with their variance.

    What the prediction does not explain is smooth over the frame: a low-order polynomial through
    the residuals of its pairs carries it to the nodes.
    """
    exposure = plane.exposures[frame.exposure]
    nodes = _node_pixels(frame)
    at = plane.header_place(frame, *nodes)
    sky = np.column_stack(project(pairs.ra, pairs.dec, exposure.crval)) / plane.scale
    inverse = np.linalg.inv(exposure.matrix)
    known, at_nodes = plane.header_place(frame, pairs.x, pairs.y), at
    offset = exposure.offset
    if before is not None and frame.exposure in before.attitudes:
        known, at_nodes = (before.true_place(frame, *p) for p in ((pairs.x, pairs.y), nodes))
        offset, matrix = before.attitudes[frame.exposure]
        inverse = np.linalg.inv(matrix)
    known, at_nodes = ((p - offset) @ inverse.T for p in (known, at_nodes))
    ny, nx = frame.image_shape
    u, v = 2 * pairs.x / (nx - 1) - 1, 2 * pairs.y / (ny - 1) - 1
    order = 2 if len(u) >= _FOR_QUADRATIC else 1
    design, there = _low_order(u, v, order), _low_order(*_NODES.T, order)
    # as at least one pixel of the frame's own for the few: three pairs always agree
    ridge = np.diag([1e-6, *[1e-4] * (design.shape[1] - 1)])
    keep = np.ones(len(u), bool)
    for _ in range(4):
        a, d = design[keep], (sky - known)[keep]
        inner = np.linalg.inv(a.T @ a + ridge)
        fit = inner @ (a.T @ d)
        left = np.hypot(*(sky - known - design @ fit).T)
        sigma = max(0.85 * np.median(left[keep]), 0.02)
        new = left < 4 * sigma
        if (new == keep).all() or new.sum() <= design.shape[1]:
            break
        keep = new
    leverage = np.einsum("ij,jk,ik->i", there, inner, there)
    # nine nodes tell no more than the terms of the fit
    share = len(_NODES) / design.shape[1]
    return at, at_nodes + there @ fit, share * sigma**2 * leverage


def _low_order(u, v, order):
    one = np.ones_like(u)
    return np.column_stack([one, u, v] + ([u * u, u * v, v * v] if order == 2 else []))


def _first_attitudes(plane, names, parts):
    """Robust linear mapping of each exposure from tangent to focal plane: median of the frames'."""
    groups = {}
    for name, (at, t, _) in zip(names, parts, strict=True):
        groups.setdefault(plane.frames[name].exposure, []).append((at, t))
    linear = {}
    for exposure, group in groups.items():
        matrices = []
        for at, t in group:
            a, b = at - at.mean(axis=0), t - t.mean(axis=0)
            matrices.append(np.linalg.lstsq(b, a, rcond=None)[0].T)
        matrix = np.median(matrices, axis=0)
        header = plane.exposures[exposure].matrix
        if np.abs(matrix @ np.linalg.inv(header) - np.eye(2)).max() < _ATTITUDE:
            # near enough: all exposures of one header then have the same scale
            matrix = header
        offset = np.median([(at - t @ matrix.T).mean(axis=0) for at, t in group], axis=0)
        linear[exposure] = offset, matrix
    return linear


def _first_widths(plane, half):
    field = tuple(_FIELD[d] * plane.radius for d in range(2, _DEGREE + 1))
    return Widths(field, _PLACE, _TURN * half, _FIRST_NOISE)


def _priors(widths, columns, plane, size):
    prior = np.empty(size)
    prior[: len(_TERMS)] = np.array(widths.field)[_TERM_DEGREE - 2]
    for k in columns["exposures"].values():
        prior[k], prior[k + 1 : k + 3] = _POINTING, _ATTITUDE * plane.radius
    for k in columns["detectors"].values():
        prior[k], prior[k + 1 : k + 3] = widths.place, widths.turn
    return prior


def _solve(design, target, variance, widths, columns, plane):
    """Posterior of all unknowns: means of both axes, covariance of one, residuals."""
    prior = _priors(widths, columns, plane, design.shape[1])
    # unknowns in units of their priors: well scaled, whatever they are
    weight = 1 / np.sqrt(variance + 3 * widths.noise**2)
    rows = scipy.sparse.csr_array(design * prior * weight[:, None])
    normal = (rows.T @ rows).toarray()
    normal[np.diag_indices_from(normal)] += 1.0
    factor = scipy.linalg.cho_factor(normal)
    inverse = scipy.linalg.cho_solve(factor, np.eye(len(normal)))
    solution = (inverse @ (rows.T @ (target * weight[:, None]))) * prior[:, None]
    covariance = inverse * prior * prior[:, None]
    return solution, covariance, target - design @ solution


def _learn(solution, covariance, residual, widths, columns, half, plane, names):
    """Widths of the priors from what they gave (EM); medians where a wrong frame must not count."""
    second = (solution**2).mean(axis=1) + np.diag(covariance)
    field = tuple(
        float(np.sqrt(second[: len(_TERMS)][_TERM_DEGREE == d].mean()))
        for d in range(2, _DEGREE + 1)
    )
    seen = {plane.frames[n].detector for n in names}
    starts = [columns["detectors"][d] for d in seen]
    # 0.455 is the median of chi-square with one degree of freedom
    place = np.sqrt(np.median([second[k] for k in starts]) / 0.455)
    turn = np.sqrt(np.median([second[k + 1 : k + 3].mean() for k in starts]) / 0.455)
    # with few detectors the first guess has its say, as five of them
    n = len(starts)
    place = np.sqrt((n * place**2 + 5 * _PLACE**2) / (n + 5))
    turn = np.sqrt((n * turn**2 + 5 * (_TURN * half) ** 2) / (n + 5))
    frames = np.sqrt((residual.reshape(len(names), -1) ** 2).mean(axis=1))
    noise = max(_LEAST_NOISE, 1.5 * float(np.median(frames)))
    return Widths(field, float(place), float(turn), noise)


def _deviations(names, design, residual, noise, covariance):
    """How far each frame is from where the others predict it, sigma and px."""
    weight = 1 / np.sqrt(noise)
    n = len(_NODES)
    deviations = {}
    for k, name in enumerate(names):
        rows = slice(k * n, (k + 1) * n)
        a = design[rows] * weight[rows, None]
        r = residual[rows] * weight[rows, None]
        hat = np.eye(n) - a @ covariance @ a.T
        left_out = np.linalg.solve(hat + 1e-12 * np.eye(n), r)
        # three numbers per axis, whatever the number of nodes
        sigma = np.sqrt(max(float((r * left_out).sum()), 0.0) / 6)
        shift = np.hypot(*(left_out / weight[rows, None]).mean(axis=0))
        deviations[name] = sigma, float(shift)
    return deviations
