"""The radial weights on the whole detector and in its center: figures 4 and 5.

::

    simulate --> calibrate --> compare_weights (one polynomial of all exposures): ours
                 calibrate with each weight, literal, no table: a polynomial of each exposure
"""

import numpy as np
from astropy.table import vstack

from wpdc_gwcs.evaluation import compare_weights, d80, tabulate_weights
from wpdc_gwcs.io import write_table
from wpdc_gwcs.plotting import plot_slices, plot_weights
from wpdc_gwcs.reproduction.detectors import calibrate_fields, simulate_fields
from wpdc_gwcs.reproduction.results import tabulate_results
from wpdc_gwcs.reproduction.scale import SEED

__all__ = ["reproduce_weights"]

_DETECTOR = "g-1"
# The weights of the paper, and uniform weight.
_WEIGHTS = {
    "w1": "exp-sqrt",
    "w2": "gaussian",
    "w3": "inverse",
    "w4": "inverse-square",
    "unweighted": "uniform",
}
# Limit of the paper for short residuals, px.
_SHORT_PX = 0.1


def reproduce_weights(folder, scale, *, seed=SEED, jobs=1, progress=None):
    """Reproduce the paper's comparison of radial weights.

    Parameters
    ----------
    folder : Path
        Existing folder for tables and figures.
    scale : Scale
        Size of the reproduction.
    seed : int, optional
        Seed of the camera and of the fields.
    jobs : int, optional
        Number of processes that match frames.
    progress : callable, optional
        Called as ``progress("weights", done, total)``.

    Returns
    -------
    `~astropy.table.QTable`
        See `~wpdc_gwcs.reproduction.results.tabulate_results`.  Items are the weights, on the whole
        detector, and "w1 central" and so on, within r0.

    Notes
    -----
    Residuals are those of the polynomial alone.  ``ours`` fits one polynomial to all exposures,
    ``literal`` one to each exposure.  Writes ``weights.png``, ``weights-central.png``,
    ``slices.png`` and ``weights.ecsv``, which also has the residuals with tables.

    Examples
    --------
    >>> from wpdc_gwcs.reproduction import CLAIMS
    >>> [(c.item, c.quantity, c.value) for c in CLAIMS if c.part == "weights"]
    [('w1', 'share_within_0p1', 0.6)]
    """
    simulation = simulate_fields(_DETECTOR, scale, seed=seed)
    run = calibrate_fields(simulation, scale, jobs=jobs)
    results = compare_weights(run.calibrations, weights=tuple(_WEIGHTS.values()), r0=scale.r0)
    central = [r.within(scale.r0) for r in results]
    steps = len(_WEIGHTS) + 1
    found = {}
    for k, (name, weight) in enumerate(_WEIGHTS.items()):
        if progress is not None:
            progress("weights", k + 1, steps)
        literal = _literal(simulation, scale, weight, jobs)
        for item, ours, inside in (
            (name, results[k], None),
            (f"{name} central", central[k], scale.r0),
        ):
            near = slice(None) if inside is None else literal[2] <= inside
            values = [_quantities(*literal[:2, near]), _quantities(ours.dx, ours.dy)]
            for key in values[0]:
                found[item, *key] = [v[key] for v in values]
    for name, chosen in (("weights", results), ("weights-central", central)):
        plot_weights(chosen).savefig(folder / f"{name}.png", dpi=110)
    axes = plot_slices(
        {"unweighted": results[-1], "weighted (w1)": results[0]},
        image_shape=run.calibrations[0].solution.image_shape,
        width=scale.slice_width,
    )
    axes[0].figure.savefig(folder / "slices.png", dpi=110)
    tables = []
    for area, chosen in (("detector", results), ("central", central)):
        table = tabulate_weights(chosen)
        table.add_column(np.full(len(table), area), name="area", index=0)
        tables.append(table)
    write_table(vstack(tables), folder / "weights.ecsv", overwrite=True)
    if progress is not None:
        progress("weights", steps, steps)
    return tabulate_results("weights", found)


def _literal(simulation, scale, weight, jobs):
    """Residuals of the literal polynomials, and distances from the reference point, px."""
    run = calibrate_fields(simulation, scale, method="paper", weight=weight, lut="none", jobs=jobs)
    columns = []
    for c in run.calibrations:
        m = c.matches[np.asarray(c.matches["used"], bool)]
        x, y, dx, dy = (np.asarray(m[name], float) for name in ("x", "y", "dx", "dy"))
        columns.append([dx, dy, np.hypot(x - c.solution.crpix[0], y - c.solution.crpix[1])])
    return np.concatenate(columns, axis=1)


def _quantities(dx, dy):
    return {
        ("d80_dx", "pix"): d80(dx),
        ("d80_dy", "pix"): d80(dy),
        ("share_within_0p1", ""): float(np.mean(np.abs(dx) < _SHORT_PX)),
    }
