"""Fields of all exposures: waves for every detector, spectra by evidence, posteriors."""

from dataclasses import replace

import numpy as np

from wpdc_gwcs.solve.basis import Basis, patch
from wpdc_gwcs.solve.field import fit_field
from wpdc_gwcs.solve.model import block, design, focal_variance, residuals
from wpdc_gwcs.solve.spectrum import learn_spectra, pooled_spectrum, products
from wpdc_gwcs.solve.surface import SummedField, of_field
from wpdc_gwcs.solve.waves import fit_waves

__all__ = ["with_fields", "with_spectra", "with_statics"]

# Number of waves that are marginalized while the shared terms are solved, and of the final field;
# number of stars needed for each.
_MOST_MARGINAL, _MOST_FINAL = 250, 1000
_STARS_PER_WAVE_MARGINAL, _STARS_PER_WAVE = 3, 4

# Number of steps of the grid on which waves are sampled: twice that of a table, so that the nodes
# of the table, with the edge effects at the outermost ones, are grid points.
_STEPS_WAVES = 98

# With more stars than this on each detector, its table describes whatever else the exposures share,
# in more detail than a field.
_TABLE_ALONE = 6000

# Number of waves of the field that the exposures of a detector share, and stars for its spectrum.
_MOST_STATIC, _STARS_POOLED = 300, 10_000

# Frames of an exposure from which its spectrum is learned, those with the most stars.
_FRAMES_PER_EXPOSURE = 6

# Largest outer scale in units of the patch.  For a single exposure, whose polynomial is free,
# larger scales belong to the distortion.
_LONGEST, _LONGEST_ALONE = 4.0, 1.0

# In a mosaic, stars of neighbors count within this fraction of the longer side of a detector.
_MARGIN = 0.35

# First guess of the amplitude of a field, and of a shared field, in units of the errors of stars.
_FIRST_AMPLITUDE, _FIRST_STATIC = 1.0, 0.3


def _box(o, state, k, margin):
    """Corners of the part of the focal plane that a detector covers, px."""
    detector = o.detectors[k]
    focal = state.model.geometry.focal(k, detector, *detector.grid(2))
    margin = margin * max(detector.image_shape)
    return focal.min(1) - margin, focal.max(1) + margin


def _margin(o):
    return _MARGIN if len(o.detectors) > 1 else 0.0


def with_spectra(o, state, *, force=False, bends=True):
    """State with waves for each detector and a spectrum for each exposure.

    Parameters
    ----------
    o : Observations
        Pairs.
    state : State
        Current solution; its fields are ignored.
    force : bool, optional
        Whether to give every exposure a field, regardless of evidence.
    bends : bool, optional
        Whether exposures may have polynomials in addition to waves.

    Returns
    -------
    State
        State in which exposures without evidence for a field have none.
    """
    counts = np.array([state.kept[s].sum() for s in o.slices])
    bases = {}
    for k in range(len(o.detectors)):
        mine = counts[(o.detector_of == k)]
        n = int(np.clip(np.median(mine) / _STARS_PER_WAVE_MARGINAL, 12, _MOST_MARGINAL))
        bases[k] = patch(*_box(o, state, k, 0.3 * _margin(o)), n, bends=bends)
    groups = {}
    for f in state.active:
        if counts[f] > 0:
            groups.setdefault(int(o.exposure_of[f]), []).append(f)
    # The same detectors in all exposures, those with the most stars.
    total = np.bincount(o.detector_of, counts, len(o.detectors))
    frames = {
        e: sorted(fs, key=lambda f: -total[o.detector_of[f]])[:_FRAMES_PER_EXPOSURE]
        for e, fs in groups.items()
    }
    plain = replace(state, spectra={}, bases=bases)

    def make(f, kinds):
        return _products(o, plain, f, bases[int(o.detector_of[f])], kinds)

    errors = np.sqrt(np.median(state.sigma[:, state.kept] ** 2))
    areas = [np.prod(2 * b.half) for b in bases.values()]
    spacing = np.sqrt(np.median(areas) / max(np.median(counts[counts > 0]), 1))
    longest = max(2 * b.half.max() for b in bases.values())
    spectra = learn_spectra(
        frames, make, start=_FIRST_AMPLITUDE * errors, force=force,
        scales=(min(2 * spacing, 0.5 * longest), _longest(o, state) * longest),
    )  # fmt: skip
    return replace(plain, spectra=spectra)


def _longest(o, state):
    alone = o.n_exposures == 1 and state.model.scoped("detector")
    return _LONGEST_ALONE if alone else _LONGEST


def _products(o, state, f, basis: Basis, kinds):
    s = o.slices[f]
    kept = state.kept[s]
    residual, focal = residuals(state.model, o, f, with_field=False)
    variance = state.noise(o, f)[:, kept]
    nuisance = None
    if len(o.detectors) == 1:
        # The polynomial of a single exposure has absorbed a part of the field.
        columns = design(state.model, o, f, o.x[s][kept], o.y[s][kept], o.color[s][kept]).rows
        own = sum(t.size for t in state.model.scoped("exposure"))
        nuisance = columns if o.n_exposures == 1 else columns[:, :, -own:]
    return products(
        basis, focal[:, kept], -residual[:, kept], 1.0 / variance, nuisance=nuisance, kinds=kinds
    )


def with_fields(o, state):
    """State with the posterior of the field in every frame whose exposure has a spectrum.

    Parameters
    ----------
    o : Observations
        Pairs.
    state : State
        State with spectra.

    Returns
    -------
    State
        State with fields.
    """
    fields = {}
    plain = replace(state, model=state.model.with_fields({}))
    for e in range(o.n_exposures):
        spectrum = state.spectra.get(e)
        frames = [f for f in o.frames_of(e) if state.reason[f] is None]
        if spectrum is None or not frames:
            continue
        stars = [_stars(o, plain, f) for f in frames]
        focal, residual, variance = (
            np.concatenate([star[i] for star in stars], axis=1) for i in range(3)
        )
        for f in frames:
            low, high = _box(o, state, int(o.detector_of[f]), _margin(o))
            near = np.all((focal > low[:, None]) & (focal < high[:, None]), axis=0)
            n = int(np.clip(near.sum() / _STARS_PER_WAVE, 12, _MOST_FINAL))
            basis = patch(low, high, n, bends=spectrum.bend > 0)
            fields[f] = fit_field(
                basis, spectrum, focal[:, near], residual[:, near], variance[:, near]
            )
    return replace(state, model=state.model.with_fields(fields))


def with_statics(o, state):
    """State with the smooth structure of each detector that its exposures share.

    These are the significant waves, see `fit_waves`, and, if there are not enough stars for a
    table, a field for the remaining structure.  The spectrum of this field is learned from all
    detectors, because a single detector may have too few stars.

    Parameters
    ----------
    o : Observations
        Pairs.
    state : State
        Current solution.

    Returns
    -------
    State
        New state.  Detectors with too few stars have no waves; those with many have no field.
    """
    plain = replace(state, model=state.model.changed(statics={}))
    stars, statics = {}, {}
    for k in range(len(o.detectors)):
        frames = [f for f in state.active if o.detector_of[f] == k]
        if not frames:
            continue
        parts = [_stars(o, plain, f) for f in frames]
        places = [_places(o, plain, f) for f in frames]
        stars[k] = [np.concatenate(places, axis=1)]
        stars[k] += [np.concatenate([p[i] for p in parts], axis=1) for i in (1, 2)]
        box = _box(o, state, k, 0.0)
        waves = fit_waves(*box, *stars[k])
        if waves is not None:
            statics[k] = of_field(waves, *box, least_steps=_STEPS_WAVES)
            stars[k][1] = stars[k][1] - statics[k](stars[k][0])
    for k, field in _common_fields(o, state, stars).items():
        statics[k] = SummedField((statics[k], field)) if k in statics else field
    return replace(state, model=state.model.changed(statics=statics))


def _common_fields(o, state, stars):
    """Fields with one spectrum for all detectors of a mosaic, if there is evidence for them."""
    typical = float(np.median([columns[0].shape[1] for columns in stars.values()]))
    if len(o.detectors) == 1 or typical > _TABLE_ALONE:
        return {}
    boxes = {k: _box(o, state, k, 0.0) for k in stars}
    n = int(np.clip(typical, 12, _MOST_STATIC))
    longest = max(float(np.max(high - low)) for low, high in boxes.values())
    spacing = longest / np.sqrt(max(typical, 1.0))
    patches = []
    pooled = int(np.clip(_STARS_POOLED / typical, 4, len(stars)))
    for k in list(stars)[:: -(-len(stars) // pooled)]:
        focal, residual, variance = stars[k]
        patches.append(
            products(patch(*boxes[k], n), focal, residual, 1.0 / variance, nuisance=_affine(focal))
        )
    spectrum = pooled_spectrum(
        patches,
        start=_FIRST_STATIC * np.sqrt(np.median(state.sigma[:, state.kept] ** 2)),
        scales=(min(2 * spacing, 0.5 * longest), 4 * longest),
    )
    if spectrum is None:
        return {}
    return {
        k: of_field(fit_field(patch(*boxes[k], n), spectrum, *stars[k]), *boxes[k]) for k in stars
    }


def _affine(focal):
    """Columns of a shift and a linear map, which belong to the place of a detector."""
    middle = focal - focal.mean(1, keepdims=True)
    rows = np.stack([np.ones(focal.shape[1]), *(middle / np.abs(middle).max())], axis=1)
    zero = np.zeros_like(rows)
    return np.array([np.hstack([rows, zero]), np.hstack([zero, rows])])


def _stars(o, state, f):
    s = o.slices[f]
    kept = state.kept[s]
    residual, focal = residuals(state.model, o, f)
    variance = focal_variance(state.model, o, f, state.sigma[:, s])
    return focal[:, kept], -residual[:, kept], variance[:, kept]


def _places(o, state, f):
    """Focal plane positions of the kept pairs of a frame, without distortion."""
    s, k = o.slices[f], int(o.detector_of[f])
    kept = state.kept[s]
    return block(state.model, k, o.detectors[k], o.x[s][kept], o.y[s][kept])[1]
