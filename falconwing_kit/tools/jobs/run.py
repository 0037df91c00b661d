"""Many tasks: a function and its items in, each item with its result out, by processes here or by a
cluster.

The one way for every verb with many like tasks. Processes on this machine start in half a second;
`distributed`, which takes several seconds to start a cluster of its own, is for an existing cluster
that is named by its address.
"""

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TypeVar

from falconwing_kit.tools.jobs.pool import WorkerLostError, map_in_processes
from falconwing_kit.tools.jobs.shards import ResultCache

Item = TypeVar("Item")
Result = TypeVar("Result")


def parallel_map(
    function: Callable[[Item], Result],
    items: Sequence[Item],
    workers: int = 2,
    cluster: str = "",
    out: Path | None = None,
) -> Iterator[tuple[Item, Result | WorkerLostError]]:
    """Do a function on many items.

    Args:
        function: can be pickled by its name; its result depends on nothing but the item.
        items: can be pickled.
        workers: processes on this machine; 1 works in this process. Not used with a cluster.
        cluster: address of a scheduler of `distributed`, such as "tcp://10.0.0.5:8786"; empty for
            this machine.
        out: a folder that keeps every result as soon as it is there, so that a run that was killed
            goes on where it was; results must then be what JSON can say. None keeps nothing.

    Yields:
        Each item with its result: those that are kept already first, then in the order of
            finishing. The results do
        not depend on workers or cluster. A WorkerLostError stands in place of a result that several
        processes died of; it is not kept.

    Raises:
        InputError: the cluster cannot be reached, or a result cannot be kept.
        Exception: what the function raised; the others' work is dropped.
    """
    if out is None:
        yield from _map_uncached(function, items, workers, cluster)
        return
    shards = ResultCache(out, function)
    pending = []
    for item in items:
        cached = shards.read(item)
        if cached is None:
            pending.append(item)
        else:
            yield item, cached[0]
    for item, result in _map_uncached(function, pending, workers, cluster):
        yield item, (result if isinstance(result, WorkerLostError) else shards.write(item, result))


def _map_uncached(
    function: Callable[[Item], Result], items: Sequence[Item], workers: int, cluster: str
) -> Iterator[tuple[Item, Result | WorkerLostError]]:
    """Without keeping anything."""
    if not cluster:
        return map_in_processes(function, items, workers)
    from falconwing_kit.tools.jobs.cluster import map_on_cluster

    return map_on_cluster(function, items, cluster)
