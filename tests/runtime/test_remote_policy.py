"""A policy on another machine: deadlines, lost connections, answers that come late, servers that change."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from _arm_bundle import arm_bundle
from _episodes_policy import CountingPolicy
from _fake_clock import FakeClock
from _numbered import NumberedPolicy, spec_of
from websockets.sync.server import Server, ServerConnection, serve

from vlatool.bundle.spec import PolicySpec, TensorSpec
from vlatool.errors import DataError, DeadlineMissed, ServingError, UsageError
from vlatool.runtime import load
from vlatool.runtime.control.deadline import Deadline
from vlatool.runtime.interface import Action
from vlatool.runtime.openpi_messages import pack, unpack
from vlatool.runtime.remote_policy import RemotePolicy
from vlatool.runtime.stack import Fallback, build_stack
from vlatool.serving import Access, Service
from vlatool.serving.openpi import OpenpiServer

KEY = "0123456789abcdef"
SPEC = spec_of(chunk=3, execute=2)


@pytest.fixture
def servers() -> Iterator[list[Any]]:
    """Those that a test started: closed at the end, the last one first."""
    started: list[Any] = []
    yield started
    for server in reversed(started):
        server.close()


def start(servers: list[Any], policy: Any = None, port: int = 0, key: str = "", **options: Any) -> str:
    server = OpenpiServer(Service(policy or CountingPolicy(), **options), Access(key=key), port)
    address = server.start()
    servers.append(server)
    return address


def remote(servers: list[Any], *given: Any, **options: Any) -> RemotePolicy:
    policy = RemotePolicy(*given, **options)
    servers.append(policy)
    return policy


class Foreign:
    """A server of openpi's protocol whose answers a test decides."""

    def __init__(self, answer: Callable[[ServerConnection, Any], None], metadata: Any = None) -> None:
        self._answer, self._metadata = answer, {} if metadata is None else metadata
        self._server: Server = serve(self._converse, "127.0.0.1", 0, compression=None)
        self.url = f"ws://127.0.0.1:{self._server.socket.getsockname()[1]}"
        self._thread = threading.Thread(target=self._server.serve_forever)
        self._thread.start()

    def _converse(self, connection: ServerConnection) -> None:
        connection.send(pack(self._metadata) if isinstance(self._metadata, dict) else self._metadata)
        for frame in connection:
            self._answer(connection, unpack(frame))

    def close(self) -> None:
        self._server.shutdown()
        self._thread.join()


def test_a_server_of_vlatool_says_what_it_serves(servers: list[Any]):
    address = start(servers, key=KEY, names={"t": "time.now"})
    policy = remote(servers, address, key=KEY)
    assert policy.spec == SPEC
    action = policy.infer({"t": 4, "unknown": 1})
    assert np.allclose(action.chunk, [[400.001, 400.501], [401.001, 401.501], [402.001, 402.501]])
    assert (action.chunk.dtype, action.labels, action.source, action.sequence) == (
        np.float32,
        ("x", "gripper"),
        "remote",
        0,
    )
    assert policy.infer({"t": 4}).chunk[0, 0] == pytest.approx(400.002)
    policy.reset()
    assert policy.infer({"t": 4}).chunk[0, 0] == pytest.approx(400.001)
    with pytest.raises(DataError, match="no 't'"):
        policy.infer({"x": 1})
    with pytest.raises(UsageError, match="noise"):
        policy.infer({"t": 1}, noise={})
    with pytest.raises(ServingError, match="401"):
        RemotePolicy(address, key=KEY[1:])


def test_a_server_of_others_needs_a_spec(servers: list[Any]):
    def answer(connection: ServerConnection, seen: Any) -> None:
        connection.send(pack({"actions": np.full((5, 2), seen["obs/t"], np.float64), "server_timing": {}}))

    foreign = Foreign(answer)
    servers.append(foreign)
    with pytest.raises(ServingError, match="does not say what its actions mean"):
        RemotePolicy(foreign.url)
    policy = remote(servers, foreign.url, SPEC, names={"t": "obs/t"})
    policy.reset()
    assert policy.infer({"t": 7}).chunk.tolist() == [[7, 7]] * 3


@pytest.mark.parametrize(
    "answer", [b"\xc1", pack({"x": 1}), pack({"actions": "text"}), "a text", pack({"actions": np.array(["a"])})]
)
def test_an_answer_that_is_none_is_no_action(servers: list[Any], answer: Any):
    foreign = Foreign(lambda connection, seen: connection.send(answer))
    servers.append(foreign)
    policy = remote(servers, foreign.url, SPEC)
    with pytest.raises(ServingError):
        policy.infer({"t": 1})


def test_what_was_answered_late_is_never_used(servers: list[Any]):
    def answer(connection: ServerConnection, seen: Any) -> None:
        if seen["t"] == 1:
            connection.send(pack({"actions": np.ones((3, 2))}))
        elif seen["t"] == 2:  # nothing in time, and then all at once
            late.append(connection)

    late: list[ServerConnection] = []
    foreign = Foreign(answer)
    servers.append(foreign)
    clock = FakeClock()
    policy = remote(servers, foreign.url, SPEC, answer_s=0.05, clock=clock)
    assert policy.infer({"t": 1}).chunk[0, 0] == 1
    with pytest.raises(ServingError, match="gave no answer"):
        policy.infer({"t": 2})
    for connection in late:
        try:
            connection.send(pack({"actions": np.full((3, 2), 2.0)}))
        except Exception:  # it is closed
            continue
    with pytest.raises(ServingError, match="shortly before"):
        policy.infer({"t": 1})
    clock.now += 10
    assert policy.infer({"t": 1}).chunk[0, 0] == 1


def test_a_deadline_answers_in_time_and_the_late_answer_is_discarded(servers: list[Any]):
    entered, leave = threading.Event(), threading.Event()

    def answer(connection: ServerConnection, seen: Any) -> None:
        if seen["t"] == 2:
            entered.set()
            leave.wait(10)
        connection.send(pack({"actions": np.full((3, 2), float(seen["t"]))}))

    foreign = Foreign(answer)
    servers.append(foreign)
    limited = Deadline(remote(servers, foreign.url, SPEC, answer_s=10.0), 2000)
    servers.append(limited)
    assert limited.infer({"t": 1}).chunk[0, 0] == 1
    limited.deadline_ms = 20
    with pytest.raises(DeadlineMissed):
        limited.infer({"t": 2})
    assert entered.wait(10)
    with pytest.raises(DeadlineMissed):  # it is still waiting, and not asked again
        limited.infer({"t": 3})
    leave.set()
    limited.deadline_ms = 2000
    for _ in range(1000):
        try:
            chunk = limited.infer({"t": 4}).chunk
            break
        except DeadlineMissed:
            threading.Event().wait(0.01)
    assert chunk[0, 0] == 4


def test_a_server_that_comes_back_is_used_again_if_it_serves_the_same(servers: list[Any]):
    first = OpenpiServer(Service(CountingPolicy()), Access(), 0)
    address = first.start()
    clock = FakeClock()
    policy = remote(servers, address, clock=clock)
    policy.infer({"t": 1})
    first.close()
    with pytest.raises(ServingError):
        policy.infer({"t": 1})
    for seconds in (0.25, 0.5, 1.0):
        clock.now += seconds - 0.01
        with pytest.raises(ServingError, match="shortly before"):
            policy.infer({"t": 1})
        clock.now += 0.02
        with pytest.raises(ServingError, match="cannot be used"):
            policy.infer({"t": 1})
    port = int(address.rpartition(":")[2])
    other = TensorSpec("a", (1, 3, 2), labels=("x", "gripper"), mode="absolute")
    second = OpenpiServer(Service(CountingPolicy(spec_of(chunk=3, action=other))), Access(), port)
    second.start()
    clock.now += 10
    with pytest.raises(UsageError, match="mode 'absolute'"):
        policy.infer({"t": 1})
    second.close()
    start(servers, port=port)
    clock.now += 10
    assert policy.infer({"t": 1}).chunk[0, 0] == pytest.approx(100.001)


def test_a_server_that_takes_other_inputs_is_refused(servers: list[Any]):
    spec = PolicySpec((TensorSpec("u", (1, 1)),), SPEC.outputs, SPEC.control_hz, 3, 2)
    address = start(servers)
    with pytest.raises(UsageError, match="takes t"):
        RemotePolicy(address, spec)


@pytest.mark.parametrize("url", ["", "http://host", "host:8000", None, "remote:ws://host"])
def test_what_is_no_url_of_a_server_is_refused(url: Any):
    with pytest.raises(UsageError, match="allowed: ws://HOST:PORT"):
        RemotePolicy(url, SPEC)


def test_a_policy_that_looks_back_is_sent_whole_windows(servers: list[Any]):
    spec = PolicySpec((TensorSpec("t", (1, 3, 1), history=3),), (TensorSpec("a", (1, 2, 1)),), 10, 2, 2)
    seen: list[Any] = []

    class Windows(CountingPolicy):
        def infer(self, observation: Any, *, noise: Any = None) -> Action:
            seen.append(observation["t"].ravel().tolist())
            return Action(np.zeros((2, 1), np.float32), (), 0.0, 0, {})

        def observe(self, observation: Any) -> None:
            raise NotImplementedError

    policy = remote(servers, start(servers, Windows(spec)))
    for number in (1, 2, 3):
        policy.observe({"t": np.float32([number])})
    policy.infer({"t": np.float32([4])})
    policy.reset()
    policy.infer({"t": np.float32([5])})
    assert seen == [[2, 3, 4], [5, 5, 5]]


def test_a_remote_policy_is_a_rung_and_a_bundle_one_below_a_remote_policy(
    servers: list[Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setenv("VLATOOL_SERVE_KEY", KEY)
    bundle = arm_bundle(tmp_path / "arm").path
    policy = load(bundle, threads=1)
    server = OpenpiServer(Service(policy), Access(key=KEY), 0)
    url = f"remote:{server.start()}"
    observation = {"q": np.zeros(7, np.float32)}
    first = load(url, fallback=bundle, threads=1)
    assert first.act(observation).shape == (7,)
    assert first.origin.source == "remote"
    server.close()
    sources = []
    for _ in range(6):
        first.act(observation)
        sources.append(first.origin.source)
    assert sources[0] == "remote"  # the rest of the chunk that is played
    assert sources[-1] == "fallback"
    below = load(bundle, threads=1, fallback=url)  # the server is not there yet
    assert below.act(observation).shape == (7,)
    assert below.origin.source == "policy"
    for stack in (first, below):
        stack.close()
    for path, second in ((bundle, url), (url, bundle)):
        with pytest.raises(UsageError, match="cannot be recorded"):
            load(path, fallback=second, threads=1, record=tmp_path / "run")


def test_a_remote_rung_answers_where_the_policy_does_not(servers: list[Any]):
    class Failing(NumberedPolicy):
        def infer(self, observation: Any, *, noise: Any = None) -> Action:
            raise ServingError("It fails.")

    second = remote(servers, start(servers))
    stack = build_stack(Failing(SPEC), fallback=Fallback(second))
    assert stack.act({"t": 3})[0] == pytest.approx(300.001)
    assert stack.origin.source == "fallback"


@pytest.mark.parametrize("actions", [
    np.float64(1.0), np.zeros(0), np.array(["forward"]), [1, 2], None,
])  # fmt: skip
def test_an_answer_that_is_no_chunk_is_an_error_of_the_server(servers: list[Any], actions: Any):
    value = np.asarray(actions) if isinstance(actions, np.float64) else actions
    foreign = Foreign(lambda connection, _seen: connection.send(pack({"actions": value})))
    servers.append(foreign)
    policy = remote(servers, foreign.url, SPEC)
    with pytest.raises(ServingError, match="answered without actions"):
        policy.infer({"t": 7})


@pytest.mark.parametrize("indices", [[0.0, 1.5, 1.0], [np.nan, 0.0, 0.0], [1e30, 0.0, 0.0]])
def test_a_label_between_two_labels_is_none_of_them(servers: list[Any], indices: list[float]):
    spec = PolicySpec(SPEC.inputs, (TensorSpec("a", (1, 3, 2), kind="discrete", labels=("stop", "go")),), 10.0, 3)
    answers = [np.array(indices), np.array([1.0, 0.0, 1.0])]
    foreign = Foreign(lambda connection, _seen: connection.send(pack({"actions": answers.pop(0)})))
    servers.append(foreign)
    policy = remote(servers, foreign.url, spec)
    with pytest.raises(ServingError, match="not indices"):
        policy.infer({"t": 7})
    policy._not_before = 0.0
    assert policy.infer({"t": 7}).chunk.tolist() == [1, 0, 1], "whole numbers are indices, whatever their dtype"
