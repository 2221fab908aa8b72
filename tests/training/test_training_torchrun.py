"""What torchrun says of a process, and what processes that follow the first one tell it."""

from __future__ import annotations

import socket
import threading
from collections.abc import Callable
from pathlib import Path

import pytest

from vlatool.errors import DataError, RecipeError, SourceError
from vlatool.training import torchrun
from vlatool.training.launcher import check_launch
from vlatool.training.torchrun import Follower, Launch, check_shared, current_launch, follow, lead, write_token

SAID = {"RANK": "1", "WORLD_SIZE": "4", "LOCAL_RANK": "1", "LOCAL_WORLD_SIZE": "2", "MASTER_ADDR": "10.0.0.7",
        "MASTER_PORT": "29500"}  # fmt: skip


@pytest.fixture
def said(monkeypatch: pytest.MonkeyPatch) -> pytest.MonkeyPatch:
    for name, value in SAID.items():
        monkeypatch.setenv(name, value)
    return monkeypatch


def test_what_torchrun_says_is_read(said: pytest.MonkeyPatch):
    assert current_launch() == Launch(1, 4, 1, 2, "10.0.0.7", 29500)
    assert not Launch(1, 4, 1, 2, "10.0.0.7", 29500).on_one_machine
    assert Launch(1, 4, 1, 2, "127.0.0.1", 29500).on_one_machine
    assert Launch(1, 2, 1, 2, "10.0.0.7", 29500).on_one_machine
    said.setenv("WORLD_SIZE", "1")
    assert current_launch() is None
    said.delenv("WORLD_SIZE")
    assert current_launch() is None


@pytest.mark.parametrize(("name", "value", "words"), [
    ("MASTER_ADDR", "", "MASTER_ADDR is 'not set'"),
    ("LOCAL_RANK", "", "LOCAL_RANK is 'not set'"),
    ("MASTER_PORT", "http", "MASTER_PORT is 'http'"),
    ("RANK", "first", "RANK is 'first'"),
    ("RANK", "4", "RANK=4 of WORLD_SIZE=4"),
    ("LOCAL_RANK", "2", "LOCAL_RANK=2 of LOCAL_WORLD_SIZE=2"),
    ("LOCAL_WORLD_SIZE", "8", "LOCAL_WORLD_SIZE=8"),
])  # fmt: skip
def test_what_torchrun_would_not_say_is_refused(said: pytest.MonkeyPatch, name: str, value: str, words: str):
    said.setenv(name, value)
    with pytest.raises(RecipeError, match=words) as caught:
        current_launch()
    assert "unset RANK and WORLD_SIZE" in caught.value.fix


@pytest.mark.parametrize(("rank", "size"), [(0, 2), (1, 4)])
def test_another_number_of_processes_is_refused(rank: int, size: int):
    with pytest.raises(RecipeError, match=f"this is number {rank + 1}; the training was asked for {size}"):
        check_launch(Launch(rank, 4, 0, 1, "127.0.0.1", 1), size)


def test_a_folder_that_is_not_seen_is_told(tmp_path: Path):
    job = {"place": str(tmp_path), "rank": 1, "size": 2, **write_token(tmp_path)}
    check_shared(job)
    with pytest.raises(RecipeError, match=r"Process 2 of 2 on .* runs torch [\d.]+.*, the first process 0\.1"):
        check_shared({**job, "versions": {"torch": "0.1"}})
    (tmp_path / torchrun.RENDEZVOUS).write_text("of another training")
    with pytest.raises(RecipeError, match=f"does not see the folder .* {tmp_path}") as caught:
        check_shared(job)
    assert "VLATOOL_CACHE" in caught.value.fix
    with pytest.raises(RecipeError, match="does not see the folder"):
        check_shared({**job, "place": str(tmp_path / "gone")})
    check_shared({})


def pair(monkeypatch: pytest.MonkeyPatch) -> tuple[Launch, Launch]:
    """The first of two processes, and the other one."""
    monkeypatch.setattr(torchrun, "START_S", 20.0)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    first, second = (Launch(rank, 2, rank, 2, "127.0.0.1", port) for rank in range(2))
    return first, second


def following(launch: Launch, ready: Callable[[], None]) -> tuple[threading.Thread, list[BaseException]]:
    """Follow in a thread, and keep what is raised there."""
    raised: list[BaseException] = []

    def run() -> None:
        try:
            follow(launch, "policy.py", ready)
        except BaseException as error:
            raised.append(error)

    thread = threading.Thread(target=run)
    thread.start()
    return thread, raised


def test_a_process_follows_until_the_command_is_over_and_tells_what_it_meets(monkeypatch: pytest.MonkeyPatch):
    first, second = pair(monkeypatch)
    with lead(first):
        thread, raised = following(second, lambda: None)
        with Follower(first, 1) as other, pytest.raises(SourceError, match=r"Process 2 of 2 \(.+\): .*AttributeError"):
            other.call("vlatool.training.rank_process:unknown", {}, None)
    thread.join(20)
    assert not thread.is_alive()
    assert not raised


def test_what_a_process_meets_before_it_follows_is_told(monkeypatch: pytest.MonkeyPatch):
    def fails() -> None:
        raise DataError("no policy here", "copy it")

    first, second = pair(monkeypatch)
    with lead(first):
        thread, raised = following(second, fails)
        with pytest.raises(DataError, match=r"Process 2 of 2 \(.+\): no policy here") as caught, Follower(first, 1):
            pass
        thread.join(20)
    assert caught.value.fix == "copy it"
    assert [type(error) for error in raised] == [DataError]


def test_a_process_that_does_not_come_or_is_gone_is_told(monkeypatch: pytest.MonkeyPatch):
    first, second = pair(monkeypatch)
    monkeypatch.setattr(torchrun, "START_S", 0.3)
    monkeypatch.setattr(torchrun, "LEFT_S", 0.2)
    silent = pytest.raises(SourceError, match="Process 2 of 2 of the training does not answer")
    with lead(first), silent as caught, Follower(first, 1):
        pass
    assert "goes on from the last checkpoint" in caught.value.fix
    with pytest.raises(SourceError, match=r"The store of torchrun at 127.0.0.1:\d+ does not answer"):
        second.store()
