"""A globular cluster like NGC 2298, without its core: figures 8 and 9.

::

    simulate --images of a King cluster--> calibrate --> sources, S/N > 30 --> calibrate, both
        methods --> residuals of 500 < r_d < 4000 px
"""

from dataclasses import replace

import astropy.units as u
import numpy as np
from astropy.coordinates import SkyCoord

from wpdc_gwcs.calibration import Settings, calibrate
from wpdc_gwcs.evaluation import Cuts, evaluate, pool_residuals, pool_scores
from wpdc_gwcs.plotting import plot_magnitude, plot_residual_maps
from wpdc_gwcs.reproduction.centroids import photon_limit
from wpdc_gwcs.reproduction.detectors import METHODS
from wpdc_gwcs.reproduction.results import tabulate_results
from wpdc_gwcs.reproduction.scale import SEED
from wpdc_gwcs.reproduction.scoring import score_run
from wpdc_gwcs.simulation import KingCluster, simulate

__all__ = ["reproduce_cluster"]

_DETECTOR = "g-1"
_CENTER = SkyCoord(102.246, -36.005, unit="deg")
# More than 5,000 stars per square arcmin in the core, in addition to the field.
_DENSITY, _FIELD = 5500.0, 60.0
_MIN_SNR = 30.0
# Magnitudes at which the paper gives the scatter, and the width of the bins.
_MAGNITUDES, _WIDTH = (19.0, 23.75), 0.5


def reproduce_cluster(folder, scale, *, seed=SEED, jobs=1, progress=None):
    """Reproduce the paper's results for a globular cluster.

    Parameters
    ----------
    folder : Path
        Existing folder for the figures.
    scale : Scale
        Size of the reproduction.
    seed : int, optional
        Seed of the camera and of the field.
    jobs : int, optional
        Number of processes that measure and match frames.
    progress : callable, optional
        Called as ``progress("cluster", done, total)``.

    Returns
    -------
    `~astropy.table.QTable`
        See `~wpdc_gwcs.reproduction.results.tabulate_results`.  ``sigma_dx`` is after 3-sigma
        clipping, ``raw_sigma_dx`` before it; ``photon_limit`` and ``raw_photon_limit`` are the
        same two for centroids limited by photons, sky and read noise.

    Notes
    -----
    The core, within 500 px, is left out.  Writes ``residuals-literal.png``, ``residuals-ours.png``,
    and the same of ``magnitude``.

    Examples
    --------
    >>> from wpdc_gwcs.reproduction import CLAIMS
    >>> [(c.item, c.quantity, c.value) for c in CLAIMS if c.part == "cluster"][1:4:2]
    [('g-1', 'sigma_dx', 0.051), ('g-1', 'sigma_dy', 0.053)]
    """
    shrink = scale.r0 / 4000.0
    cluster = KingCluster(_DENSITY, 19 * shrink * u.arcsec, 480 * shrink * u.arcsec)
    options = {"density": _FIELD, **scale.images}
    simulation = simulate(
        scale.n_cluster,
        camera="csst-msc",
        detectors=[_DETECTOR],
        seed=seed,
        center=_CENTER,
        cluster=cluster,
        dither=10 * shrink * u.arcsec,
        **options,
    )
    measured = calibrate(
        [exposure.frame(image=True) for exposure in simulation.exposures],
        simulation.reference,
        settings=Settings(r0=scale.r0),
        jobs=jobs,
    )
    frames = {exposure.name: exposure.frame() for exposure in simulation.exposures}
    listed = [replace(frames[c.frame], load_sources=c.sources.copy) for c in measured.calibrations]
    cuts = Cuts(min_radius=500 * shrink, max_radius=4000 * shrink, min_snr=_MIN_SNR)
    numbers = {}
    for done, (name, method) in enumerate(METHODS.items()):
        settings = Settings(method=method, r0=scale.r0, min_snr=_MIN_SNR)
        run = calibrate(listed, simulation.reference, settings=settings, jobs=jobs)
        numbers[name] = _quantities(simulation, run, cuts)
        _draw(run, cuts, name, folder)
        if progress is not None:
            progress("cluster", done + 1, len(METHODS))
    found = {
        key: (numbers["literal"].get(key, np.nan), numbers["ours"][key]) for key in numbers["ours"]
    }
    return tabulate_results("cluster", found)


def _outside(calibration, cuts):
    m = calibration.matches
    return m[cuts.select(m, calibration.solution.crpix)]


def _quantities(simulation, run, cuts):
    pooled = pool_residuals(run.calibrations, cuts=cuts)[0]
    score = pool_scores(score_run(simulation, run, images=True))[0]
    moments = ("mean_dx", "sigma_dx", "mean_dy", "sigma_dy")
    found = {
        **{(_DETECTOR, name, "pix"): getattr(pooled.statistics, name) for name in moments},
        (_DETECTOR, "raw_sigma_dx", "pix"): float(np.std(pooled.dx)),
        (_DETECTOR, "raw_sigma_dy", "pix"): float(np.std(pooled.dy)),
        (_DETECTOR, "wcs_rms", "pix"): score.wcs_rms,
        (_DETECTOR, "n_stars", ""): pooled.statistics.n,
        (_DETECTOR, "n_wrong", ""): score.n_wrong_used,
    }
    tables = [_outside(c, cuts) for c in run.calibrations]
    tables = [t[np.asarray(t["used"], bool)] for t in tables]
    magnitude, dx, dy = (
        np.concatenate([np.asarray(t[name], float) for t in tables])
        for name in ("phot_g_mean_mag", "dx", "dy")
    )
    camera = simulation.camera
    limit = photon_limit(camera, camera.detectors[0], magnitude)
    # Clipping a sum of Gaussians has no closed form: simulated with a fixed seed.
    drawn = evaluate(*np.random.default_rng(0).normal(size=(2, limit.size)) * limit)
    found[_DETECTOR, "photon_limit", "pix"] = np.hypot(drawn.sigma_dx, drawn.sigma_dy) / np.sqrt(2)
    found[_DETECTOR, "raw_photon_limit", "pix"] = float(np.sqrt(np.mean(limit**2)))
    for middle in _MAGNITUDES:
        inside = np.abs(magnitude - middle) <= _WIDTH / 2
        s = evaluate(dx[inside], dy[inside])
        # Per axis, averaged over both.
        found[f"g = {middle:g}", "sigma_total", "pix"] = float(
            np.hypot(s.sigma_dx, s.sigma_dy) / np.sqrt(2)
        )
    return found


def _draw(run, cuts, name, folder):
    from astropy.table import vstack

    tables = [_outside(c, cuts) for c in run.calibrations]
    pooled = vstack(tables, metadata_conflicts="silent")
    shape = run.calibrations[0].solution.image_shape
    plot_residual_maps(pooled, image_shape=shape).savefig(folder / f"residuals-{name}.png", dpi=110)
    axes = plot_magnitude(tables)
    axes[0].figure.savefig(folder / f"magnitude-{name}.png", dpi=110)
