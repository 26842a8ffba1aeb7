"""Where frames are measured and matched: here, in processes of our own, or in an executor.

::

    Task --submit--> (this process | process of a thread | executor) --> MatchedFrame or FailedFrame

Each process is driven by a thread and talks to it through a pipe: it ends when the pipe or the
parent does, whatever ends the parent, and a process that dies takes nothing with it but the frame
that it had.
"""

import contextlib
import os
import signal
import threading
import time
import traceback
import warnings
from collections.abc import Mapping
from concurrent.futures import CancelledError, ThreadPoolExecutor
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
from wpdc_gwcs.threads import one_blas_thread

__all__ = ["Task", "Workers", "internal_error", "stored_of"]

# A process may die of something that passes, memory that others took for example.
_TRIES = 2
# Tasks in hand for each that works on them: none waits for work, few results for their turn.
_IN_HAND = 2
# Those who work for an executor that does not tell how many they are.
_WORKERS = 32
# Processes that are killed end at once; one that does not in this time, s, is left to the system.
_PATIENCE = 5.0


@dataclass(frozen=True, eq=False)
class Task:
    """A frame to be matched, how and against what; its sources where they have been measured."""

    frame: Frame
    settings: Settings
    catalog: Table
    solution: object | None = None
    sources: Table | None = None

    def alone(self):
        """Task that carries no more of the catalog than it needs.

        Returns
        -------
        Task
            With the same result.
        """
        stored = stored_of(self.solution, self.frame.detector)
        near = catalog_of_frame(self.frame, self.catalog, self.settings, solution=stored)
        return replace(self, catalog=near, solution=stored)


def stored_of(solution, detector):
    """Pick the stored solution of a detector: solutions come alone or by detector.

    Parameters
    ----------
    solution : DistortionSolution, mapping or None
        One or many.
    detector : str
        Name of the detector.

    Returns
    -------
    DistortionSolution or None
        None where there is none.
    """
    return solution.get(detector) if isinstance(solution, Mapping) else solution


def internal_error(problem):
    """Error of a frame in which something happened that nobody thought of.

    Parameters
    ----------
    problem : Exception
        What happened.

    Returns
    -------
    InternalError
        Its ``details`` are the traceback.
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
        Whatever happens.
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
    except Exception as problem:  # noqa: BLE001  One frame is not to end the run of all.
        error = internal_error(problem)
    n_sources = 0 if sources is None else len(sources)
    # Nobody can tell what is wrong with sources that met an internal error.
    kept = None if isinstance(error, InternalError) else sources
    return FailedFrame(without_frames(error), n_sources, time.perf_counter() - began, kept)


def _stored_for(solution, frame):
    """Find the stored solution of a frame, and refuse one of another detector."""
    solution = stored_of(solution, frame.detector)
    if solution is not None and tuple(solution.image_shape) != tuple(frame.image_shape):
        raise FitError(
            f"{frame.source}: the frame has shape (ny, nx) {tuple(frame.image_shape)}, the stored "
            f"solution is for {tuple(solution.image_shape)}"
        )
    if solution is not None and frame.detector != solution.detector:
        raise FitError(
            f"{frame.source}: the frame is of detector {frame.detector!r}, the stored solution of "
            f"{solution.detector!r}; if they are one, name it (--detector {solution.detector})"
        )
    return solution


class Workers:
    """Where tasks are done; a context manager, whose end is the end of all that it has begun.

    Parameters
    ----------
    jobs : int
        Processes; 1 for none but this one.
    executor : concurrent.futures.Executor, optional
        Where tasks are done instead.
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
                # Else the first process to be started starts it, and hears Ctrl-C thereafter.
                resource_tracker.ensure_running()
            self._threads = ThreadPoolExecutor(jobs, initializer=_ignore_interrupts)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._closed = True
        for future in self._futures:
            future.cancel()
        for process in list(self._processes):
            process.end()
        if self._threads is not None:
            self._threads.shutdown(cancel_futures=True)

    @property
    def in_hand(self):
        """How many tasks should be in hand, so that nobody waits for one."""
        if self._executor is not None:
            return _IN_HAND * getattr(self._executor, "n_workers", _WORKERS)
        return _IN_HAND * self._jobs if self._threads is not None else 0

    def submit(self, task):
        """Have a task done.

        Parameters
        ----------
        task : Task
            The frame.

        Returns
        -------
        callable
            Returns the `MatchedFrame` or `FailedFrame`, when it is there.

        Raises
        ------
        ClusterError
            If the executor has nobody left to do it; the same by the callable.
        """
        if self._threads is not None:
            future = self._threads.submit(self._in_process, task)
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

    def _outcome(self, future):
        try:
            answer = future.result()
        except ClusterError:
            # Nobody is there to do the other frames either.
            raise
        except Exception as problem:  # noqa: BLE001  Such as the death of a worker of an executor.
            return FailedFrame(internal_error(problem), 0, 0.0)
        finally:
            # It would keep what is asked for once.
            self._futures.discard(future)
        if self._threads is None:
            return answer
        result, messages = answer
        for message in messages:
            warnings.warn(message)
        return result

    def _in_process(self, task):
        """Done by a thread: hand the task to its process, a new one where that has died."""
        try:
            message = ForkingPickler.dumps(task.alone())
        except (PicklingError, TypeError, AttributeError, ValueError) as problem:
            reason = " ".join(str(problem).split())
            failure = FrameFailure(
                f"{task.frame.source or task.frame.name}: the frame cannot be handed to another "
                f"process ({reason}): use one job"
            )
            return FailedFrame(failure, 0, 0.0), []
        for _ in range(_TRIES):
            process = getattr(self._mine, "process", None)
            if process is None:
                process = self._mine.process = _Process()
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
        failure = InternalError(
            f"internal error: its process died {_TRIES} times, exit status {status} "
            "(-9: killed, mostly for want of memory)"
        )
        return FailedFrame(failure, 0, 0.0), []


def _ignore_interrupts():
    # Ctrl-C goes to all processes of a terminal.  Those that are started by this thread inherit
    # that they do not hear it, from their first moment on, and end with their parent.
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})


class _Process:
    """A process and the pipe to it."""

    def __init__(self):
        context = get_context("spawn")
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(theirs,), daemon=True)
        self._process.start()
        theirs.close()

    def ask(self, message):
        self._pipe.send_bytes(message)
        return self._pipe.recv()

    def end(self):
        """End the process, and tell its exit status."""
        self._process.kill()
        self._process.join(_PATIENCE)
        with contextlib.suppress(OSError):
            self._pipe.close()
        return self._process.exitcode


def _serve(pipe):
    """Work of a process, until its parent or the pipe ends."""
    threading.Thread(target=_end_with_parent, daemon=True).start()
    with contextlib.suppress(EOFError, OSError):
        while True:
            task = pipe.recv()
            with warnings.catch_warnings(record=True) as caught:
                warnings.simplefilter("always")
                result = match_or_fail(task)
            # Ours are about the user's data; those of libraries are about code.
            ours = [w.message for w in caught if issubclass(w.category, WPDCWarning)]
            pipe.send((result, ours))


def _end_with_parent():
    """Wait for the end of the parent, which may come in the middle of our work."""
    connection.wait([parent_process().sentinel])
    os._exit(1)
