"""Pool: every item has one result, also if processes are killed."""

import os
import signal
from functools import partial
from pathlib import Path

import pytest

from falconwing_kit.tools.jobs import pool
from falconwing_kit.tools.jobs.pool import WorkerLostError, map_in_processes


def square(number):
    return number * number


def fails(number):
    raise ValueError(f"no {number}")


def file_error(number):
    raise FileNotFoundError(f"no {number}")


def dies_once(number, folder):
    """Dies on the odd numbers, the first time."""
    mark = Path(folder, str(number))
    if number % 2 and not mark.exists():
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return number * number


def dies_on_three(number):
    if number == 3:
        os.kill(os.getpid(), signal.SIGKILL)
    return number * number


@pytest.mark.parametrize("workers", [1, 3])
def test_every_item_has_its_result(workers):
    """By hand: squares; in any order."""
    assert dict(map_in_processes(square, range(7), workers)) == {n: n * n for n in range(7)}
    assert list(map_in_processes(square, [], workers)) == []


@pytest.mark.parametrize("function", [fails, file_error])
def test_errors_come_out(function):
    """An error of the function is the caller's to see, an OSError too: it is not a lost process."""
    with pytest.raises((ValueError, FileNotFoundError), match="no 1"):
        list(map_in_processes(function, [1, 1], 2))


def renderer_threads(_):
    from numba import config

    return config.NUMBA_NUM_THREADS


@pytest.mark.parametrize(("available", "each"), [(8, 4), (3, 1), (1, 1)])
def test_processes_share_the_cores(monkeypatch, available, each):
    """By hand: two processes with half of the cores each, at least one; ours keeps what it has."""
    monkeypatch.delenv("NUMBA_NUM_THREADS", raising=False)
    monkeypatch.setattr(pool, "cores", lambda: available)
    assert dict(map_in_processes(renderer_threads, [0, 1], 2)) == {0: each, 1: each}
    assert "NUMBA_NUM_THREADS" not in os.environ
    monkeypatch.setenv("NUMBA_NUM_THREADS", "3")
    assert dict(map_in_processes(renderer_threads, [0, 1], 2)) == {0: 3, 1: 3}
    assert os.environ["NUMBA_NUM_THREADS"] == "3"


def test_lost_work_is_taken_up_again(tmp_path):
    """Each odd item kills its process once; all have their results in the end."""
    results = dict(map_in_processes(partial(dies_once, folder=str(tmp_path)), range(4), 2))
    assert results == {n: n * n for n in range(4)}


def test_item_that_always_kills_is_given_up():
    """Three times; the others are done."""
    results = dict(map_in_processes(dies_on_three, range(5), 2))
    assert isinstance(results.pop(3), WorkerLostError)
    assert results == {0: 0, 1: 1, 2: 4, 4: 16}
