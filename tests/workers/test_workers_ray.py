"""Jobs on a Ray cluster of two nodes: the answers of one process, whatever happens to the workers."""

from __future__ import annotations

import os
import shutil
import signal
import socket
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests._processes import below
from tests._reach import GOOD, bundle_of
from vlatool.accuracy.success_comparison import Outcome
from vlatool.bundle.bundle import Bundle
from vlatool.episodes.jobs import disturbances_of, run_jobs
from vlatool.episodes.play import EpisodesJob
from vlatool.errors import DataError, InputError, SourceError, TargetError
from vlatool.stage.base import Context
from vlatool.workers import launcher

ROOT = Path(__file__).parents[2]
LOOPBACK = "127.0.0.2"
"""Ray takes 127.0.0.1 for the machine's other address."""
STEP = "        self.steps += 1\n"
OLD = "0.0.1"
"""Version of onnxruntime that the second node says it has."""
ray = pytest.importorskip("ray", reason="ray is not installed (extra 'ray')")


@dataclass(frozen=True)
class Nodes:
    """A cluster of two nodes with a processor and a cache each."""

    address: str
    caches: tuple[Path, Path]


@pytest.fixture(scope="module")
def nodes(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Nodes]:
    from ray.cluster_utils import Cluster

    place = tmp_path_factory.mktemp("nodes")
    caches = place / "first", place / "second"
    old = place / f"old/onnxruntime-{OLD}.dist-info"
    old.mkdir(parents=True)
    (old / "METADATA").write_text(f"Metadata-Version: 2.1\nName: onnxruntime\nVersion: {OLD}\n")
    sockets = tempfile.mkdtemp(prefix="ray-", dir="/tmp")  # the names of sockets are short
    paths = [str(ROOT), os.pathsep.join((str(ROOT), str(old.parent)))]
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RAY_USAGE_STATS_ENABLED", "0")
        patch.setenv("RAY_TMPDIR", sockets)  # where it notes the address of the cluster, in a folder that must be there
        Path(sockets, "ray").mkdir()
        arguments = [
            {"num_cpus": 1, "node_ip_address": LOOPBACK, "object_store_memory": 80 << 20,
             "env_vars": {"VLATOOL_CACHE": str(cache), "PYTHONPATH": path}}
            for cache, path in zip(caches, paths, strict=True)
        ]  # fmt: skip
        first = {**arguments[0], "include_dashboard": False, "temp_dir": sockets}
        handler = signal.getsignal(signal.SIGTERM)  # a node takes it for itself, and keeps it when it is gone
        cluster = Cluster(initialize_head=True, head_node_args=first)
        try:
            cluster.add_node(**arguments[1])
            patch.setenv("RAY_ADDRESS", cluster.address)
            yield Nodes(cluster.address, caches)
        finally:
            ray.shutdown()
            cluster.shutdown()
            signal.signal(signal.SIGTERM, handler)
            shutil.rmtree(sockets, ignore_errors=True)


@pytest.fixture(scope="module")
def bundle(tmp_path_factory: pytest.TempPathFactory) -> Bundle:
    return bundle_of(tmp_path_factory.mktemp("ray") / "good", GOOD)


def jobs(folder: Path, count: int = 10) -> list[EpisodesJob]:
    tasks = ("near", "far")
    return [EpisodesJob("environment.py:make", str(folder), tasks[at % 2], (at, at + 100)) for at in range(count)]


def alone(bundle: Bundle, asked: list[EpisodesJob]) -> list[Outcome]:
    return run_jobs(bundle, asked, "", Context())


def changed(bundle: Bundle, folder: Path, code: str) -> Path:
    """Write the environment with something else in each step."""
    folder.mkdir()
    text = (bundle.path.parent / "policy/environment.py").read_text()
    assert STEP in text
    (folder / "environment.py").write_text(text.replace(STEP, STEP + f"        {code}\n"))
    return folder


def test_two_nodes_give_the_rows_of_one_process_and_say_how_they_differ(nodes: Nodes, bundle: Bundle):
    asked = jobs(bundle.path.parent / "policy")
    wanted = alone(bundle, asked)
    for _ in range(8):  # a node that is slow to start leaves all to the other
        notes: list[str] = []
        context = Context(launcher="ray", workers=0, note=notes.append)
        assert run_jobs(bundle, asked, "", context) == wanted
        sent = [{path.name for path in (cache / "shipped").glob("*/*")} for cache in nodes.caches]
        if all(sent):
            break
    for found in sent:
        assert {"environment.py", "manifest.json"} <= found, "each node has a copy of its own"
    (noted,) = notes
    assert f"onnxruntime {OLD}" in noted
    assert disturbances_of(bundle, asked[0], context)[-1] == "push"


@pytest.mark.soak("the rows of two nodes; a command that is killed: tests/episodes/test_episodes_kept.py")
def test_a_worker_that_is_killed_loses_nothing(nodes: Nodes, bundle: Bundle):
    asked = jobs(bundle.path.parent / "policy", 16)
    told: list[str] = []

    def tell(what: str, _share: float | None) -> None:
        told.append(what)
        if sum("succeed" in line for line in told) == 1 and "succeed" in what:
            below(os.getpid(), "ray::RemoteWorker")[0].kill()

    assert run_jobs(bundle, asked, "", Context(tell, launcher="ray", workers=0)) == alone(bundle, asked)
    assert any("a worker of the Ray cluster was lost" in line for line in told)


@pytest.mark.soak("the rows of two nodes; environments that fail here: tests/episodes")
@pytest.mark.parametrize(("code", "error"), [
    ("raise RuntimeError(f'no display in {__file__}')", DataError), ("import os; os._exit(3)", SourceError),
])  # fmt: skip
def test_an_environment_that_fails_fails_as_it_does_here(nodes: Nodes, bundle: Bundle, tmp_path: Path, code, error):
    asked = jobs(changed(bundle, tmp_path / "broken", code), 3)
    found: list[InputError] = []
    for context in (Context(), Context(launcher="ray", workers=0)):
        with pytest.raises(error) as caught:
            run_jobs(bundle, asked, "", context)
        found.append(caught.value)
    assert (found[0].message, found[0].fix) == (found[1].message, found[1].fix)


@pytest.mark.soak("a worker that is killed once, and a policy's process that dies")
def test_an_environment_that_takes_each_worker_with_it_is_told(nodes: Nodes, bundle: Bundle, tmp_path: Path):
    folder = changed(bundle, tmp_path / "deadly", "import os, signal; os.kill(os.getpid(), signal.SIGKILL)")
    with pytest.raises(SourceError, match=r"was killed \(SIGKILL\) before it was done, 3 times in a row"):
        run_jobs(bundle, jobs(folder, 1), "", Context(launcher="ray", workers=0))


def test_no_cluster_is_said_at_once(monkeypatch: pytest.MonkeyPatch):
    ray.shutdown()
    with socket.socket() as free:
        free.bind((LOOPBACK, 0))
        address = f"{LOOPBACK}:{free.getsockname()[1]}"
    monkeypatch.setenv("RAY_ADDRESS", address)
    with pytest.raises(TargetError, match=f"No Ray cluster answers at {address}") as caught:
        launcher("ray", 0).check()
    assert "ray start --head" in caught.value.fix
