"""Packages of the optional extras: whether they are installed."""

from importlib.util import find_spec

from wpdc_gwcs.exceptions import InputError

__all__ = ["PLOT", "missing", "require"]

#: Packages that figures and the report need, of the extra ``plot``.
PLOT = ("matplotlib", "jinja2")


def missing(*packages):
    """Return the packages that are not installed.

    Parameters
    ----------
    *packages : str
        Names of modules.

    Returns
    -------
    list of str
        Those of them that cannot be imported.
    """
    return [name for name in packages if find_spec(name) is None]


def require(what, extra, *packages, error=InputError):
    """Raise an error unless the packages of an extra are installed.

    Parameters
    ----------
    what : str
        What needs them, for the message.
    extra : str
        Extra of this package that installs them.
    *packages : str
        Names of modules.
    error : type, optional
        Subclass of `~wpdc_gwcs.exceptions.InputError` that is raised.

    Raises
    ------
    InputError
        If one is missing; the message has the command that installs it.
    """
    if lacking := missing(*packages):
        raise error(
            f"{what} needs {' and '.join(lacking)}, not installed here: "
            f"pip install 'wpdc_gwcs[{extra}]'"
        )
