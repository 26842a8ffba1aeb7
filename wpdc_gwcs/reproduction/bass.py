"""BASS: four chips around a common reference point, at epoch 2017.33; figure 10.

::

    simulate --10 exposures of 4 chips----> calibrate --> pool_residuals, plot_sky_offsets
    real headers --the same for one chip-->     literal: a weighted cubic per exposure, no table
                                                ours: the default, and its cubic alone
                                            scamp: if it is installed
"""

import warnings

import numpy as np
from astropy.coordinates import SkyCoord

from wpdc_gwcs.calibration import Settings, calibrate
from wpdc_gwcs.evaluation import evaluate, pool_residuals
from wpdc_gwcs.exceptions import WPDCError, WPDCWarning
from wpdc_gwcs.plotting import plot_sky_offsets
from wpdc_gwcs.reproduction.headers import find_headers, header_camera
from wpdc_gwcs.reproduction.results import tabulate_results
from wpdc_gwcs.reproduction.scale import SEED
from wpdc_gwcs.reproduction.scamp import has_scamp, solve_with_scamp
from wpdc_gwcs.reproduction.scoring import sky_error
from wpdc_gwcs.simulation import simulate

__all__ = ["reproduce_bass"]

# Pointing of the paper's exposures.
_CENTER = SkyCoord(278.8, 40.0, unit="deg")
# Stars per square arcmin: about as many per chip as in the paper (49,158 on 40 images).
_DENSITY = 1.5
# The paper uses a cubic alone, about the matched source nearest to the center.
_RUNS = {
    "literal": {"method": "paper", "lut": "none"},
    "cubic": {"lut": "none"},
    "ours": {},
}
# Radius within which all stars of a real chip have the same weight, px (section 4.2).
_R0 = 2000.0
_MOMENTS = ("mean_alpha", "sigma_alpha", "mean_delta", "sigma_delta")
_SCAMP = "scamp"
# Degree of the SCAMP polynomials of BASS (section 1 of the paper).
_SCAMP_DEGREE = 4
_MAS = 3.6e6  # per deg


def reproduce_bass(folder, scale, *, seed=SEED, jobs=1, progress=None):
    """Reproduce the paper's results for BASS.

    Parameters
    ----------
    folder : Path
        Existing folder for the figures.
    scale : Scale
        Size of the reproduction.
    seed : int, optional
        Seed of the camera and of the field.
    jobs : int, optional
        Number of processes that match frames.
    progress : callable, optional
        Called as ``progress("bass", done, total)``.

    Returns
    -------
    `~astropy.table.QTable`
        See `~wpdc_gwcs.reproduction.results.tabulate_results`.  The items are: "all", the default
        compared with the literal cubic, and "cubic", both without a table, for four chips with
        different distortions; "scamp", where ``ours`` is the result of SCAMP, if it is installed;
        and "HEADER" and "HEADER cubic" for each real header of 90Prime, if there are any.
        ``wcs_alpha`` and ``wcs_delta`` are the errors of the WCS itself, without centroid noise.

    Notes
    -----
    Headers are searched in the folder given by the environment variable ``WPDC_GWCS_DATA``.
    Writes ``sky-offsets-literal.png``, ``sky-offsets-cubic.png``, ``sky-offsets-ours.png`` and,
    if SCAMP is installed, ``sky-offsets-scamp.png``.

    Examples
    --------
    >>> from wpdc_gwcs.reproduction import CLAIMS
    >>> [(c.item, c.quantity, c.value) for c in CLAIMS if c.part == "bass"][:2]
    [('all', 'mean_alpha', -0.016), ('all', 'sigma_alpha', 5.494)]
    """
    headers = find_headers()[: scale.n_headers]
    steps = 1 + len(headers)
    options = {"center": _CENTER, "seed": seed, "density": _DENSITY, **scale.bass}
    simulation = simulate(scale.n_bass, camera="bass-90prime", **options)
    runs = _calibrate(simulation, scale.r0_bass, jobs)
    numbers = {name: _quantities(simulation, run) for name, run in runs.items()}
    tables = {name: [c.matches for c in run.calibrations] for name, run in runs.items()}
    found = _side_by_side(numbers, "all", "cubic")
    if scale.scamp and has_scamp():
        try:
            solved = solve_with_scamp(simulation, degree=_SCAMP_DEGREE, threads=jobs)
        except WPDCError as problem:
            warnings.warn(f"SCAMP is left out: {problem}", WPDCWarning, stacklevel=2)
        else:
            tables[_SCAMP], values = _hold_against(solved, simulation, runs["ours"])
            found |= {(_SCAMP, *key): (np.nan, value) for key, value in values.items()}
    limit = 5 * max(numbers["literal"][f"sigma_{axis}", "mas"] for axis in ("alpha", "delta"))
    for name, matches in tables.items():
        axes = plot_sky_offsets(matches, title=name, limit=None if name == _SCAMP else limit)
        axes[0].figure.savefig(folder / f"sky-offsets-{name}.png", dpi=110)
    if progress is not None:
        progress("bass", 1, steps)
    for done, path in enumerate(headers):
        camera, degree = header_camera(path)
        simulation = simulate(
            scale.n_bass, camera=camera, center=_CENTER, seed=seed, density=_DENSITY
        )
        runs = _calibrate(simulation, _R0, jobs)
        numbers = {name: _quantities(simulation, run) for name, run in runs.items()}
        found |= _side_by_side(numbers, path.stem, f"{path.stem} cubic")
        found[path.stem, "degree", ""] = (degree, degree)
        if progress is not None:
            progress("bass", done + 2, steps)
    return tabulate_results("bass", found)


def _calibrate(simulation, r0, jobs):
    frames = [exposure.frame() for exposure in simulation.exposures]
    return {
        name: calibrate(
            frames,
            simulation.reference,
            settings=Settings(r0=r0, reference_point="nearest-source", **choices),
            jobs=jobs,
        )
        for name, choices in _RUNS.items()
    }


def _quantities(simulation, run):
    pooled = pool_residuals(run.calibrations)[-1]
    truths = {exposure.name: exposure for exposure in simulation.exposures}
    alpha, delta = sky_error([(truths[c.frame], c.wcs) for c in run.calibrations])
    return {
        **{(moment, "mas"): getattr(pooled, moment) for moment in _MOMENTS},
        ("wcs_alpha", "mas"): alpha,
        ("wcs_delta", "mas"): delta,
        ("n_stars", ""): pooled.statistics.n,
    }


def _side_by_side(numbers, full, cubic):
    return {
        (item, *key): (numbers["literal"][key], numbers[name][key])
        for item, name in ((full, "ours"), (cubic, "cubic"))
        for key in numbers["literal"]
    }


def _hold_against(solved, simulation, run):
    """Residuals of our pairs in the WCSs of SCAMP, and their statistics."""
    found, offsets = [], []
    for c in run.calibrations:
        table = c.matches.copy()
        ra, dec = solved[c.frame].wcs_pix2world(table["x"], table["y"], 0)
        table["source_ra"], table["source_dec"] = ra, dec
        m = table[np.asarray(table["used"], bool)]
        d_ra = (m["source_ra"] - m["ra"] + 180) % 360 - 180
        offsets.append([d_ra * np.cos(np.deg2rad(m["dec"])), m["source_dec"] - m["dec"]])
        found.append(table)
    alpha, delta = np.concatenate(offsets, axis=1) * _MAS
    s = evaluate(alpha, delta)
    wcs = sky_error([(exposure, solved[exposure.name]) for exposure in simulation.exposures])
    values = (s.mean_dx, s.sigma_dx, s.mean_dy, s.sigma_dy)
    return found, {
        **{(name, "mas"): value for name, value in zip(_MOMENTS, values, strict=True)},
        ("wcs_alpha", "mas"): wcs[0],
        ("wcs_delta", "mas"): wcs[1],
        ("n_stars", ""): s.n,
    }
