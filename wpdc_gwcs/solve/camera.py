"""The solution of a camera."""

import logging
from dataclasses import replace

import numpy as np

from wpdc_gwcs.exceptions import FitError
from wpdc_gwcs.fitting import RadialWeight
from wpdc_gwcs.solve import terms as make
from wpdc_gwcs.solve.change import find_change
from wpdc_gwcs.solve.exposure import SolveResult
from wpdc_gwcs.solve.fields import with_fields, with_spectra, with_statics
from wpdc_gwcs.solve.geometry import start_geometry
from wpdc_gwcs.solve.model import Model
from wpdc_gwcs.solve.observations import gather
from wpdc_gwcs.solve.rejection import without_aliens, without_wrong
from wpdc_gwcs.solve.results import frozen_result
from wpdc_gwcs.solve.state import (
    State,
    linear_step,
    with_clipping,
    with_error_models,
)
from wpdc_gwcs.solve.stored import StoredMap, unswallowed_maps, updated_solution
from wpdc_gwcs.solve.tables import choose_tables, folds, residual_maps, with_tables
from wpdc_gwcs.threads import one_blas_thread

__all__ = ["solve"]

log = logging.getLogger(__name__)

# Default maximum degrees: of a detector, and of the optics of a mosaic.  Evidence keeps the highest
# ones small; without them, sparse stars would have to tell them place by place.
_DEGREE_DETECTOR = 7
_DEGREE_OPTICS = 9

# Degree of the delivered polynomial; the rest is in the table.
_PV_DEGREE = 3

# Number of alternating steps.
_ROUNDS_ALIGN = 6
_ROUNDS_FIELD = 2
# Before the waves are known, the errors of the stars are overestimated.
_ROUNDS_WAVES = 2

# Once the instrument is known: how much larger residuals may be in one part of the detector than
# elsewhere before they are taken for outliers.
_MAX_LOCAL_SCALE = 10.0

# Updates of the variances in each linear step.
_LEARN = 12

_REFINE = ("auto", "attitude", "field", "pv")
_LUT = ("auto", "always", "none")


@one_blas_thread
def solve(
    exposures,
    *,
    image_shape,
    crpix=None,
    cd=None,
    weight=None,
    degree="auto",
    n_grid=50,
    lut="auto",
    refine="auto",
    solution=None,
    update=False,
    pool_attitudes=True,
    clip=3.5,
    table_choice=None,
    seed=0,
):
    r"""Solve for the distortion of all detectors of a camera, and for each exposure.

    Parameters
    ----------
    exposures : sequence of Exposure
        Pairs of each exposure of each detector.
    image_shape : (int, int) or dict
        Shape ``(ny, nx)`` of the detectors, or of each by its name.
    crpix : (2,) array_like or dict, optional
        Reference point, px, zero based.  Default: that of ``solution``, or else the center of the
        detector.
    cd : (2, 2) array_like, optional
        Nominal matrix CD0 for the polynomial of a single detector, deg / px.  Default: the mean of
        the solved matrices.
    weight : RadialWeight or dict, optional
        Radial weight of the stored polynomial.  Default: ``exp-sqrt`` with 0.87 times half the
        shorter side, or uniform with ``lut="none"``, because then no table corrects an
        extrapolation.
    degree : int or 'auto', optional
        Degree of the stored polynomial, and the highest degree of the distortion of a detector.
        ``auto``: up to 7 by evidence, stored as a cubic and a table.
    n_grid : int, optional
        Nodes of the look-up table along each axis.
    lut : {'auto', 'always', 'none'}, optional
        Whether residuals are smoothed into a table.  ``auto`` decides from the data, and ``none``
        returns the polynomial alone.
    refine : {'auto', 'attitude', 'field', 'pv'}, optional
        What is fitted to each exposure: six linear numbers (``attitude``), a smooth field as well
        if there is evidence for it (``auto``) or always (``field``), or a polynomial (``pv``, as in
        the paper).
    solution : DistortionSolution or dict, optional
        Stored instrument, or one for each detector by its name.
    update : bool, optional
        Whether to add the residuals of these exposures to those of ``solution`` and make a new
        table.
    pool_attitudes : bool, optional
        Whether to estimate from five or more exposures how much scale, rotation and skew vary
        between them, and to shrink those of each exposure toward their mean accordingly.
    clip : float, optional
        Pairs with residuals of more than this many robust standard deviations are left out.
    table_choice : dict, optional
        Settings of the tables by detector, from an earlier result
        (``result.table_infos[name].choice``).  This saves time if only a few pairs have changed.
        Default: the settings are chosen.
    seed : int, optional
        Seed for the division of the stars of a single exposure into groups for cross-validation.

    Returns
    -------
    SolveResult
        Solutions, exposures, and those that were rejected.

    Raises
    ------
    FitError
        If there is no exposure, the pairs do not determine the solution, or the stored solution is
        for a detector of another shape.
    ValueError
        If an option has a wrong value, or ``update`` is set without a stored solution.

    Notes
    -----
    The residual of a pair is a sum of linear terms (`wpdc_gwcs.solve.terms`), each with a Gaussian
    prior whose variance is learned:

    .. math:: r = \Phi(x) w + O(\varphi) o + B(\varphi) a_e + \delta_e(\varphi) + \text{noise}

    Here x is the position on the detector and :math:`\varphi` that in the focal plane; w are the
    coefficients of the detector, o those of the optics, :math:`a_e` the six linear numbers of the
    exposure e, and :math:`\delta_e` is its field.

    1. All terms except the fields are solved together, with the variance of every degree.
       Outliers are judged by the prediction from the other stars.
    2. The remaining residuals of each detector, pooled over exposures, become its table.
    3. Each exposure gets a field if there is evidence for it.  The shared terms are solved again
       with the fields marginalized, and then tables and fields once more.
    4. The result is stored as PV polynomial, table, attitude, and a table of the exposure.

    References
    ----------
    WPDC-2P, arXiv:2603.09193, section 3; Bernstein et al. (2017), PASP 129, 074503 (gbdes);
    Fortino et al. (2021), AJ 162, 106 (turbulence as a Gaussian process).

    Examples
    --------
    >>> import numpy as np
    >>> from wpdc_gwcs.solve import Exposure, solve
    >>> from wpdc_gwcs.models import deproject
    >>> cd, center, rng = np.array([[-2e-5, 0], [0, 2e-5]]), 1023.5, np.random.default_rng(1)
    >>> exposures = []
    >>> for k in range(3):
    ...     x, y = rng.uniform(0, 2047, (2, 500))
    ...     u, v = (x - center) / 1024, (y - center) / 1024
    ...     plane = cd @ [x - center + 3 * u * (u**2 + v**2), y - center]
    ...     ra, dec = deproject(*plane, (120.0 + 0.01 * k, 30.0))
    ...     exposures.append(Exposure(f"e{k}", x, y, ra, dec, crval=(120.0, 30.0), cd=cd))
    >>> result = solve(exposures, image_shape=(2048, 2048))
    >>> result.exposures[2].crval
    array([120.02, 30. ])
    """
    exposures = list(exposures)
    _check_options(exposures, degree, lut, refine, solution, update)
    names = list(dict.fromkeys(e.detector for e in exposures))
    stored = _by_name(solution, names)
    if stored and len(stored) < len(names):
        options = {
            "image_shape": image_shape, "crpix": crpix, "cd": cd, "weight": weight,
            "degree": degree, "n_grid": n_grid, "lut": lut, "refine": refine, "update": update,
            "pool_attitudes": pool_attitudes, "clip": clip, "table_choice": table_choice,
            "seed": seed,
        }  # fmt: skip
        return _solve_apart(exposures, stored, options)
    shapes = {n: tuple(int(v) for v in s) for n, s in _by_name(image_shape, names).items()}
    points = _reference_points(crpix, names, shapes, stored)
    o = gather(exposures, shapes, points)
    weights = _weights(weight, names, shapes, lut)
    pv_degree = _PV_DEGREE if degree == "auto" else int(degree)
    # Without a table, the delivered polynomial has to describe everything.
    state = _start(o, pv_degree if lut == "none" else degree, stored)
    state = _align(o, state, clip, pool_attitudes)
    group = folds(o, seed)
    infos = [None] * len(o.detectors)
    choices = None if table_choice is None else [(table_choice[n], ()) for n in names]
    alone = o.n_exposures == 1
    waves = lut != "none" and not stored and (not alone or len(o.detectors) > 1)
    for _ in range(_ROUNDS_WAVES if waves else 0):
        state = _settled(o, with_statics(o, state), clip, pool_attitudes)
        state = with_error_models(o, state)
    if lut != "none" and not stored and not alone:
        if choices is None:
            choices = choose_tables(residual_maps(o, state, group), lut)
        state, infos = with_tables(o, state, group, n_grid, lut, choices=choices, draft=True)
        if any(table is not None for table in state.model.tables):
            state = with_error_models(o, _settled(o, state, clip, pool_attitudes))
    # In a mosaic the stars of neighbors tell how an exposure bends; in an update it may be the
    # instrument that does.
    bends = len(o.detectors) == 1 and not update
    # Without a table there is no place for a field, unless it is requested.
    if refine == "field" or (refine == "auto" and lut != "none"):
        for _ in range(_ROUNDS_FIELD):
            state = with_spectra(o, state, force=refine == "field", bends=bends)
            if not any(state.spectra.values()):
                break
            state = linear_step(o, state, learn=_LEARN, pool=pool_attitudes)
            state = with_fields(o, state)
            state = with_clipping(o, state, clip, local=_MAX_LOCAL_SCALE, thorough=True)
            # Former scatter is now part of the field, so the errors are smaller.
            state = with_error_models(o, state)
            if waves:
                state = with_statics(o, state)
            if lut != "none" and not stored and not alone:
                state, infos = with_tables(
                    o, state, group, n_grid, lut, choices=choices, draft=True
                )
    if lut != "none" and not stored:
        if choices is None:
            choices = choose_tables(residual_maps(o, state, group), lut)
        state, infos = with_tables(o, state, group, n_grid, lut, choices=choices)
        state = _settled(o, state, clip, pool_attitudes)
    if update:
        state, stored, infos = _updated(o, state, stored, group, n_grid, refine == "field")
        state = _settled(o, state, clip, pool_attitudes)
    state = with_error_models(o, state)
    state = linear_step(o, state, learn=1, pool=pool_attitudes)
    if any(state.spectra.values()):
        state = with_fields(o, state)
    return frozen_result(o, state, stored, infos, group, {
        "weight": weights, "degree": degree, "pv_degree": pv_degree, "n_grid": n_grid,
        "lut": lut, "refine": refine, "clip": float(clip), "pool_attitudes": bool(pool_attitudes),
    }, cd, update)  # fmt: skip


def _solve_apart(exposures, stored, options):
    """Solve detectors with and without a stored solution as two cameras."""
    known = [e for e in exposures if e.detector in stored]
    others = [e for e in exposures if e.detector not in stored]
    first = solve(known, solution=stored, **options)
    second = solve(others, **(options | {"update": False}))
    fits = {f.name: f for f in first.exposures + second.exposures}
    return SolveResult(
        first.solutions | second.solutions,
        tuple(fits[e.name] for e in exposures),
        first.rejected | second.rejected,
        first.table_infos | second.table_infos,
        first.reference_color if second.reference_color is None else second.reference_color,
    )


def _check_options(exposures, degree, lut, refine, solution, update):
    if refine not in _REFINE:
        raise ValueError(f"refine must be one of {', '.join(_REFINE)}, got {refine!r}")
    if lut not in _LUT:
        raise ValueError(f"lut must be one of {', '.join(_LUT)}, got {lut!r}")
    if degree != "auto" and not (isinstance(degree, (int, np.integer)) and 1 <= degree <= 7):
        raise ValueError(f"degree must be 'auto' or an integer from 1 to 7, got {degree!r}")
    if not exposures:
        raise FitError("no exposure was given")
    if update and solution is None:
        raise ValueError("update needs a stored solution")


def _by_name(value, names):
    """Return the value of each detector, given by name or for all; nothing for `None`."""
    if value is None:
        return {}
    return (
        {n: value[n] for n in names if n in value}
        if isinstance(value, dict)
        else dict.fromkeys(names, value)
    )


def _reference_points(crpix, names, shapes, stored):
    points = _by_name(crpix, names)
    for name in names:
        if name in stored:
            shape = tuple(stored[name].image_shape)
            if shape != shapes[name]:
                raise FitError(
                    f"the stored solution is for a detector of {shape} px (ny, nx), these "
                    f"exposures have {shapes[name]}"
                )
            points[name] = stored[name].crpix
        elif points.get(name) is None:
            points[name] = 0.5 * (np.array(shapes[name][::-1]) - 1.0)
    return {n: np.array(p, dtype=float) for n, p in points.items()}


def _weights(weight, names, shapes, lut):
    given = _by_name(weight, names)
    default = "uniform" if lut == "none" else "exp-sqrt"
    return {n: given.get(n) or RadialWeight.for_shape(shapes[n], default) for n in names}


def _start(o, degree, stored):
    """Build the state before any solution."""
    mosaic = len(o.detectors) > 1
    chosen = []
    if not stored:
        largest = _DEGREE_DETECTOR if degree == "auto" else degree
        if mosaic:
            chosen += [make.optics(_DEGREE_OPTICS), make.place(), make.tilt()]
        if largest > 1:
            chosen.append(make.polynomial(largest, mosaic=mosaic))
    elif mosaic:
        chosen.append(make.place())
    chosen.append(make.attitude())
    if np.isfinite(o.reference_color) and np.any(o.color):
        chosen.append(make.refraction())
        if not stored:
            chosen.append(make.lateral_color())
    counts = {"camera": (), "detector": (len(o.detectors),), "exposure": (o.n_exposures,)}
    model = Model(
        geometry=start_geometry(o),
        terms=tuple(chosen),
        coefficients={t.name: np.zeros((*counts[t.scope], t.size)) for t in chosen},
        sigma={t.name: t.start.copy() for t in chosen},
        tables=tuple(StoredMap(stored[d.name]) if d.name in stored else None for d in o.detectors),
    )
    return State(model, o.sigma.copy(), o.valid.copy(), (None,) * len(o.frames))


def _align(o, state, clip, pool):
    """Solve all terms, outliers and errors together, from the start of the frames."""
    state = without_aliens(o, state)
    for turn in range(_ROUNDS_ALIGN):
        state = linear_step(o, state, learn=_LEARN, pool=pool)
        # Distortion that is not yet in the model is not noise: clip little at first.
        last = turn == _ROUNDS_ALIGN - 1
        state = with_clipping(o, state, clip, relax=max(1.0, 4.0 / 2**turn), thorough=last)
        if turn and not o.has_errors.all():
            state = with_error_models(o, state)
    state = without_wrong(o, state)
    state = linear_step(o, state, learn=_LEARN, pool=pool)
    return with_error_models(o, state)


def _settled(o, state, clip, pool):
    """State with all terms, fields and outliers for the present tables."""
    for last in (False, True):
        state = linear_step(o, state, learn=1, pool=pool)
        state = with_clipping(o, state, clip, local=_MAX_LOCAL_SCALE, thorough=last)
    return with_fields(o, state) if any(state.spectra.values()) else state


def _updated(o, state, stored, group, n_grid, force):
    """Adapt stored solutions to the common residuals of these exposures, see `find_change`."""
    for name, solution in stored.items():
        if solution.residual_map is None:
            raise FitError(
                f"the stored solution of {name!r} holds no residual map: it cannot be updated"
            )
    bases = [stored[d.name].lookup_table for d in o.detectors]
    found = {k: find_change(o, state, k, stored[d.name]) for k, d in enumerate(o.detectors)
             if any(o.detector_of[f] == k for f in state.active)}  # fmt: skip
    maps = unswallowed_maps(o, state, group, bases, {k: both[1] for k, both in found.items()})
    stored, infos, tables = dict(stored), [], []
    for k, (detector, new) in enumerate(zip(o.detectors, maps)):
        change = found[k][0] if k in found else None
        solution, info = updated_solution(o, state, k, change, stored[detector.name], new, n_grid)
        infos.append(info)
        stored[detector.name] = solution
        tables.append(StoredMap(solution))
    model = state.model.changed(tables=tuple(tables), fields={})
    state = replace(state, model=model)
    if any(state.spectra.values()):
        # The part of a change that fields had absorbed now belongs to the instrument.
        state = linear_step(o, with_spectra(o, state, force=force, bends=False), learn=1)
    return state, stored, infos
