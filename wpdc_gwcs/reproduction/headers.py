"""Real headers of 90Prime: their distortions, transferred to whole chips.

::

    WPDC_GWCS_DATA/wcs_headers/legacysurvey/90prime/*.fits --TPV--> Distortion --> SimulatedCamera
"""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np

from wpdc_gwcs.io.headers import read_headers
from wpdc_gwcs.io.tan import parse_tan
from wpdc_gwcs.simulation import Distortion, SimulatedDetector, make_camera

__all__ = ["chip_distortion", "find_headers", "header_camera"]

_VARIABLE = "WPDC_GWCS_DATA"
_FOLDER = Path("wcs_headers", "legacysurvey", "90prime")
_CAMERA = "bass-90prime"
# Size of a chip, and distance of its nearest corner from the camera's reference point, px.  The
# headers are of cutouts, so their reference points are shifted.
_SHAPE = (4096, 4032)
_GAP = (184, 60)


def find_headers():
    """Return the paths of the headers.

    Returns
    -------
    list of Path
        FITS files in the folder given by the environment variable ``WPDC_GWCS_DATA``; none if it is
        not set.
    """
    root = os.environ.get(_VARIABLE)
    return sorted((Path(root) / _FOLDER).glob("*.fits")) if root else []


def chip_distortion(path):
    """Transfer the distortion of a header to a whole chip.

    Parameters
    ----------
    path : path-like
        FITS file with a TPV header.

    Returns
    -------
    distortion : Distortion
        The PV polynomial of the header in pixels, about a reference point outside the chip, on the
        same side as in the header.
    crpix : (2,) ndarray
        The reference point, px, zero based.
    degree : int
        Degree of the polynomial.

    Raises
    ------
    FileFormatError
        If the file cannot be read.
    ValueError
        If the polynomial has radial terms.
    """
    tan = parse_tan(next(h for h in read_headers(path) if h["CTYPE1"].endswith("TPV")))
    crpix = np.where(tan.crpix < 0, np.negative(_GAP), np.add(_SHAPE[::-1], _GAP)).astype(float)
    inverse = np.linalg.inv(tan.cd)

    def undistort(x, y):
        plane = tan.pv(*np.tensordot(tan.cd, [x - crpix[0], y - crpix[1]], axes=1))
        return np.tensordot(inverse, plane, axes=1) + crpix[:, None]

    return Distortion.from_map(_SHAPE, undistort, degree=tan.pv.degree), crpix, tan.pv.degree


def header_camera(path):
    """Make a camera of one 90Prime chip, with the distortion of a header.

    Parameters
    ----------
    path : path-like
        FITS file with a TPV header.

    Returns
    -------
    camera : SimulatedCamera
        The chip, named after the file; its headers have the reference point of the camera, outside
        the chip.
    degree : int
        Degree of the header's polynomial.

    Notes
    -----
    The linear matrix of the header (rotation and skew) is replaced by that of the simulation.
    """
    distortion, crpix, degree = chip_distortion(path)
    place = tuple(map(float, np.subtract(distortion.center, crpix)))
    chip = SimulatedDetector(Path(path).stem, distortion, center=place)
    return replace(make_camera(_CAMERA), detectors=(chip,)), degree
