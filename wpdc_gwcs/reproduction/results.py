"""Results compared with the paper, in one table for all parts."""

import math

from astropy.table import QTable

from wpdc_gwcs.reproduction.claims import CLAIMS

__all__ = ["tabulate_results"]

_WHERE = {(c.part, c.item, c.quantity): c for c in CLAIMS}


def tabulate_results(part, found):
    """Tabulate the results of a part beside the numbers of the paper.

    Parameters
    ----------
    part : str
        Name of the part.
    found : dict
        Numbers of the literal and of the default method (NaN for none), by
        ``(item, quantity, unit)``.

    Returns
    -------
    `~astropy.table.QTable`
        Columns ``part``, ``item``, ``quantity``, ``unit``, ``paper`` (NaN if it has none),
        ``literal``, ``ours`` and ``source``, the place in the paper.

    Examples
    --------
    >>> from wpdc_gwcs.reproduction.results import tabulate_results
    >>> table = tabulate_results("detectors", {("g-1", "sigma_dx", "pix"): (0.09, 0.03)})
    >>> table["paper"][0], table["source"][0]
    (np.float64(0.029), np.str_('table 2'))
    """
    rows = []
    for (item, quantity, unit), (literal, ours) in found.items():
        claim = _WHERE.get((part, item, quantity))
        rows.append(
            {
                "part": part,
                "item": item,
                "quantity": quantity,
                "unit": unit,
                "paper": math.nan if claim is None else claim.value,
                "literal": float(literal),
                "ours": float(ours),
                "source": "" if claim is None else claim.source,
            }
        )
    return QTable(rows)
