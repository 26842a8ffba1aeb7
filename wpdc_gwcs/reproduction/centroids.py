"""Centroid residuals on rendered images against magnitude, with the photon limit: figure 2.

::

    simulate --images--> measure_sources --nearest true star--> residuals, in bins of 0.5 mag
"""

import numpy as np
from astropy.table import Table
from scipy.spatial import cKDTree

from wpdc_gwcs.calibration import measure_sources
from wpdc_gwcs.evaluation import evaluate
from wpdc_gwcs.plotting import plot_centroids
from wpdc_gwcs.reproduction.results import tabulate_results
from wpdc_gwcs.reproduction.scale import SEED
from wpdc_gwcs.simulation import simulate

__all__ = ["measure_against_truth", "photon_limit", "reproduce_centroids"]

_DETECTOR = "g-1"
# Faintest magnitude; the stars of the paper reach beyond 25 mag.
_MAGNITUDES = (17.0, 25.5)
# Magnitudes for which the paper gives numbers.
_BINS = {"g < 20": (-np.inf, 20.0), "g = 25": (24.75, 25.25)}
# A source is identified with a star within the first distance, px, if no other star is within the
# second distance, where its light would shift the centroid.
_NEAR_PX, _ALONE_PX = 1.0, 12.0


def measure_against_truth(exposure):
    """Measure the stars of a rendered image and compare them with the truth.

    Parameters
    ----------
    exposure : SimulatedExposure
        The exposure; its image is rendered.

    Returns
    -------
    `~astropy.table.Table`
        One row for each clean source that is an isolated star: ``x``, ``y``, ``dx``, ``dy``
        (measured minus true), ``x_err``, ``y_err`` in px, ``snr`` and ``magnitude``.
    """
    sources = measure_sources(exposure.frame(image=True))
    sources = sources[np.asarray(sources["flags"]) == 0]
    stars = exposure.observe()[1]
    x, y = (np.asarray(sources[name], float) for name in ("x", "y"))
    tree = cKDTree(np.column_stack([stars["x"], stars["y"]]))
    distance, star = tree.query(np.column_stack([x, y]))
    apart = tree.query(tree.data, k=2)[0][:, 1]
    chosen = np.flatnonzero((distance < _NEAR_PX) & (apart[star] > _ALONE_PX))
    true = stars[star[chosen]]
    found = Table({name: np.asarray(sources[name], float)[chosen] for name in ("x_err", "y_err")})
    found["x"], found["y"] = true["x"], true["y"]
    found["dx"], found["dy"] = x[chosen] - true["x"], y[chosen] - true["y"]
    found["magnitude"] = true["magnitude"]
    return found


def reproduce_centroids(folder, scale, *, seed=SEED, jobs=1, progress=None):
    """Reproduce the paper's centroid residuals against magnitude.

    Parameters
    ----------
    folder : Path
        Existing folder for the figures.
    scale : Scale
        Size of the reproduction.
    seed : int, optional
        Seed of the camera and of the field.
    jobs : int, optional
        Not used: images are measured one by one.
    progress : callable, optional
        Called as ``progress("centroids", done, total)``.

    Returns
    -------
    `~astropy.table.QTable`
        See `~wpdc_gwcs.reproduction.results.tabulate_results`.  The literal method uses PSF fits
        too, so it has no numbers of its own.

    Notes
    -----
    Writes ``centroids.png``.

    Examples
    --------
    >>> from wpdc_gwcs.reproduction import CLAIMS
    >>> [(c.item, c.value) for c in CLAIMS if c.part == "centroids" and c.quantity == "sigma_dx"]
    [('g < 20', 0.02), ('g = 25', 0.07)]
    """
    options = {"density": 60.0, "galaxies": 10.0, **scale.images}
    simulation = simulate(
        scale.n_images,
        camera="csst-msc",
        detectors=[_DETECTOR],
        seed=seed,
        magnitudes=_MAGNITUDES,
        **options,
    )
    tables = []
    for done, exposure in enumerate(simulation.exposures):
        tables.append(measure_against_truth(exposure))
        if progress is not None:
            progress("centroids", done + 1, len(simulation.exposures))
    dx, dy, magnitude = (
        np.concatenate([np.asarray(t[name]) for t in tables]) for name in ("dx", "dy", "magnitude")
    )
    camera, (detector,) = simulation.camera, simulation.camera.detectors
    bright = np.linspace(magnitude.min(), magnitude.max(), 100)
    limit = photon_limit(camera, detector, bright)
    axes = plot_centroids(tables, limit=(bright, limit))
    axes[0].figure.savefig(folder / "centroids.png", dpi=110)
    found = {}
    for item, (low, high) in _BINS.items():
        inside = (magnitude > low) & (magnitude < high)
        s = evaluate(dx[inside], dy[inside])
        at = magnitude[inside]
        numbers = {
            ("mean_dx", "pix"): s.mean_dx,
            ("sigma_dx", "pix"): s.sigma_dx,
            ("mean_dy", "pix"): s.mean_dy,
            ("sigma_dy", "pix"): s.sigma_dy,
            ("photon_limit", "pix"): np.median(photon_limit(camera, detector, at)),
            ("n_stars", ""): s.n,
        }
        found |= {(item, *key): (np.nan, number) for key, number in numbers.items()}
    return tabulate_results("centroids", found)


def photon_limit(camera, detector, magnitude):
    """Return the centroid error due to photons, sky and read noise.

    Parameters
    ----------
    camera : SimulatedCamera
        The camera.
    detector : SimulatedDetector
        The detector.
    magnitude : (N,) ndarray
        Magnitudes of stars.

    Returns
    -------
    (N,) ndarray
        Errors along one axis, px: the Cramer-Rao bound of the mean pixelated PSF, for a star at
        the center of a pixel.
    """
    _, _, profile, slope = camera.psf_stamp()
    flux = camera.flux(magnitude, detector)[:, None]
    variance = flux * profile + camera.background + camera.read_noise**2
    return 1 / np.sqrt(np.sum((flux * slope) ** 2 / variance, axis=1))
