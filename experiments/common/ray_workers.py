"""Work on a Ray cluster: the same pieces of work as on this computer, one processor each.

Every node needs the same checkout at the same place and the same libraries; a worker that has others refuses.  Ray runs
a piece of work again elsewhere when its process or its node dies.
"""

from __future__ import annotations

import functools
import logging
import os
import platform
from collections.abc import Callable, Iterator, Mapping
from typing import Any, Final

from runtime.errors import InputRefused

RETRIES: Final = 3
"""So many times a piece of work is begun again after the death of its process or node."""
WAITING_PER_CPU: Final = 2
NO_USAGE_REPORT: Final = ("RAY_USAGE_STATS_ENABLED", "0")
"""Ray tells its makers about every cluster unless this is set."""


def completed(
    work: Mapping[str, Callable[[], Any]], address: str, identity: Callable[[], str]
) -> Iterator[tuple[str, Any]]:
    """Yield name and result of every piece of work as it is done on the cluster at ``address`` ("auto": that of this
    node).

    ``identity`` names the sources and libraries of the process that calls it: workers must name the same as we do.

    Raises:
        InputRefused: Ray is not installed, no cluster answers, a node has other sources, or workers die repeatedly.
    """
    ray = connected(address)
    from ray.exceptions import NodeDiedError, OutOfMemoryError, RayTaskError, WorkerCrashedError

    task = ray.remote(num_cpus=1, max_retries=RETRIES)(_on_node)
    waiting: dict[Any, str] = {}
    ours, queue = _own(identity), iter(work.items())
    limit = WAITING_PER_CPU * max(1, int(ray.cluster_resources().get("CPU", 1)))
    try:
        while True:
            while len(waiting) < limit and (piece := next(queue, None)):
                waiting[task.remote(piece[1], identity, ours)] = piece[0]
            if not waiting:
                return
            for reference in ray.wait(list(waiting), num_returns=1)[0]:
                name = waiting.pop(reference)
                try:
                    result = ray.get(reference)
                except RayTaskError as error:
                    raise error.cause if isinstance(error.cause, Exception) else error from None
                except (WorkerCrashedError, NodeDiedError, OutOfMemoryError) as error:
                    raise InputRefused(
                        "experiment.worker-killed",
                        f"the process of {name} was killed {RETRIES + 1} times, as Ray does when a node's memory runs "
                        f"out ({type(error).__name__}): give the nodes fewer processors (ray start --num-cpus)",
                    ) from None
                yield name, result
    except BaseException:
        for reference in waiting:
            ray.cancel(reference, force=True)
        raise


def connected(address: str) -> Any:
    """Connect Ray to the cluster and return it.

    Raises:
        InputRefused: Ray is not installed, or no cluster answers there.
    """
    try:
        import ray
    except ImportError:
        raise InputRefused(
            "experiment.ray-missing", "Ray is not installed: pip install 'timberhand[cluster]', or leave out --ray"
        ) from None
    if not ray.is_initialized():
        os.environ.setdefault(*NO_USAGE_REPORT)
        try:
            # Ray gives a task of one processor one thread (OMP_NUM_THREADS), as joblib gives it to local workers.
            ray.init(address=address, logging_level=logging.ERROR, log_to_driver=False)
        except (ConnectionError, RuntimeError, ValueError) as error:
            raise InputRefused(
                "experiment.no-cluster",
                f"no Ray cluster answers at {address!r} ({str(error).splitlines()[0]}): start one with "
                "ray start --head, and run this command on one of its nodes",
            ) from None
    return ray


def _on_node(do: Callable[[], Any], identity: Callable[[], str], ours: str) -> Any:
    begin_worker()
    theirs = _own(identity)
    if theirs != ours:
        raise InputRefused(
            "experiment.node-differs",
            f"the node {platform.node()} has other sources or libraries ({theirs}) than this one ({ours}): give every "
            "node the same checkout and constraints.txt",
        )
    return do()


@functools.cache
def _own(identity: Callable[[], str]) -> str:
    """Name the Python version and identity, once per process: hashing the sources takes longer than a short trial."""
    return f"Python {platform.python_version()}, {identity()}"


@functools.cache
def begin_worker() -> None:
    """Prepare a worker process before anything else: keep its memory, as the local ones do."""
    from runtime.memory import keep_memory

    keep_memory()
