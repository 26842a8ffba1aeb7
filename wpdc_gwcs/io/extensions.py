"""The extensions of asdf, loaded with the fast parser of PyYAML."""

import threading

import asdf
import yaml

__all__ = ["load_extensions"]

_lock = threading.Lock()


def load_extensions():
    """Load the extensions of asdf, once per process.

    Returns
    -------
    tuple of asdf.extension.Extension
        All installed extensions.

    Notes
    -----
    asdf-astropy has some fifty manifests, which asdf reads with the pure Python parser of PyYAML;
    this takes as long as measuring the stars of a small frame.  The safe loader of libyaml, if
    PyYAML has it, reads the same twenty times as fast.
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
