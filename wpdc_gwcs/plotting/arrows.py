"""Mean residuals in the cells of a grid, as arrows."""

from dataclasses import dataclass

import numpy as np

from wpdc_gwcs.evaluation import binned_residuals
from wpdc_gwcs.plotting._style import BLUE, ORANGE, frame_detector, round_number

__all__ = ["Arrows", "draw_arrows"]


@dataclass(frozen=True, eq=False)
class Arrows:
    """Arrows on a figure, and their scale.

    Parameters
    ----------
    quiver : `matplotlib.quiver.Quiver`
        The arrows.
    typical : float
        Residual whose arrow is as long as a cell, px.
    magnification : float
        Ratio of the length of an arrow to its residual.
    rms : float
        Root mean square of the cell means, px.
    """

    quiver: object
    typical: float
    magnification: float
    rms: float

    def draw_key(self, axes, x, y, *, labelpos="E"):
        """Draw a key: an arrow of a round length, with its value.

        Parameters
        ----------
        axes : `matplotlib.axes.Axes`
            Axes that have the arrows.
        x, y : float
            Position in units of the axes.
        labelpos : {'N', 'S', 'E', 'W'}, optional
            Side of the label.
        """
        key = round_number(self.typical)
        axes.quiverkey(
            self.quiver, x, y, key, f"{key:g} px", labelpos=labelpos, color=ORANGE,
            coordinates="axes",
        )  # fmt: skip


def draw_arrows(axes, x, y, dx, dy, *, image_shape, n_bins):
    """Draw the mean residuals of each cell of a detector.

    Parameters
    ----------
    axes : `matplotlib.axes.Axes`
        Axes to draw into.
    x, y, dx, dy : (N,) array_like
        Pixel coordinates, zero based, and residuals, px.
    image_shape : (int, int)
        Shape of the detector, ``(ny, nx)``.
    n_bins : int
        Cells along each side.

    Returns
    -------
    Arrows
        One arrow for each cell that has stars.
    """
    ny, nx = image_shape
    u, v, count = binned_residuals(x, y, dx, dy, image_shape=image_shape, n_bins=n_bins)
    cell = np.array([nx, ny]) / n_bins
    filled = count > 0
    iy, ix = np.nonzero(filled)
    u, v = u[filled], v[filled]
    length = np.hypot(u, v)
    # A typical arrow is as long as a cell, and the longest one fits into the margin.  The key is a
    # round number near the typical one.
    typical = float(max(np.percentile(length, 80), length.max() / 1.9)) if length.size else 0.0
    typical = typical or 1.0
    quiver = axes.quiver(
        (ix + 0.5) * cell[0] - 0.5,
        (iy + 0.5) * cell[1] - 0.5,
        u,
        v,
        angles="xy",
        scale_units="xy",
        scale=typical / cell.min(),
        width=0.0032,
        color=BLUE,
        pivot="tail",
    )
    frame_detector(axes, image_shape)
    # Arrows of the outer cells may reach over the edge.
    margin = 1.5 * cell.min()
    axes.set_xlim(-0.5 - margin, nx - 0.5 + margin)
    axes.set_ylim(-0.5 - margin, ny - 0.5 + margin)
    rms = float(np.sqrt(np.mean(length**2))) if length.size else np.nan
    return Arrows(quiver, typical, cell.min() / typical, rms)
