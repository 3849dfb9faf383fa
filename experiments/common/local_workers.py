"""Work on the cores of this computer: joblib's processes, which outlive one call and are replaced when one is killed.

Workers ignore Ctrl-C: the parent ends them.  One whose parent was killed ends itself.
"""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing
from typing import Any, Final

from joblib import Parallel, delayed, parallel_config
from joblib.externals.loky import get_reusable_executor

from runtime.errors import InputRefused
from runtime.memory import keep_memory

WAITING_PER_WORKER: Final = 2
PARENT_CHECK_S: Final = 1.0
DEATHS: Final = 3
"""So many times in a row, without a finished trial in between, workers may be killed."""


def completed(work: Mapping[str, Callable[[], Any]], count: int) -> Iterator[tuple[str, Any]]:
    """Yield name and result of every piece of work as it is done, by ``count`` processes.

    Raises:
        InputRefused: workers are killed again and again.
    """
    left, deaths = dict(work), 0
    try:
        while left:
            with parallel_config("loky", n_jobs=count, inner_max_num_threads=1, initializer=_begin):
                dispatched = Parallel(
                    return_as="generator_unordered", pre_dispatch=WAITING_PER_WORKER * count, batch_size=1
                )
                results = dispatched(delayed(_named)(name, do) for name, do in list(left.items()))
                with closing(results):
                    try:
                        for name, result in results:
                            deaths = 0
                            del left[name]
                            yield name, result
                    except BrokenProcessPool:
                        deaths += 1
                        if deaths == DEATHS:
                            raise InputRefused(
                                "experiment.worker-killed",
                                f"worker processes were killed {DEATHS} times without a finished trial in between, "
                                "as the kernel does when memory runs out: give fewer --workers",
                            ) from None
    except BaseException:
        get_reusable_executor().shutdown(wait=True, kill_workers=True)
        raise


def _named(name: str, do: Callable[[], Any]) -> tuple[str, Any]:
    return name, do()


def _begin() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with, args=(os.getppid(),), daemon=True).start()
    keep_memory()  # as the detector process of the machine does, whose time is measured


def _end_with(parent: int) -> None:
    """End this process once its parent is gone: the trial it computes for nobody may take a quarter of an hour."""
    while os.getppid() == parent:
        time.sleep(PARENT_CHECK_S)
    os._exit(1)
