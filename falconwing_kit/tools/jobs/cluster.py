"""A cluster: items in, results out, by the workers of a scheduler of `distributed` that somebody
started.

    dask scheduler                                        on one machine; it says its address, tcp://...
    dask worker tcp://... --nworkers 4 --nthreads 1       on each machine, with the same kit installed

Whoever reaches a scheduler can run anything on its workers: keep it within a network that you
trust, or give both commands certificates and an address that begins with tls://.
"""

import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, TypeVar

from falconwing_kit import __version__
from falconwing_kit.core.checks import InputError
from falconwing_kit.tools.jobs.pool import WorkerLostError

Item = TypeVar("Item")
Result = TypeVar("Result")
TIMEOUT_S = 30.0  # s for the scheduler to answer, and for a first worker to come
_execution_lock = threading.Lock()  # in a worker's process, whatever --nthreads says


def map_on_cluster(
    function: Callable[[Item], Result], items: Sequence[Item], address: str
) -> Iterator[tuple[Item, Result | WorkerLostError]]:
    """Do a function on many items.

    Args:
        function: is found by its name in the kit that the workers have.
        items: can be pickled; paths in them must lead to the same files for the workers.
        address: of the scheduler.

    Yields:
        Each item with its result, in the order of finishing; a WorkerLostError where the workers that had
        it were lost one after the other. What one lost worker was doing, the others take up.

    Raises:
        InputError: no scheduler answers, it has no workers, or a worker has another version of the
            kit.
        Exception: what the function raised; the others' work is dropped.
    """
    from distributed import as_completed
    from distributed.scheduler import KilledWorker

    with _client(address) as client:
        futures = {
            client.submit(_run_exclusively, function, item, __version__, pure=False): item
            for item in items
        }
        try:
            for future in as_completed(list(futures), loop=client.loop):
                raised = future.exception()
                if raised is not None and not isinstance(raised, KilledWorker):
                    raise raised
                lost = WorkerLostError("the workers that had this were lost one after the other")
                yield futures[future], lost if raised is not None else future.result()
        finally:
            client.cancel(list(futures), reason="nobody waits for it any more")


def run_on_every_worker(function: Callable[[], Result], address: str) -> dict[str, Result]:
    """Do a function once on each worker that a cluster has now.

    Args:
        function: is found by its name in the kit that the workers have.
        address: of the scheduler.

    Returns:
        The results, by the address of the worker.

    Raises:
        InputError: no scheduler answers, or it has no workers.
        Exception: what the function raised.
    """
    with _client(address) as client:
        return dict(client.run(function))


@contextmanager
def _client(address: str) -> Iterator[Any]:
    """A connection to a scheduler that has at least one worker."""
    from distributed import Client

    advice = f"start `dask scheduler`, then `dask worker {address} --nthreads 1`"
    try:
        client = Client(address, timeout=TIMEOUT_S, set_as_default=False)
    except (OSError, ValueError):
        raise InputError(
            f"--cluster {address}: expected a scheduler of distributed there, none answers; {advice}"
        ) from None
    with client:
        try:
            client.wait_for_workers(1, timeout=TIMEOUT_S)
        except TimeoutError:
            raise InputError(
                f"--cluster {address}: expected workers at this scheduler, found none; {advice}"
            ) from None
        yield client


def _run_exclusively(function: Callable[[Any], Any], item: Any, version: str) -> Any:
    """On the worker: one item at a time, and only with the kit that asked."""
    if version != __version__:
        raise InputError(
            f"--cluster: expected version {version} of the kit on every worker, one has {__version__}"
        )
    with _execution_lock:
        return function(item)
