"""Geometry of a camera from its matched detectors, to predict the positions of the others.

::

    pixel --headers--> focal plane of the camera (px)
          --smooth field of the camera + place of the detector--> true focal plane
          --linear, per exposure--> tangent plane --> sky

The header's geometry is common to all exposures of a camera, up to a linear mapping.  It lacks a
polynomial of the focal plane (the optics), three numbers per axis for each detector (its place),
and three per axis for each exposure (pointing, rotation, scale).  All of them are fitted together
to the matched frames, each with a Gaussian prior whose width is learned from the data.  So each
prediction has an error, which is small between matched detectors and grows outward.
"""

from dataclasses import dataclass

import numpy as np
import scipy.linalg

from wpdc_gwcs.calibration.focal_plane import NODES, FocalPlane, node_pixels
from wpdc_gwcs.models import deproject, project

__all__ = ["Geometry", "LocalPairs", "Prediction", "fit_geometry"]

# Degree of the field: the distortion of cameras has terms from r^3 to r^7.
_DEGREE = 7
_TERMS = [(d - j, j) for d in range(2, _DEGREE + 1) for j in range(d + 1)]
_TERM_DEGREE = np.array([i + j for i, j in _TERMS])
# Widths of the priors before anything is learned: displacement at the edge by degree, as a fraction
# of the radius of the camera (raw headers of prime-focus cameras are off by up to 5 % there);
# places of detectors in px, and their rotations and stretches; pointing of an exposure in px, and
# its linear part as a fraction of the radius.
_FIELD = {2: 0.01, 3: 0.03, 4: 0.01, 5: 0.01, 6: 0.005, 7: 0.005}
_PLACE, _TURN = 20.0, 1e-3
_POINTING, _ATTITUDE = 1e4, 0.05
# Noise that a smooth field leaves within a detector, px: more means a frame in the wrong place.
_LEAST_NOISE, _MOST_NOISE = 0.1, 3.0
_FIRST_NOISE = 1.0
# Number of pairs above which nodes replace them: enough for a safe quadratic polynomial.
_FOR_NODES = 30
# Minimum scatter of pairs, px: rounding, and for few pairs the curvature that they do not show.
_LEAST_SCATTER, _SCATTER_OF_FEW = 0.02, 0.3
# Frames that deviate by more standard errors than this count less.
_DOUBTFUL = 4.0
_ROUNDS_OF_VARIANCES = 6


@dataclass(frozen=True, eq=False)
class LocalPairs:
    """Pairs of a matched frame.

    Parameters
    ----------
    x, y : (N,) ndarray
        Pixels of the sources, zero based.
    ra, dec : (N,) ndarray
        Positions of the reference stars, deg.
    """

    x: np.ndarray
    y: np.ndarray
    ra: np.ndarray
    dec: np.ndarray


@dataclass(frozen=True, eq=False)
class Prediction:
    """The WCS of a frame as predicted from the other frames of its camera, with its error.

    Parameters
    ----------
    geometry : Geometry
        Geometry of the camera.
    frame : Frame
        The frame.
    shift, bend : float
        Standard errors in px: of the position of the frame as a whole, and of its rotation and
        stretch at the corners.
    """

    geometry: "Geometry"
    frame: object
    shift: float
    bend: float

    def pixel_to_world_values(self, x, y):
        """Return the sky positions of pixels.

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
    """Geometry of a camera, fitted to its matched frames.

    Parameters
    ----------
    plane : FocalPlane
        Focal plane of the headers, with all frames.
    attitudes : dict
        Linear mapping (offset, matrix) of each exposure from the tangent plane to the true focal
        plane.
    field : (n_terms, 2) ndarray
        Coefficients of the smooth field, px.
    places : dict
        Coefficients (3, 2) of the place of each detector, px.
    widths : Widths
        Learned widths of the priors.
    deviations : dict
        Deviation of each matched frame from the prediction of the others, in standard errors and
        in px.
    covariance : (n, n) ndarray
        Covariance of all unknowns of one axis, px^2.
    columns : dict
        Columns of the unknowns of exposures and detectors.
    linear : dict
        Mapping of each exposure about which its attitude was linearized.
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
        """Return the true focal plane position of pixels, with field and place corrected.

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
        at = self.plane.header_place(frame, x, y)
        place = _place_terms(self.plane, frame.detector, at) @ self.places[frame.detector]
        return at + _field_terms(self.plane, at) @ self.field + place

    def predict(self, frame):
        """Predict the WCS of a frame from the other frames.

        Parameters
        ----------
        frame : Frame
            A frame of the focal plane.

        Returns
        -------
        Prediction or None
            Prediction with its errors; `None` if no frame of its exposure is matched.
        """
        if frame.exposure not in self.attitudes:
            return None
        at = self.plane.header_place(frame, *node_pixels(frame))
        true = self.true_place(frame, *node_pixels(frame))
        offset, matrix = self.attitudes[frame.exposure]
        t = np.linalg.solve(matrix, (true - offset).T).T
        first = self.linear[frame.exposure]
        rows = _terms_of(self.plane, frame, at, first[0] + t @ first[1].T)
        columns = _columns_of(self.columns, frame)
        s = rows @ self.covariance[np.ix_(columns, columns)] @ rows.T
        common = max(float(s.mean()), 0.0)
        bend = max(float(np.trace(s)) / len(s) - common, 0.0)
        noise = self.widths.noise**2
        # The corners are 1.5 times as far out as the nodes (rms).
        return Prediction(self, frame, np.sqrt(common + noise), 1.5 * np.sqrt(bend + noise))


@dataclass(frozen=True)
class Widths:
    """Standard deviations of the priors.

    Parameters
    ----------
    field : tuple of float
        Field for each degree, px.
    place, turn : float
        Shifts, and rotations and stretches at the edge, of detectors, px.
    noise : float
        Noise of a frame, px.
    """

    field: tuple
    place: float
    turn: float
    noise: float


def _field_terms(plane, at):
    u, v = at.T / plane.radius
    return np.column_stack([u**i * v**j for i, j in _TERMS])


def _place_terms(plane, detector, at):
    step = (at - plane.centers[detector]) / plane.halves[detector]
    return np.column_stack([np.ones(len(at)), step])


def _terms_of(plane, frame, at, t):
    """Coefficients of the unknowns that a frame depends on: field, attitude, place.

    Attitude - field - place = header place - first guess; see `Geometry`.
    """
    attitude = np.column_stack([np.ones(len(at)), t / plane.radius])
    place = _place_terms(plane, frame.detector, at)
    return np.hstack([-_field_terms(plane, at), attitude, -place])


def _columns_of(columns, frame):
    """Where these unknowns are among all."""
    attitude, place = columns["exposures"][frame.exposure], columns["detectors"][frame.detector]
    return np.concatenate([np.arange(len(_TERMS)), attitude + np.arange(3), place + np.arange(3)])


@dataclass(eq=False)
class _Part:
    """What one matched frame brings to a fit: rows of the design and what they should give."""

    frame: object
    at: np.ndarray
    t: np.ndarray
    variance: np.ndarray
    design: np.ndarray = None
    columns: np.ndarray = None
    target: np.ndarray = None
    doubt: float = 1.0  # factor of the errors of a frame that the others contradict
    residual: np.ndarray = None

    def weights(self, noise):
        # The noise is common to the whole frame, so many rows count no more than three.
        common = max(1.0, len(self.at) / 3) * noise**2
        return 1 / (self.doubt * np.sqrt(self.variance + common))


def fit_geometry(plane, pairs, before=None):
    """Fit the geometry of a camera to its matched frames.

    Parameters
    ----------
    plane : FocalPlane
        Focal plane of the headers, with all frames.
    pairs : dict
        `LocalPairs` of each matched frame, by name.
    before : Geometry, optional
        Result for fewer frames, whose widths are the start values.

    Returns
    -------
    Geometry
        Field, places and attitudes with their covariance.
    """
    parts = [_part_of(plane, f, pairs[n], before) for n, f in plane.frames.items() if n in pairs]
    exposures = list(dict.fromkeys(part.frame.exposure for part in parts))
    first = len(_TERMS) + 3 * len(exposures)
    columns = {
        "exposures": {e: len(_TERMS) + 3 * k for k, e in enumerate(exposures)},
        "detectors": {d: first + 3 * k for k, d in enumerate(plane.centers)},
    }
    linear = _first_attitudes(plane, parts)
    for part in parts:
        offset, matrix = linear[part.frame.exposure]
        moved = offset + part.t @ matrix.T
        part.design = _terms_of(plane, part.frame, part.at, moved)
        part.columns = _columns_of(columns, part.frame)
        part.target = part.at - moved
    half = float(np.median(list(plane.halves.values())))
    widths = before.widths if before is not None else _first_widths(plane, half)
    for _ in range(_ROUNDS_OF_VARIANCES):
        solution, covariance = _solve(parts, widths, columns, plane)
        deviations = _deviations(parts, widths, covariance)
        for part in parts:
            part.doubt = max(1.0, (deviations[part.frame.name][0] / _DOUBTFUL) ** 2)
        widths = _learn(parts, solution, covariance, widths, columns, half)
    solution, covariance = _solve(parts, widths, columns, plane)
    attitudes = {}
    for e, k in columns["exposures"].items():
        offset, matrix = linear[e]
        extra = solution[k + 1 : k + 3].T / plane.radius
        attitudes[e] = offset + solution[k] + extra @ offset, matrix + extra @ matrix
    return Geometry(
        plane=plane,
        attitudes=attitudes,
        field=solution[: len(_TERMS)],
        places={d: solution[k : k + 3] for d, k in columns["detectors"].items()},
        widths=widths,
        deviations=_deviations(parts, widths, covariance),
        covariance=covariance,
        columns=columns,
        linear=linear,
    )


def _part_of(plane, frame, pairs, before):
    """Header and tangent-plane positions of the pairs of a frame, or of nodes that stand for many.

    What the prediction does not explain is smooth over the frame: a low-order polynomial through
    the residuals tells outliers from pairs, and carries many pairs to few nodes.
    """
    exposure = plane.exposures[frame.exposure]
    sky = np.column_stack(project(pairs.ra, pairs.dec, exposure.crval)) / plane.scale
    at = plane.header_place(frame, pairs.x, pairs.y)
    nodes = node_pixels(frame)
    offset, matrix, known = exposure.offset, exposure.matrix, at
    there = plane.header_place(frame, *nodes)
    known_there = there
    if before is not None and frame.exposure in before.attitudes:
        offset, matrix = before.attitudes[frame.exposure]
        known, known_there = (before.true_place(frame, *p) for p in ((pairs.x, pairs.y), nodes))
    inverse = np.linalg.inv(matrix)
    known, known_there = ((p - offset) @ inverse.T for p in (known, known_there))
    ny, nx = frame.image_shape
    many = len(at) >= _FOR_NODES
    design = _low_order(2 * pairs.x / (nx - 1) - 1, 2 * pairs.y / (ny - 1) - 1, 2 if many else 1)
    # Without this, three pairs on a line would be a singular problem.
    ridge = 1e-4 * np.eye(design.shape[1])
    keep = np.ones(len(at), bool)
    for _ in range(4):
        a, d = design[keep], (sky - known)[keep]
        inner = np.linalg.inv(a.T @ a + ridge)
        fit = inner @ (a.T @ d)
        left = np.hypot(*(sky - known - design @ fit).T)
        sigma = max(0.85 * np.median(left[keep]), _LEAST_SCATTER)
        new = left < 4 * sigma
        if (new == keep).all() or new.sum() <= design.shape[1] + 1:
            break
        keep = new
    if not many:
        sigma = max(sigma, _SCATTER_OF_FEW)
        return _Part(frame, at[keep], sky[keep], np.full(keep.sum(), sigma**2))
    low = _low_order(*NODES.T, 2)
    # Nine nodes contain no more information than the terms of the fit.
    variance = len(NODES) / low.shape[1] * sigma**2 * np.einsum("ij,jk,ik->i", low, inner, low)
    return _Part(frame, there, known_there + low @ fit, variance)


def _low_order(u, v, order):
    one = np.ones_like(u)
    return np.column_stack([one, u, v] + ([u * u, u * v, v * v] if order == 2 else []))


def _first_attitudes(plane, parts):
    """Robust linear mapping of each exposure from tangent to focal plane: median of the frames'."""
    groups = {}
    for part in parts:
        groups.setdefault(part.frame.exposure, []).append(part)
    linear = {}
    for exposure, group in groups.items():
        matrices = []
        for part in group:
            a, b = part.at - part.at.mean(axis=0), part.t - part.t.mean(axis=0)
            matrices.append(np.linalg.lstsq(b, a, rcond=None)[0].T)
        matrix = np.median(matrices, axis=0)
        header = plane.exposures[exposure].matrix
        if np.abs(matrix @ np.linalg.inv(header) - np.eye(2)).max() < _ATTITUDE:
            # near enough: all exposures of one header then have the same scale
            matrix = header
        offsets = [(part.at - part.t @ matrix.T).mean(axis=0) for part in group]
        linear[exposure] = np.median(offsets, axis=0), matrix
    return linear


def _first_widths(plane, half):
    field = tuple(_FIELD[d] * plane.radius for d in range(2, _DEGREE + 1))
    return Widths(field, _PLACE, _TURN * half, _FIRST_NOISE)


def _priors(widths, columns, plane):
    size = len(_TERMS) + 3 * (len(columns["exposures"]) + len(columns["detectors"]))
    prior = np.empty(size)
    prior[: len(_TERMS)] = np.array(widths.field)[_TERM_DEGREE - 2]
    for k in columns["exposures"].values():
        prior[k], prior[k + 1 : k + 3] = _POINTING, _ATTITUDE * plane.radius
    for k in columns["detectors"].values():
        prior[k], prior[k + 1 : k + 3] = widths.place, widths.turn
    return prior


def _solve(parts, widths, columns, plane):
    """Posterior of all unknowns: means of both axes, covariance of one; residuals go to the parts.

    Unknowns are in units of their priors, so they are well scaled.
    """
    prior = _priors(widths, columns, plane)
    normal, right = np.eye(len(prior)), np.zeros((len(prior), 2))
    for part in parts:
        weight = part.weights(widths.noise)[:, None]
        rows = part.design * prior[part.columns] * weight
        normal[np.ix_(part.columns, part.columns)] += rows.T @ rows
        right[part.columns] += rows.T @ (part.target * weight)
    inverse = scipy.linalg.cho_solve(scipy.linalg.cho_factor(normal), np.eye(len(normal)))
    solution = (inverse @ right) * prior[:, None]
    for part in parts:
        part.residual = part.target - part.design @ solution[part.columns]
    return solution, inverse * prior * prior[:, None]


def _learn(parts, solution, covariance, widths, columns, half):
    """Widths of the priors from what they gave (EM); medians where a wrong frame must not count."""
    second = (solution**2).mean(axis=1) + np.diag(covariance)
    field = tuple(
        float(np.sqrt(second[: len(_TERMS)][_TERM_DEGREE == d].mean()))
        for d in range(2, _DEGREE + 1)
    )
    starts = [columns["detectors"][d] for d in {part.frame.detector for part in parts}]
    # The median of chi square with one degree of freedom is 0.455.
    place = np.median([second[k] for k in starts]) / 0.455
    turn = np.median([second[k + 1 : k + 3].mean() for k in starts]) / 0.455
    # The first guess counts as much as five detectors.
    n = len(starts)
    place = np.sqrt((n * place + 5 * _PLACE**2) / (n + 5))
    turn = np.sqrt((n * turn + 5 * (_TURN * half) ** 2) / (n + 5))
    scatter = np.median([np.sqrt((part.residual**2).mean()) for part in parts])
    noise = float(np.clip(1.5 * scatter, _LEAST_NOISE, _MOST_NOISE))
    return Widths(field, float(place), float(turn), noise)


def _deviations(parts, widths, covariance):
    """How far each frame is from where the others predict it, sigma and px, by name."""
    deviations = {}
    for part in parts:
        weight = part.weights(widths.noise)[:, None]
        rows, residual = part.design * weight, part.residual * weight
        inner = covariance[np.ix_(part.columns, part.columns)]
        rest = (1 + 1e-9) * np.eye(len(rows)) - rows @ inner @ rows.T
        inverse = np.linalg.inv(rest)
        left_out = inverse @ residual
        # Variance of the frame without the part added by doubt.
        spread = inverse - (1 - 1 / part.doubt**2 - 1e-9) * np.eye(len(rows))
        # As if all of it were a shift, because wrong matches are off by a shift.
        sigma = np.sqrt(max(float((left_out * np.linalg.solve(spread, left_out)).sum()), 0.0) / 2)
        shift = np.hypot(*np.median(left_out / weight, axis=0))
        deviations[part.frame.name] = sigma, float(shift)
    return deviations
