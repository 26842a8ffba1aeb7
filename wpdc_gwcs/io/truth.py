"""The truth of simulations as ASDF: an exact WCS for each frame.

::

    {"frames": {name: {"wcs": gwcs in stock models, exact to rounding}, ...},
     "truth": {format_version, detectors, frames, ...}}

The first part is for everyone.  From the second one, `read_truths` makes maps with exact inverses.
Layout of ``truth``, format version 1.0.0, all plain YAML:

================== =============================================================================
``format_version`` "1.0.0"
``software``       name and version of the writer
``camera``         name of the camera
``catalog``        file of the reference catalog, beside this one
``detectors``      name to ``image_shape`` (ny, nx) and to the closed form of the distortion, see
                   `~wpdc_gwcs.simulation.Distortion`: ``axis``, ``radial``, ``terms`` (m, n and the
                   coefficient), ``waves`` (wave vector, phase, amplitude); complex numbers as pairs
``frames``         name to ``detector``, ``exposure`` (or null), ``epoch``, ``file``, ``measured``
                   ("list" or "image"), ``color`` (of the stars that the map is of, or null) and the
                   linear WCS ``crpix`` (1-based), ``crval``, ``cd``
================== =============================================================================
"""

from math import comb
from pathlib import Path

import numpy as np
from astropy.modeling.models import Mapping, Polynomial2D, Scale, Shift, Sine1D
from gwcs import WCS as GWCS

from wpdc_gwcs.exceptions import FileFormatError
from wpdc_gwcs.io.asdf import read_entry, write_tree
from wpdc_gwcs.io.files import READ_ERRORS, first_line
from wpdc_gwcs.io.integrity import check_version
from wpdc_gwcs.simulation import Distortion, FrameTruth
from wpdc_gwcs.simulation.pointing import tan_wcs
from wpdc_gwcs.wcs import build_wcs, stock_polynomial, to_stock_wcs

__all__ = ["read_truths", "true_wcs", "write_truths"]

_FORMAT_VERSION = "1.0.0"


def true_wcs(truth, *, first_step=None):
    """Build the true WCS of a frame from stock models.

    Parameters
    ----------
    truth : FrameTruth
        The truth about the frame.
    first_step : `~astropy.modeling.Model`, optional
        Model of the distortion of its detector, if it has already been built.

    Returns
    -------
    `gwcs.WCS`
        WCS with the frames ``detector``, ``undistorted`` and ``icrs``, exact to rounding (1e-8 px).
    """
    linear = truth.linear_wcs.wcs
    stock = to_stock_wcs(build_wcs(crpix=linear.crpix - 1, cd=linear.cd, crval=linear.crval))
    detector, undistorted, sky = stock.pipeline
    first_step = _stock_distortion(truth.distortion) if first_step is None else first_step
    wcs = GWCS(
        [
            (detector.frame, first_step),
            (undistorted.frame, undistorted.transform),
            (sky.frame, None),
        ]
    )
    ny, nx = truth.image_shape
    wcs.pixel_shape = (nx, ny)
    wcs.bounding_box = ((-0.5, nx - 0.5), (-0.5, ny - 0.5))
    return wcs


def _stock_distortion(distortion):
    c = distortion.coefficients
    size = len(c)
    # z^m conj(z)^n in powers of the real and of the imaginary part of z.
    real, imaginary = np.zeros((2, size, size))
    for m, n in np.argwhere(c):
        first = [comb(m, j) * 1j**j for j in range(m + 1)]
        second = [comb(n, j) * (-1j) ** j for j in range(n + 1)]
        product = np.convolve(first, second) * c[m, n]
        k = np.arange(m + n + 1)
        real[m + n - k, k] += product.real
        imaginary[m + n - k, k] += product.imag
    real[1, 0] += 1
    imaginary[0, 1] += 1
    axes = [stock_polynomial(real), stock_polynomial(imaginary)]
    for kappa, phase, amplitude in distortion.waves:
        angle = Polynomial2D(1, c0_0=phase, c1_0=kappa.real, c0_1=kappa.imag)
        for axis, size_of in enumerate((amplitude.real, amplitude.imag)):
            axes[axis] = axes[axis] + (angle | Sine1D(size_of, 1 / (2 * np.pi), 0.0))
    x0, y0 = distortion.center
    half = max(distortion.image_shape) / 2
    return (
        Shift(-x0) & Shift(-y0)
        | Scale(1 / half) & Scale(1 / half)
        | Mapping((0, 1, 0, 1))
        | axes[0] & axes[1]
        | Scale(half) & Scale(half)
        | Shift(x0) & Shift(y0)
    )


def write_truths(truths, path, *, camera, catalog, files, overwrite=False):
    """Write the truth about frames.

    Parameters
    ----------
    truths : sequence of FrameTruth
        The frames.
    path : path-like
        File to write.
    camera : str
        Name of the camera.
    catalog : str
        File of the reference catalog.
    files : sequence of (str, str)
        File of each frame, and "list" or "image".
    overwrite : bool, optional
        Whether an existing file may be replaced.
    """
    from wpdc_gwcs import __version__

    # All frames of a detector share a model, so the file contains it once.
    distortions = {t.detector: t.distortion for t in truths}
    first_steps = {name: _stock_distortion(one) for name, one in distortions.items()}
    tree = {
        "format_version": _FORMAT_VERSION,
        "software": {"name": "wpdc_gwcs", "version": __version__},
        "camera": camera,
        "catalog": catalog,
        "detectors": {name: _plain_distortion(one) for name, one in distortions.items()},
        "frames": {
            t.name: {
                "detector": t.detector,
                "exposure": t.exposure,
                "epoch": t.epoch,
                "file": file,
                "measured": measured,
                "color": t.color,
                "crpix": t.linear_wcs.wcs.crpix.tolist(),
                "crval": t.linear_wcs.wcs.crval.tolist(),
                "cd": t.linear_wcs.wcs.cd.tolist(),
            }
            for t, (file, measured) in zip(truths, files, strict=True)
        },
    }
    wcs = {t.name: {"wcs": true_wcs(t, first_step=first_steps[t.detector])} for t in truths}
    write_tree({"frames": wcs, "truth": tree}, path, overwrite)


def read_truths(path):
    """Read the truth about frames.

    Parameters
    ----------
    path : path-like
        File that was written by `write_truths`.

    Returns
    -------
    tree : dict
        Content of ``truth`` in the file.
    truths : dict
        `~wpdc_gwcs.simulation.FrameTruth` of each frame, by name.

    Raises
    ------
    FileFormatError
        If the file is missing, damaged, of a newer format version or not of this kind.
    """
    if not Path(path).is_file():
        raise FileFormatError(f"{path}: no such file: the truth of a simulation is expected there")
    tree = read_entry(path, "truth")
    if not isinstance(tree, dict):
        raise FileFormatError(f"{path}: must have a 'truth' tree, has none")
    check_version(tree.get("format_version"), path)
    try:
        distortions = {name: _distortion_of(node) for name, node in tree["detectors"].items()}
        truths = {
            name: FrameTruth(
                name,
                node["detector"],
                float(node["epoch"]),
                node["exposure"],
                distortions[node["detector"]],
                tan_wcs(
                    node["crpix"],
                    node["crval"],
                    node["cd"],
                    distortions[node["detector"]].image_shape,
                ),
                color=node["color"],
            )
            for name, node in tree["frames"].items()
        }
    except (AttributeError, TypeError, KeyError, *READ_ERRORS) as problem:
        raise FileFormatError(f"{path}: damaged 'truth' tree: {first_line(problem)}") from problem
    return tree, truths


def _pair(z):
    return [float(z.real), float(z.imag)]


def _plain_distortion(d):
    return {
        "image_shape": list(d.image_shape),
        "axis": _pair(d.axis),
        "radial": [float(k) for k in d.radial],
        "terms": [[m, n, *_pair(c)] for (m, n), c in d.terms.items()],
        "waves": [[*_pair(kappa), float(phase), *_pair(a)] for kappa, phase, a in d.waves],
    }


def _distortion_of(node):
    return Distortion(
        tuple(node["image_shape"]),
        complex(*node["axis"]),
        tuple(node["radial"]),
        {(m, n): complex(a, b) for m, n, a, b in node["terms"]},
        tuple((complex(a, b), phase, complex(c, d)) for a, b, phase, c, d in node["waves"]),
    )
