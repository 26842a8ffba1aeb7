"""Packages that only some catalogs need."""

from importlib.util import find_spec

from wpdc_gwcs.exceptions import CatalogError

__all__ = ["require"]


def require(what, extra, *packages):
    """Raise an error unless the packages of an extra are installed.

    Parameters
    ----------
    what : str
        What needs them, for the message.
    extra : str
        Extra of this package that installs them.
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
