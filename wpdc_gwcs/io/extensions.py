"""The extensions of asdf, loaded with the faster of the parsers that PyYAML has."""

import threading

import asdf
import yaml

__all__ = ["load_extensions"]

_lock = threading.Lock()


def load_extensions():
    """Load the extensions of asdf, once in the life of a process.

    Returns
    -------
    tuple of asdf.extension.Extension
        All that are installed.

    Notes
    -----
    asdf-astropy has some fifty manifests, which asdf has PyYAML's parser in Python read: as long
    as it takes to measure the stars of a small frame.  Where PyYAML was built with libyaml, that
    reads the same by a safe loader too, twenty times as fast.
    """
    with _lock:
        in_python = yaml.safe_load
        if yaml.__with_libyaml__:
            yaml.safe_load = _safe_load
        try:
            return tuple(asdf.get_config().extensions)
        finally:
            yaml.safe_load = in_python


def _safe_load(stream):
    return yaml.load(stream, Loader=yaml.CSafeLoader)  # noqa: S506  That is a safe loader.
