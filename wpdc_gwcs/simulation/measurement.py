"""Simulated source lists with known errors."""

from dataclasses import dataclass

import numpy as np
from astropy.table import Table
from scipy.spatial import cKDTree

from wpdc_gwcs.detector import on_detector
from wpdc_gwcs.simulation.light import SIGMA_PER_FWHM

__all__ = ["Measurement"]

# Minimum signal-to-noise ratio of source lists.
_LEAST_SNR = 5.0
# Scatter of the roundness of stars, of spurious sources and of galaxies.
_ROUNDNESS = (0.05, 0.12, 0.5)


@dataclass(frozen=True)
class Measurement:
    """Properties of source lists.

    Parameters
    ----------
    spurious, lost : float
        Spurious sources, and undetected stars, as fractions of the stars on the detector.
    noise : bool
        Whether positions scatter by their errors.
    galaxies : float
        Galaxies per square arcmin.
    slope : float
        Slope of the luminosity function, d log10 N / d mag.
    resolution : float
        The list has only the brighter one of two sources closer than this, in FWHM.
    """

    spurious: float
    lost: float
    noise: bool
    galaxies: float
    slope: float
    resolution: float

    def measure(self, rng, extra, stars, camera, detector):
        """Measure the stars on a detector.

        Parameters
        ----------
        rng, extra : `numpy.random.Generator`
            Random number generators; the second one is for galaxies.
        stars : `~astropy.table.Table`
            Columns ``x``, ``y``, ``magnitude``, ``reference_index``.
        camera : SimulatedCamera
            The camera.
        detector : SimulatedDetector
            The detector.

        Returns
        -------
        sources : `~astropy.table.Table`
            Columns ``x``, ``y``, ``x_err``, ``y_err``, ``flux``, ``snr``, ``roundness``,
            ``reference_index``.
        source_index : (N,) ndarray of int
            Row of each star in the sources, -1 if it was not detected.
        """
        ny, nx = detector.image_shape
        x, y, magnitude = stars["x"].data, stars["y"].data, stars["magnitude"].data
        light = camera.flux(magnitude, detector)
        seen = on_detector(x, y, (ny, nx))
        seen &= rng.uniform(size=len(stars)) >= self.lost
        seen &= camera.peak(light) < camera.saturation
        seen &= camera.snr(light) > _LEAST_SNR
        rows = np.flatnonzero(seen)
        n = len(rows)
        m = rng.poisson(self.spurious * n)
        faint = magnitude[rows].max(initial=0.0)
        spurious = faint - rng.exponential(1 / (self.slope * 3), m)
        flux = camera.flux(np.append(magnitude[rows], spurious), detector)
        snr = camera.snr(flux)
        # The photon limit of a Gaussian image, plus the floor of bright stars.
        sigma = np.hypot(camera.centroid_floor, camera.fwhm * SIGMA_PER_FWHM / snr)
        error = rng.normal(size=(2, n + m)) * sigma * self.noise
        error[:, n:] = 0.0
        order = rng.permutation(n + m)
        columns = {
            "x": np.append(x[rows], rng.uniform(-0.5, nx - 0.5, m)) + error[0],
            "y": np.append(y[rows], rng.uniform(-0.5, ny - 0.5, m)) + error[1],
            "x_err": sigma,
            "y_err": sigma,
            "flux": flux / camera.gain,
            "snr": snr,
            "roundness": rng.normal(0, np.repeat(_ROUNDNESS[:2], (n, m))),
            "reference_index": np.append(stars["reference_index"].data[rows], np.full(m, -1)),
        }
        area = nx * ny * (camera.arcsec / 60) ** 2
        if n_galaxies := extra.poisson(self.galaxies * area):
            own = self._galaxies(extra, n_galaxies, faint, camera, detector)
            columns = {k: np.append(v, own[k]) for k, v in columns.items()}
            order = extra.permutation(len(columns["x"]))
        apart = self.resolution * camera.fwhm
        order = order[~_outshone(columns["x"], columns["y"], columns["flux"], apart)[order]]
        source_index = np.full(len(stars), -1)
        place = np.full(len(columns["x"]), -1)
        place[order] = np.arange(len(order))
        source_index[rows] = place[:n]
        return Table({k: v[order] for k, v in columns.items()}), source_index

    def _galaxies(self, rng, n, faint, camera, detector):
        ny, nx = detector.image_shape
        flux = camera.flux(faint - rng.exponential(1 / (self.slope * 3), n), detector)
        snr = camera.snr(flux)
        # Twice as wide as stars, with twice their errors.
        sigma = np.hypot(camera.centroid_floor, 2 * camera.fwhm * SIGMA_PER_FWHM / snr)
        return {
            "x": rng.uniform(-0.5, nx - 0.5, n),
            "y": rng.uniform(-0.5, ny - 0.5, n),
            "x_err": sigma,
            "y_err": sigma,
            "flux": flux / camera.gain,
            "snr": snr,
            "roundness": rng.normal(0, _ROUNDNESS[2], n),
            "reference_index": np.full(n, -1),
        }


def _outshone(x, y, flux, distance):
    """Mark sources that are blended with a brighter one."""
    hidden = np.zeros(len(x), bool)
    if distance > 0 and len(x):
        pairs = cKDTree(np.column_stack([x, y])).query_pairs(distance, output_type="ndarray")
        first, second = pairs.T
        hidden[np.where(flux[first] < flux[second], first, second)] = True
    return hidden
