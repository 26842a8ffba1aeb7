"""Announcement of the current stage of the work, for progress displays."""

from contextlib import contextmanager
from contextvars import ContextVar

__all__ = ["announce", "listening"]

_listener = ContextVar("listener", default=None)


def announce(stage):
    """Announce that a stage begins.

    Parameters
    ----------
    stage : str
        Name of the stage, one word.
    """
    listener = _listener.get()
    if listener is not None:
        listener(stage)


@contextmanager
def listening(listener):
    """Listen to announcements within a block, in this thread.

    Parameters
    ----------
    listener : callable
        Called with the names of stages.

    Yields
    ------
    None
        No value.
    """
    token = _listener.set(listener)
    try:
        yield
    finally:
        _listener.reset(token)
