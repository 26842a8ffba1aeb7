"""Weight of a star by its distance from the reference point."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

__all__ = ["RadialWeight"]

_WEIGHTS = ("exp-sqrt", "gaussian", "inverse", "inverse-square", "uniform")
# The numbers of the paper.
_NUMBERED = {f"w{k}": name for k, name in enumerate(_WEIGHTS[:4], 1)}


@dataclass(frozen=True)
class RadialWeight:
    r"""Weight of a star by its distance from the reference point.

    Parameters
    ----------
    name : {'exp-sqrt', 'gaussian', 'inverse', 'inverse-square', 'uniform'}, optional
        Weighting function outside ``r0``; inside, every weight is 1.  The names ``w1`` to ``w4`` of
        the paper are also accepted, for the first four.
    r0 : float, optional
        Radius in px within which all stars have the same weight.

    Raises
    ------
    ValueError
        If the name is unknown or ``r0`` is not a positive number.

    Notes
    -----
    With :math:`r_d` the distance from the reference point, the weight for :math:`r_d > r_0` is
    (equations 6 to 9 of the paper, with the brackets of the Gaussian corrected):

    ==================  ======================================
    ``exp-sqrt``        :math:`\exp(-\sqrt{r_d - r_0})`
    ``gaussian``        :math:`\exp(-((r_d - r_0) / r_0)^2)`
    ``inverse``         :math:`r_0 / r_d`
    ``inverse-square``  :math:`(r_0 / r_d)^2`
    ``uniform``         1
    ==================  ======================================

    The weight multiplies the *squared* residual.  ``exp-sqrt`` falls to 5e-5 within 100 px, so it
    acts as a mask: outside ``r0``, a polynomial fitted with it is an extrapolation.

    References
    ----------
    WPDC-2P, arXiv:2603.09193, section 3.2.

    Examples
    --------
    >>> from wpdc_gwcs import RadialWeight
    >>> RadialWeight("inverse", r0=4000.0)([0.0, 4000.0, 8000.0])
    array([1. , 1. , 0.5])
    """

    names: ClassVar[tuple] = _WEIGHTS

    name: str = "exp-sqrt"
    r0: float = 4000.0

    def __post_init__(self):
        if self.name not in _WEIGHTS and self.name not in _NUMBERED:
            raise ValueError(
                f"weight must be one of {', '.join(_WEIGHTS)} or w1 to w4, got {self.name!r}"
            )
        object.__setattr__(self, "name", _NUMBERED.get(self.name, self.name))
        if not (np.isfinite(self.r0) and self.r0 > 0):
            raise ValueError(f"r0 must be a positive number of px, got {self.r0}")

    @classmethod
    def for_shape(cls, image_shape, name="exp-sqrt"):
        """Return a weight with the default radius of a detector: 0.87 times half its shorter side.

        Parameters
        ----------
        image_shape : (int, int)
            Shape ``(ny, nx)`` of the detector in px.
        name : str, optional
            Weighting function.

        Returns
        -------
        RadialWeight
            The weight, with ``r0`` in px.
        """
        return cls(name, r0=0.87 * 0.5 * min(image_shape))

    def __call__(self, r):
        """Evaluate the weight.

        Parameters
        ----------
        r : array_like
            Distance from the reference point in px.

        Returns
        -------
        ndarray
            Weights between 0 and 1, of the shape of ``r``.
        """
        r = np.asarray(r, dtype=float)
        outside = np.maximum(r, self.r0)  # every function is 1 at r0
        if self.name == "exp-sqrt":
            return np.exp(-np.sqrt(outside - self.r0))
        if self.name == "gaussian":
            return np.exp(-(((outside - self.r0) / self.r0) ** 2))
        if self.name == "inverse":
            return self.r0 / outside
        if self.name == "inverse-square":
            return (self.r0 / outside) ** 2
        return np.ones_like(r)
