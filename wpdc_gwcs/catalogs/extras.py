"""Packages that only some catalogs need."""

from importlib.util import find_spec

from wpdc_gwcs.exceptions import CatalogError

__all__ = ["require"]


def require(what, extra, *packages):
    """Refuse to go on without the packages of an extra.

    Parameters
    ----------
    what : str
        What was asked for.
    extra : str
        Extra of this package that brings them.
    *packages : str
        Names of modules.

    Raises
    ------
    CatalogError
        If one is missing.
    """
    missing = [name for name in packages if find_spec(name) is None]
    if missing:
        raise CatalogError(
            f"{what} needs {' and '.join(missing)}, not installed here: "
            f"pip install 'wpdc_gwcs[{extra}]'"
        )
