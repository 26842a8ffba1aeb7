"""Frozen result objects: the instrument (`DistortionSolution`), the frame (`Calibration`).

::

    detector px --[instrument: CRPIX, CD0, PV, table]--> undistorted px --[exposure: CD, CRVAL]-->
    ICRS
"""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from wpdc_gwcs.models import LookupTable, PVPolynomial
from wpdc_gwcs.wcs import build_wcs

__all__ = ["Calibration", "DistortionSolution"]


@dataclass(frozen=True, eq=False)
class DistortionSolution:
    """The distortion of one detector: what all its exposures share."""

    detector: str
    image_shape: tuple[int, int]
    crpix: np.ndarray  # (2,), px, zero based
    cd: np.ndarray  # (2, 2), deg / px, the nominal CD0 in which the PV polynomial stands
    crval: np.ndarray  # (2,), deg, nominal pointing
    pv: PVPolynomial
    lookup_table: "LookupTable | None" = None
    pv_covariance: np.ndarray | None = (
        None  # (2, n, n), deg^2: covariance of the terms of each axis
    )
    table_sigma: np.ndarray | None = (
        None  # (3, ny_grid, nx_grid): sigma_x, sigma_y [px], rho at the nodes
    )
    residual_map: object | None = None  # ResidualMap
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


@dataclass(frozen=True, eq=False)
class Calibration:
    """One calibrated frame: an instrument and the attitude of one exposure."""

    frame: str
    solution: DistortionSolution
    crval: np.ndarray  # (2,), deg
    cd: np.ndarray  # (2, 2), deg / px
    attitude_covariance: np.ndarray | None = None  # (6, 6), see Calibration.uncertainty
    matches: object | None = None  # QTable
    sources: object | None = None  # QTable
    statistics: dict = field(default_factory=dict)
    settings: dict = field(default_factory=dict)
    provenance: dict = field(default_factory=dict)

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
