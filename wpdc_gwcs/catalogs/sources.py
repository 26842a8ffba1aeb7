"""Where reference stars come from: a file, Gaia's archive, a partitioned catalog."""

from wpdc_gwcs.catalogs.gaia import GaiaArchive
from wpdc_gwcs.catalogs.hats import HatsCatalog

__all__ = ["catalog_source"]


def catalog_source(source, *, url=None, cache=None, max_mag=None):
    """Tell what a word means that is to be a catalog.

    Parameters
    ----------
    source : object
        ``"gaia"``, ``"hats:PATH"``, or anything else.
    url : str, optional
        Address of the service, of ``"gaia"`` alone; see `GaiaArchive`.
    cache : path-like, optional
        Folder of what came from there.
    max_mag : float, optional
        Magnitude of the faintest stars asked for.

    Returns
    -------
    object
        `GaiaArchive` or `HatsCatalog`; else what was given, such as the path of a file, which is
        ``./gaia`` if it has that name.
    """
    if not isinstance(source, str):
        return source
    if source == "gaia":
        limit = {} if max_mag is None else {"max_mag": float(max_mag)}
        return GaiaArchive(url=url, cache=cache, **limit)
    if source.startswith("hats:"):
        return HatsCatalog(source.removeprefix("hats:"))
    return source
