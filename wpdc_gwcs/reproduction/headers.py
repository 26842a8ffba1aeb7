"""Real headers of 90Prime: the distortion of each, on a whole chip beside its reference point.

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
# A chip, and how far the reference point of the camera is from its nearest corner, px.  The headers
# are those of cut-outs, whose reference points have moved with them.
_SHAPE = (4096, 4032)
_GAP = (184, 60)


def find_headers():
    """Find the headers.

    Returns
    -------
    list of Path
        FITS files in the folder that the environment variable ``WPDC_GWCS_DATA`` names; none where
        it is not set.
    """
    root = os.environ.get(_VARIABLE)
    return sorted((Path(root) / _FOLDER).glob("*.fits")) if root else []


def chip_distortion(path):
    """Put the distortion of a header onto a whole chip.

    Parameters
    ----------
    path : path-like
        FITS file with a TPV header.

    Returns
    -------
    distortion : Distortion
        The PV polynomial of the header in pixels, about a reference point off the chip, on the side
        where the header has it.
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
    """Make a camera of one chip of 90Prime, with the distortion of a header.

    Parameters
    ----------
    path : path-like
        FITS file with a TPV header.

    Returns
    -------
    camera : SimulatedCamera
        The chip, named after the file; its headers have the reference point of the camera, off it.
    degree : int
        Degree of the header's polynomial.

    Notes
    -----
    The matrix of the header, its rotation and its skew, is replaced by that of the simulation.
    """
    distortion, crpix, degree = chip_distortion(path)
    place = tuple(map(float, np.subtract(distortion.center, crpix)))
    chip = SimulatedDetector(Path(path).stem, distortion, center=place)
    return replace(make_camera(_CAMERA), detectors=(chip,)), degree
