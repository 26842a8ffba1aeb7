"""Which frames of a run are solved together: cameras, or parts of those that are known already.

::

    frames --connected by detectors and exposures--> cameras --stored solution--> batches
"""

from wpdc_gwcs.calibration.camera import cameras_of, exposure_key

__all__ = ["are_independent", "batches_of"]

# Exposures of a camera whose distortion is known that are solved together: enough to tell how much
# scale and rotation vary between them, few enough that the memory of a run is that of a night.
_MOST_EXPOSURES = 16


def are_independent(settings, *, solution, update):
    """Return whether exposures of a known camera have nothing to tell each other.

    Parameters
    ----------
    settings : Settings
        Choices.
    solution : DistortionSolution, mapping or None
        Stored solutions.
    update : bool
        Whether they are updated.

    Returns
    -------
    bool
        False without a stored solution, and where all exposures are tied together.
    """
    tied = update or settings.free_stars or settings.method == "paper"
    return solution is not None and not tied


def batches_of(frames, settings, *, solution=None, update=False, earlier=()):
    """Group frames that are solved together.

    Parameters
    ----------
    frames : list of Frame
        All frames of a run.
    settings : Settings
        Choices; free stars and the paper's method tie all exposures together.
    solution : DistortionSolution, mapping or None, optional
        Stored solutions by detector, or one for all.
    update : bool, optional
        Whether they are updated, from all frames at once.
    earlier : iterable of set of str, optional
        Names of frames that an earlier run of the same choices has solved together.

    Returns
    -------
    list of list of Frame
        Cameras: connected through detectors and exposures.  Where all detectors of one have stored
        solutions, which stay as they are, its exposures have nothing in common but how much they
        vary, and come in batches of 16 at most, in the order of the frames; those of an earlier run
        first, as they were.
    """
    cameras = cameras_of(frames)
    if not are_independent(settings, solution=solution, update=update):
        return cameras
    earlier = [set(names) for names in earlier]
    return [batch for camera in cameras for batch in _split(camera, solution, earlier)]


def _split(camera, solution, earlier):
    stored = solution if hasattr(solution, "keys") else None
    if stored is not None and not all(frame.detector in stored for frame in camera):
        return [camera]
    by_name = {frame.name: frame for frame in camera}
    batches, left = [], dict(by_name)
    for names in earlier:
        if names <= set(left):
            batches.append([frame for name, frame in by_name.items() if name in names])
            left = {name: frame for name, frame in left.items() if name not in names}
    exposures = {}
    for frame in left.values():
        exposures.setdefault(exposure_key(frame), []).append(frame)
    exposures = list(exposures.values())
    n_batches = -(-len(exposures) // _MOST_EXPOSURES)
    for k in range(n_batches):
        first, last = (len(exposures) * i // n_batches for i in (k, k + 1))
        batches.append([frame for exposure in exposures[first:last] for frame in exposure])
    return batches
