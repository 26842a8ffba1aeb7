"""Evaluation in cache-sized blocks on a small thread pool.

::

    inputs (any shape) --broadcast--> blocks --function, in threads--> outputs (same shape)
"""

import math
from functools import cache

import numpy as np
from astropy.utils.masked import Masked

from wpdc_gwcs.threads import count_threads, map_threads

__all__ = ["BLOCK_SIZE", "evaluate_blocks", "run_blocks"]

#: Points per block where one thread works: the work arrays stay in a core's second-level cache.
BLOCK_SIZE = 16384

# Number of points in a block for several threads.  A thread that has to wait for the interpreter
# lock loses about 50 us, which is rare with blocks of this size.
_THREADED_BLOCK_SIZE = 131072

# With fewer points, threads take more time than they save.
_THREADED_SIZE = 65536

# glibc returns freed memory to the system and has to get it again for the next block, unless a
# block of up to 32 MB has been freed before: then it keeps twice as much.  Elsewhere, this has no
# effect.
_KEEP_BYTES = 31 * 2**20


@cache
def _keep_freed_memory():
    np.empty(_KEEP_BYTES, dtype=np.uint8)


def run_blocks(function, size, *, weight=1):
    """Call ``function(start, stop)`` for blocks of ``range(size)``, in threads if that saves time.

    Parameters
    ----------
    function : callable
        Called once for each block; blocks are independent of each other.
    size : int
        Number of elements.
    weight : int, optional
        Points in each element, for example the length of a row.
    """
    _keep_freed_memory()
    n_threads = count_threads() if size * weight >= _THREADED_SIZE else 1
    if n_threads == 1:
        step = max(1, BLOCK_SIZE // weight)
    else:
        # The same number of blocks for each thread.
        n_blocks = n_threads * math.ceil(size * weight / (_THREADED_BLOCK_SIZE * n_threads))
        step = max(1, math.ceil(size / n_blocks))
    starts = range(0, size, step)
    if n_threads == 1:
        for start in starts:
            function(start, min(start + step, size))
        return

    def work(first):
        # Interleaved rather than halved: a stretch of slow blocks is shared.
        for start in starts[first::n_threads]:
            function(start, min(start + step, size))

    # Starting two threads costs less than one block.
    map_threads(work, range(n_threads))


def evaluate_blocks(function, *inputs, n_outputs=2):
    """Call ``function(*inputs, *outputs)`` for inputs of any shape, block by block.

    Parameters
    ----------
    function : callable
        Function of contiguous 1-D float64 arrays: the inputs, and the outputs that it writes.
    *inputs : array_like
        Inputs that broadcast: scalars, empty or multi-dimensional arrays.  Elements that are masked
        in one of them are masked in all outputs.
    n_outputs : int, optional
        Number of outputs.

    Returns
    -------
    outputs : tuple of ndarray
        Outputs with the broadcast shape of the inputs (zero-dimensional for scalars); masked arrays
        of numpy or of astropy if an input is one.
    """
    if all(isinstance(value, (float, int)) for value in inputs):
        # A fast path for one point, as in a loop over objects.
        outputs = [np.empty(1) for _ in range(n_outputs)]
        function(*[np.array((value,), dtype=np.float64) for value in inputs], *outputs)
        return tuple([output.reshape(()) for output in outputs])
    if any(hasattr(value, "mask") for value in inputs):
        return _evaluate_masked(function, inputs, n_outputs)
    inputs = [np.asarray(value) for value in inputs]
    if any(value.shape != inputs[0].shape for value in inputs):
        inputs = np.broadcast_arrays(*inputs)
    shape = inputs[0].shape
    flat = [value.reshape(-1) for value in inputs]
    outputs = [np.empty(shape) for _ in range(n_outputs)]
    flat_outputs = [output.reshape(-1) for output in outputs]

    def run(start, stop):
        blocks = [np.ascontiguousarray(value[start:stop], dtype=np.float64) for value in flat]
        function(*blocks, *(output[start:stop] for output in flat_outputs))

    if flat[0].size <= BLOCK_SIZE:
        run(0, flat[0].size)
    else:
        run_blocks(run, flat[0].size)
    return tuple(outputs)


def _evaluate_masked(function, inputs, n_outputs):
    """Evaluate masked elements, too, and apply the masks of all inputs to the outputs."""
    in_numpy = any(isinstance(value, np.ma.MaskedArray) for value in inputs)
    masks = [np.asarray(getattr(value, "mask", False)) for value in inputs]
    plain = [
        value.data if isinstance(value, np.ma.MaskedArray) else getattr(value, "unmasked", value)
        for value in inputs
    ]
    outputs = evaluate_blocks(function, *plain, n_outputs=n_outputs)
    mask = np.broadcast_to(np.logical_or.reduce(np.broadcast_arrays(*masks)), outputs[0].shape)
    if in_numpy:
        return tuple(np.ma.array(output, mask=mask.copy()) for output in outputs)
    return tuple(Masked(output, mask=mask.copy()) for output in outputs)
