"""Sources of reference stars: a file, the Gaia archive, a partitioned catalog."""

from wpdc_gwcs.catalogs.gaia import GaiaArchive
from wpdc_gwcs.catalogs.hats import HatsCatalog

__all__ = ["catalog_source"]


def catalog_source(source, *, url=None, cache=None, max_mag=None):
    """Interpret the name of a catalog.

    Parameters
    ----------
    source : object
        ``"gaia"``, ``"hats:PATH"``, or anything else.
    url : str, optional
        Address of the service, for ``"gaia"`` alone; see `GaiaArchive`.
    cache : path-like, optional
        Cache folder of the service.
    max_mag : float, optional
        Magnitude of the faintest stars to request.

    Returns
    -------
    object
        A `GaiaArchive` or `HatsCatalog`; otherwise `source` itself, such as the path of a file.  A
        file named ``gaia`` must be given as ``./gaia``.

    Examples
    --------
    >>> from wpdc_gwcs.catalogs import catalog_source
    >>> print(catalog_source("gaia", max_mag=19))
    gaiadr3.gaia_source at https://gea.esac.esa.int/tap-server/tap, G <= 19
    >>> catalog_source("./gaia")
    './gaia'
    """
    if not isinstance(source, str):
        return source
    if source == "gaia":
        limit = {} if max_mag is None else {"max_mag": float(max_mag)}
        return GaiaArchive(url=url, cache=cache, **limit)
    if source.startswith("hats:"):
        return HatsCatalog(source.removeprefix("hats:"))
    return source
