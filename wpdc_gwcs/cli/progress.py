"""Progress bar on a terminal; nothing in a pipe."""

import sys
from contextlib import contextmanager

__all__ = ["progress_bar"]


@contextmanager
def progress_bar(*, quiet=False):
    """Show a progress bar on standard error, if that is a terminal.

    Parameters
    ----------
    quiet : bool, optional
        Show nothing even on a terminal.

    Yields
    ------
    callable
        Function to call as ``progress(stage, done, total)``.
    """
    if quiet or not sys.stderr.isatty():
        yield lambda stage, done, total: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (
        TextColumn("{task.description:>10}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
    )
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        tasks = {}

        def progress(stage, done, total):
            # Stages of a frame have no total: they share one line.
            name = stage if total else None
            if name not in tasks:
                tasks[name] = bar.add_task(stage, total=total or None)
            # Refresh at once: long calls in C would block the refresh thread.
            bar.update(tasks[name], completed=done, description=stage, refresh=True)

        yield progress
