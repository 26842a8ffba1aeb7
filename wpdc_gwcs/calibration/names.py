"""Names of the files of a run: of frames, detectors and cameras."""

from wpdc_gwcs.calibration.staging import FRAME_SUFFIXES
from wpdc_gwcs.exceptions import InputError

__all__ = ["check_distinct", "file_stem", "names_of", "superseded_name"]


def file_stem(name):
    """Make a file name of the name of a detector or camera, whatever characters it has.

    Parameters
    ----------
    name : str
        Name of the detector.

    Returns
    -------
    str
        Name without characters that a file system may refuse.
    """
    return "".join(c if c.isalnum() or c in "._-" else "_" for c in name)


def superseded_name(solution):
    """Return the file name of a solution that no longer holds.

    Parameters
    ----------
    solution : DistortionSolution
        Solution with the epoch until which it was valid.

    Returns
    -------
    str
        For example ``ccd1.until-2024.5000.solution.asdf``.
    """
    return f"{file_stem(solution.detector)}.until-{solution.valid_to:.4f}.solution.asdf"


def names_of(group, cameras):
    """List the files that a group of frames may write.

    Parameters
    ----------
    group : list of Frame
        Frames that are solved together.
    cameras : dict
        Camera to the detectors of each part of it that is solved apart; those of the group are
        added.

    Returns
    -------
    dict
        Owner of each file, by file name.

    Raises
    ------
    InputError
        If two detectors have the same file name.
    """
    names = {
        frame.name + suffix: frame.source or frame.name
        for frame in group
        for suffix in reversed(FRAME_SUFFIXES)
    }
    detectors = {frame.detector for frame in group}
    for detector in detectors:
        names[f"{file_stem(detector)}.solution.asdf"] = f"detector {detector!r}"
    if len(names) < len(FRAME_SUFFIXES) * len(group) + len(detectors):
        raise InputError(
            "the names of detectors must differ in file names too, got "
            f"{', '.join(sorted(detectors))}"
        )
    if len(detectors) > 1:
        camera = next((frame.camera for frame in group if frame.camera), "camera")
        # Exposures that have no detector in common are solved apart.
        apart = cameras.setdefault(camera, [])
        k = next((k for k, known in enumerate(apart) if known & detectors), len(apart))
        if k == len(apart):
            apart.append(set())
        apart[k] |= detectors
        mark = f"-{k + 1}" if k else ""
        names[f"{file_stem(camera)}{mark}.camera.asdf"] = f"camera {camera!r}{mark}"
    return names


def check_distinct(names):
    """Check that no file has two owners.

    Parameters
    ----------
    names : iterable of dict
        As returned by `names_of`, for all groups.

    Raises
    ------
    InputError
        If a file has two owners.
    """
    owners = {}
    for files in names:
        for name, owner in files.items():
            # Detectors of one name have one stored solution.
            if name in owners and owners[name] != owner:
                raise InputError(
                    f"{owners[name]} and {owner} would both write {name}: calibrate them into "
                    "different folders"
                )
            owners[name] = owner
