"""Parallel map: a function and its items -> each item with its result, on processes or a cluster.

Processes on this machine start in half a second; `distributed` takes several seconds to start a
cluster of its own, so it is used for an existing cluster only.
"""

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TypeVar

from falconwing_kit.tools.jobs.pool import WorkerLostError, map_in_processes
from falconwing_kit.tools.jobs.result_cache import ResultCache

Item = TypeVar("Item")
Result = TypeVar("Result")


def parallel_map(
    function: Callable[[Item], Result],
    items: Sequence[Item],
    workers: int = 2,
    cluster: str = "",
    out: Path | None = None,
) -> Iterator[tuple[Item, Result | WorkerLostError]]:
    """Each item with its result: cached results first, then in the order of completion.

    The results do not depend on workers or cluster. A WorkerLostError replaces the result of an
    item that ended several processes; it is not cached.

    Args:
        function: can be pickled by its name; its result depends on the item only.
        items: can be pickled.
        workers: processes on this machine, 1 for this process; ignored with a cluster.
        cluster: address of a scheduler of `distributed`, such as "tcp://10.0.0.5:8786"; empty for
            this machine.
        out: a folder that caches every result immediately, so a killed run can be resumed; results
            must be valid JSON. None caches nothing.

    Raises:
        InputError: the cluster cannot be reached, or a result cannot be cached.
        Exception: raised by the function; the other items are abandoned.
    """
    if out is None:
        yield from _map_uncached(function, items, workers, cluster)
        return
    cache = ResultCache(out, function)
    pending = []
    for item in items:
        cached = cache.read(item)
        if cached is None:
            pending.append(item)
        else:
            yield item, cached[0]
    for item, result in _map_uncached(function, pending, workers, cluster):
        yield item, (result if isinstance(result, WorkerLostError) else cache.write(item, result))


def _map_uncached(
    function: Callable[[Item], Result], items: Sequence[Item], workers: int, cluster: str
) -> Iterator[tuple[Item, Result | WorkerLostError]]:
    """Each item with its result, without a cache."""
    if not cluster:
        return map_in_processes(function, items, workers)
    from falconwing_kit.tools.jobs.cluster import map_on_cluster

    return map_on_cluster(function, items, cluster)
