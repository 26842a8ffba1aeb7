"""Frozen result objects: the instrument (`DistortionSolution`), the frame (`Calibration`).

::

    detector px --[instrument: CRPIX, CD0, PV, table]--> undistorted px --[exposure: CD, CRVAL]-->
    ICRS
"""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from scipy.interpolate import RegularGridInterpolator

from wpdc_gwcs.models import LookupTable, PVPolynomial
from wpdc_gwcs.wcs import build_wcs

__all__ = ["Calibration", "DistortionSolution"]


@dataclass(frozen=True, eq=False)
class DistortionSolution:
    """The distortion of one detector: what all its exposures share.

    Parameters
    ----------
    detector : str
        Name of the detector.
    image_shape : (int, int)
        Shape ``(ny, nx)`` in px.
    crpix : (2,) ndarray
        Reference point, px, zero based.
    cd : (2, 2) ndarray
        Nominal matrix CD0 in which the PV polynomial stands, deg / px.
    crval : (2,) ndarray
        Nominal pointing, deg.
    pv : PVPolynomial
        Polynomial without constant and with unit linear terms.
    lookup_table : LookupTable, optional
        What the polynomial leaves.
    pv_covariance : (2, n, n) ndarray, optional
        Covariance of the terms of each axis, deg^2.
    table_sigma : (3, ny_grid, nx_grid) ndarray, optional
        sigma_x, sigma_y in px and their correlation at the nodes of the table, without the linear
        part that the attitudes carry.
    residual_map : ResidualMap, optional
        Binned residuals behind the table, to which those of other frames can be added.
    statistics, settings, provenance : dict
        How the solution came about.
    """

    detector: str
    image_shape: tuple[int, int]
    crpix: np.ndarray
    cd: np.ndarray
    crval: np.ndarray
    pv: PVPolynomial
    lookup_table: "LookupTable | None" = None
    pv_covariance: np.ndarray | None = None
    table_sigma: np.ndarray | None = None
    residual_map: object | None = None
    statistics: dict = field(default_factory=dict)
    settings: dict = field(default_factory=dict)
    provenance: dict = field(default_factory=dict)

    @cached_property
    def wcs(self):
        """WCS about the nominal pointing, `gwcs.WCS`."""
        return build_wcs(
            crpix=self.crpix,
            cd=self.cd,
            crval=self.crval,
            pv=self.pv,
            lookup_table=self.lookup_table,
            image_shape=self.image_shape,
        )

    def undistort(self, x, y):
        """Take the distortion off detector pixels.

        Parameters
        ----------
        x, y : array_like
            Detector pixels, zero based.

        Returns
        -------
        x, y : ndarray
            Undistorted pixels; NaN off the detector.
        """
        return self.wcs.get_transform("detector", "undistorted")(x, y)

    def covariance(self, x, y):
        """Covariance of the distortion that the instrument predicts, apart from its linear part.

        Parameters
        ----------
        x, y : array_like
            Positions on the detector, px, zero based.

        Returns
        -------
        (2, 2, ...) ndarray
            Covariance of the undistorted position in px^2; NaN off the detector, and everywhere
            where the solution holds no covariances.

        Notes
        -----
        The table was made of what the polynomial left over the whole detector: whatever error the
        polynomial has is in the table, with the opposite sign.  With a table its own uncertainty is
        therefore all; without one, that of the polynomial.
        """
        x, y = np.broadcast_arrays(np.asarray(x, dtype=float), np.asarray(y, dtype=float))
        if self.lookup_table is not None:
            if self.table_sigma is None:
                return np.full((2, 2, *x.shape), np.nan)
            return self._table_covariance(x, y)
        if self.pv_covariance is None:
            return np.full((2, 2, *x.shape), np.nan)
        return self._polynomial_covariance(x, y, self.pv_covariance, without_linear=True)

    def _table_covariance(self, x, y):
        table = self.lookup_table
        nodes = np.moveaxis(np.asarray(self.table_sigma, dtype=float), 0, -1)
        interpolate = RegularGridInterpolator(
            (table.y_grid, table.x_grid), nodes, bounds_error=False, fill_value=np.nan
        )
        points = np.stack([y.ravel(), x.ravel()], axis=-1)
        sigma_x, sigma_y, rho = interpolate(points).T.reshape(3, *x.shape)
        cross = rho * sigma_x * sigma_y
        return np.array([[sigma_x**2, cross], [cross, sigma_y**2]])

    def _polynomial_covariance(self, x, y, covariance, *, without_linear):
        """Covariance of CD0^-1 PV; optionally without what attitudes take."""
        columns = self._columns(x.ravel(), y.ravel())
        if without_linear:
            ny, nx = self.image_shape
            gx, gy = (
                a.ravel()
                for a in np.meshgrid(np.linspace(0, nx - 1, 15), np.linspace(0, ny - 1, 15))
            )
            plane = np.stack([np.ones_like(gx), gx / nx, gy / ny], axis=1)
            fit = np.linalg.lstsq(plane, np.hstack(self._columns(gx, gy)), rcond=None)[0]
            here = np.stack([np.ones(x.size), x.ravel() / nx, y.ravel() / ny], axis=1) @ fit
            columns = [c - h for c, h in zip(columns, np.hsplit(here, 2))]
        variance = [np.einsum("ij,jk,ik->i", c, v, c) for c, v in zip(columns, covariance)]
        inverse = np.linalg.inv(self.cd)
        out = np.einsum("ik,jk,kn->ijn", inverse, inverse, np.array(variance))
        return out.reshape(2, 2, *x.shape)

    def _columns(self, x, y):
        offset = np.array([x, y]) - np.reshape(self.crpix, (2, 1))
        return self.pv.design_matrix(*(self.cd @ offset))


@dataclass(frozen=True, eq=False)
class Calibration:
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
    attitude_covariance : (6, 6) ndarray, optional
        Covariance of the errors (ax, bxx, bxy, ay, byx, byy) that the attitude leaves in the
        undistorted position: dX = ax + bxx X + bxy Y and dY = ay + byx X + byy Y, with X, Y in px
        from the reference point.
    matches, sources : QTable, optional
        Pairs and sources of the frame.
    statistics, settings, provenance : dict
        How the calibration came about.
    pv_covariance : (2, n, n) ndarray, optional
        Covariance of the terms of each axis, deg^2, where the frame has a polynomial of its own
        (``refine="pv"``); all terms, so that the attitude adds nothing.
    """

    frame: str
    solution: DistortionSolution
    crval: np.ndarray
    cd: np.ndarray
    attitude_covariance: np.ndarray | None = None
    matches: object | None = None
    sources: object | None = None
    statistics: dict = field(default_factory=dict)
    settings: dict = field(default_factory=dict)
    provenance: dict = field(default_factory=dict)
    pv_covariance: np.ndarray | None = None

    @cached_property
    def wcs(self):
        """WCS of the frame, `gwcs.WCS`."""
        s = self.solution
        return build_wcs(
            crpix=s.crpix,
            cd=self.cd,
            crval=self.crval,
            pv=s.pv,
            pv_cd=s.cd,
            lookup_table=s.lookup_table,
            image_shape=s.image_shape,
        )

    def uncertainty(self, x, y):
        """Uncertainty of the calibrated position of a detector position, without centroid errors.

        Parameters
        ----------
        x, y : array_like
            Positions on the detector, px, zero based.

        Returns
        -------
        sigma_x, sigma_y : ndarray
            Standard deviations of the undistorted position along the detector's axes, px; NaN off
            the detector, and everywhere where the covariances are not known.
        rho : ndarray
            Correlation of the two errors.

        Notes
        -----
        Sum of the covariances of the attitude (its six numbers from this frame's stars) and of the
        instrument's non-linear part (`DistortionSolution.covariance`), which is shared by all
        frames.  Times the scale of the detector, it is the uncertainty on the sky.
        """
        x, y = np.broadcast_arrays(np.asarray(x, dtype=float), np.asarray(y, dtype=float))
        s = self.solution
        if self.attitude_covariance is None and self.pv_covariance is None:
            total = np.full((2, 2, *x.shape), np.nan)
        elif self.pv_covariance is not None:
            total = s._polynomial_covariance(x, y, self.pv_covariance, without_linear=False)
            if s.lookup_table is not None:
                total = total + s.covariance(x, y)
        else:
            total = s.covariance(x, y) + self._attitude_covariance(x, y)
        ny, nx = s.image_shape
        inside = (x >= -0.5) & (x <= nx - 0.5) & (y >= -0.5) & (y <= ny - 0.5)
        total = np.where(inside, total, np.nan)
        sigma_x, sigma_y = np.sqrt(total[0, 0]), np.sqrt(total[1, 1])
        with np.errstate(invalid="ignore", divide="ignore"):
            rho = total[0, 1] / (sigma_x * sigma_y)
        return sigma_x, sigma_y, np.where((sigma_x == 0) | (sigma_y == 0), 0.0, rho)

    def _attitude_covariance(self, x, y):
        s = self.solution
        offset = np.array([x, y]) - np.reshape(s.crpix, (2, *[1] * x.ndim))
        plane = np.array(s.pv(*np.tensordot(s.cd, offset, axes=1)))
        place = np.tensordot(np.linalg.inv(s.cd), plane, axes=1)
        row = np.stack([np.ones_like(x), *place])
        blocks = np.asarray(self.attitude_covariance, dtype=float).reshape(2, 3, 2, 3)
        return np.einsum("a...,iajb,b...->ij...", row, blocks, row)
