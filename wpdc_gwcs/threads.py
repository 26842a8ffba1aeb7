"""Threads for work without the interpreter lock, and one thread for linear algebra."""

import os
from concurrent.futures import ThreadPoolExecutor

from threadpoolctl import threadpool_limits

__all__ = ["count_threads", "map_threads", "one_blas_thread", "share_processors"]

_MAX_THREADS = 4
# Processes that share the processors.
_n_processes = 1

#: Decorator: while the function runs, linear algebra uses one thread.  The matrices are small and
#: many: threads gain little on an idle machine, and on a busy one they wait for each other several
#: (up to a thousand) times as long as the work takes.
one_blas_thread = threadpool_limits.wrap(limits=1, user_api="blas")


def count_threads():
    """Return the number of threads to use: one for each available processor, up to four.

    Returns
    -------
    int
        Number of threads.
    """
    if hasattr(os, "sched_getaffinity"):
        n_processors = len(os.sched_getaffinity(0))
    else:
        n_processors = os.cpu_count() or 1
    return max(1, min(_MAX_THREADS, n_processors // _n_processes))


def share_processors(n_processes):
    """Limit this process to its share of the processors.

    Parameters
    ----------
    n_processes : int
        Number of processes that work at the same time.
    """
    global _n_processes
    _n_processes = n_processes


def map_threads(function, items):
    """Call a function for each item, several at a time.

    Parameters
    ----------
    function : callable
        Function of one item.  Threads save time if it consists mostly of linear algebra and
        operations on large arrays.
    items : iterable
        The items, which are independent of each other.

    Returns
    -------
    list
        Results in the order of the items; they do not depend on the number of threads.
    """
    items = list(items)
    n_threads = min(count_threads(), len(items))
    if n_threads < 2:
        return [function(item) for item in items]
    # A separate pool for each call: nothing outlives the call, so forked children and nested calls
    # are safe.
    with ThreadPoolExecutor(n_threads) as pool:
        return list(pool.map(function, items))
