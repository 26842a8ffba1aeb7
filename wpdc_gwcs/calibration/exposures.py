"""Frames of one exposure: the claims of their headers, checked against each other."""

import re
import warnings
from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from wpdc_gwcs.calibration.start import detector_center, sky_of
from wpdc_gwcs.exceptions import WPDCWarning

__all__ = ["tie_exposures"]

# Detectors of one exposure start within this time of each other, s: the shutter takes a second or
# two, and the next exposure does not start before the readout of the first.
_SAME_START = 5.0
# Largest distance between detectors of one camera, in diagonals of a detector: the largest existing
# camera, with 15 x 15 detectors, has 14 between its outermost centers.
_FARTHEST = 20.0


def tie_exposures(frames):
    """Tie only those frames together that can belong to one exposure.

    Parameters
    ----------
    frames : list of Frame
        Frames with the camera and exposure from their headers.

    Returns
    -------
    list of Frame
        The same frames in the same order; some have another ``exposure``, or `None` if they are
        taken on their own.

    Warns
    -----
    WPDCWarning
        If frames of one exposure point to different parts of the sky, or two of them are from the
        same detector.

    Notes
    -----
    Frames with the same identifier but different start times are different exposures: some
    observatories use an identifier for several exposures, or restart their numbers every night.
    If a detector still occurs twice, the frames of each file stay together, or else those with the
    same tangent point.
    """
    groups = {}
    for row, frame in enumerate(frames):
        if frame.camera is not None and frame.exposure is not None:
            groups.setdefault((frame.camera, frame.exposure), []).append(row)
    tied = list(frames)
    for (_, exposure), rows in groups.items():
        if len(rows) < 2:
            continue
        parts = []
        for part in [p for same in _by_start(frames, rows) for p in _by_place(frames, same)]:
            split = _without_doubles(frames, part)
            if split is None:
                _warn(frames, part, "include a detector twice; each frame is taken on its own")
                tied = [replace(f, exposure=None) if i in part else f for i, f in enumerate(tied)]
            else:
                parts += split
        for number, part in enumerate(parts):
            key = exposure if number == 0 else f"{exposure}#{number + 1}"
            for row in part:
                tied[row] = replace(frames[row], exposure=key)
    return tied


def _by_start(frames, rows):
    """Split frames at gaps between their start times."""
    starts = [frames[row].meta.get("start") for row in rows]
    if any(start is None for start in starts):
        return [rows]
    order = np.argsort(starts, kind="stable")
    gaps = np.diff(np.array(starts)[order]) * 86_400 > _SAME_START
    return [[rows[i] for i in sorted(part)] for part in np.split(order, np.flatnonzero(gaps) + 1)]


def _by_place(frames, rows):
    """Split frames whose headers point farther apart than the size of a camera."""
    places, sizes = zip(*(_place(frames[row]) for row in rows), strict=True)
    places = np.array(places)
    if not np.isfinite(places).all():
        return [rows]
    # Chords of the unit sphere have no special cases at the poles.
    reach = 2 * np.sin(min(_FARTHEST * float(np.median(sizes)), np.pi) / 2)
    tree, left, parts = cKDTree(places), set(range(len(rows))), []
    while left:
        near = sorted(left & set(tree.query_ball_point(places[min(left)], reach)))
        parts.append([rows[i] for i in near])
        left -= set(near)
    if len(parts) > 1:
        _warn(
            frames, rows, "point to different parts of the sky; they are taken as several exposures"
        )
    return parts


def _place(frame):
    """Direction of the center of a frame from its header, and its diagonal in radians."""
    ny, nx = frame.image_shape
    center = detector_center(frame.image_shape)
    x, y = center[0] + np.array([0.0, 0.5, 0.0]), center[1] + np.array([0.0, 0.0, 0.5])
    ra, dec = np.deg2rad(sky_of(frame.wcs, x, y))
    at, right, up = np.array([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)]).T
    size = 2 * np.hypot(nx * np.linalg.norm(right - at), ny * np.linalg.norm(up - at))
    return at, size


def _without_doubles(frames, rows):
    """Split frames that have a detector twice, by file or by tangent point; `None` if neither can.

    The detectors of one exposure mostly have one tangent point in their headers, and dithered
    exposures have others.
    """
    if not _has_double(frames, rows):
        return [rows]
    for label in (_file_of, _tangent_point):
        parts = {}
        for row in rows:
            parts.setdefault(label(frames[row]), []).append(row)
        if 1 < len(parts) < len(rows) and not any(_has_double(frames, p) for p in parts.values()):
            return list(parts.values())
    return None


def _has_double(frames, rows):
    return len({frames[row].detector for row in rows}) < len(rows)


def _file_of(frame):
    return re.sub(r"\[[^\[\]]*\]$", "", frame.source)


def _tangent_point(frame):
    header = getattr(frame.wcs, "wcs", None)
    return None if header is None else tuple(np.round(header.crval, 7))


def _warn(frames, rows, what):
    first, last = frames[rows[0]], frames[rows[-1]]
    warnings.warn(
        f"{first.source} to {last.source}: {len(rows)} frames of camera {first.camera} that claim "
        f"to be one exposure, {first.exposure}, {what}",
        WPDCWarning,
        stacklevel=4,
    )
