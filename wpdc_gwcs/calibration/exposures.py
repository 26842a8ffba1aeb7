"""Which frames are one exposure: what their headers say, checked against each other."""

import re
import warnings
from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from wpdc_gwcs.calibration.start import detector_center, sky_of
from wpdc_gwcs.exceptions import WPDCWarning

__all__ = ["tie_exposures"]

# Detectors of one exposure begin within this time of each other, s: the shutter takes a second or
# two, and the next exposure does not begin before the first is read out.
_SAME_START = 5.0
# Detectors of one camera are not further apart than this, in diagonals of a detector: a camera of
# 15 x 15, the largest there is, measures 14 between its outermost centres.
_FARTHEST = 20.0


def tie_exposures(frames):
    """Keep together only those frames that can be of one exposure.

    Parameters
    ----------
    frames : list of Frame
        With the keys that their headers gave.

    Returns
    -------
    list of Frame
        The same frames, in order; some with another ``exposure``, or `None` where they are on their
        own.

    Warns
    -----
    WPDCWarning
        If frames with one key point to different parts of the sky, or are twice of one detector.

    Notes
    -----
    Frames of one key that began at different times are different exposures: some observatories give
    one identifier to several exposures, or begin to count anew each night.
    """
    groups = {}
    for row, frame in enumerate(frames):
        if frame.camera is not None and frame.exposure is not None:
            groups.setdefault((frame.camera, frame.exposure), []).append(row)
    tied = list(frames)
    for (_, exposure), rows in groups.items():
        if len(rows) < 2:
            continue
        parts = [p for together in _by_start(frames, rows) for p in _by_place(frames, together)]
        for number, part in enumerate(parts):
            for row, key in zip(part, _checked(frames, part, exposure, number), strict=True):
                tied[row] = replace(frames[row], exposure=key)
    return tied


def _by_start(frames, rows):
    """Split frames where the times at which they began have a gap."""
    starts = [frames[row].meta.get("start") for row in rows]
    if any(start is None for start in starts):
        return [rows]
    order = np.argsort(starts, kind="stable")
    gaps = np.diff(np.array(starts)[order]) * 86_400 > _SAME_START
    return [[rows[i] for i in sorted(part)] for part in np.split(order, np.flatnonzero(gaps) + 1)]


def _by_place(frames, rows):
    """Split frames whose headers point further apart than a camera is large."""
    places, sizes = zip(*(_place(frames[row]) for row in rows), strict=True)
    places = np.array(places)
    if not np.isfinite(places).all():
        return [rows]
    # chords of the unit sphere: straight distances need no care at the poles
    reach = 2 * np.sin(min(_FARTHEST * float(np.median(sizes)), np.pi) / 2)
    tree, left, parts = cKDTree(places), set(range(len(rows))), []
    while left:
        near = sorted(left & set(tree.query_ball_point(places[min(left)], reach)))
        parts.append([rows[i] for i in near])
        left -= set(near)
    if len(parts) > 1:
        _warn(frames, rows, "point to different parts of the sky; they are taken as several")
    return parts


def _place(frame):
    """Direction of the centre of a frame by its header, and its diagonal in radians."""
    ny, nx = frame.image_shape
    center = detector_center(frame.image_shape)
    x, y = center[0] + np.array([0.0, 0.5, 0.0]), center[1] + np.array([0.0, 0.0, 0.5])
    ra, dec = np.deg2rad(sky_of(frame.wcs, x, y))
    at, right, up = np.array([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)]).T
    size = 2 * np.hypot(nx * np.linalg.norm(right - at), ny * np.linalg.norm(up - at))
    return at, size


def _checked(frames, rows, exposure, number):
    """Keys of frames that agree in time and place; no detector can be in an exposure twice."""
    key = exposure if number == 0 else f"{exposure}#{number + 1}"
    detectors = [frames[row].detector for row in rows]
    if len(set(detectors)) == len(detectors):
        return [key] * len(rows)
    twice = sorted({d for d in detectors if detectors.count(d) > 1})
    files = [re.sub(r"\[[^\[\]]*\]$", "", frames[row].source) for row in rows]
    pairs = set(zip(files, detectors, strict=True))
    if len(pairs) == len(rows) and len(set(files)) < len(files):
        _warn(frames, rows, f"have the detector {twice[0]!r} twice; each file is taken as one")
        return [f"{key} {file}" if files.count(file) > 1 else None for file in files]
    _warn(frames, rows, f"have the detector {twice[0]!r} twice; each is taken on its own")
    return [None] * len(rows)


def _warn(frames, rows, what):
    first, last = frames[rows[0]], frames[rows[-1]]
    warnings.warn(
        f"{first.source} to {last.source}: {len(rows)} frames of camera {first.camera} that claim "
        f"to be one exposure, {first.exposure}, {what}",
        WPDCWarning,
        stacklevel=4,
    )
