"""``vlatool serve``: what it refuses, that it serves, and how it ends."""

from __future__ import annotations

import json
import os
import signal
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from _arm_bundle import arm_bundle
from websockets.sync.client import connect

from vlatool.cli import serve as command
from vlatool.runtime.openpi_messages import pack, unpack


@pytest.fixture(scope="module")
def arm(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bundle for seven joints; read only."""
    return arm_bundle(tmp_path_factory.mktemp("served") / "arm").path


@pytest.mark.parametrize(("words", "code", "message"), [
    (["--host", "0.0.0.0"], 2, "there is no key"),
    (["--protocol", "opnpi"], 2, "did you mean 'openpi'"),
    (["--protocol", ","], 2, "protocols are ','"),
    (["--protocol", "openpi,openpi"], 2, "name each once"),
    (["--map", "q"], 2, "NAME=RECORDED"),
    (["--map", "picture=q"], 2, "no input 'picture'"),
    (["--key", "missing"], 3, "cannot be read"),
    (["--deadline-ms", "-1"], 2, "deadline_ms"),
    (["--execute", "9"], 2, "execute is 9"),
    (["--robot", "ur5e"], 2, "elements"),
    (["--robot", "nobody"], 3, "Unknown robot"),
    (["--records", "missing/requests.jsonl"], 3, "cannot be written"),
])  # fmt: skip
def test_what_cannot_be_served_is_refused(
    vlatool: Any, arm: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: list[str], code: int,
    message: str,
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    got, out, err = vlatool("serve", arm, *words)
    assert (got, out) == (code, "")
    assert message in err


def test_a_key_that_is_empty_or_short_is_refused(vlatool: Any, arm: Path, tmp_path: Path) -> None:
    for text, code, message in (("", 3, "it is empty"), ("\n", 3, "it is empty"), ("short", 2, "16 or more")):
        (tmp_path / "key").write_text(text)
        got, _, err = vlatool("serve", arm, "--key", tmp_path / "key")
        assert (got, message in err) == (code, True)


def stopped_after(
    monkeypatch: pytest.MonkeyPatch, use: Callable[[str], None], number: signal.Signals
) -> list[BaseException]:
    """Let a thread use what is served as soon as it is, and send a signal; returns what it raised."""
    raised: list[BaseException] = []

    def work(address: str) -> None:
        try:
            use(address)
        except BaseException as error:
            raised.append(error)
        os.kill(os.getpid(), number)

    def echo(text: str, **options: Any) -> None:
        if text.startswith("openpi: "):
            threading.Thread(target=work, args=(text.removeprefix("openpi: "),)).start()
        else:
            said(text, **options)

    said = command.typer.echo

    monkeypatch.setattr(command.typer, "echo", echo)
    return raised


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_it_serves_until_a_signal_ends_it(
    vlatool: Any, arm: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: signal.Signals
) -> None:
    answers: list[Any] = []
    observation = {"joints": np.float32([0, -0.5, 0, -2, 0, 1.5, 0.7])}

    def use(address: str) -> None:
        with connect(address, proxy=None) as connection:
            connection.recv(10)
            connection.send(pack(observation))
            frame = connection.recv(10)
            answers.append(unpack(frame) if isinstance(frame, bytes) else frame)

    raised = stopped_after(monkeypatch, use, number)
    records = tmp_path / "requests.jsonl"
    code, out, err = vlatool("serve", arm, "--port", 0, "--threads", 1, "--map", "q=joints",
                             "--robot", "franka-panda",
                             "--records", records, "--deadline-ms", 5000, "--json")  # fmt: skip
    assert (code, err, raised) == (0, "", []), answers
    found = json.loads(out)
    assert (found["requests"], found["missed"], found["failed"]) == (1, 0, 0), answers
    assert answers[0]["actions"].shape == (3, 7)
    assert json.loads(records.read_text())["error"] == ""
    assert list(found["addresses"]) == ["openpi"]
