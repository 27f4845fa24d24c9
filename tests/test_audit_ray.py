"""An audit on a Ray cluster of two nodes gives what one process gives, also if a node dies.

Ray is no part of ``make setup``: ``.tools/bin/uv pip install 'ray>=2.40'`` lets these tests run.
"""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest
from msgspec.structs import replace

from dexkit.conformance.audit.audit import Audit, AuditProgress, Limits, in_this_process
from dexkit.conformance.audit.cluster import Cluster as RayCluster
from dexkit.conformance.audit.journal import Journal
from dexkit.conformance.audit.records import EpisodeRecord
from dexkit.errors import ConformanceError, UsageError
from dexkit.traces import sample_path

FILES = 12
LOOPBACK = "127.0.0.2"
"""Clients of Ray replace 127.0.0.1 by an address that other machines reach."""


def test_missing_ray_is_reported_with_its_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(UsageError, match="needs Ray"):
        RayCluster("auto", Limits())


def test_cluster_of_this_machine_has_a_token(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its servers listen on every address, and run the code that they are given."""
    asked: list[tuple[str, Any, str, str]] = []

    def init(address: str, **options: Any) -> None:
        mode, token = os.environ["RAY_AUTH_MODE"], os.environ["RAY_AUTH_TOKEN"]
        asked.append((address, options["include_dashboard"], mode, token))

    ray = SimpleNamespace(
        __version__="2.60.0", init=init, remote=lambda **options: lambda function: function
    )
    monkeypatch.setitem(sys.modules, "ray", ray)
    for name in ("RAY_AUTH_MODE", "RAY_AUTH_TOKEN"):
        monkeypatch.setenv(name, "")  # as before, afterwards
    for _ in range(2):
        RayCluster("local", Limits())
    (first, second) = asked
    assert first[:3] == second[:3] == ("local", False, "token")
    assert len({first[3], second[3]}) == 2
    assert len(first[3]) == 64
    ray.__version__ = "2.51.1"
    with pytest.raises(UsageError, match="would run code for every network"):
        RayCluster("local", Limits())
    assert len(asked) == 2


@pytest.mark.soak
def test_nobody_else_runs_code_on_the_cluster_of_this_machine() -> None:
    pytest.importorskip("ray", reason="install it: .tools/bin/uv pip install 'ray>=2.52'")
    script = """
import os, subprocess, sys
from dexkit.conformance.audit.audit import Limits
from dexkit.conformance.audit.cluster import Cluster
Cluster("local", Limits())
import ray
address = ray.get_runtime_context().gcs_address
client = f"import ray; ray.init('{address}', log_to_driver=False); print(ray.get(ray.put(7)))"
for names in (), ("RAY_AUTH_MODE", "RAY_AUTH_TOKEN"):
    env = {k: v for k, v in os.environ.items() if k not in names}
    done = subprocess.run([sys.executable, "-c", client], env=env, capture_output=True, text=True)
    print(done.returncode, done.stdout.strip())
"""
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=False
    )
    assert done.stdout == "0 7\n1 \n", (done.stdout, done.stderr)


@pytest.fixture
def two_nodes(monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[Any, Any]]:
    """A cluster of two raylets on the loopback interface, and its second node."""
    pytest.importorskip("ray", reason="install it: .tools/bin/uv pip install 'ray>=2.40'")
    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
    from ray.cluster_utils import Cluster

    about = {"num_cpus": 1, "node_ip_address": LOOPBACK, "object_store_memory": 80 * 2**20}
    cluster = Cluster(initialize_head=True, head_node_args={**about, "include_dashboard": False})
    try:
        second = cluster.add_node(**about)
        cluster.wait_for_nodes()
        yield cluster, second
    finally:
        cluster.shutdown()


def archive(folder: Path) -> Path:
    for number in range(FILES):
        sample = ("dex1_pick_place", "dex1_hand_dropout", "dex3_pinch")[number % 3]
        path = folder / f"{number:02}.mcap"
        path.parent.mkdir(exist_ok=True)
        shutil.copyfile(sample_path(sample), path)
    (folder / "99.mcap").write_text("no recording")
    return folder


def records(out: Path) -> dict[str, EpisodeRecord]:
    """The records, and that no file has two."""
    lines = (out / "journal.jsonl").read_text().splitlines()[1:]
    with Journal(out / "journal.jsonl") as journal:
        found = {name: journal.read(entry) for name, entry in journal.entries.items()}
    assert len(lines) == len(found)
    return {
        name: replace(r, facts={k: v for k, v in r.facts.items() if k != "cpu_s"})
        for name, r in found.items()
    }


@pytest.mark.soak
def test_a_node_is_killed_and_nothing_is_lost_or_done_twice(
    tmp_path: Path, two_nodes: tuple[Any, Any]
) -> None:
    cluster, second = two_nodes
    files = archive(tmp_path / "archive")
    killed: list[int] = []

    def kill_a_node(outcome: AuditProgress) -> None:
        if outcome.done == 3:
            cluster.remove_node(second, allow_graceful=False)
            killed.append(outcome.done)

    audit = Audit([str(files)], tmp_path / "ray", parquet=False)
    outcome = audit.run(RayCluster(cluster.address, Limits()).run, progress=kill_a_node)
    assert killed == [3]
    assert (outcome.done, outcome.total, outcome.stopped) == (FILES + 1, FILES + 1, False)
    Audit([str(files)], tmp_path / "one", parquet=False).run(in_this_process)
    assert records(tmp_path / "ray") == records(tmp_path / "one")


def test_missing_ray_cluster_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", ModuleType("ray"))
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    with pytest.raises(ConformanceError, match="no Ray cluster"):
        RayCluster(f"127.0.0.1:{port}", Limits())


def test_a_head_node_that_only_listens_at_127_0_0_1_is_named(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Ray itself would look for it at the machine's own address, for minutes."""
    ray, util = ModuleType("ray"), ModuleType("ray.util")
    util.get_node_ip_address = lambda: "127.0.0.3"  # type: ignore[attr-defined]
    ray.util = util  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "ray", ray)
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        with pytest.raises(ConformanceError, match=r"looks for it at 127\.0\.0\.3.*127\.0\.0\.2"):
            RayCluster(f"127.0.0.1:{port}", Limits())
