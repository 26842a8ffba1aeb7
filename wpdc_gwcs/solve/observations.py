"""All pairs of all exposures and detectors, checked, in flat columns."""

from dataclasses import dataclass

import numpy as np

from wpdc_gwcs.counts import counted
from wpdc_gwcs.detector import on_detector
from wpdc_gwcs.exceptions import FitError

__all__ = ["Detector", "Observations", "gather"]


@dataclass(frozen=True, eq=False)
class Detector:
    """Shape and reference point of one detector.

    Parameters
    ----------
    name : str
        Name of the detector.
    image_shape : (int, int)
        Shape ``(ny, nx)`` in px.
    crpix : (2,) ndarray
        Reference point, px, zero based.
    """

    name: str
    image_shape: tuple[int, int]
    crpix: np.ndarray

    @property
    def center(self):
        """Center of the pixels, (x, y)."""
        ny, nx = self.image_shape
        return np.array([0.5 * (nx - 1), 0.5 * (ny - 1)])

    @property
    def aspect(self):
        """Sides along x and y in units of the longer one."""
        return np.array(self.image_shape[::-1]) / max(self.image_shape)

    def normalized(self, x, y):
        """Pixels from the center in units of half of each side, ``(u, v)``.

        Parameters
        ----------
        x : (N,) ndarray
            Pixels along x.
        y : (N,) ndarray
            Pixels along y.
        """
        ny, nx = self.image_shape
        return 2 * (x - self.center[0]) / nx, 2 * (y - self.center[1]) / ny

    def contains(self, x, y):
        """Mark pixels on the detector; NaN is not.

        Parameters
        ----------
        x : (N,) ndarray
            Pixels along x.
        y : (N,) ndarray
            Pixels along y.
        """
        return on_detector(x, y, self.image_shape)

    def grid(self, n):
        """Pixels of an ``n`` by ``n`` grid from one outer edge to the other, flat ``(x, y)``.

        Parameters
        ----------
        n : int
            Points along each axis.
        """
        ny, nx = self.image_shape
        x, y = np.meshgrid(np.linspace(-0.5, nx - 0.5, n), np.linspace(-0.5, ny - 0.5, n))
        return x.ravel(), y.ravel()


@dataclass(frozen=True, eq=False)
class Observations:
    """Flat columns of all pairs, one slice for each frame.

    A frame is one exposure of one detector; frames with the same key share an exposure.

    Parameters
    ----------
    frames : tuple of Exposure
        The given exposures.
    detectors : tuple of Detector
        Detectors in the order of their first frame.
    slices : tuple of slice
        Rows of each frame.
    detector_of, exposure_of : (F,) ndarray of int
        Detector and exposure of each frame.
    x, y, ra, dec : (N,) ndarray
        Pixels and reference positions in degrees.
    sigma : (2, N) ndarray
        Stated errors in px; 1 where there are none.
    reference : (N,) ndarray
        Fraction of the variances due to reference stars, 0 to 1.
    star : (N,) ndarray of int
        Number of the star; -1 where it is unknown.
    has_errors, valid, finite : (N,) ndarray of bool
        Whether errors were stated, the pair may be fitted, and it gets a residual.
    color : (N,) ndarray
        Color of the star minus the reference color, 0 where unknown.
    reference_color : float
        Median color; NaN without colors.
    """

    frames: tuple
    detectors: tuple
    slices: tuple
    detector_of: np.ndarray
    exposure_of: np.ndarray
    x: np.ndarray
    y: np.ndarray
    ra: np.ndarray
    dec: np.ndarray
    sigma: np.ndarray
    reference: np.ndarray
    star: np.ndarray
    has_errors: np.ndarray
    valid: np.ndarray
    finite: np.ndarray
    color: np.ndarray
    reference_color: float

    def __len__(self):
        return len(self.x)

    @property
    def n_exposures(self):
        """Number of exposures."""
        return int(self.exposure_of.max()) + 1

    def frames_of(self, exposure):
        """Frames of one exposure.

        Parameters
        ----------
        exposure : int
            Number of the exposure.
        """
        return np.flatnonzero(self.exposure_of == exposure)

    def detector(self, frame):
        """Detector of a frame.

        Parameters
        ----------
        frame : int
            Number of the frame.
        """
        return self.detectors[self.detector_of[frame]]


def gather(frames, shapes, crpix):
    """Collect the pairs of all frames in flat columns, and check them.

    Parameters
    ----------
    frames : sequence of Exposure
        Pairs of one exposure of one detector each.
    shapes, crpix : dict
        Shape ``(ny, nx)`` and reference point of each detector, by its name.

    Returns
    -------
    Observations
        Columns.

    Raises
    ------
    FitError
        If no pair can be used, or a frame starts from an impossible attitude.
    ValueError
        If columns of a frame differ in length.
    """
    names = list(dict.fromkeys(f.detector for f in frames))
    detectors = tuple(Detector(n, shapes[n], np.asarray(crpix[n], float)) for n in names)
    detector_of = np.array([names.index(f.detector) for f in frames])
    keys = [(k,) if f.exposure is None else f.exposure for k, f in enumerate(frames)]
    order = list(dict.fromkeys(keys))
    exposure_of = np.array([order.index(key) for key in keys])
    edges = np.concatenate([[0], np.cumsum([np.size(f.x) for f in frames])])
    slices = tuple(slice(int(a), int(b)) for a, b in zip(edges[:-1], edges[1:]))
    n = int(edges[-1])
    wanted = ("x", "y", "ra", "dec", "color", "reference_err", "star")
    columns = {name: np.full(n, np.nan) for name in wanted}
    stated = np.full((2, n), np.nan)
    has_errors, valid, inside = np.zeros(n, bool), np.ones(n, bool), np.zeros(n, bool)
    for frame, s, d in zip(frames, slices, detector_of):
        _check_start(frame)
        for name in columns:
            value = getattr(frame, name)
            if value is None:
                continue
            value = np.ravel(np.asarray(value, dtype=float))
            if value.size != s.stop - s.start:
                raise ValueError(
                    f"exposure {frame.name}: {name} must have as many values as x, has "
                    f"{value.size}, x has {s.stop - s.start}"
                )
            columns[name][s] = value
        if frame.x_err is not None and frame.y_err is not None:
            stated[0, s], stated[1, s] = frame.x_err, frame.y_err
            has_errors[s] = True
        if frame.use is not None:
            valid[s] &= np.asarray(frame.use, bool)
        inside[s] = detectors[d].contains(columns["x"][s], columns["y"][s])
    finite = np.isfinite(sum(columns[name] for name in ("x", "y", "ra", "dec")))
    good_error = (np.isfinite(stated) & (stated > 0)).all(0)
    bad_error = has_errors & ~good_error
    allowed = int(valid.sum())
    valid &= finite & inside & ~bad_error
    if not np.any(valid):
        shape = detectors[0].image_shape
        raise FitError(
            f"none of {counted(n, 'pair')} can be used: {int((~finite).sum())} have NaN positions, "
            f"{int((finite & ~inside).sum())} lie off the detector of {shape[1]} x {shape[0]} px, "
            f"{int(bad_error.sum())} have errors that are NaN, infinite or not positive, "
            f"{n - allowed} are held out"
        )
    color, reference_err, star = (columns.pop(c) for c in ("color", "reference_err", "star"))
    sigma = np.where(has_errors & good_error, stated, 1.0)
    share = reference_err**2 / np.mean(sigma**2, axis=0)
    known = np.isfinite(color)
    # Color terms need colors for half of the stars.
    reference_color = float(np.median(color[known & valid])) if _mostly(known, valid) else np.nan
    color = np.where(known & np.isfinite(reference_color), color - reference_color, 0.0)
    return Observations(
        frames=tuple(frames),
        detectors=detectors,
        slices=slices,
        detector_of=detector_of,
        exposure_of=exposure_of,
        **columns,
        sigma=sigma,
        reference=np.where(share > 0, np.minimum(share, 1.0), 0.0),
        star=np.where(star >= 0, star, -1).astype(np.int64),
        has_errors=has_errors,
        valid=valid,
        finite=finite & inside,
        color=color,
        reference_color=reference_color,
    )


def _mostly(known, valid):
    return known[valid].mean() > 0.5


def _check_start(frame):
    start = np.asarray(frame.crval, dtype=float), np.asarray(frame.cd, dtype=float)
    if not all(np.isfinite(a).all() for a in start) or np.linalg.det(start[1]) == 0:
        raise FitError(
            f"exposure {frame.name}: it must start from a finite CRVAL and an invertible CD, "
            f"got {start[0].tolist()} and {start[1].tolist()}"
        )
