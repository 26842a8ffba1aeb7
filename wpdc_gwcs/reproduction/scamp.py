"""SCAMP for comparison, if it is installed: the same lists and the same catalog.

::

    Simulation --FITS_LDAC--> scamp --.head--> TPV WCS of each exposure
"""

import shutil
import subprocess
import tempfile
from pathlib import Path

import numpy as np
from astropy.io import fits
from astropy.table import Table

from wpdc_gwcs.catalogs import propagate, read_catalog
from wpdc_gwcs.exceptions import WPDCError
from wpdc_gwcs.io import write_simulation
from wpdc_gwcs.io.headers import read_headers
from wpdc_gwcs.io.ldac import write_ldac
from wpdc_gwcs.io.tan import parse_tan

__all__ = ["has_scamp", "solve_with_scamp"]

_PROGRAM = "scamp"
# Errors assumed for a catalog without errors, mas: SCAMP weights stars by them.
_LEAST_ERROR = 0.1
_MAS = 1 / 3.6e6  # deg
# Plots, servers and photometry are switched off.  Headers are accurate to arcseconds, and
# distortions reach 18 arcsec.
_OPTIONS = {
    "ASTREF_CATALOG": "FILE",
    "ASTREFCENT_KEYS": "X_WORLD,Y_WORLD",
    "ASTREFERR_KEYS": "ERRA_WORLD,ERRB_WORLD,ERRTHETA_WORLD",
    "ASTREFMAG_KEY": "MAG",
    # A polynomial for each detector, over all exposures.
    "STABILITY_TYPE": "INSTRUMENT",
    "ASTRINSTRU_KEY": "DETECTOR",
    "CROSSID_RADIUS": "15",
    "POSITION_MAXERR": "1",
    "POSANGLE_MAXERR": "1",
    "SN_THRESHOLDS": "10,100",
    "FWHM_THRESHOLDS": "0,100",
    "SOLVE_PHOTOM": "N",
    "CHECKPLOT_TYPE": "NONE",
    "WRITE_XML": "N",
    "VERBOSE_TYPE": "QUIET",
}


def has_scamp():
    """Return whether SCAMP is installed.

    Returns
    -------
    bool
        True if its program is found.
    """
    return shutil.which(_PROGRAM) is not None


def solve_with_scamp(simulation, *, degree, threads=1):
    """Solve the exposures of a simulation with SCAMP.

    Parameters
    ----------
    simulation : Simulation
        Exposures of one epoch, with source lists.
    degree : int
        Degree of the polynomial that all exposures of a detector share.
    threads : int, optional
        Maximum number of threads.

    Returns
    -------
    dict
        The `astropy.wcs.WCS` of each exposure, by name.

    Raises
    ------
    WPDCError
        If SCAMP is not installed or finds no solution.
    """
    if not has_scamp():
        raise WPDCError(f"{_PROGRAM} must be installed, is not")
    names = [exposure.name for exposure in simulation.exposures]
    with tempfile.TemporaryDirectory() as folder:
        folder = Path(folder)
        write_simulation(simulation, folder, images=(), sources="ldac")
        _write_reference(simulation, folder / "stars.ldac")
        options = {
            **_OPTIONS,
            "ASTREFCAT_NAME": "stars.ldac",
            "DISTORT_DEGREES": str(degree),
            "NTHREADS": str(threads),
        }
        done = subprocess.run(
            [
                _PROGRAM, *(f"{name}.ldac" for name in names), "-c", "/dev/null",
                *(word for key, value in options.items() for word in (f"-{key}", value)),
            ],
            cwd=folder, capture_output=True, text=True, errors="replace", check=False,
        )  # fmt: skip
        if not all((folder / f"{name}.head").exists() for name in names):
            said = (done.stderr.strip().splitlines() or ["nothing"])[-1]
            raise WPDCError(f"{_PROGRAM} must give a header for each list, gave: {said}")
        return {
            name: parse_tan(read_headers(folder / f"{name}.head")[0]).to_wcs() for name in names
        }


def _write_reference(simulation, path):
    """Write the catalog at the epoch of the exposures: SCAMP reads no motions from files."""
    epoch = simulation.exposures[0].epoch
    catalog = propagate(read_catalog(simulation.reference), epoch)
    columns = {"X_WORLD": catalog["ra"], "Y_WORLD": catalog["dec"]}
    for axis, name in (("A", "ra_error"), ("B", "dec_error")):
        error = catalog[name] if name in catalog.colnames else np.zeros(len(catalog))
        columns[f"ERR{axis}_WORLD"] = np.maximum(np.asarray(error, float), _LEAST_ERROR) * _MAS
    columns["ERRTHETA_WORLD"] = np.zeros(len(catalog))
    columns["MAG"] = catalog["phot_g_mean_mag"]
    columns["OBSDATE"] = np.full(len(catalog), epoch)
    table = Table({name: np.asarray(values, float) for name, values in columns.items()})
    write_ldac(table, fits.Header(), path)
