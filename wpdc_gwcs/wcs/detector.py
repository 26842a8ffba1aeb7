"""A `gwcs.WCS` of a detector with fast calls and masking by the bounding box."""

import numpy as np
from astropy import coordinates as coord
from astropy import units as u
from astropy.modeling.bounding_box import ModelBoundingBox
from astropy.modeling.models import (
    AffineTransformation2D,
    Pix2Sky_TAN,
    RotateNative2Celestial,
    Scale,
    Shift,
)
from astropy.modeling.rotations import RotationSequence3D
from astropy.utils.masked import Masked
from gwcs import WCS
from gwcs import coordinate_frames as cf
from gwcs.geometry import CartesianToSpherical, SphericalToCartesian

from wpdc_gwcs.models import DetectorToSky, DistortionCorrection, TangentSky
from wpdc_gwcs.models.blocks import evaluate_blocks
from wpdc_gwcs.models.mapping import RIM_PX

__all__ = ["DetectorWCS", "build_wcs", "pipeline_steps"]


class DetectorWCS(WCS):
    """A `gwcs.WCS` of a detector whose inverse decides validity by pixels.

    It differs from its base class only in these points:

    - `invert` (and with it ``world_to_pixel``) does not mask positions by the range of right
      ascension and declination of the detector's corners, which would lose good points if
      the detector is not a rectangle in these coordinates, and all of them at a pole.  Every
      solution comes from an exact inverse; solutions outside the bounding box are masked in both
      coordinates, and those within 1e-6 px of its edge count as inside.
    - The two steps and the bounding box are evaluated in one pass.

    Everything else, including the parameters, is as in the base class.

    Examples
    --------
    >>> from wpdc_gwcs import build_wcs
    >>> cd = [[-1e-3, 0], [0, 1e-3]]
    >>> wcs = build_wcs(crpix=(511.5, 511.5), cd=cd, crval=(0, 89.9), image_shape=(1024, 1024))
    >>> x, y = wcs.invert(123.0, 90.0)  # the pole is on the detector
    >>> round(float(x), 3), round(float(y), 3)
    (511.5, 611.5)
    """

    def _models(self):
        """Return both models if they are those of `build_wcs`, else `None`."""
        steps = self.pipeline
        if len(steps) != 3:
            return None
        models = steps[0].transform, steps[1].transform
        if type(models[0]) is DistortionCorrection and type(models[1]) is TangentSky:
            return models
        return None

    @property
    def forward_transform(self):
        """The transform from the first to the last frame, with the bounding box."""
        models = self._models()
        if models is None:
            return super().forward_transform
        fused = DetectorToSky(*models)
        box = self.bounding_box
        if box is not None:
            fused.bounding_box = box
        return fused

    def _limits(self, distortion):
        """Return smallest and largest x, smallest and largest y, `None` without a bounding box."""
        try:
            box = distortion.bounding_box
        except NotImplementedError:
            return None
        if isinstance(box, ModelBoundingBox) and len(box.intervals) == 2:
            return box.intervals[0], box.intervals[1]
        return box.bounding_box(order="F")

    def __call__(self, *args, with_bounding_box=True, fill_value=np.nan, **kwargs):
        """Map detector pixels to the last frame.

        Parameters
        ----------
        *args : array_like
            Pixel coordinates, zero based.
        with_bounding_box : bool, optional
            Whether points outside the bounding box are set to ``fill_value``.
        fill_value : float, optional
            Value for these points.
        **kwargs
            Passed to the transform.

        Returns
        -------
        result : tuple of array_like
            Coordinates in the last frame.
        """
        models = self._models()
        if models is None or kwargs or len(args) != 2:
            return super().__call__(
                *args, with_bounding_box=with_bounding_box, fill_value=fill_value, **kwargs
            )
        distortion, sky = models
        box = self._limits(distortion) if with_bounding_box else None
        function = sky._after(distortion._plane_map()).to_sky(box, fill_value)
        return _evaluate(function, args, self.input_frame, self.output_frame)

    def invert(self, *args, with_bounding_box=True, fill_value=np.nan, **kwargs):
        """Map positions in the last frame to detector pixels.

        Parameters
        ----------
        *args : array_like
            Coordinates in the last frame.
        with_bounding_box : bool, optional
            Whether points outside the bounding box are set to ``fill_value``.
        fill_value : float, optional
            Value of both coordinates for these points, and if there is no solution.
        **kwargs
            Passed to the base class.

        Returns
        -------
        result : tuple of array_like
            Pixel coordinates, zero based.
        """
        models = self._models()
        if models is None or kwargs or len(args) != 2:
            return super().invert(
                *args, with_bounding_box=with_bounding_box, fill_value=fill_value, **kwargs
            )
        distortion, sky = models
        box = self._limits(distortion) if with_bounding_box else None
        function = sky._after(distortion._plane_map()).from_sky(box, fill_value)
        return _evaluate(function, args, self.output_frame, self.input_frame)

    @property
    def _has_our_inverse(self):
        """Whether the inverse is exact, so that pixels decide what is outside."""
        return any(isinstance(step.transform, DistortionCorrection) for step in self.pipeline)

    def outside_footprint(self, world_arrays):
        """Return the positions unchanged: the inverse itself decides what is outside.

        Parameters
        ----------
        world_arrays : sequence of array_like
            Coordinates in the last frame.

        Returns
        -------
        world_arrays : sequence of array_like
            The same; for pipelines without a `~wpdc_gwcs.models.DistortionCorrection`, the result
            of gwcs.
        """
        if not self._has_our_inverse:
            return super().outside_footprint(world_arrays)
        return world_arrays

    def out_of_bounds(self, pixel_arrays, fill_value=np.nan):
        """Mask pixels outside the bounding box, both coordinates together.

        Parameters
        ----------
        pixel_arrays : sequence of array_like
            Pixel coordinates.
        fill_value : float, optional
            Value of points outside.

        Returns
        -------
        pixel_arrays : tuple of array_like
            Pixel coordinates; those up to 1e-6 px outside are moved to the edge.  For pipelines
            without a `~wpdc_gwcs.models.DistortionCorrection`, the result of gwcs.
        """
        if not self._has_our_inverse:
            return super().out_of_bounds(pixel_arrays, fill_value=fill_value)
        limits = self.bounding_box.bounding_box(order="F")
        values = [getattr(value, "unmasked", np.asarray(value)) for value in pixel_arrays]
        if all(
            value.size and value.min() >= low and value.max() <= high
            for value, (low, high) in zip(values, limits, strict=True)
        ):
            return tuple(pixel_arrays)
        outside = False
        for k, (low, high) in enumerate(limits):
            # NaN stays NaN, and is outside.
            near = np.clip(values[k], low, high)
            values[k] = np.where(np.abs(near - values[k]) <= RIM_PX, near, values[k])
            outside = outside | ~((values[k] >= low) & (values[k] <= high))
        values = [np.where(outside, fill_value, value)[()] for value in values]
        for k, given in enumerate(pixel_arrays):
            if isinstance(given, np.ma.MaskedArray):
                values[k] = np.ma.array(values[k], mask=given.mask)
            elif hasattr(given, "mask"):
                values[k] = Masked(values[k], mask=given.mask)
        return tuple(values)


# `str` and `repr` of a WCS use the name of the gwcs class, also where astropy writes them.
DetectorWCS.__name__ = WCS.__name__


def _evaluate(function, args, input_frame, output_frame):
    """Evaluate a function of blocks for arguments with units or without; scalars become floats."""
    with_units = any(isinstance(value, u.Quantity) for value in args)
    if with_units:
        args = input_frame.remove_units(args)
    result = tuple(
        value if value.ndim or hasattr(value, "mask") else value.item()
        for value in evaluate_blocks(function, *args)
    )
    return output_frame.add_units(result) if with_units else result


def build_wcs(
    *, crpix, cd, crval, pv=None, pv_cd=None, lookup_table=None, image_shape=None, v2v3=None
):
    """Build the WCS of a detector from its distortion and attitude.

    Parameters
    ----------
    crpix : (float, float)
        Reference point in zero-based pixels, (x, y).
    cd : (2, 2) array_like
        Matrix of the exposure, degrees per pixel.
    crval : (float, float) or `~astropy.coordinates.SkyCoord`
        Right ascension and declination of the tangent point in degrees.
    pv : PVPolynomial, optional
        The distortion; none by default.
    pv_cd : (2, 2) array_like, optional
        Matrix used by the polynomial, degrees per pixel; ``cd`` by default.
    lookup_table : LookupTable, optional
        Table that is subtracted after the polynomial.
    image_shape : (int, int), optional
        Shape of the detector, (ny, nx).  The bounding box then covers all of it, -0.5 ... n - 0.5.
    v2v3 : (float, float, float), optional
        V2 and V3 of the reference point in arcseconds, and the position angle of the V3 axis there
        (north through east) in degrees, as ``v2_ref``, ``v3_ref``, ``roll_ref`` of JWST and Roman.
        The WCS then has the frame ``v2v3``, in arcseconds, before ``icrs``, where the
        correctors of tweakwcs and stcal act.

    Returns
    -------
    wcs : DetectorWCS
        A `gwcs.WCS` with the frames ``detector``, ``undistorted``, ``icrs``, with ``v2v3`` before
        the last one if it is requested.

    Raises
    ------
    ValueError
        If a shape is wrong, a number is not finite or a matrix is singular.
    TypeError
        If ``pv`` or ``lookup_table`` is of another type.

    Notes
    -----
    ::

        X'' = CD0^-1 PV(CD0 (x - CRPIX)) + CRPIX - table(x),    CD0 = pv_cd
        sky = TAN^-1(CD (X'' - CRPIX)) about CRVAL

    Examples
    --------
    >>> from wpdc_gwcs import PVPolynomial, build_wcs
    >>> wcs = build_wcs(crpix=(511.5, 511.5), cd=[[-1e-4, 0], [0, 1e-4]], crval=(0.0, 45.0),
    ...                 pv=PVPolynomial(pv1_7=0.1, pv2_7=0.1), image_shape=(1024, 1024))
    >>> ra, dec = wcs(511.5, 511.5)
    >>> float(ra), float(dec)
    (0.0, 45.0)
    >>> x, y = wcs.invert(*wcs(10.0, 20.0))
    >>> float(x), float(y)
    (10.0, 20.0)
    """
    if isinstance(crval, coord.SkyCoord):
        crval = (crval.icrs.ra.deg, crval.icrs.dec.deg)
    distortion = DistortionCorrection(crpix, cd if pv_cd is None else pv_cd, pv, lookup_table)
    sky = TangentSky(crpix, cd, crval)
    steps = pipeline_steps(distortion, sky)
    if v2v3 is not None:
        (undistorted, _), (icrs, _) = steps[1:]
        steps[1:] = [*_v2v3_steps(undistorted, sky, v2v3), (icrs, None)]
    wcs = DetectorWCS(steps)
    _set_shape(wcs, image_shape)
    return wcs


def _v2v3_steps(undistorted, sky, v2v3):
    """Return the steps from undistorted pixels to the sky, through the frame v2v3."""
    v2v3 = np.array(v2v3, dtype=float)
    if v2v3.shape != (3,) or not np.all(np.isfinite(v2v3)) or abs(v2v3[1]) >= 90 * 3600:
        raise ValueError(
            "v2v3 must be V2 and V3 in arcsec, V3 within a quarter of a circle, and an angle in "
            f"deg, not {v2v3.tolist()}"
        )
    v2, v3, roll = v2v3 / (3600, 3600, 1)
    c, s = np.cos(np.radians(roll)), np.sin(np.radians(roll))
    along_v2v3 = np.array([[c, -s], [s, c]])
    crpix, (ra, dec) = sky.crpix.value, sky.crval.value
    to_v2v3 = (
        Shift(-crpix[0]) & Shift(-crpix[1])
        | AffineTransformation2D(along_v2v3 @ sky.cd.value, translation=[0.0, 0.0])
        | Pix2Sky_TAN()
        | RotateNative2Celestial(v2, v3, 180.0)
        # V2 may have either sign.
        | SphericalToCartesian(wrap_lon_at=360)
        | CartesianToSpherical(wrap_lon_at=180)
        | Scale(3600.0) & Scale(3600.0)
    )
    # Not by way of native latitudes: an arc sine near 90 degrees has no more than eight digits.
    to_sky = (
        Scale(1 / 3600) & Scale(1 / 3600)
        | SphericalToCartesian(wrap_lon_at=180)
        | RotationSequence3D([v2, -v3, roll, dec, -ra], "zyxyz")
        | CartesianToSpherical(wrap_lon_at=360)
    )
    to_v2v3.name, to_sky.name = "undistorted_to_v2v3", "v2v3_to_sky"
    frame = cf.Frame2D(
        name="v2v3",
        axes_order=(0, 1),
        axes_names=("v2", "v3"),
        axes_type=("SPATIAL", "SPATIAL"),
        unit=(u.arcsec, u.arcsec),
    )
    return [(undistorted, to_v2v3), (frame, to_sky)]


def pipeline_steps(distortion, sky):
    """Return the frames and transforms of a pipeline from pixels to the sky.

    Parameters
    ----------
    distortion : `~astropy.modeling.Model`
        Transform from pixels to undistorted pixels.
    sky : `~astropy.modeling.Model`
        Transform from these to right ascension and declination, ICRS, deg.

    Returns
    -------
    list of tuple
        The ``forward_transform`` of a `gwcs.WCS`: detector, undistorted, icrs.
    """
    pixel_axes = {"axes_order": (0, 1), "unit": (u.pix, u.pix)}
    detector = cf.Frame2D(name="detector", axes_names=("x", "y"), **pixel_axes)
    undistorted = cf.Frame2D(
        name="undistorted", axes_names=("x_undistorted", "y_undistorted"), **pixel_axes
    )
    icrs = cf.CelestialFrame(
        name="icrs",
        reference_frame=coord.ICRS(),
        axes_names=("ra", "dec"),
        unit=(u.deg, u.deg),
    )
    return [(detector, distortion), (undistorted, sky), (icrs, None)]


def _set_shape(wcs, image_shape):
    if image_shape is None:
        return
    ny, nx = (int(n) for n in image_shape)
    if ny < 1 or nx < 1:
        raise ValueError(f"image_shape must be positive, not {tuple(image_shape)}")
    wcs.pixel_shape = (nx, ny)
    # Last: inserting frames drops it.
    wcs.bounding_box = ((-0.5, nx - 0.5), (-0.5, ny - 0.5))
