"""Evaluation in cache-sized blocks on a small thread pool.

::

    inputs (any shape) --broadcast--> blocks --function, in threads--> outputs (same shape)
"""

import os
from concurrent.futures import ThreadPoolExecutor

import numpy as np

__all__ = ["BLOCK_SIZE", "evaluate_blocks", "run_blocks"]

#: Points per block: the work arrays stay in a core's caches, and a step over them takes long enough
#: that threads seldom wait for each other's interpreter lock.
BLOCK_SIZE = 16384

# Below this many points the threads cost more than they bring.
_THREADED_SIZE = 4 * BLOCK_SIZE

_MAX_THREADS = 4


def _n_threads():
    if hasattr(os, "sched_getaffinity"):
        return min(_MAX_THREADS, len(os.sched_getaffinity(0)))
    return min(_MAX_THREADS, os.cpu_count() or 1)


def run_blocks(function, size, *, step=BLOCK_SIZE, threaded=None):
    """Call ``function(start, stop)`` over ``range(size)`` in blocks, threaded when there are many.

    Parameters
    ----------
    function : callable
        Called once for each block; blocks are independent of each other.
    size : int
        Number of elements.
    step : int, optional
        Elements per block.
    threaded : bool, optional
        Whether to use threads; by default when ``size`` is large.
    """
    starts = range(0, size, step)
    if threaded is None:
        threaded = size >= _THREADED_SIZE
    n_threads = min(_n_threads(), len(starts)) if threaded else 1
    if n_threads < 2:
        for start in starts:
            function(start, min(start + step, size))
        return

    def work(first):
        # Interleaved rather than halved: a stretch of slow blocks is shared.
        for start in starts[first::n_threads]:
            function(start, min(start + step, size))

    # A pool of its own for each call: nothing outlives the call, so forked children and nested
    # calls are safe, and starting two threads costs less than one block.
    with ThreadPoolExecutor(n_threads) as pool:
        list(pool.map(work, range(n_threads)))


def evaluate_blocks(function, *inputs, n_outputs=2):
    """Evaluate ``function(*blocks) -> outputs`` over inputs of any shape, block by block.

    Parameters
    ----------
    function : callable
        Takes contiguous 1-D float64 arrays and returns ``n_outputs`` arrays of the same length.
    *inputs : array_like
        Mutually broadcastable; scalars, empty and multi-dimensional arrays are welcome.
    n_outputs : int, optional
        Number of outputs.

    Returns
    -------
    outputs : tuple of ndarray
        Of the broadcast shape of the inputs (zero-dimensional for scalars).
    """
    inputs = [np.asarray(value) for value in inputs]
    if any(value.shape != inputs[0].shape for value in inputs):
        inputs = np.broadcast_arrays(*inputs)
    shape = inputs[0].shape
    flat = [value.reshape(-1) for value in inputs]
    size = flat[0].size

    def call(start, stop):
        blocks = [np.ascontiguousarray(value[start:stop], dtype=np.float64) for value in flat]
        # Infinite and absurd coordinates become NaN; that is the answer, not an accident.
        with np.errstate(all="ignore"):
            return function(*blocks)

    if size <= BLOCK_SIZE:
        return tuple(value.reshape(shape) for value in call(0, size))
    outputs = [np.empty(size) for _ in range(n_outputs)]

    def run(start, stop):
        for output, block in zip(outputs, call(start, stop), strict=True):
            output[start:stop] = block

    run_blocks(run, size)
    return tuple(output.reshape(shape) for output in outputs)
