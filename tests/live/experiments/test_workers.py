"""Where trials run changes nothing: one process, two, two nodes of a cluster, a worker that is killed on the way."""

from __future__ import annotations

import contextlib
import importlib.util
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from experiments.common import pool, ray_workers
from experiments.common.checkpoint import Checkpoint
from experiments.common.workers import Trial, Workers
from runtime.errors import InputRefused
from tests.codes import coded
from tests.experiments.mortal_trials import (
    QUIET,
    always_killed,
    mortal,
    plant_jobs,
    process_id,
    slow_square,
    square_jobs,
    table,
    table_of_one_process,
)

ROOT = Path(__file__).parents[3]
INTERRUPTED = """
import sys
from pathlib import Path
from rich.console import Console
from experiments.common import pool, ray_workers
from experiments.common.checkpoint import Checkpoint
from experiments.common.workers import Workers
from tests.experiments.mortal_trials import slow_square, square_jobs
if __name__ == "__main__":
    with Checkpoint(Path(sys.argv[1]), "run") as kept:
        pool.run(slow_square, square_jobs(200), kept, Workers(2), "squares", Console(quiet=True))
"""

ORPHANING = """
import sys
from functools import partial
from pathlib import Path
from rich.console import Console
from experiments.common import pool
from experiments.common.checkpoint import Checkpoint
from experiments.common.workers import Workers
from tests.experiments.mortal_trials import endless, square_jobs
if __name__ == "__main__":
    with Checkpoint(Path(sys.argv[1]), "run") as kept:
        pool.run(partial(endless, Path(sys.argv[2])), square_jobs(2), kept, Workers(2), "", Console(quiet=True))
"""


def test_workers_that_are_killed_again_and_again_end_the_run_with_a_sentence(tmp_path: Path) -> None:
    with pytest.raises(InputRefused, check=coded("experiment.worker-killed")):
        table(tmp_path / "trials.jsonl", always_killed, Workers(2), square_jobs(3))


def test_ctrl_c_keeps_the_finished_trials_and_leaves_no_process(tmp_path: Path) -> None:
    kept = tmp_path / "trials.jsonl"
    command = [sys.executable, "-c", INTERRUPTED, str(kept)]
    with subprocess.Popen(command, cwd=ROOT, stderr=subprocess.PIPE, start_new_session=True) as process:
        while process.poll() is None and (not kept.exists() or kept.read_bytes().count(b"\n") < 3):
            time.sleep(0.05)
        os.killpg(process.pid, signal.SIGINT)  # as a terminal does: to the workers, too
        assert process.wait(timeout=30) != 0
        assert process.stderr is not None
        told = process.stderr.read().decode()
    assert told.count("Traceback") == 1 and told.rstrip().endswith("KeyboardInterrupt"), told
    with pytest.raises(ProcessLookupError):  # nobody is left in the session
        for _ in range(100):
            os.killpg(process.pid, 0)
            time.sleep(0.1)
    ran: list[int] = []
    with Checkpoint(kept, "run") as again:
        done = len(again.done)
        outcomes = pool.run(
            lambda job: ran.append(job.seed) or job.seed**2, square_jobs(20), again, Workers(), "", QUIET
        )
    assert done >= 3 and len(ran) == 20 - done and list(outcomes.values()) == [i * i for i in range(20)]


def test_workers_whose_parent_is_killed_end_with_it(tmp_path: Path) -> None:
    began = tmp_path / "began"
    command = [sys.executable, "-c", ORPHANING, str(tmp_path / "trials.jsonl"), str(began)]
    with subprocess.Popen(command, cwd=ROOT, start_new_session=True) as process:
        try:
            while process.poll() is None and not began.exists():
                time.sleep(0.05)
            process.kill()
            process.wait(timeout=30)
            with pytest.raises(ProcessLookupError):  # nobody is left in the session
                for _ in range(100):
                    os.killpg(process.pid, 0)
                    time.sleep(0.1)
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)


def test_every_trial_comes_with_its_cost_and_a_kept_one_with_that_of_then(tmp_path: Path) -> None:
    first: list[Trial] = []
    with Checkpoint(tmp_path / "trials.jsonl", "run", stays=True) as kept:
        pool.run(slow_square, square_jobs(2), kept, Workers(2, trials=first), "trials", QUIET)
    assert [t.outcome for t in first] == [0, 1] and all(t.cost and 0.5 <= t.cost.seconds < 5.0 for t in first)
    second: list[Trial] = []
    with Checkpoint(tmp_path / "trials.jsonl", "run", stays=True) as kept:
        pool.run(slow_square, square_jobs(2), kept, Workers(2, trials=second), "trials", QUIET)
    assert second == first
    assert all(t.cost and t.cost.peak_bytes > 2**20 for t in second)


def test_without_ray_the_sentence_says_how_to_install_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(InputRefused, check=coded("experiment.ray-missing")):
        table(tmp_path / "trials.jsonl", slow_square, Workers(ray="auto"), square_jobs(1))


needs_ray = pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="Ray is not installed (extra cluster)")


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    """A cluster of two nodes on this computer, one processor each."""
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    # On a busy host a node needs longer than Ray waits by itself.
    os.environ.update({"RAY_raylet_start_wait_time_s": "240", "RAY_agent_register_timeout_ms": "240000"})
    os.environ["PYTHONPATH"] = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    import ray
    from ray.cluster_utils import Cluster

    node = {"num_cpus": 1, "object_store_memory": 80 * 2**20}
    try:
        made = Cluster(initialize_head=True, head_node_args={**node, **free_ports(), "include_dashboard": False})
        made.add_node(**node, **free_ports())
    except Exception as error:
        if "timed out during startup" not in str(error):
            raise
        pytest.skip("Ray did not start: its agent gets 15 s by Ray's own limit, and this host is too busy for that")
    yield made
    session = made.head_node.get_session_dir_path()
    ray.shutdown()
    made.shutdown()
    shutil.rmtree(session, ignore_errors=True)


def free_ports() -> dict[str, int]:
    """Ports for a node: one that is given is not waited for."""
    names = ("metrics_agent_port", "runtime_env_agent_port", "dashboard_agent_listen_port")
    found = [socket.socket() for _ in names]
    for each in found:
        each.bind(("127.0.0.1", 0))
    ports = {name: each.getsockname()[1] for name, each in zip(names, found, strict=True)}
    for each in found:
        each.close()
    return ports


def meet(folder: Path, name: str) -> str:
    """Wait until two have begun; the node of this one."""
    import ray

    (folder / f"met-{name}").touch()
    limit = time.monotonic() + 60.0
    while len(list(folder.glob("met-*"))) < 2:
        assert time.monotonic() < limit, "nobody else works"
        time.sleep(0.05)
    return str(ray.get_runtime_context().get_node_id())


@needs_ray
@pytest.mark.timeout(600)
def test_a_cluster_of_two_nodes_gives_the_same_bytes_with_a_worker_killed_on_the_way(
    tmp_path: Path, cluster: Any
) -> None:
    trials: list[Trial] = []
    there = table(
        tmp_path / "a.jsonl", mortal(tmp_path / "marker"), Workers(ray=cluster.address, trials=trials), plant_jobs()
    )
    assert (tmp_path / "marker").exists() and there == table_of_one_process(tmp_path)
    met = ray_workers.completed({name: partial(meet, tmp_path, name) for name in "ab"}, cluster.address, lambda: "ours")
    assert len({node for _, node in met}) == 2, "each node works, at the same time"
    with pytest.raises(InputRefused, check=coded("experiment.node-differs")):
        list(ray_workers.completed({"a": partial(slow_square, square_jobs(1)[0])}, cluster.address, process_id))
