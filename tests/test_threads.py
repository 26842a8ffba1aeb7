"""Threads change nothing but the time."""

import os
import subprocess
import sys
import threading

import numpy as np
import pytest

from wpdc_gwcs.threads import count_threads, map_threads, share_processors


def test_results_come_in_the_order_of_the_items(monkeypatch):
    monkeypatch.setattr("wpdc_gwcs.threads.count_threads", lambda: 3)
    matrices = np.random.default_rng(1).normal(size=(20, 30, 30))
    expected = [np.linalg.det(matrix) for matrix in matrices]
    assert map_threads(np.linalg.det, iter(matrices)) == expected
    assert map_threads(np.linalg.det, []) == []


def test_items_are_worked_on_at_the_same_time(monkeypatch):
    monkeypatch.setattr("wpdc_gwcs.threads.count_threads", lambda: 2)
    both = threading.Barrier(2, timeout=30)
    assert sorted(map_threads(lambda _: both.wait(), "ab")) == [0, 1]


def test_one_item_stays_in_its_thread():
    assert map_threads(lambda _: threading.current_thread(), "a") == [threading.current_thread()]


def test_errors_come_through(monkeypatch):
    monkeypatch.setattr("wpdc_gwcs.threads.count_threads", lambda: 2)
    with pytest.raises(ZeroDivisionError):
        map_threads(lambda value: 1 / value, [1, 0, 2])


def test_threads_are_few():
    assert 1 <= count_threads() <= 4


def test_processes_share_the_processors(monkeypatch):
    monkeypatch.setattr("wpdc_gwcs.threads._n_processes", 1)
    monkeypatch.setattr("os.sched_getaffinity", lambda _: range(6), raising=False)
    assert count_threads() == 4
    for n_processes, n_threads in ((2, 3), (6, 1), (8, 1)):
        share_processors(n_processes)
        assert count_threads() == n_threads


@pytest.mark.parametrize("given", [None, "2"])
def test_command_line_starts_no_threads_of_linear_algebra(given):
    """OpenBLAS starts as many threads as there are processors, unless a user says how many."""
    code = (
        "from wpdc_gwcs.__main__ import prepare; prepare(); import numpy, os, threadpoolctl; "
        "print(os.environ['OPENBLAS_NUM_THREADS'], max([pool['num_threads'] for pool in "
        "threadpoolctl.threadpool_info() if pool['internal_api'] == 'openblas'], default=1))"
    )
    environment = {k: v for k, v in os.environ.items() if not k.endswith("_NUM_THREADS")}
    if given is not None:
        environment["OPENBLAS_NUM_THREADS"] = given
    ran = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True
    )
    variable, threads = ran.stdout.split()
    assert variable == (given or "1")
    assert int(threads) <= int(variable)
