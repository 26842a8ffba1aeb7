"""Models to a `gwcs.WCS`, and the same in stock astropy models.

::

    detector (px) --DistortionCorrection--> undistorted (px) --TangentSky--> icrs (deg)
"""

import numpy as np
from astropy import coordinates as coord
from astropy import units as u
from gwcs import WCS
from gwcs import coordinate_frames as cf

from wpdc_gwcs.models import DetectorToSky, DistortionCorrection, TangentSky

__all__ = ["DetectorWCS", "build_wcs"]

# An answer this far (px) outside the bounding box lies on its rim but for rounding.
_RIM_PX = 1e-6


class DetectorWCS(WCS):
    """A `gwcs.WCS` of a detector whose inverse decides validity by pixels.

    It differs from its base class in these points only:

    - `invert` (and with it ``world_to_pixel``) does not mask positions by the range of right
      ascension and declination of the detector's corners, which loses good points wherever the
      image of the detector is not a rectangle on the sky, up to all of them at a pole.  Every
      answer comes from an exact inverse; those that lie outside the bounding box are masked, both
      coordinates together, and answers within 1e-6 px of the rim count as on it.
    - The two steps are evaluated in one pass, and the bounding box is applied afterwards, in one
      pass too.

    All else, including the parameters, is that of the base class.
    """

    @property
    def forward_transform(self):
        """The transform from the first to the last frame, with the bounding box."""
        transforms = [step.transform for step in self.pipeline[:-1]]
        if list(map(type, transforms)) != [DistortionCorrection, TangentSky]:
            return super().forward_transform
        fused = DetectorToSky(*transforms)
        box = self.bounding_box
        if box is not None:
            fused.bounding_box = box
        return fused

    def __call__(self, *args, with_bounding_box=True, fill_value=np.nan, **kwargs):
        """Map detector pixels to the last frame.

        Parameters
        ----------
        *args : array_like
            Pixel coordinates, zero based.
        with_bounding_box : bool, optional
            Whether points outside the bounding box become ``fill_value``.
        fill_value : float, optional
            What they become.
        **kwargs
            Passed on to the transform.

        Returns
        -------
        result : tuple of array_like
            Coordinates in the last frame.
        """
        if any(isinstance(value, u.Quantity) for value in args):
            return super().__call__(
                *args, with_bounding_box=with_bounding_box, fill_value=fill_value, **kwargs
            )
        result = super().__call__(*args, with_bounding_box=False, **kwargs)
        if not with_bounding_box:
            return result
        return self._mask(args, result, fill_value)

    def outside_footprint(self, world_arrays):
        """Return the positions as they are: the inverse itself tells what is outside.

        Parameters
        ----------
        world_arrays : sequence of array_like
            Coordinates in the last frame.

        Returns
        -------
        world_arrays : sequence of array_like
            The same.
        """
        return world_arrays

    def out_of_bounds(self, pixel_arrays, fill_value=np.nan):
        """Mask pixels outside the bounding box, both coordinates together.

        Parameters
        ----------
        pixel_arrays : sequence of array_like
            Pixel coordinates.
        fill_value : float, optional
            What points outside become.

        Returns
        -------
        pixel_arrays : tuple of array_like
            Pixel coordinates; those within 1e-6 px outside the rim are put on it.
        """
        snapped = []
        for value, (low, high) in zip(
            pixel_arrays, self.bounding_box.bounding_box(order="F"), strict=True
        ):
            value = np.where((value < low) & (value >= low - _RIM_PX), low, value)
            snapped.append(np.where((value > high) & (value <= high + _RIM_PX), high, value)[()])
        return self._mask(snapped, snapped, fill_value)

    def _mask(self, pixels, values, fill_value):
        """Replace the values of pixels outside the bounding box."""
        box = self.bounding_box
        if box is None:
            return values
        outside = False
        for pixel, (low, high) in zip(pixels, box.bounding_box(order="F"), strict=True):
            pixel = np.asarray(pixel)
            outside = outside | ~((pixel >= low) & (pixel <= high))
        if np.any(outside):
            values = tuple(np.where(outside, fill_value, value)[()] for value in values)
        return values


def build_wcs(*, crpix, cd, crval, pv=None, pv_cd=None, lookup_table=None, image_shape=None):
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
        Matrix in which the polynomial stands, degrees per pixel; ``cd`` by default.
    lookup_table : LookupTable, optional
        Subtracted after the polynomial.
    image_shape : (int, int), optional
        Shape of the detector, (ny, nx).  The bounding box then covers all of it, -0.5 ... n - 0.5.

    Returns
    -------
    wcs : DetectorWCS
        A `gwcs.WCS` with the frames ``detector``, ``undistorted`` and ``icrs``.

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
    wcs = DetectorWCS(_steps(distortion, sky))
    _set_shape(wcs, image_shape)
    return wcs


def _steps(distortion, sky):
    pixel_axes = {"axes_order": (0, 1), "unit": (u.pix, u.pix)}
    detector = cf.Frame2D(name="detector", axes_names=("x", "y"), **pixel_axes)
    undistorted = cf.Frame2D(
        name="undistorted", axes_names=("x_undistorted", "y_undistorted"), **pixel_axes
    )
    icrs = cf.CelestialFrame(name="icrs", reference_frame=coord.ICRS(), unit=(u.deg, u.deg))
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
