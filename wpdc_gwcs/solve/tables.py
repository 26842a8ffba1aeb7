"""Look-up tables of the detectors: residuals of the terms, binned and interpolated."""

from dataclasses import replace

import numpy as np

from wpdc_gwcs.lookup import N_FOLDS, ResidualMap, build_lookup_table, choose_table
from wpdc_gwcs.solve.state import all_residuals
from wpdc_gwcs.solve.surface import of_table

__all__ = ["choose_tables", "folds", "residual_maps", "with_tables"]

# Maximum number of detectors for which all settings of tables are tried; others adopt theirs.
_DETECTORS_TRIED = 3

# With more stars than this, a detector determines its settings better than others do.
_OWN_SETTINGS = 6000

# Detectors with fewer stars than this fraction of the richest one get their own settings.
_SHARE_OF_STARS = 0.25


def folds(o, seed):
    """Return the cross-validation group of each pair: by exposure, or random for one or two.

    Parameters
    ----------
    o : Observations
        Pairs.
    seed : int
        Seed of the division of single exposures.
    """
    groups = np.random.default_rng(seed).integers(0, N_FOLDS, len(o))
    if o.n_exposures >= 3:
        for f, s in enumerate(o.slices):
            groups[s] = int(o.exposure_of[f]) % N_FOLDS
    return groups


def residual_maps(o, state, group, base=None):
    """Binned residuals of each detector with its field, its table put back.

    Parameters
    ----------
    o : Observations
        Pairs.
    state : State
        Current state.
    group : (N,) ndarray of int
        Group of each pair in cross-validation.
    base : sequence of callable, optional
        Displacements to add back for each detector instead of its current table.

    Returns
    -------
    list of ResidualMap
        One for each detector.
    """
    model = state.model
    residual = all_residuals(o, state)
    maps = []
    for k, detector in enumerate(o.detectors):
        total = ResidualMap(detector.image_shape)
        frames = [f for f in state.active if o.detector_of[f] == k]
        rows = [np.flatnonzero(state.kept[o.slices[f]]) + o.slices[f].start for f in frames]
        if rows:
            i = np.concatenate(rows)
            sigma = np.concatenate([np.sqrt(_with_unresolved(o, state, f)) for f in frames], axis=1)
            table = model.tables[k] if base is None else base[k]
            put_back = 0.0 if table is None else np.array(table(o.x[i], o.y[i]))
            dx, dy = residual[:, i] + put_back
            total = ResidualMap.from_residuals(
                o.x[i], o.y[i], dx, dy, x_err=sigma[0], y_err=sigma[1],
                image_shape=detector.image_shape, fold=group[i],
            )  # fmt: skip
        maps.append(total)
    return maps


def _with_unresolved(o, state, f):
    """Variances of the kept pairs of a frame along the detector, short waves included."""
    s = o.slices[f]
    spectrum = state.spectrum(o, f)
    extra = 0.0 if spectrum is None else spectrum.unresolved(state.bases[int(o.detector_of[f])])
    return (state.sigma[:, s] ** 2 + extra)[:, state.kept[s]]


def with_tables(o, state, group, n_grid, lut, *, choices=None, draft=False):
    """Return the state with new tables of the remaining residuals.

    Parameters
    ----------
    o : Observations
        Pairs.
    state : State
        Where the solution stands.
    group : (N,) ndarray of int
        Group of each pair in cross-validation.
    n_grid : int
        Nodes along each axis.
    lut : {'auto', 'always'}
        Whether there may be no table.
    choices : sequence of (TableChoice, tuple), optional
        Settings found before, and those they were chosen from; quick ones if not given.
    draft : bool, optional
        Quick tables, for iterations.

    Returns
    -------
    state : State
        State with new tables.
    infos : list of TableInfo
        Information about them.
    """
    maps = residual_maps(o, state, group)
    tables, infos = [], []
    for total, (choice, candidates) in zip(maps, choices or [(None, ())] * len(maps)):
        table, info = build_lookup_table(total, n_grid, choice=choice, lut=lut, draft=draft)
        tables.append(None if table is None else of_table(table))
        infos.append(replace(info, candidates=candidates))
    return replace(state, model=state.model.changed(tables=tuple(tables))), infos


def choose_tables(maps, lut):
    """Choose the settings of the table of every detector.

    Parameters
    ----------
    maps : list of ResidualMap
        Residuals of each detector.
    lut : {'auto', 'always'}
        Whether there may be no table.

    Returns
    -------
    list of (TableChoice, tuple)
        Settings and the candidates they were chosen from; in a large camera, detectors
        adopt the settings of those with the most stars.
    """
    if len(maps) <= _DETECTORS_TRIED:
        return [choose_table(m, lut=lut) for m in maps]
    order = np.argsort([-m.n_stars for m in maps], kind="stable")
    tried = [choose_table(maps[k], lut=lut) for k in order[:_DETECTORS_TRIED]]
    tried.sort(key=lambda found: (found[0].kernel == "none", found[0].freedom))
    common = tried[_DETECTORS_TRIED // 2]
    enough = _SHARE_OF_STARS * maps[order[0]].n_stars
    return [
        common if enough <= m.n_stars < _OWN_SETTINGS else choose_table(m, lut=lut) for m in maps
    ]
