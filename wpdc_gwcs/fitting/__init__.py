"""Weighted linear least squares: radial weights, the astropy fitter, the attitude of an exposure.

::

    (xi, eta), (xi_ref, eta_ref) --WPDCFitter, RadialWeight--> polynomial
    undistorted px, (ra, dec)    --fit_attitude-------------> CRVAL, CD and their covariance

Everything is solved by QR and SVD of columns scaled to unit length, never by normal equations of
raw powers.
"""

# astropy imports the fitter (entry point ``astropy.modeling``) at the end of its own import.  That
# must happen before the fitter's module is executed, not halfway through it.
import astropy.modeling  # noqa: F401

from wpdc_gwcs.fitting.attitude import MIN_STARS_ATTITUDE, AttitudeFit, fit_attitude
from wpdc_gwcs.fitting.fitter import WPDCFitter
from wpdc_gwcs.fitting.linear import LinearSolution, solve_linear
from wpdc_gwcs.fitting.radial import RadialWeight
from wpdc_gwcs.robust import robust_sigma

__all__ = [
    "MIN_STARS_ATTITUDE",
    "AttitudeFit",
    "LinearSolution",
    "RadialWeight",
    "WPDCFitter",
    "fit_attitude",
    "robust_sigma",
    "solve_linear",
]
