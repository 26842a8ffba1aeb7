"""A Dask cluster as an executor that does not wait forever.

::

    submit --> the client's executor --> workers
                     |                      |
                     +--- future <--- watch: is there a scheduler, is there a worker?

Dask waits for workers without a limit, and reports the loss of its scheduler as canceled tasks.
Here, both end the run with an error that says so.  Results that have been written are kept.
"""

import contextlib
import logging
import threading
import time
import warnings
from concurrent.futures import Executor, Future
from functools import partial

from wpdc_gwcs.exceptions import ClusterError

__all__ = ["cluster_executor"]

log = logging.getLogger(__name__)

# How often workers are counted, s.
_PERIOD = 0.5
# A client may have no answer for this long, s, just because its machine is busy.
_BUSY = 10.0
_GO_ON = "results so far are kept: continue with --resume (resume=True)"


@contextlib.contextmanager
def cluster_executor(address, timeout):
    """Connect to the Dask cluster at an address.

    Parameters
    ----------
    address : str
        Address of its scheduler.
    timeout : float
        Seconds to wait for the scheduler, and for a worker whenever there is none.

    Yields
    ------
    concurrent.futures.Executor
        For `calibrate`.

    Raises
    ------
    ClusterError
        If Dask is not installed, no scheduler answers, or there is no worker for so long.  Later on
        it is raised by the futures.

    Examples
    --------
    >>> from wpdc_gwcs.calibration import cluster_executor
    >>> with cluster_executor("tcp://127.0.0.1:9", timeout=0.1):  # no scheduler there
    ...     pass
    Traceback (most recent call last):
        ...
    wpdc_gwcs.exceptions.ClusterError: ...
    """
    try:
        from dask.distributed import Client
    except ImportError as err:
        raise ClusterError(
            "--scheduler needs Dask, which is not installed: pip install 'wpdc_gwcs[dask]'"
        ) from err
    # Messages of Dask about lost connections are suppressed; the outcome is reported here.
    # Its configuration sets a separate level for the second logger.
    for name in ("distributed", "distributed.client"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
    began = time.monotonic()
    try:
        client = Client(address, timeout=timeout)
    except (OSError, ValueError, TimeoutError) as err:
        raise ClusterError(
            f"--scheduler {address}: no Dask scheduler answers there: {err}"
        ) from err
    with client:
        if not client.scheduler_info(n_workers=-1)["workers"]:
            log.warning(
                "%s: the Dask scheduler has no worker yet; waiting at most %g s", address, timeout
            )
            try:
                client.wait_for_workers(1, timeout=max(timeout - time.monotonic() + began, 0.1))
            except TimeoutError as err:
                raise ClusterError(
                    f"--scheduler {address}: must have a worker within {timeout:g} s, has none"
                ) from err
        pool = _WatchedExecutor(client, address, timeout)
        try:
            yield pool
        finally:
            pool.shutdown(wait=False)


class _WatchedExecutor(Executor):
    """Executor of a client whose futures fail when there are no workers."""

    def __init__(self, client, address, timeout):
        self._client, self._address, self._timeout = client, address, timeout
        self._pool = client.get_executor(pure=False)
        self._lock = threading.Lock()
        self._waiting = set()
        self._error = None
        self._ended = threading.Event()
        threading.Thread(target=self._watch, daemon=True).start()

    @property
    def n_workers(self):
        """Number of tasks that the workers do at a time, at the moment."""
        try:
            workers = self._client.scheduler_info(n_workers=-1).get("workers", {})
        except (OSError, RuntimeError, TimeoutError):
            return 1
        return max(1, sum(worker.get("nthreads", 1) for worker in workers.values()))

    def submit(self, fn, /, *args, **kwargs):
        from distributed.protocol.pickle import dumps

        future = Future()
        with self._lock:
            if self._error is not None:
                raise self._error
            self._waiting.add(future)
        with warnings.catch_warnings():
            # Frames that are solved together have about 10 MB, for which Dask issues a warning.
            warnings.filterwarnings("ignore", "Sending large graph", UserWarning)
            # Bytes: otherwise, the scheduler would make the objects too.
            inner = self._pool.submit(_call, dumps((fn, args, kwargs)))
        inner.add_done_callback(partial(self._pass_on, future))
        return future

    def shutdown(self, wait=True, *, cancel_futures=False):  # noqa: FBT002  As of Executor.
        self._ended.set()
        self._pool.shutdown(wait=wait)

    def _pass_on(self, future, inner):
        with self._lock:
            if future not in self._waiting:
                return
            self._waiting.discard(future)
        if not future.set_running_or_notify_cancel():
            return
        if inner.cancelled():
            future.set_exception(
                ClusterError(f"--scheduler {self._address}: the scheduler is gone; {_GO_ON}")
            )
        elif inner.exception() is not None:
            future.set_exception(inner.exception())
        else:
            future.set_result(inner.result())

    def _watch(self):
        """Count the workers, in a thread, and give up when there are none for too long."""
        since, said = None, False
        while not self._ended.wait(_PERIOD):
            if self._has_workers():
                since, said = None, False
                continue
            since = time.monotonic() if since is None else since
            waited = time.monotonic() - since
            if waited > self._timeout:
                self._give_up()
                return
            if waited > _BUSY and not said:
                said = True
                log.warning(
                    "%s: the Dask scheduler has had no worker for %.0f s; waiting at most %g s",
                    self._address,
                    waited,
                    self._timeout,
                )

    def _has_workers(self):
        try:
            # A client that has lost its scheduler knows no workers.
            return bool(self._client.scheduler_info(n_workers=-1).get("workers"))
        except (OSError, RuntimeError, TimeoutError):
            return False

    def _give_up(self):
        error = ClusterError(
            f"--scheduler {self._address}: all workers are gone, and none came back within "
            f"{self._timeout:g} s; {_GO_ON}"
        )
        with self._lock:
            self._error = error
            left, self._waiting = self._waiting, set()
        for future in left:
            if future.set_running_or_notify_cancel():
                future.set_exception(error)


def _call(message):
    """Call a function in a worker."""
    from distributed.protocol.pickle import loads

    function, args, kwargs = loads(message)
    return function(*args, **kwargs)
