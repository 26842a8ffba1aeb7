"""The current model of a camera: geometry, coefficients, tables, fields."""

from dataclasses import dataclass, field, replace

import numpy as np

from wpdc_gwcs.solve.geometry import Geometry
from wpdc_gwcs.solve.terms import Block, Design

__all__ = ["Model", "design", "focal_variance", "residuals", "undistorted"]


@dataclass(frozen=True, eq=False)
class Model:
    """The mapping from pixels of frames to the sky.

    Parameters
    ----------
    geometry : Geometry
        Places, pointings and CD matrices.
    terms : tuple of Term
        Displacements of the focal plane.
    coefficients : dict
        Coefficients of the terms by name, ``(K,)`` (camera) or ``(n, K)`` (detectors or
        exposures).
    sigma : dict
        Standard deviations of the groups of the terms by name, px.
    tables : tuple
        For each detector a function of its pixels that returns displacements to subtract, or
        `None`.
    fields : dict
        The `Field` of each frame that has one.
    statics : dict
        The `Field` of each detector that all its exposures share, as a function of the position in
        the focal plane without distortion, because it belongs to the pixels.
    """

    geometry: Geometry
    terms: tuple
    coefficients: dict
    sigma: dict
    tables: tuple
    fields: dict = field(default_factory=dict)
    statics: dict = field(default_factory=dict)
    _without_fields: dict = field(default_factory=dict, repr=False)
    _at_stars: dict = field(default_factory=dict, repr=False)

    def changed(self, **parts):
        """Return the model with new parts except fields, without cached values.

        Parameters
        ----------
        **parts
            New values.

        Returns
        -------
        Model
            The new model.
        """
        return replace(self, _without_fields={}, _at_stars={}, **parts)

    def with_fields(self, fields):
        """Return the model with other fields.

        Parameters
        ----------
        fields : dict
            The `Field` of each frame.

        Returns
        -------
        Model
            The new model.
        """
        return replace(self, fields=fields, _at_stars={})

    def scoped(self, *scopes):
        """Return the terms of some scopes.

        Parameters
        ----------
        *scopes : str
            Names of scopes.
        """
        return [t for t in self.terms if t.scope in scopes]


def block(model, k, detector, x, y, color=None):
    """Return the coordinates of pixels of detector ``k`` for designs, and in the focal plane.

    Parameters
    ----------
    model : Model
        The model.
    k : int
        Number of the detector.
    detector : Detector
        The detector.
    x : (N,) ndarray
        Pixels along x.
    y : (N,) ndarray
        Pixels along y.
    color : (N,) ndarray, optional
        Color less the reference color.
    """
    dx, dy = (0.0, 0.0) if model.tables[k] is None else model.tables[k](x, y)
    focal = model.geometry.focal(k, detector, x - dx, y - dy)
    u, v = detector.normalized(x, y)
    color = np.zeros_like(u) if color is None else color
    return Block(u, v, detector.aspect, focal / model.geometry.radius, color), focal


def undistorted(model, k, detector, x, y):
    """Return undistorted positions of pixels in the focal plane, at the reference color.

    Parameters
    ----------
    model : Model
        The model.
    k : int
        Number of the detector.
    detector : Detector
        The detector.
    x, y : (N,) ndarray
        Pixels.

    Returns
    -------
    (2, N) ndarray
        Px of the focal plane.
    """
    b, place = block(model, k, detector, x, y)
    focal = place
    for term in model.scoped("camera", "detector"):
        if term.chromatic:
            continue
        c = model.coefficients[term.name]
        c = c if term.scope == "camera" else c[k]
        if np.any(c):
            focal = focal + term.displacement(b, c)
    return focal + model.statics[k](place) if k in model.statics else focal


def colored(model, exposure, b):
    """Return the displacement of stars due to their color.

    Parameters
    ----------
    model : Model
        The model.
    exposure : int
        Number of the exposure.
    b : Block
        Coordinates of the stars.
    """
    total = np.zeros((2, len(b.u)))
    for term in model.terms:
        if term.chromatic:
            c = model.coefficients[term.name]
            c = c if term.scope == "camera" else c[exposure]
            total = total + term.displacement(b, c)
    return total


def residuals(model, observations, frame, *, with_field=True):
    """Return model minus reference of the pairs of a frame, and their focal plane positions.

    Parameters
    ----------
    model : Model
        The model.
    observations : Observations
        Pairs.
    frame : int
        Number of the frame.
    with_field : bool, optional
        Whether the field of the exposure is part of the model.

    Returns
    -------
    residual, focal : (2, N) ndarray
        Px of the focal plane; residuals of pairs without a position are NaN.
    """
    if frame not in model._without_fields:
        model._without_fields[frame] = _residuals(model, observations, frame)
    residual, focal = model._without_fields[frame]
    if with_field and frame in model.fields:
        if frame not in model._at_stars:
            model._at_stars[frame] = model.fields[frame](focal)
        residual = residual + model._at_stars[frame]
    return residual, focal


def _residuals(model, o, frame):
    """Residuals and places of the pairs of one frame, without its field."""
    s = o.slices[frame]
    k, e = o.detector_of[frame], o.exposure_of[frame]
    detector = o.detectors[k]
    # Pairs outside the detector get no residual, and must not turn others into NaN.
    finite = o.finite[s]
    x = np.where(finite, o.x[s], detector.center[0])
    y = np.where(finite, o.y[s], detector.center[1])
    focal = undistorted(model, k, detector, x, y)
    total = focal
    if np.any(o.color[s]):
        total = focal + colored(model, e, block(model, k, detector, x, y, o.color[s])[0])
    reference = model.geometry.reference(e, o.ra[s], o.dec[s])
    return np.where(finite, total - reference, np.nan), focal


def design(model, observations, frame, x, y, color=None):
    """Return the columns of all unknowns at pixels: shared terms, then those of the exposure.

    Parameters
    ----------
    model : Model
        The model.
    observations : Observations
        Observations with the detector of the frame.
    frame : int
        Number of the frame.
    x, y : (N,) ndarray
        Pixels.
    color : (N,) ndarray, optional
        Color less the reference color.

    Returns
    -------
    Design
        Px of the focal plane per unit of each unknown.
    """
    k = observations.detector_of[frame]
    b, _ = block(model, k, observations.detectors[k], x, y, color)
    ordered = model.scoped("camera") + model.scoped("detector") + model.scoped("exposure")
    return Design.joined([t.design(b) for t in ordered])


def focal_variance(model, observations, frame, sigma):
    """Return variances of pairs along the axes of the focal plane, ``(2, N)``.

    Parameters
    ----------
    model : Model
        Model with the orientation of the detector.
    observations : Observations
        Pairs.
    frame : int
        Number of the frame.
    sigma : (2, N) ndarray
        Errors along the axes of the detector, px.

    Returns
    -------
    ndarray
        Px^2.
    """
    return model.geometry.matrix[observations.detector_of[frame]] ** 2 @ sigma**2
