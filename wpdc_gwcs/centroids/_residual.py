"""Images without the models of their stars, strip by strip."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.spatial import KDTree

from wpdc_gwcs.centroids._fit import Stars
from wpdc_gwcs.centroids._profile import Profile
from wpdc_gwcs.cutouts import cut_squares
from wpdc_gwcs.threads import count_threads, map_threads

__all__ = ["Painter", "Residual", "Scene"]

# Number of pixels processed at a time, if stars are drawn, and if all pixels are used, which fit
# into the cache of a processor.
_STRIP, _CACHED = 3_000_000, 500_000
# Number of stars processed at a time.
_MANY = 10_000

# Half widths in px with which stars are drawn, up to that of the profile; faint stars are smaller.
_SIZES = (3, 5, 8, 12, 20)
# Light in the wings that may be left out, in standard deviations of the sky.
_FAINTEST = 0.1

# Light of neighbors that does not matter to a fit, in standard deviations of the sky, and relative
# to the light in the pixel.
_NEGLIGIBLE, _SHARE = 0.05, 0.01
# The same for a change of that light.
_SETTLED = 0.02

# Relative error of the PSF: smaller residuals are no sign of another star.
_MODEL_ERROR = 0.1


class Painter:
    """Maker of models of stars, each drawn as far as its light exceeds the noise.

    Parameters
    ----------
    profile : Profile
        The PSF.
    rms : (ny, nx) ndarray
        Noise of the background.
    """

    def __init__(self, profile, rms):
        self.profile = profile
        samples = np.abs(profile.samples()).max(axis=0)
        center = samples.shape[0] // 2
        full = profile.radius - 1
        # Greatest value of the profile at or beyond each distance along the axes.
        distance = np.abs(np.arange(samples.shape[0]) - center) / profile.oversampling
        line = np.maximum(samples[center], samples[:, center])
        self._sizes = np.unique(np.minimum([*_SIZES, full], full))
        self._levels = np.array([line[distance >= size].max() for size in self._sizes[:-1]])
        step = max(1, min(rms.shape) // 500)
        self._faintest = _FAINTEST * float(np.median(rms[::step, ::step]))

    def half(self, flux):
        """Find how large stars are drawn.

        Parameters
        ----------
        flux : (N,) ndarray
            Their fluxes.

        Returns
        -------
        (N,) ndarray of int
            Half-widths in px.
        """
        light = np.abs(flux)[:, None] * self._levels
        return self._sizes[(light > self._faintest).sum(axis=1)]

    def models(self, stars):
        """Make models of stars.

        Parameters
        ----------
        stars : Stars
            The stars; a negative flux subtracts light.

        Returns
        -------
        list of Models
            Models, one entry for each size.
        """
        half = self.half(stars.flux)
        groups = (stars.take((half == size) & (stars.flux != 0)) for size in self._sizes)
        pairs = zip(groups, self._sizes, strict=True)
        return [self.profile.models(*group, size) for group, size in pairs if len(group.x)]


def _paint(image, models, first_row):
    """Make an image of models."""
    image.fill(0)
    for one in models:
        one.paint(image, first_row=first_row)
    return image


class Scene:
    """Image from which the models of stars are subtracted as they are found.

    Parameters
    ----------
    data : Field
        The pixels; its image is changed.
    profile : Profile
        The PSF.
    drawn : Stars
        The stars whose models have been subtracted; the flux is 0 for stars without a model.

    Notes
    -----
    Only changes are drawn, in strips, so no image of all models is needed.
    """

    def __init__(self, data, profile, drawn):
        self.field = data
        self.drawn = drawn
        self._painter = Painter(profile, data.rms)

    @property
    def own(self):
        """Models that are added back to stars for their fits; None if none was subtracted."""
        return self.drawn if self.drawn.flux.any() else None

    def draw(self, stars, radius):
        """Subtract the new models of stars from the image instead of the old ones.

        Parameters
        ----------
        stars : Stars
            The same stars with new positions and fluxes; the flux is 0 for stars that are not
            drawn.
        radius : float
            Radius in px of the pixels of a fit.

        Returns
        -------
        (n,) ndarray of int
            Rows of the stars in whose pixels the light of others has changed.
        """
        old, settled = self.drawn, _SETTLED if self.own is not None else _NEGLIGIBLE
        changed = np.any([a != b for a, b in zip(old, stars, strict=True)], axis=0)
        self.drawn = stars
        if not changed.any():
            return np.zeros(0, int)
        gone, come = old.take(changed), stars.take(changed)
        both = Stars(*map(np.concatenate, zip(gone._replace(flux=-gone.flux), come, strict=True)))
        models, image = self._painter.models(both), self.field.image
        margin = int(np.ceil(radius))
        rows = _near_any(stars, changed, self._painter.half(both.flux).max() + margin + 1)
        rows = rows[np.argsort(np.rint(stars.y[rows]))]
        near, was = stars.take(rows), old.take(rows)
        xc, yc = (np.rint(place).astype(int) for place in (near.x, near.y))
        beside = np.empty((len(rows), 2 * margin + 1, 2 * margin + 1), np.float32)
        strip_of = np.clip(yc, 0, len(image) - 1)
        step = max(1, _STRIP // image.shape[1])
        firsts = range(0, len(image), step)

        def draw(part):
            # The light is zero again after each strip.
            work = np.zeros((step + 2 * margin, image.shape[1]), np.float32)
            for first in firsts[part::n_parts]:
                last = min(first + step, len(image))
                low, high = max(first - margin, 0), min(last + margin, len(image))
                light = work[: high - low]
                for one in models:
                    one.paint(light, first_row=low)
                k = slice(*np.searchsorted(strip_of, [first, last]))
                beside[k] = cut_squares(light, xc[k], yc[k] - low, margin)
                for one in models:
                    one.take(light, image[low:high], (first - low, last - low), first_row=low)

        n_parts = count_threads()
        map_threads(draw, range(n_parts))
        parts = [slice(k, k + _MANY) for k in range(0, len(rows), _MANY)]
        found = [
            self._disturbed(beside[k], was.take(k), near.take(k), changed[rows[k]], radius, settled)
            for k in parts
        ]
        return np.sort(rows[np.concatenate([np.zeros(0, bool), *found])])

    def _disturbed(self, light, old, new, changed, radius, settled):
        """Mark the stars that have light of other stars in their pixels."""
        half = light.shape[1] // 2
        xc, yc, _, use, sky = self.field.cut(new, half, radius)
        light = light.reshape(use.shape).astype(float)
        others = light.copy()
        profile = self._painter.profile
        for sign, side in ((-1, new), (1, old)):
            k = np.flatnonzero(changed & (side.flux > 0))
            if len(k):
                others[k] += sign * side.take(k).light(profile, xc[k], yc[k], half)
        limit = settled * (np.sqrt(sky.variance) + _SHARE * np.abs(light))
        return (use & (np.abs(others) > limit)).any(axis=1)


def _near_any(stars, changed, reach):
    """Rows of the stars that have a changed star within reach along both axes."""
    places = np.column_stack([stars.x, stars.y])
    options = {"k": 2, "p": np.inf, "distance_upper_bound": reach}
    distance = KDTree(places[changed]).query(places, **options)[0]
    return np.flatnonzero(np.isfinite(np.where(changed, distance[:, 1], distance[:, 0])))


@dataclass(frozen=True, eq=False)
class Residual:
    """Image without its stars, whose parts are made on request.

    Parameters
    ----------
    background : Background
        Image without background.
    profile : Profile
        The PSF.
    stars : Stars
        The stars.
    gain : float or None
        Electrons per unit of the image.
    subtracted : bool
        Whether the models have already been subtracted from the image.
    """

    background: object
    profile: Profile
    stars: Stars
    gain: float | None
    subtracted: bool

    @cached_property
    def _models(self):
        return Painter(self.profile, self.background.rms).models(self.stars)

    @property
    def shape(self):
        """Shape of the image, (ny, nx)."""
        return self.background.shape

    def rows(self, start, stop):
        """Make some rows.

        Parameters
        ----------
        start, stop : int
            First row, and the row after the last.

        Returns
        -------
        Background
            The residual image.  Its ``rms`` includes the background, the photons of the stars and
            an error of the PSF of 10 %, so what exceeds it is not a residual of a known star.
        """
        part = self.background.rows(start, stop)
        image = part.image if self.subtracted else np.empty_like(part.image)
        rms = np.array(part.rms, np.float32, order="C")
        step = max(1, _CACHED // part.shape[1])
        work = np.empty((min(step, len(rms)), part.shape[1]), np.float32)
        for first in range(0, len(rms), step):
            k = slice(first, min(first + step, len(rms)))
            model = _paint(work[: k.stop - first], self._models, start + first)
            if not self.subtracted:
                np.subtract(part.image[k], model, out=image[k])
            # Most pixels have no light of a star.
            lit = np.flatnonzero(model != 0)
            light, noise = model.reshape(-1)[lit], rms[k].reshape(-1)
            variance = noise[lit] ** 2 + (_MODEL_ERROR * light) ** 2
            if self.gain is not None:
                photons = np.maximum(light, 0) / self.gain
                variance += photons if part.photons is None else photons * part.photons[k].flat[lit]
            noise[lit] = np.sqrt(variance)
        return replace(part, image=image, rms=rms)
