"""Many tasks: what is kept is not done again, and neither workers nor clusters change a result."""

import json
import os
import signal
import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from falconwing_kit.core.checks import InputError
from falconwing_kit.tools.jobs.cluster import run_on_every_worker
from falconwing_kit.tools.jobs.pool import WorkerLostError
from falconwing_kit.tools.jobs.result_cache import cache_key
from falconwing_kit.tools.jobs.run import parallel_map
from tests import clusters


@dataclass(frozen=True)
class Task:
    """An item as verbs have them."""

    number: int
    place: Path


def square(task):
    """Leaves a mark for each time it worked."""
    with (task.place / f"done{task.number}").open("a") as mark:
        mark.write(f"{os.getpid()}\n")
    return {"square": task.number**2}


def slow_square(task):
    (task.place / f"begun{task.number}").write_text(str(os.getpid()))
    time.sleep(0.4)
    return {"square": task.number**2}


def kills_worker(number):
    if number == 3:
        os.kill(os.getpid(), signal.SIGKILL)
    return number


def fails(number):
    raise ValueError(f"no {number}")


def tasks(folder, count=6):
    folder.mkdir(exist_ok=True)
    return [Task(number, folder) for number in range(count)]


RIGHT = {n: {"square": n * n} for n in range(6)}  # by hand


def by_number(results):
    return {task.number: result for task, result in results}


def worked(folder):
    return sum(len(mark.read_text().split()) for mark in folder.glob("done*"))


def test_restart_goes_on_where_it_was(tmp_path):
    """Two results were taken before the run ended; the second run does the other four, and all are
    the same.
    """
    items, kept = tasks(tmp_path / "marks"), tmp_path / "kept"
    run = parallel_map(square, items, 1, out=kept)
    assert [next(run)[1], next(run)[1]] == [RIGHT[0], RIGHT[1]]
    run.close()
    assert by_number(parallel_map(square, items, 2, out=kept)) == RIGHT
    assert worked(tmp_path / "marks") == 6
    assert by_number(parallel_map(square, reversed(items), 1, out=kept)) == RIGHT
    assert worked(tmp_path / "marks") == 6


def test_shard_cut_short_is_made_again(tmp_path):
    """What a full disk or an editor left behind is no result."""
    items, kept = tasks(tmp_path / "marks"), tmp_path / "kept"
    list(parallel_map(square, items, 1, out=kept))
    shards = sorted(kept.glob("*.json"))
    assert len(shards) == 6
    shards[0].write_text('{"result": {"squ')
    shards[1].write_text(json.dumps([1]))
    assert by_number(parallel_map(square, items, 1, out=kept)) == RIGHT
    assert worked(tmp_path / "marks") == 8


def test_key_tells_all_tasks_apart():
    """Every pair differs in value or kind, so every fingerprint must; the same value twice has the
    same.
    """
    items = [1, 1.5, "1", True, None, b"1", Path("1"), [1], {"1": 1}, {1: 1},
             np.array([1.0]), np.array([[1.0]]),
             np.array([1]), Task(1, Path("a")), Task(1, Path("b"))]  # fmt: skip
    keys = [cache_key(square, item) for item in items]
    assert len(set(keys)) == len(items)
    assert cache_key(square, Task(1, Path("a"))) == keys[-2]
    functions = [square, slow_square, partial(square, 1), partial(square, 2), partial(square, x=1)]
    assert len({cache_key(function, 1) for function in functions}) == len(functions)
    with pytest.raises(TypeError, match="got object"):
        cache_key(square, object())


def test_result_that_json_cannot_say_is_refused(tmp_path):
    """An infinite number would come back as something else."""
    with pytest.raises(InputError, match="expected results of texts"):
        list(parallel_map(float, ["inf"], 1, out=tmp_path))


@pytest.fixture(scope="module")
def cluster(tmp_path_factory):
    """A scheduler's address, and how to start a worker."""
    pytest.importorskip("distributed")
    with clusters.running(tmp_path_factory.mktemp("cluster")) as found:
        yield found


def test_cluster_without_workers_is_refused(cluster, monkeypatch):
    """The sentence says how to start one; and another how to start a scheduler."""
    monkeypatch.setattr("falconwing_kit.tools.jobs.cluster.TIMEOUT_S", 0.5)
    with pytest.raises(
        InputError, match=r"expected workers at this scheduler, found none; start `dask scheduler`"
    ):
        list(parallel_map(square, [1], cluster=cluster[0]))
    with pytest.raises(InputError, match="none answers"):
        list(parallel_map(square, [1], cluster="tcp://127.0.0.1:9"))


def test_cluster_gives_the_same_and_outlives_a_worker(cluster, tmp_path):
    """By hand: squares. One of two workers is killed at work; the other repeats its items."""
    address, start_worker = cluster
    first = start_worker()
    assert (
        by_number(
            parallel_map(square, tasks(tmp_path / "calm"), cluster=address, out=tmp_path / "kept")
        )
        == RIGHT
    )
    second = start_worker()
    clusters.wait_for_workers(address, 2)
    run = parallel_map(slow_square, tasks(tmp_path / "marks"), cluster=address)
    done = [next(run)]
    first.kill()
    assert by_number([*done, *run]) == RIGHT
    assert set(run_on_every_worker(os.getpid, address).values()) == {second.pid}
    with pytest.raises(ValueError, match="no 1"):
        list(parallel_map(fails, [1, 1], cluster=address))


def test_item_that_kills_every_worker_is_given_up(cluster):
    """Each worker that takes it is lost; with new ones in time, the others are done."""
    address, start_worker = cluster
    for _ in range(5):
        start_worker()
    clusters.wait_for_workers(address, 5)
    results = dict(parallel_map(kills_worker, range(4), cluster=address))
    assert isinstance(results.pop(3), WorkerLostError)
    assert results == {0: 0, 1: 1, 2: 2}
