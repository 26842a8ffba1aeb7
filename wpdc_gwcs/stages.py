"""Names of what is being done, for those who wait: told by the stages, heard by who asks."""

from contextlib import contextmanager
from contextvars import ContextVar

__all__ = ["announce", "listening"]

_listener = ContextVar("listener", default=None)


def announce(stage):
    """Tell that a stage begins.

    Parameters
    ----------
    stage : str
        Its name, a word.
    """
    listener = _listener.get()
    if listener is not None:
        listener(stage)


@contextmanager
def listening(listener):
    """Hear what is announced within a block, in this thread.

    Parameters
    ----------
    listener : callable
        Called with the names of stages.

    Yields
    ------
    None
        Nothing.
    """
    token = _listener.set(listener)
    try:
        yield
    finally:
        _listener.reset(token)
