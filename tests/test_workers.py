"""Workers call functions in other processes as they would be called here."""

import os
import warnings
from functools import partial

import pytest

from wpdc_gwcs.calibration.workers import Workers
from wpdc_gwcs.exceptions import InputError, InternalError, WPDCWarning
from wpdc_gwcs.threads import count_threads


def _process_of(value):
    return value, os.getpid()


def _threads_of(value):
    return count_threads()


def _refuse(value):
    if value > 1:
        raise InputError(f"value must be at most 1, got {value}")
    return value


def _stumble(value):
    return 1 / value


def _warn(value):
    warnings.warn(f"value {value}", WPDCWarning)
    return value


def _die(first_time, value):
    if not first_time.exists():
        first_time.touch()
        os._exit(7)
    return value


def _die_always(value):
    os._exit(7)


@pytest.fixture(scope="module")
def two():
    with Workers(2) as workers:
        yield workers


def test_one_job_stays_in_this_process():
    with Workers(1) as workers:
        assert workers.map(_process_of, [3, 1]) == [(3, os.getpid()), (1, os.getpid())]


def test_two_jobs_are_other_processes(two):
    values, processes = zip(*two.map(_process_of, [4, 3, 2, 1]), strict=True)
    assert values == (4, 3, 2, 1)
    assert os.getpid() not in processes
    assert two.map(_process_of, []) == []


def test_processes_share_the_processors(two):
    affinity = getattr(os, "sched_getaffinity", None)
    n_processors = len(affinity(0)) if affinity else os.cpu_count()
    assert two.map(_threads_of, [1, 2]) == [max(1, min(4, n_processors // 2))] * 2


def test_busy_workers_are_left_alone(two):
    two._futures.add("another frame")
    try:
        assert two.map(_process_of, [1, 2]) == [(1, os.getpid()), (2, os.getpid())]
    finally:
        two._futures.clear()


def test_errors_and_warnings_come_through(two):
    with pytest.raises(InputError, match="value must be at most 1, got 2"):
        two.map(_refuse, [0, 1, 2, 3])
    with pytest.raises(InternalError, match="ZeroDivisionError"):
        two.map(_stumble, [1, 0])
    with pytest.warns(WPDCWarning, match="value [12]"):
        assert two.map(_warn, [1, 2]) == [1, 2]


def test_work_of_a_process_that_died_is_done_again(two, tmp_path):
    assert two.map(partial(_die, tmp_path / "died"), [1, 2, 3]) == [1, 2, 3]
    with pytest.raises(InternalError, match="its process died 2 times, exit status 7"):
        two.map(_die_always, [1, 2])
