"""The distortion of all detectors of a camera in the focal plane."""

import numpy as np

from wpdc_gwcs.models import deproject, project
from wpdc_gwcs.plotting._style import BLUE, GREY, ORANGE, given_axes, round_number

__all__ = ["plot_focal_plane"]

# Default length of the longest arrow, as a fraction of the distance between arrows.
_LONGEST = 2.5
# Height of the key above the axes, beside the title.
_KEY_INCHES = 0.12
# Points along each side of a detector where its greatest distortion is looked for, edges included.
_N_POINTS = 21


def plot_focal_plane(detectors, *, axes=None, n_arrows=8, magnification=None):
    """Draw the distortion of all detectors of a camera as arrows in the focal plane.

    Parameters
    ----------
    detectors : Camera or iterable of Calibration
        The camera, or one calibrated frame of each detector.  All frames must be of one exposure,
        or of exposures with the same pointing.
    axes : `matplotlib.axes.Axes`, optional
        Axes to draw into.  Default: new ones.
    n_arrows : int, optional
        Number of arrows along each side of a detector.
    magnification : float, optional
        Ratio of the length of the arrows to the distortion; 10 in the paper.  Default: a round
        number at which the arrows do not cross.

    Returns
    -------
    `matplotlib.axes.Axes`
        Axes in thousands of px of the focal plane, with an outline and a name for each detector.

    Raises
    ------
    ValueError
        If there is no detector, a detector occurs twice, or ``n_arrows`` is less than 1.

    Notes
    -----
    An arrow starts where the linear part of the solution, about its reference point, puts the
    pixel.  It ends where the whole solution puts it.

    References
    ----------
    WPDC-2P, arXiv:2603.09193, figure 1.

    Examples
    --------
    >>> from wpdc_gwcs import calibrate, simulate
    >>> from wpdc_gwcs.plotting import plot_focal_plane
    >>> sky = simulate(1, image_shape=(1000, 1000), density=30, distortion=10, seed=2)
    >>> run = calibrate([e.frame() for e in sky.exposures], sky.reference)
    >>> axes = plot_focal_plane(run.calibrations)
    >>> [text.get_text() for text in axes.texts][0]
    'sim'
    """
    if not n_arrows >= 1:
        raise ValueError(f"n_arrows must be at least 1, got {n_arrows}")
    places = _of_camera(detectors) if hasattr(detectors, "places") else _of_frames(detectors)
    edges = [to_plane(*_outline(s.image_shape)) for _, s, to_plane in places]
    if axes is None:
        width, height = np.ptp(np.concatenate(edges, axis=1), axis=1)
        axes = given_axes(None, 1, 8.0, float(np.clip(7.2 * height / width, 2.5, 11.0)) + 0.8)[0]
    starts, steps, spacing = [], [], []
    for (name, solution, to_plane), edge in zip(places, edges, strict=True):
        ny, nx = solution.image_shape
        axes.plot(*edge / 1e3, color=GREY, lw=0.9)
        middle = to_plane(np.array([0.5 * (nx - 1)]), np.array([0.5 * (ny - 1)]))[:, 0]
        axes.text(
            *middle / 1e3, name, color=BLUE, ha="center", va="center", weight="bold", zorder=4,
            bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.75, "pad": 1},
        )  # fmt: skip
        x, y = (
            a.ravel()
            for a in np.meshgrid(
                *((np.arange(n_arrows) + 0.5) * n / n_arrows - 0.5 for n in (nx, ny))
            )
        )
        start = to_plane(x, y)
        starts.append(start)
        steps.append(to_plane(*np.array(solution.undistort(x, y))) - start)
        spacing.append(np.hypot(*(edge[:, 1] - edge[:, 0])) / n_arrows)
    start, step = np.concatenate(starts, axis=1), np.concatenate(steps, axis=1)
    longest = float(np.hypot(*step).max())
    if magnification is None:
        magnification = round_number(_LONGEST * min(spacing) / longest) if longest > 0 else 1.0
    quiver = axes.quiver(
        *start / 1e3, *step / 1e3, angles="xy", scale_units="xy", scale=1 / magnification,
        width=0.0022, color=ORANGE, zorder=3,
    )  # fmt: skip
    # Arrows at the edges may lead out of the outlines.
    axes.update_datalim((start + magnification * step).T / 1e3)
    axes.autoscale_view()
    key = round_number(longest / 2) if longest > 0 else 1.0
    above = _KEY_INCHES * axes.figure.dpi / axes.bbox.height
    axes.quiverkey(
        quiver, 0.86, 1 + above, key / 1e3, f"{key:g} px", labelpos="E", color=ORANGE,
        coordinates="axes",
    )  # fmt: skip
    axes.set_aspect("equal")
    axes.set_xlabel("focal plane x [1000 px]")
    axes.set_ylabel("focal plane y [1000 px]")
    most = max(_greatest(solution) for _, solution, _ in places)
    axes.set_title(rf"distortion $\times$ {magnification:g}, at most {most:.3g} px", loc="left")
    return axes


def _outline(image_shape):
    """Outline of a detector along the outer edges of its pixels, closed."""
    ny, nx = image_shape
    return np.array([[0, nx, nx, 0, 0], [0, 0, ny, ny, 0]]) - 0.5


def _greatest(solution):
    """Return the greatest distortion of a detector, px."""
    ny, nx = solution.image_shape
    x, y = (
        a.ravel()
        for a in np.meshgrid(np.linspace(0, nx - 1, _N_POINTS), np.linspace(0, ny - 1, _N_POINTS))
    )
    u, v = solution.undistort(x, y)
    return float(np.nanmax(np.hypot(u - x, v - y)))


def _of_camera(camera):
    """Name and solution of each detector, and its map from undistorted px to the focal plane."""
    found = []
    for k, name in enumerate(camera.detectors):
        solution = camera.solutions[name]

        def to_plane(x, y, k=k, solution=solution):
            offset = np.array([x - solution.crpix[0], y - solution.crpix[1]])
            return camera.matrices[k] @ offset + camera.places[k][:, None]

        found.append((name, solution, to_plane))
    return found


def _of_frames(calibrations):
    """Return the same for frames, in the plane of the first one, about the center of all."""
    calibrations = list(calibrations)
    if not calibrations:
        raise ValueError("a focal plane needs at least one detector")
    names = [c.solution.detector for c in calibrations]
    twice = {name for name in names if names.count(name) > 1}
    if twice:
        raise ValueError(f"every detector must be given once, got {min(twice)!r} twice")
    directions = np.radians([c.crval for c in calibrations])
    ra, dec = directions.T
    x, y, z = np.mean([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)], axis=1)
    middle = np.degrees([np.arctan2(y, x), np.arctan2(z, np.hypot(x, y))])
    first = np.asarray(calibrations[0].cd, float)

    found = []
    for c in calibrations:

        def to_plane(x, y, c=c):
            crpix = c.solution.crpix
            offset = np.array([x - crpix[0], y - crpix[1]])
            sky = deproject(*(np.asarray(c.cd) @ offset), c.crval)
            return np.linalg.solve(first, np.array(project(*sky, middle)))

        found.append((c.solution.detector, _OwnDistortion(c), to_plane))
    return found


class _OwnDistortion:
    """Distortion of a frame, its field included, in the form of a solution."""

    def __init__(self, calibration):
        self.image_shape = calibration.solution.image_shape
        self.undistort = calibration.undistort
