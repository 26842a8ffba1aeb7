"""BASS: four chips about a reference point between them, Gaia's epoch to 2017.33, figure 10.

::

    simulate --10 exposures of 4 chips--> calibrate --> pool_residuals, plot_sky_offsets
        literal: a weighted cubic of each exposure, no table
        ours: the default, and its cubic alone
"""

from astropy.coordinates import SkyCoord

from wpdc_gwcs.calibration import Settings, calibrate
from wpdc_gwcs.evaluation import pool_residuals
from wpdc_gwcs.plotting import plot_sky_offsets
from wpdc_gwcs.reproduction.results import tabulate_results
from wpdc_gwcs.reproduction.scoring import score_run, sky_error
from wpdc_gwcs.simulation import simulate

__all__ = ["reproduce_bass"]

# Where the paper's exposures point.
_CENTER = SkyCoord(278.8, 40.0, unit="deg")
# What the paper has is a cubic alone, about the matched source nearest to the center.
_RUNS = {
    "literal": {"method": "paper", "lut": "none"},
    "cubic": {"lut": "none"},
    "ours": {},
}
_MOMENTS = ("mean_alpha", "sigma_alpha", "mean_delta", "sigma_delta")


def reproduce_bass(folder, scale, *, seed=1, jobs=1, progress=None):
    """Reproduce the paper's results for BASS, with distortions of its kind.

    Parameters
    ----------
    folder : Path
        Where figures go; it must exist.
    scale : Scale
        How large it is.
    seed : int, optional
        Of the camera and of the field.
    jobs : int, optional
        Processes in which frames are matched.
    progress : callable, optional
        Called as ``progress("bass", done, total)``.

    Returns
    -------
    `~astropy.table.QTable`
        See `~wpdc_gwcs.reproduction.results.tabulate_results`.  Items are "all", the default
        against the literal cubic, and "cubic", where both have no table; ``wcs_alpha`` and
        ``wcs_delta`` are the error of the WCS itself, without the noise of centroids.

    Notes
    -----
    Writes ``sky-offsets-literal.png``, ``sky-offsets-cubic.png`` and ``sky-offsets-ours.png``.
    """
    options = {"density": 3.0, **scale.bass}
    simulation = simulate(scale.n_bass, camera="bass-90prime", center=_CENTER, seed=seed, **options)
    numbers = {}
    for done, (name, choices) in enumerate(_RUNS.items()):
        run = calibrate(
            [exposure.frame() for exposure in simulation.exposures],
            simulation.reference,
            settings=Settings(r0=scale.r0_bass, reference_point="nearest-source", **choices),
            jobs=jobs,
        )
        pooled = pool_residuals(run.calibrations)[-1]
        wcs = sky_error(run, score_run(simulation, run))
        numbers[name] = {
            **{(moment, "mas"): getattr(pooled, moment) for moment in _MOMENTS},
            ("wcs_alpha", "mas"): wcs[0],
            ("wcs_delta", "mas"): wcs[1],
            ("n_stars", ""): pooled.statistics.n,
        }
        axes = plot_sky_offsets([c.matches for c in run.calibrations], title=name)
        axes[0].figure.savefig(folder / f"sky-offsets-{name}.png", dpi=110)
        if progress is not None:
            progress("bass", done + 1, len(_RUNS))
    found = {
        (item, *key): (numbers["literal"][key], numbers[name][key])
        for item, name in (("all", "ours"), ("cubic", "cubic"))
        for key in numbers["literal"]
    }
    return tabulate_results("bass", found)
