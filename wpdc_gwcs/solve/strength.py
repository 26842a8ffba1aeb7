"""Typical strength of fields, stored with a solution as a prior for later exposures."""

import numpy as np

__all__ = ["FieldPrior", "log_strength", "summarize_fields"]

# Assumed scatter of the logarithm of the strength of fields, and the number of exposures that this
# guess is worth; least strength in units of the errors of stars.
_LOG_STRENGTH, _GUESS_WEIGHT = 1.0, 0.5
_LEAST_STRENGTH = 0.1

# Amplitude of turbulence that bends a detector as much as polynomials with unit coefficients, in
# which a part of it may have been absorbed.
_AMPLITUDE_OF_BEND = 1.7

# Scatter of the logarithms of an outer scale, and of a strength that no solution determines.
_LOG_SCALE, _LOG_UNKNOWN = 0.7, 1.5


class FieldPrior:
    """Prior of the strength of the field of an exposure.

    Parameters
    ----------
    known : dict or None
        Summary of the stored solution, see `summarize_fields`.
    errors : float
        Typical error of a star, px.
    scales : (2,) ndarray
        Logarithms of the smallest and the largest outer scale, px.
    wavelength : float
        Wavelength of the strength, px, see `log_strength`.
    """

    def __init__(self, known, errors, scales, wavelength):
        self.wavelength = wavelength
        self.known = bool(known)
        self.scale = 0.5 * scales.sum()
        level = np.log(0.5 * errors)
        self.scatter = _LOG_UNKNOWN
        if known:
            if known["amplitude"] > 0:
                self.scale = float(np.clip(np.log(known["scale"]), *scales))
            level = np.log(max(known["amplitude"], _LEAST_STRENGTH * errors))
            self.scatter = known["scatter"]
        self.strength = level + log_strength(0.0, self.scale, wavelength)

    def penalty(self, amplitude, scale):
        """Return minus the log prior.

        Parameters
        ----------
        amplitude, scale : float
            Logarithms of amplitude and outer scale, px.
        """
        strength = log_strength(amplitude, scale, self.wavelength) - self.strength
        return 0.5 * (strength / self.scatter) ** 2 + 0.5 * ((scale - self.scale) / _LOG_SCALE) ** 2


def log_strength(amplitude, scale, wavelength):
    """Return the log strength of a field at a wavelength, from log amplitude and log scale.

    This is half the log power.  At half the side of a detector it is well determined, unlike
    amplitude and outer scale, which is mostly larger than the detector.

    Parameters
    ----------
    amplitude, scale : float
        Logarithms of amplitude and outer scale, px.
    wavelength : float
        Px.
    """
    return amplitude + scale - 11 / 12 * np.log1p((np.exp(scale) / wavelength) ** 2)


def _log_amplitude(spectrum):
    return np.log(np.hypot(spectrum.amplitude, _AMPLITUDE_OF_BEND * spectrum.bend))


def summarize_fields(spectra, image_shape, previous=None):
    """Summarize the fields of exposures, for later updates.

    Parameters
    ----------
    spectra : sequence of Spectrum or None
        Spectra of the exposures; `None` for none.
    image_shape : (int, int)
        Shape of the detector.
    previous : dict, optional
        Summary of the stored solution.

    Returns
    -------
    dict
        ``n`` exposures, ``amplitude`` (px) and ``scale`` (px) of the typical field, and
        ``scatter`` of the logarithm of the strength; amplitude 0 without fields.
    """
    found = [s for s in spectra if s is not None]
    n, guess = len(spectra), _GUESS_WEIGHT * _LOG_STRENGTH**2
    if not found:
        scatter = np.sqrt(guess / max(n - 1 + _GUESS_WEIGHT, 1))
        own = {"n": n, "amplitude": 0.0, "scale": 1.0, "scatter": float(scatter)}
    else:
        scale = np.mean([np.log(s.scale) for s in found])
        wavelength = 0.5 * max(image_shape)
        strengths = np.array(
            [log_strength(_log_amplitude(s), np.log(s.scale), wavelength) for s in found]
        )
        square = guess + np.sum((strengths - strengths.mean()) ** 2)
        own = {
            "n": n,
            "amplitude": float(np.exp(strengths.mean() - log_strength(0.0, scale, wavelength))),
            "scale": float(np.exp(scale)),
            "scatter": float(np.sqrt(square / max(len(found) - 1 + _GUESS_WEIGHT, 1))),
        }
    if not previous or (previous["amplitude"] == 0) != (own["amplitude"] == 0):
        return own if not previous or own["n"] >= previous["n"] else previous
    total = own["n"] + previous["n"]
    share = own["n"] / total
    merged = {k: float(share * own[k] + (1 - share) * previous[k]) for k in ("scale", "scatter")}
    amplitude = share * own["amplitude"] + (1 - share) * previous["amplitude"]
    return {"n": total, "amplitude": float(amplitude), **merged}
