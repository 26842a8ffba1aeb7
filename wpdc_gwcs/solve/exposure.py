"""Exposures as input and output of the solution."""

import dataclasses
from dataclasses import dataclass

import numpy as np

from wpdc_gwcs.frozen import freeze_attributes
from wpdc_gwcs.models import LookupTable, PVPolynomial

__all__ = ["Exposure", "ExposureFit", "SolveResult"]


@dataclass(frozen=True, eq=False)
class Exposure:
    """Pairs of one exposure of one detector, with its starting attitude.

    Parameters
    ----------
    name : str
        Name of the frame, for messages.
    x, y : (N,) array_like
        Measured positions, px, zero based.
    ra, dec : (N,) array_like
        Reference positions at the epoch of the exposure, deg.
    crval : (2,) array_like
        Starting RA and Dec of the reference point, deg.
    cd : (2, 2) array_like
        Starting linear matrix, deg / px.
    x_err, y_err : (N,) array_like, optional
        Total 1-sigma errors (centroid and reference), px.  Default: estimated from the residuals.
    reference_err : (N,) array_like, optional
        Part of these errors that is due to the reference positions, px.  Default: 0.
    star : (N,) array_like of int, optional
        Number of the star of each pair, 0 or more, the same in all exposures.
    use : (N,) array_like of bool, optional
        Stars that may be fitted; the others (held out) only get residuals.
    color : (N,) array_like, optional
        Colors of the stars, mag; NaN where unknown.
    detector : str, optional
        Name of the detector.
    exposure : hashable, optional
        Identifier that the frames of one exposure of a mosaic share.  Default: none is shared.

    Examples
    --------
    >>> import numpy as np
    >>> from wpdc_gwcs.solve import Exposure
    >>> exposure = Exposure(
    ...     "night-07", x=[10, 20], y=[5, 6], ra=[120.0, 120.1], dec=[30.0, 30.1], crval=(120, 30),
    ...     cd=np.diag([-2e-5, 2e-5]), detector="d1",
    ... )
    >>> exposure.name, len(exposure.x), exposure.x_err is None  # errors from the residuals
    ('night-07', 2, True)
    """

    name: str
    x: np.ndarray
    y: np.ndarray
    ra: np.ndarray
    dec: np.ndarray
    crval: np.ndarray
    cd: np.ndarray
    x_err: np.ndarray | None = None
    y_err: np.ndarray | None = None
    reference_err: np.ndarray | None = None
    star: np.ndarray | None = None
    use: np.ndarray | None = None
    color: np.ndarray | None = None
    detector: str = ""
    exposure: object | None = None


@dataclass(frozen=True, eq=False)
class ExposureFit:
    """Solution for one exposure of one detector.

    Parameters
    ----------
    name : str
        Name of the frame.
    crval : (2,) ndarray
        RA and Dec of the reference point, deg.
    cd : (2, 2) ndarray
        Linear matrix, deg / px.
    dx, dy : (N,) ndarray
        Residuals X'' - X_ref, Y'' - Y_ref of all pairs given, undistorted px; NaN where a position
        is NaN.
    x_err, y_err : (N,) ndarray
        Errors of the pairs according to the fit: the given ones, rescaled and with a floor.
    used : (N,) ndarray of bool
        Pairs that were fitted: allowed, valid and not clipped.
    sigma : (3, n, n) ndarray or None
        Uncertainty of the map over the detector: sigma_x, sigma_y in px and their correlation on a
        grid from one outer edge to the other.
    field : LookupTable or None
        The exposure's own displacement, to be subtracted with the table of the instrument.
    pv : PVPolynomial or None
        The exposure's own polynomial with ``refine="pv"``.
    crpix : (2,) ndarray or None
        Reference point of the exposure's own polynomial where that is not the detector's, px, zero
        based; the polynomial is then in the matrix ``cd``.
    color_shift : (2, 3) ndarray or None
        Displacement of stars per magnitude of color in undistorted px: constant and linear part.
    reference_offset : (2, N) ndarray or None
        Offsets of free reference stars east and north of the catalog, mas.
    reason : str or None
        Why the exposure was left out; its numbers are then the starting values.
    statistics : dict
        Counts and scatter of the pairs used, px.

    Examples
    --------
    >>> import numpy as np
    >>> from wpdc_gwcs.models import deproject
    >>> from wpdc_gwcs.solve import Exposure, solve
    >>> cd, rng = np.diag([-2e-5, 2e-5]), np.random.default_rng(1)
    >>> x, y = rng.uniform(0, 999, (2, 300))
    >>> sky = deproject(*(cd @ [x - 499.5, y - 499.5]), (120.0, 30.0))
    >>> x[0] += 5.0  # a wrong pair
    >>> exposure = Exposure("a", x, y, *sky, crval=(120, 30), cd=cd)
    >>> fit = solve([exposure], image_shape=(1000, 1000), lut="none").exposures[0]
    >>> fit.used[:3].tolist(), (fit.dx[:3].round(2) + 0.0).tolist()
    ([False, True, True], [5.0, 0.0, 0.0])
    """

    name: str
    crval: np.ndarray
    cd: np.ndarray
    dx: np.ndarray
    dy: np.ndarray
    x_err: np.ndarray
    y_err: np.ndarray
    used: np.ndarray
    sigma: np.ndarray | None = None
    field: "LookupTable | None" = None
    pv: "PVPolynomial | None" = None
    crpix: np.ndarray | None = None
    color_shift: np.ndarray | None = None
    reference_offset: np.ndarray | None = None
    reason: str | None = None
    statistics: dict = dataclasses.field(default_factory=dict)

    def __post_init__(self):
        freeze_attributes(self, "statistics")


@dataclass(frozen=True, eq=False)
class SolveResult:
    """The detectors of a camera and all their exposures.

    Parameters
    ----------
    solutions : dict
        `DistortionSolution` of each detector, by name.
    exposures : tuple of ExposureFit
        One for each given frame, in the same order.
    rejected : dict of str
        Reason for each frame that was left out, by name.
    table_infos : dict
        `TableInfo` of each detector, by name; no entry without a table.
    reference_color : float or None
        Color that the solution is for; `None` if no colors were given.

    Examples
    --------
    >>> import numpy as np
    >>> from wpdc_gwcs.models import deproject
    >>> from wpdc_gwcs.solve import Exposure, solve
    >>> cd, rng = np.diag([-2e-5, 2e-5]), np.random.default_rng(1)
    >>> x, y = rng.uniform(0, 999, (2, 300))
    >>> sky = deproject(*(cd @ [x - 499.5, y - 499.5]), (120.0, 30.0))
    >>> exposure = Exposure("a", x, y, *sky, crval=(120, 30), cd=cd, detector="d1")
    >>> result = solve([exposure], image_shape=(1000, 1000), lut="none")
    >>> list(result.solutions), [fit.name for fit in result.exposures], result.rejected
    (['d1'], ['a'], {})
    """

    solutions: dict
    exposures: tuple
    rejected: dict
    table_infos: dict = dataclasses.field(default_factory=dict)
    reference_color: float | None = None

    def __post_init__(self):
        freeze_attributes(self, "solutions", "rejected", "table_infos")

    @property
    def solution(self):
        """The solution of the only detector."""
        (only,) = self.solutions.values()
        return only

    @property
    def table_info(self):
        """`TableInfo` of the only detector, or None."""
        return next(iter(self.table_infos.values()), None)
