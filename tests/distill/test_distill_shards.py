"""A training whose processes hold parts of the weights, here and under torchrun: what one process would have made."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from _deep import write_deep
from _trainings import RECORDED, digest, distilled, killed_after, peers, training_of
from safetensors import safe_open
from safetensors.numpy import load_file

from vlatool.bundle.bundle import Bundle
from vlatool.errors import RecipeError, SourceError
from vlatool.machine.processes import import_path
from vlatool.prune.neurons import Neurons
from vlatool.sources.torch_module import TorchModule
from vlatool.stage.base import Context
from vlatool.stage.build import build_stage
from vlatool.stage.run import run_transform

pytestmark = pytest.mark.usefixtures("in_this_process")
TOLERANCE = 1e-3
"""Relative difference of losses and weights: sums are added in another order, and Adam divides by small numbers."""
ALL: dict[str, Any] = {**RECORDED, "steps": 6, "batch": 8, "threads": 2, "accumulate": 2, "patience": 3, "alpha": 0.5,
                       "features": 1.0}  # fmt: skip
"""Hints on blocks, an expert's term, held-out rows and parts of batches."""
BATCHED = ("reshape(1, 4, 2)", "reshape(-1, 4, 2)")


@pytest.fixture(scope="module")
def policy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_deep(tmp_path_factory.mktemp("deep") / "policy", BATCHED, layers=3)


@pytest.fixture(scope="module")
def pruned_deep(policy: Path, tmp_path_factory: pytest.TempPathFactory) -> Bundle:
    place = tmp_path_factory.mktemp("pruned")
    source = run_transform(TorchModule(policy=policy), None, place / "source", Context()).bundle
    return run_transform(Neurons(ratio=0.5), source, place / "pruned", Context()).bundle


def weights(made: Bundle) -> Mapping[str, Any]:
    return dict(sorted(load_file(made.path / "module/main.safetensors").items()))


def apart(made: Bundle, other: Bundle) -> tuple[float, float]:
    """Largest relative difference of a step's loss; relative L2 difference of the weights."""
    curves = [np.array(training_of(each)["losses"]) for each in (made, other)]
    flat = [np.concatenate([value.ravel() for value in weights(each).values()]) for each in (made, other)]
    return float(np.abs(curves[0] / curves[1] - 1).max()), float(
        np.linalg.norm(flat[0] - flat[1]) / np.linalg.norm(flat[1])
    )


@pytest.fixture(scope="module")
def two(pruned_deep: Bundle, tmp_path_factory: pytest.TempPathFactory) -> Bundle:
    """What two processes of this machine make, each with parts."""
    place = tmp_path_factory.mktemp("two")
    with pytest.MonkeyPatch.context() as patched:
        patched.setenv("VLATOOL_CACHE", str(place / "cache"))
        patched.setattr("vlatool.stage.run.run_in_child", lambda stage, *rest: stage.run(*rest))
        return distilled(pruned_deep, place / "out", processes=2, shard=True, **ALL)


def test_parts_train_as_one_process(
    pruned_deep: Bundle, two: Bundle, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    one = distilled(pruned_deep, tmp_path / "one", **ALL)
    curve, far = apart(two, one)
    with capsys.disabled():
        print(f"\n2 processes with parts, and 1: losses {curve:.1e}, weights {far:.1e} (allowed {TOLERANCE:.0e})")
    assert curve < TOLERANCE
    assert far < TOLERANCE
    scores = [training_of(made)["judged"]["scores"] for made in (one, two)]
    assert scores[1] == pytest.approx(scores[0], rel=TOLERANCE)
    assert weights(two).keys() == weights(one).keys()


def test_parts_go_on_after_a_kill_to_the_same_bits(pruned_deep: Bundle, two: Bundle, tmp_path: Path):
    killed = pytest.raises(SourceError, match=r"process 2 of 2: the process that ran it was killed \(SIGKILL\)")
    with killed_after(5, lambda: os.kill(peers()[0].pid, signal.SIGKILL)), killed:
        distilled(pruned_deep, tmp_path / "out", processes=2, shard=True, **ALL)
    (checkpoint,) = (tmp_path / "cache").rglob("checkpoint.safetensors")
    with safe_open(checkpoint, "pt") as opened:
        assert opened.metadata()["step"] == "3", "of the round before the kill"
    again = distilled(pruned_deep, tmp_path / "out", processes=2, shard=True, **ALL)
    assert digest(again) == digest(two)


def test_the_student_plays_with_the_weights_of_all(pruned_deep: Bundle, tmp_path: Path):
    options = {"steps": 4, "every": 2, "batch": 8, "episodes": 2, "student_episodes": 2, "threads": 2}
    one = distilled(pruned_deep, tmp_path / "one", **options)
    two = distilled(pruned_deep, tmp_path / "two", processes=2, shard=True, **options)
    rounds = [training_of(made)["rounds"] for made in (one, two)]
    assert len(rounds[0]) == 2
    assert rounds[0][1].pop("loss"), "of rows that one process alone runs"
    assert rounds[1] == rounds[0]
    assert max(apart(two, one)) < TOLERANCE


@pytest.mark.soak("the same parts as processes of one machine; torchrun's options in tests/cli")
def test_torchrun_trains_as_processes_of_one_machine_do(policy: Path, pruned_deep: Bundle, two: Bundle, tmp_path: Path):
    agents = [agent(rank, pruned_deep, policy, tmp_path) for rank in range(2)]
    said = [each.communicate(timeout=240)[0] for each in agents]
    assert [each.returncode for each in agents] == [0, 0], "\n".join(said)
    made = Bundle.open(tmp_path / "out")
    assert digest(made) == digest(two)
    assert training_of(made)["losses"] == training_of(two)["losses"]
    assert made.manifest.made_by["options"] == two.manifest.made_by["options"]


PORT: list[int] = []


def port() -> int:
    """A free port, the same for both agents."""
    if not PORT:
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            PORT.append(free.getsockname()[1])
    return PORT[0]


def agent(rank: int, source: Bundle, policy: Path, place: Path) -> subprocess.Popen[str]:
    """One of two agents of torchrun, as on a machine of its own; both listen on this one alone."""
    flags = [f"--{name.replace('_', '-')}={value}" for name, value in ALL.items()]
    launch = [
        "--nnodes=2",
        "--nproc-per-node=1",
        f"--node-rank={rank}",
        "--master-addr=127.0.0.1",
        f"--master-port={port()}",
    ]
    command = [
        "distill",
        "policy",
        str(source.path),
        "-o",
        str(place / "out"),
        "--trust",
        str(policy),
        "--shard",
        *flags,
    ]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(import_path()), "GLOO_SOCKET_IFNAME": "lo"}
    return subprocess.Popen([sys.executable, "-m", "torch.distributed.run", *launch, "-m", "vlatool", *command],
                            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=environment)  # fmt: skip


@pytest.mark.parametrize(("stage", "options", "words"), [
    ("distill.policy", {"shard": True}, "--shard lets several processes hold a part of the weights each; there is one"),
    ("distill.policy", {"shard": True, "processes": 2, "batch": 7},
     r"a batch of 7 makes no 2 equal parts \(processes 2, accumulate 1\)"),
    ("prune.gradual", {"shard": True, "processes": 2, "steps": 12, "batch": 6}, "--shard splits layers into parts"),
])  # fmt: skip
def test_parts_that_cannot_be_are_refused(pruned_deep: Bundle, stage: str, options: dict[str, Any], words: str):
    with pytest.raises(RecipeError, match=words):
        build_stage(stage, options).check(pruned_deep, None)
