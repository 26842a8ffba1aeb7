"""Frozen results: the instrument (`DistortionSolution`), the frame (`Calibration`).

::

    detector px --[instrument: CRPIX, CD0, PV, table]--> undistorted px --[exposure: CD, CRVAL]-->
    ICRS
"""

import dataclasses
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from astropy import units as u
from scipy.interpolate import RegularGridInterpolator

from wpdc_gwcs.description import Described
from wpdc_gwcs.export.memory import InMemory
from wpdc_gwcs.frozen import freeze_attributes, freeze_models, frozen_array
from wpdc_gwcs.models import LookupTable, PVPolynomial, deproject
from wpdc_gwcs.models.blocks import evaluate_blocks
from wpdc_gwcs.wcs import build_wcs

__all__ = ["Calibration", "DistortionSolution"]

# No camera has a reference point farther away than this, px.
FARTHEST_PX = 1e9
# If the scales along its axes differ by more than this factor, a matrix has no useful inverse.
_MOST_CONDITION = 1e6


def has_inverse(matrix):
    """Return whether a matrix is finite and has a useful inverse.

    Parameters
    ----------
    matrix : (2, 2) array_like of float
        A linear map, in any units.

    Returns
    -------
    bool
        True if its scales along its own axes differ by less than a factor of a million.
    """
    matrix = np.asarray(matrix, dtype=float)
    return bool(np.isfinite(matrix).all() and np.linalg.cond(matrix) < _MOST_CONDITION)


def _freeze_pointing(owner):
    """Freeze CRVAL and CD, and check that they are a position and a linear map."""
    crval = frozen_array(owner, "crval", shape=(2,))
    if not (abs(crval[0]) <= 360 and abs(crval[1]) <= 90):
        raise ValueError(f"crval must be RA and Dec within 360 and 90 deg, got {crval.tolist()}")
    cd = frozen_array(owner, "cd", shape=(2, 2))
    if not has_inverse(cd):
        raise ValueError(f"cd must have an inverse, got {cd.tolist()}")


def _freeze_sigma(owner, name):
    sigma = frozen_array(owner, name, shape=(3, None, None), finite=False)
    if sigma is not None and (min(sigma.shape[1:]) < 2 or np.any(sigma[:2] < 0)):
        raise ValueError(f"{name} must be standard deviations on 2 x 2 nodes at least")


@dataclass(frozen=True, eq=False, repr=False)
class DistortionSolution(Described, InMemory):
    """The distortion of one detector, which all its exposures share.

    Parameters
    ----------
    detector : str
        Name of the detector.
    image_shape : (int, int)
        Shape ``(ny, nx)`` in px.
    crpix : (2,) ndarray
        Reference point, px, zero based.
    cd : (2, 2) ndarray
        Nominal matrix CD0 used by the PV polynomial, deg / px.
    crval : (2,) ndarray
        Nominal pointing, deg.
    pv : PVPolynomial
        Polynomial without constant and with unit linear terms.
    lookup_table : LookupTable, optional
        Table of the residuals of the polynomial.
    table_sigma : (3, n, n) ndarray, optional
        sigma_x, sigma_y in px and their correlation on a grid from one outer edge of the detector
        to the other, of polynomial and table together, without the linear part that attitudes
        absorb.
    residual_map : ResidualMap, optional
        Binned residuals of the table, to which those of other frames can be added.
    statistics, settings, provenance : dict
        How the solution was made; immutable.
    valid_from, valid_to : float, optional
        Epochs (Julian years) from which, and until which, the solution is valid; `None` if there is
        no known limit.

    Examples
    --------
    >>> import numpy as np
    >>> from wpdc_gwcs import Calibration, DistortionSolution, PVPolynomial
    >>> cd = np.array([[-8e-5, 0.0], [0.0, 8e-5]])
    >>> solution = DistortionSolution(
    ...     detector="d1", image_shape=(1024, 1024), crpix=np.array([511.5, 511.5]), cd=cd,
    ...     crval=np.array([10.0, 45.0]), pv=PVPolynomial(pv1_7=4.0, pv2_7=-3.0)
    ... )
    >>> ra, dec = solution.wcs(511.5, 511.5)
    >>> print(f"{ra:.6f} {dec:.6f}")
    10.000000 45.000000
    """

    detector: str
    image_shape: tuple[int, int]
    crpix: np.ndarray
    cd: np.ndarray
    crval: np.ndarray
    pv: PVPolynomial
    lookup_table: "LookupTable | None" = None
    table_sigma: np.ndarray | None = None
    residual_map: object | None = None
    statistics: dict = dataclasses.field(default_factory=dict)
    settings: dict = dataclasses.field(default_factory=dict)
    provenance: dict = dataclasses.field(default_factory=dict)
    valid_from: float | None = None
    valid_to: float | None = None

    def __post_init__(self):
        crpix = frozen_array(self, "crpix", shape=(2,))
        if np.any(np.abs(crpix) > FARTHEST_PX):
            raise ValueError(f"crpix must be within {FARTHEST_PX:g} px, got {crpix.tolist()}")
        _freeze_pointing(self)
        _freeze_sigma(self, "table_sigma")
        freeze_attributes(self, "statistics", "settings", "provenance")
        if self.image_shape is not None:
            shape = tuple(int(n) for n in self.image_shape)
            if len(shape) != 2 or min(shape) < 1 or shape != tuple(self.image_shape):
                raise ValueError(f"image_shape must be (ny, nx), got {self.image_shape!r}")
            object.__setattr__(self, "image_shape", shape)
        if not np.isfinite(self.pv.coefficients).all():
            raise ValueError("coefficients of the polynomial must be finite")
        freeze_models(self, "pv", "lookup_table")
        for name in ("valid_from", "valid_to"):
            epoch = getattr(self, name)
            if epoch is not None and not np.isfinite(epoch):
                raise ValueError(f"{name} must be a Julian year or None, got {epoch}")

    def __setstate__(self, state):
        # Copies of models are mutable, but not those in copies of results.
        self.__dict__.update(state)
        freeze_models(self, "pv", "lookup_table")

    def holds_at(self, epoch):
        """Return whether the solution is valid at an epoch.

        Parameters
        ----------
        epoch : float or None
            Julian year; an unknown epoch counts as valid.

        Returns
        -------
        bool
            True from ``valid_from`` on and before ``valid_to``.
        """
        if epoch is None:
            return True
        since = self.valid_from is None or epoch >= self.valid_from
        return since and (self.valid_to is None or epoch < self.valid_to)

    @property
    def validity(self):
        """Validity in words, for messages."""
        parts = [
            f"{word} {value:.4f}"
            for word, value in (("from", self.valid_from), ("until", self.valid_to))
            if value is not None
        ]
        return " ".join(parts) or "always"

    @cached_property
    def wcs(self):
        """WCS with the nominal pointing, `gwcs.WCS`."""
        return build_wcs(
            crpix=self.crpix,
            cd=self.cd,
            crval=self.crval,
            pv=self.pv,
            lookup_table=self.lookup_table,
            image_shape=self.image_shape,
        )

    def undistort(self, x, y):
        """Remove the distortion from detector pixels.

        Parameters
        ----------
        x, y : array_like
            Detector pixels, zero based.

        Returns
        -------
        x, y : ndarray
            Undistorted pixels; also defined off the detector.
        """
        return self.wcs.get_transform("detector", "undistorted")(x, y)

    @cached_property
    def area_range(self):
        """Smallest and largest area of a pixel over the detector, relative to the median."""
        ny, nx = self.image_shape
        x, y = np.meshgrid(np.linspace(-0.5, nx - 0.5, 33), np.linspace(-0.5, ny - 0.5, 33))
        ux, uy = self.undistort(x, y)
        area = np.gradient(ux, axis=1) * np.gradient(uy, axis=0)
        area -= np.gradient(ux, axis=0) * np.gradient(uy, axis=1)
        area /= np.median(area)
        return float(area.min()), float(area.max())

    def covariance(self, x, y):
        """Return the covariance of the distortion, without its linear part.

        Parameters
        ----------
        x, y : array_like
            Positions on the detector, px, zero based.

        Returns
        -------
        (2, 2, ...) ndarray
            Covariance of the undistorted position in px^2; NaN outside the detector, and everywhere
            if the solution has no covariances.
        """
        x, y = np.broadcast_arrays(np.asarray(x, dtype=float), np.asarray(y, dtype=float))
        return _covariance(self.table_sigma, self.image_shape, x, y)


def _covariance(sigma, image_shape, x, y):
    """Covariance ``(2, 2, ...)`` of a grid of sigmas and correlation; NaN off the detector."""
    if sigma is None:
        return np.full((2, 2, *x.shape), np.nan)
    nodes = np.moveaxis(np.asarray(sigma, dtype=float), 0, -1)
    edges = [np.linspace(-0.5, n - 0.5, m) for n, m in zip(image_shape, nodes.shape)]
    interpolate = RegularGridInterpolator(edges, nodes, bounds_error=False, fill_value=np.nan)
    points = np.stack([y.ravel(), x.ravel()], axis=-1)
    return covariance_of(interpolate(points).T.reshape(3, *x.shape))


def covariance_of(sigma):
    """Return covariance matrices for standard deviations and correlations.

    Parameters
    ----------
    sigma : (3, ...) ndarray
        Standard deviations along both axes, and their correlation.

    Returns
    -------
    (2, 2, ...) ndarray
        Covariances, in the squared unit.
    """
    sigma_x, sigma_y, rho = sigma
    cross = rho * sigma_x * sigma_y
    return np.array([[sigma_x**2, cross], [cross, sigma_y**2]])


def _evaluate(function, first, second, unit):
    """Evaluate a function of blocks for numbers or Quantities; scalars become floats."""
    values = [v.to_value(unit) if isinstance(v, u.Quantity) else v for v in (first, second)]
    first, second = evaluate_blocks(function, *values)
    if first.ndim or hasattr(first, "mask"):
        return first, second
    return first.item(), second.item()


@dataclass(frozen=True, eq=False, repr=False)
class Calibration(Described, InMemory):
    """One calibrated frame: an instrument and the attitude of one exposure.

    Parameters
    ----------
    frame : str
        Name of the frame.
    solution : DistortionSolution
        The instrument.
    crval : (2,) ndarray
        RA and Dec of the reference point, deg.
    cd : (2, 2) ndarray
        Linear matrix, deg / px.
    field : LookupTable, optional
        Displacement of this exposure alone, to be subtracted with the table of the instrument.
    sigma : (3, n, n) ndarray, optional
        Uncertainty of the map, see `uncertainty`, on a grid from one outer edge of the detector to
        the other.
    color_shift : (2, 3) ndarray, optional
        Displacement of stars per magnitude of color in undistorted px: dX = c0 + cx X + cy Y for
        each axis, with X, Y in px from the reference point.
    reference_color : float, optional
        Color for which the WCS is valid, mag.
    matches, sources : `~astropy.table.Table`, optional
        Pairs and sources of the frame, with units.
    statistics, settings, provenance : dict
        How the calibration was made; immutable.

    Examples
    --------
    >>> import numpy as np
    >>> from wpdc_gwcs import Calibration, DistortionSolution, PVPolynomial
    >>> cd = np.array([[-8e-5, 0.0], [0.0, 8e-5]])
    >>> solution = DistortionSolution(
    ...     detector="d1", image_shape=(1024, 1024), crpix=np.array([511.5, 511.5]), cd=cd,
    ...     crval=np.array([10.0, 45.0]), pv=PVPolynomial(pv1_7=4.0, pv2_7=-3.0)
    ... )
    >>> calibration = Calibration("a", solution, crval=np.array([10.1, 45.1]), cd=1.0001 * cd)
    >>> ra, dec = calibration.wcs(511.5, 511.5)
    >>> print(f"{ra:.6f} {dec:.6f}")
    10.100000 45.100000
    >>> calibration.to_header("tpv")["CTYPE1"]
    'RA---TPV'
    """

    frame: str
    solution: DistortionSolution
    crval: np.ndarray
    cd: np.ndarray
    field: "LookupTable | None" = None
    sigma: np.ndarray | None = None
    color_shift: np.ndarray | None = None
    reference_color: float | None = None
    matches: object | None = None
    sources: object | None = None
    statistics: dict = dataclasses.field(default_factory=dict)
    settings: dict = dataclasses.field(default_factory=dict)
    provenance: dict = dataclasses.field(default_factory=dict)

    def __post_init__(self):
        _freeze_pointing(self)
        _freeze_sigma(self, "sigma")
        frozen_array(self, "color_shift", shape=(2, 3))
        freeze_attributes(self, "statistics", "settings", "provenance")
        freeze_models(self, "field")

    def __getstate__(self):
        # Compiled functions are not pickled; they are created again when needed.
        return {name: value for name, value in self.__dict__.items() if name != "_functions"}

    def __setstate__(self, state):
        self.__dict__.update(state)
        freeze_models(self, "field")

    @cached_property
    def wcs(self):
        """WCS of the frame, `gwcs.WCS`."""
        return self._build_wcs()

    def _build_wcs(self):
        s = self.solution
        return build_wcs(
            crpix=s.crpix,
            cd=self.cd,
            crval=self.crval,
            pv=s.pv,
            pv_cd=s.cd,
            lookup_table=self.lookup_table,
            image_shape=s.image_shape,
        )

    @cached_property
    def _functions(self):
        """Functions from detector to sky and back, for blocks of points."""
        # Independent of the WCS, which is mutable, so no check for changes is needed.
        wcs = self._build_wcs()
        box = wcs.bounding_box
        box = None if box is None else box.bounding_box(order="F")
        forward = wcs.forward_transform
        return forward.block_function(box=box), forward.inverse.block_function(box=box)

    def pixel_to_sky(self, x, y):
        """Map detector pixels to the sky: a faster ``wcs(x, y)`` for a few points.

        Parameters
        ----------
        x, y : array_like or `~astropy.units.Quantity`
            Detector pixels, zero based; of any shapes that broadcast.

        Returns
        -------
        ra, dec : float or ndarray
            Positions in degrees, NaN outside the detector; masked where an input is.

        See Also
        --------
        sky_to_pixel : The inverse.
        """
        return _evaluate(self._functions[0], x, y, u.pix)

    def sky_to_pixel(self, ra, dec):
        """Map the sky to detector pixels: a faster ``wcs.invert(ra, dec)`` for a few points.

        Parameters
        ----------
        ra, dec : array_like or `~astropy.units.Quantity`
            Positions in degrees, or with a unit.

        Returns
        -------
        x, y : float or ndarray
            Detector pixels, zero based, NaN outside the detector; masked where an input is.

        See Also
        --------
        pixel_to_sky : The inverse.
        """
        return _evaluate(self._functions[1], ra, dec, u.deg)

    @cached_property
    def lookup_table(self):
        """Sum of the table of the instrument and the field of the exposure, or `None`.

        A spline on the finer nodes of the two; the field is much smoother than the spacing of its
        nodes.
        """
        tables = [t for t in (self.solution.lookup_table, self.field) if t is not None]
        if len(tables) < 2:
            return tables[0] if tables else None
        table, other = tables
        # A copy, because a table that is evaluated keeps its spline, which is 16 times its size.
        dx, dy = other.copy()(*np.meshgrid(table.x_grid, table.y_grid))
        return LookupTable(
            table.x_grid, table.y_grid, table.dx + dx, table.dy + dy, method=table.method
        )

    def undistort(self, x, y):
        """Remove distortion and field from detector pixels.

        Parameters
        ----------
        x, y : array_like
            Detector pixels, zero based.

        Returns
        -------
        x, y : ndarray
            Undistorted pixels; also defined off the detector.
        """
        return self.wcs.get_transform("detector", "undistorted")(x, y)

    def at_color(self, color):
        """Return the calibration of the frame for stars of another color.

        Parameters
        ----------
        color : float
            Color, mag, in the system of the catalog (Gaia BP - RP).

        Returns
        -------
        Calibration
            Calibration with another CRVAL and CD; the same one if there is no dependence on color.

        Raises
        ------
        ValueError
            If ``color`` is not a finite number.
        """
        if not np.isfinite(color):
            raise ValueError(f"color must be a finite number, got {color}")
        if self.color_shift is None:
            return self
        shift = (float(color) - self.reference_color) * np.asarray(self.color_shift, dtype=float)
        crval = np.array(deproject(*(self.cd @ shift[:, 0]), self.crval))
        return dataclasses.replace(
            self,
            crval=crval,
            cd=self.cd @ (np.eye(2) + shift[:, 1:]),
            reference_color=float(color),
        )

    def uncertainty(self, x, y):
        """Return the uncertainty of the WCS at a position, without centroid errors.

        Parameters
        ----------
        x, y : array_like
            Positions on the detector, px, zero based.

        Returns
        -------
        sigma_x, sigma_y : ndarray
            Standard deviations of the undistorted position along the detector's axes, px; NaN off
            the detector, and everywhere if the covariances are unknown.
        rho : ndarray
            Correlation of the two errors.

        Notes
        -----
        This is the posterior covariance of all terms: polynomial or table, attitude and field of
        the exposure.  It is large where there are no stars.  Multiply it by the pixel scale to get
        the uncertainty on the sky.
        """
        x, y = np.broadcast_arrays(np.asarray(x, dtype=float), np.asarray(y, dtype=float))
        total = _covariance(self.sigma, self.solution.image_shape, x, y)
        sigma_x, sigma_y = np.sqrt(total[0, 0]), np.sqrt(total[1, 1])
        with np.errstate(invalid="ignore", divide="ignore"):
            rho = total[0, 1] / (sigma_x * sigma_y)
        return sigma_x, sigma_y, np.where((sigma_x == 0) | (sigma_y == 0), 0.0, rho)
