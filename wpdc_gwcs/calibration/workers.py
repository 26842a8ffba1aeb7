"""Workers that measure, match and write frames: this process, other processes, or an executor.

::

    Task --submit--> (this process | process of a thread | executor) --> MatchedFrame or FailedFrame
    items --map--> (this process | processes of the threads) --> results

Each process is driven by a thread through a pipe.  It ends when the pipe or the parent ends, for
whatever reason.  A process that dies affects only its current frame.
"""

import contextlib
import os
import signal
import threading
import time
import traceback
import warnings
from collections.abc import Mapping
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing import connection, get_context, parent_process, resource_tracker
from multiprocessing.reduction import ForkingPickler
from pickle import PicklingError

from astropy.table import Table

from wpdc_gwcs.calibration.matched import (
    FailedFrame,
    catalog_of_frame,
    match_frame,
)
from wpdc_gwcs.calibration.measure import measure_sources
from wpdc_gwcs.calibration.settings import Settings
from wpdc_gwcs.exceptions import (
    ClusterError,
    FitError,
    FrameFailure,
    InternalError,
    WPDCError,
    WPDCWarning,
    without_frames,
)
from wpdc_gwcs.frame import Frame
from wpdc_gwcs.threads import one_blas_thread, share_processors

__all__ = ["Task", "Workers", "internal_error", "stored_of", "without_maps"]

# A process may die for a temporary reason, for example memory used by others.
_TRIES = 2
# Tasks per worker: no worker is idle, and few results have to wait.
_IN_HAND = 2
# Assumed number of workers of an executor that does not tell it.
_WORKERS = 32
# Seconds to wait for the end of a killed process, after which it is left to the system.
_PATIENCE = 5.0


@dataclass(frozen=True, eq=False)
class Task:
    """A frame to match with its settings and catalog, and its sources if already measured."""

    frame: Frame
    settings: Settings
    catalog: Table
    solution: object | None = None
    sources: Table | None = None

    def alone(self):
        """Return the task with only the needed part of the catalog.

        Returns
        -------
        Task
            Task with the same result.
        """
        stored = stored_of(self.solution, self.frame.detector)
        near = catalog_of_frame(self.frame, self.catalog, self.settings, solution=stored)
        return replace(self, catalog=near, solution=stored)


def stored_of(solution, detector):
    """Select the stored solution of a detector from one or many.

    Parameters
    ----------
    solution : DistortionSolution, mapping or None
        One solution, or solutions by detector.
    detector : str
        Name of the detector.

    Returns
    -------
    DistortionSolution or None
        None if there is none.
    """
    return solution.get(detector) if isinstance(solution, Mapping) else solution


def without_maps(solution):
    """Return stored solutions without their residual maps, which are most of their size.

    Parameters
    ----------
    solution : DistortionSolution, mapping or None
        One solution, or solutions by detector.

    Returns
    -------
    DistortionSolution, dict or None
        The same, for all that does not update them.
    """
    if isinstance(solution, Mapping):
        return {name: without_maps(one) for name, one in solution.items()}
    return None if solution is None else replace(solution, residual_map=None)


def internal_error(problem):
    """Return the error of a frame for an unexpected exception.

    Parameters
    ----------
    problem : Exception
        The exception.

    Returns
    -------
    InternalError
        Error whose ``details`` are the traceback.
    """
    text = " ".join(str(problem).split())
    return InternalError(
        f"internal error: {type(problem).__name__}: {text}",
        "".join(traceback.format_exception(problem)),
    )


@one_blas_thread
def match_or_fail(task):
    """Measure and match a frame.

    Parameters
    ----------
    task : Task
        The frame.

    Returns
    -------
    MatchedFrame or FailedFrame
        The result, in any case.
    """
    began = time.perf_counter()
    frame, sources = task.frame, task.sources
    try:
        stored = _stored_for(task.solution, frame)
        if sources is None:
            sources = measure_sources(frame, task.settings)
        found = match_frame(frame, task.catalog, task.settings, sources=sources, solution=stored)
        return replace(found, seconds=time.perf_counter() - began)
    except WPDCError as err:
        error = err
    except Exception as problem:  # noqa: BLE001  One frame must not end the whole run.
        error = internal_error(problem)
    n_sources = 0 if sources is None else len(sources)
    # The sources may be the cause of an internal error.
    kept = None if isinstance(error, InternalError) else sources
    return FailedFrame(without_frames(error), n_sources, time.perf_counter() - began, kept)


def _stored_for(solution, frame):
    """Find the stored solution of a frame; raise an error if it is for another detector."""
    solution = stored_of(solution, frame.detector)
    if solution is not None and tuple(solution.image_shape) != tuple(frame.image_shape):
        raise FitError(
            f"{frame.source}: the frame has shape (ny, nx) {tuple(frame.image_shape)}, the stored "
            f"solution has {tuple(solution.image_shape)}"
        )
    if solution is not None and frame.detector != solution.detector:
        raise FitError(
            f"{frame.source}: the frame is from detector {frame.detector!r}, the stored solution "
            f"for {solution.detector!r}; if these are the same, say so (--detector "
            f"{solution.detector})"
        )
    return solution


class Workers:
    """Workers as a context manager; at its end, everything that it started ends.

    Parameters
    ----------
    jobs : int
        Number of processes; 1 for this process only.
    executor : concurrent.futures.Executor, optional
        Executor for the tasks instead.
    """

    def __init__(self, jobs, executor=None):
        self._executor = executor
        self._jobs = jobs
        self._threads = None
        self._mine = threading.local()
        self._processes = set()
        self._closed = False
        self._futures = set()
        if executor is None and jobs > 1:
            if hasattr(signal, "pthread_sigmask"):
                # Otherwise the first new process would start it, and then receive Ctrl-C.
                resource_tracker.ensure_running()
            self._threads = ThreadPoolExecutor(jobs, initializer=_ignore_interrupts)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._closed = True
        # A copy: a future that is canceled leaves the set.
        for future in list(self._futures):
            future.cancel()
        for process in list(self._processes):
            process.end()
        if self._threads is not None:
            self._threads.shutdown(cancel_futures=True)

    @property
    def in_hand(self):
        """Number of tasks to start so that no worker is idle."""
        if self._executor is not None:
            return _IN_HAND * getattr(self._executor, "n_workers", _WORKERS)
        return _IN_HAND * self._jobs if self._threads is not None else 0

    def submit(self, task):
        """Start a task.

        Parameters
        ----------
        task : Task
            The frame.

        Returns
        -------
        callable
            Waits for the `MatchedFrame` or `FailedFrame` and returns it.

        Raises
        ------
        ClusterError
            If the executor has no workers left; also raised by the callable.
        """
        if self._threads is not None:
            future = self._threads.submit(self._match, task)
        elif self._executor is not None:
            try:
                future = self._executor.submit(match_or_fail, task.alone())
            except ClusterError:
                raise
            except Exception as problem:  # noqa: BLE001  As in `match_or_fail`.
                return partial(FailedFrame, internal_error(problem), 0, 0.0)
        else:
            return partial(match_or_fail, task)
        self._futures.add(future)
        return partial(self._outcome, future)

    def start(self, function, item):
        """Start any work that can be handed to another process.

        Parameters
        ----------
        function : callable
            Of one item, at the top of a module.
        item : object
            The item.

        Returns
        -------
        concurrent.futures.Future or None
            Its result; None if there are no workers.
        """
        try:
            if self._threads is not None:
                future = self._threads.submit(self._call, function, item)
            elif self._executor is not None:
                future = self._executor.submit(function, item)
            else:
                return None
        except Exception as problem:  # noqa: BLE001  The future has the problem.
            future = Future()
            future.set_exception(problem)
        self._futures.add(future)
        future.add_done_callback(self._futures.discard)
        return future

    def _call(self, function, item):
        """Call a function in the process of this thread."""
        return _result_of(self._ask(ForkingPickler.dumps((function, item))))

    def _outcome(self, future):
        try:
            answer = future.result()
        except ClusterError:
            # There are no workers for other frames either.
            raise
        except Exception as problem:  # noqa: BLE001  Such as the death of a worker of an executor.
            return FailedFrame(internal_error(problem), 0, 0.0)
        finally:
            # The future would keep the result.
            self._futures.discard(future)
        if self._threads is None:
            return answer
        return _result_of(answer)

    def map(self, function, items):
        """Call a function for each item; in the processes, if there are any and they are idle.

        Parameters
        ----------
        function : callable
            Of one item, at the top of a module; called again if its process dies.  It works on
            this machine, also where an executor measures and matches.
        items : list
            The items.

        Returns
        -------
        list
            Its results.

        Raises
        ------
        WPDCError
            What the function raises; an `InternalError` if a process dies again and again.
        """
        if self._threads is None or self._futures or len(items) < 2:
            return [function(item) for item in items]
        futures = [self._threads.submit(self._call, function, item) for item in items]
        try:
            return [future.result() for future in futures]
        finally:
            for future in futures:
                future.cancel()

    def _match(self, task):
        """Match a frame in the process of this thread."""
        try:
            message = ForkingPickler.dumps((match_or_fail, task.alone()))
        except (PicklingError, TypeError, AttributeError, ValueError) as problem:
            reason = " ".join(str(problem).split())
            failure = FrameFailure(
                f"{task.frame.source or task.frame.name}: the frame cannot be handed to another "
                f"process ({reason}): use one job"
            )
            return FailedFrame(failure, 0, 0.0), []
        try:
            return self._ask(message)
        except InternalError as error:
            return FailedFrame(error, 0, 0.0), []

    def _ask(self, message):
        """Hand work to the process of this thread, or to a new one if that has died."""
        for _ in range(_TRIES):
            process = getattr(self._mine, "process", None)
            if process is None:
                process = self._mine.process = _Process(self._jobs)
                self._processes.add(process)
            try:
                if self._closed:
                    raise EOFError
                return process.ask(message)
            except (EOFError, OSError):
                self._mine.process = None
                self._processes.discard(process)
                status = process.end()
                if self._closed:
                    raise CancelledError from None
        raise InternalError(
            f"internal error: its process died {_TRIES} times, exit status {status} "
            "(-9: killed, usually because memory ran out)"
        )


def _result_of(answer):
    """Take the result from the answer of a process; its warnings and errors become ours."""
    result, messages = answer
    for message in messages:
        warnings.warn(message)
    if isinstance(result, WPDCError):
        raise result
    return result


def _ignore_interrupts():
    # Ctrl-C goes to all processes of a terminal.  Processes started by this thread inherit that it
    # is blocked, and end with their parent.
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})


class _Process:
    """A process and the pipe to it."""

    def __init__(self, jobs):
        context = get_context("spawn")
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(theirs, jobs), daemon=True)
        self._process.start()
        theirs.close()

    def ask(self, message):
        self._pipe.send_bytes(message)
        return self._pipe.recv()

    def end(self):
        """End the process, and return its exit status."""
        self._process.kill()
        self._process.join(_PATIENCE)
        with contextlib.suppress(OSError):
            self._pipe.close()
        return self._process.exitcode


def _serve(pipe, jobs):
    """Work until the parent or the pipe ends, as one of so many processes."""
    share_processors(jobs)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    with contextlib.suppress(EOFError, OSError):
        while True:
            function, item = pipe.recv()
            with warnings.catch_warnings(record=True) as caught:
                warnings.simplefilter("always")
                try:
                    result = function(item)
                except WPDCError as error:
                    result = without_frames(error)
                except Exception as problem:  # noqa: BLE001  As in `match_or_fail`.
                    result = internal_error(problem)
            # Our own warnings are about the user's data; those of libraries are about code.
            ours = [w.message for w in caught if issubclass(w.category, WPDCWarning)]
            pipe.send((result, ours))


def _end_with_parent():
    """Exit when the parent ends, even in the middle of the work."""
    connection.wait([parent_process().sentinel])
    os._exit(1)
