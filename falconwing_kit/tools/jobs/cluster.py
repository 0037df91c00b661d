"""Cluster: items -> results, by the workers of a running scheduler of `distributed`.

    dask scheduler                                     on one machine; prints its address tcp://...
    dask worker tcp://... --nworkers 4 --nthreads 1    on each machine, with the same kit installed

Every client of a scheduler can run any code on its workers: use a trusted network, or give both
commands certificates and an address that begins with tls://.
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
TIMEOUT_S = 30.0  # for the scheduler to answer, and for the first worker
_execution_lock = threading.Lock()  # in a worker's process, whatever --nthreads says


def map_on_cluster(
    function: Callable[[Item], Result], items: Sequence[Item], address: str
) -> Iterator[tuple[Item, Result | WorkerLostError]]:
    """Each item with its result, in the order of completion; items of a lost worker are repeated.

    A WorkerLostError replaces the result of an item whose workers were lost repeatedly.

    Args:
        function: importable by its name in the workers' kit.
        items: can be pickled; paths in them must be valid on the workers.
        address: of the scheduler.

    Raises:
        InputError: no scheduler answers, it has no workers, or a worker has another version of the
            kit.
        Exception: raised by the function; the other items are abandoned.
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
            client.cancel(list(futures), reason="abandoned")


def run_on_every_worker(function: Callable[[], Result], address: str) -> dict[str, Result]:
    """Results of a function called once on each worker, by the worker's address.

    Raises:
        InputError: no scheduler answers, or it has no workers.
        Exception: raised by the function.
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
            f"--cluster {address}: expected a scheduler of distributed there, none answers; "
            f"{advice}"
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
    """On the worker: one item at a time, and only with the client's version of the kit."""
    if version != __version__:
        raise InputError(
            f"--cluster: expected version {version} of the kit on every worker, "
            f"one has {__version__}"
        )
    with _execution_lock:
        return function(item)
