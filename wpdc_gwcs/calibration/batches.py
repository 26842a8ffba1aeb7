"""Groups of frames that are solved together: cameras, or batches of a known camera.

::

    frames --connected by detectors and exposures--> cameras --stored solution--> batches
"""

from wpdc_gwcs.calibration.camera import cameras_of, exposure_key

__all__ = ["are_independent", "batches_of"]

# Maximum number of exposures in a batch of a known camera: enough to learn how much scale and
# rotation vary between them, and few enough to keep the memory of a long run small.
_MOST_EXPOSURES = 16


def are_independent(settings, *, solution, update):
    """Return whether exposures of a known camera can be solved in separate batches.

    Parameters
    ----------
    settings : Settings
        Settings of the run.
    solution : DistortionSolution, mapping or None
        Stored solutions.
    update : bool
        Whether the stored solutions are updated.

    Returns
    -------
    bool
        False without a stored solution, and if the settings tie all exposures together.
    """
    tied = update or settings.free_stars or settings.method == "paper"
    return solution is not None and not tied


def batches_of(frames, settings, *, solution=None, update=False, earlier=()):
    """Group the frames that are solved together.

    Parameters
    ----------
    frames : list of Frame
        All frames of a run.
    settings : Settings
        Settings of the run; free stars and the paper's method tie all exposures together.
    solution : DistortionSolution, mapping or None, optional
        Stored solutions by detector, or one for all.
    update : bool, optional
        Whether the stored solutions are updated, which takes all frames at once.
    earlier : iterable of set of str, optional
        Names of the frames in each batch of an earlier run with the same settings.

    Returns
    -------
    list of list of Frame
        One list for each camera: frames that are connected by detectors and exposures.  If all
        detectors of a camera have stored solutions that are not updated, it is divided into
        batches of at most 16 exposures, in the order of the frames.  The batches of an earlier
        run come first, unchanged.
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
