"""The model of a camera as it stands: geometry, coefficients, tables, fields."""

from dataclasses import dataclass, field, replace

import numpy as np

from wpdc_gwcs.solve.geometry import Geometry
from wpdc_gwcs.solve.terms import Block, Design

__all__ = ["Model", "design", "focal_variance", "residuals", "undistorted"]


@dataclass(frozen=True, eq=False)
class Model:
    """Everything that takes a pixel of a frame to the sky.

    Parameters
    ----------
    geometry : Geometry
        Places, pointings and CD matrices.
    terms : tuple of Term
        Displacements of the focal plane.
    coefficients : dict
        Name of a term to its coefficients, ``(K,)`` (camera) or ``(n, K)`` (each detector or
        exposure).
    sigma : dict
        Name of a term to the standard deviations of its groups, px.
    tables : tuple
        For each detector a function of its pixels that returns displacements to subtract, or
        `None`.
    fields : dict
        Frame to its `Field`; no entry for none.
    statics : dict
        Detector to the `Field` that all its exposures share, as a function of the place on the
        focal plane without distortion: it belongs to the pixels; no entry for none.
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
        """Model with other parts than its fields; what was computed with them is forgotten.

        Parameters
        ----------
        **parts
            New values.

        Returns
        -------
        Model
            With these.
        """
        return replace(self, _without_fields={}, _at_stars={}, **parts)

    def with_fields(self, fields):
        """Model with other fields.

        Parameters
        ----------
        fields : dict
            Frame to its `Field`.

        Returns
        -------
        Model
            With these.
        """
        return replace(self, fields=fields, _at_stars={})

    def scoped(self, *scopes):
        """Terms of some scopes.

        Parameters
        ----------
        *scopes : str
            Names of scopes.
        """
        return [t for t in self.terms if t.scope in scopes]


def block(model, k, detector, x, y, color=None):
    """Coordinates of pixels of detector number ``k`` for the designs; also their focal plane.

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
    """Focal plane position of pixels, distortion and table applied, at the reference color.

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
    """Displacement of stars that differ from the reference color.

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
    """Model less reference of the pairs of one frame, and their focal plane positions.

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
    # Pairs off the detector get no residual; they must not make NaN of others on the way.
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
    """Columns of all unknowns at pixels of a frame: shared terms first, then the exposure's.

    Parameters
    ----------
    model : Model
        The model.
    observations : Observations
        For the frame's detector.
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
    """Variances of pairs along the axes of the focal plane, ``(2, N)``.

    Parameters
    ----------
    model : Model
        For the orientation of the detector.
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
