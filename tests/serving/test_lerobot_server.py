"""LeRobot's asynchronous inference over gRPC: chunks, names, episodes, refusals."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from typing import Any

import grpc
import numpy as np
import pytest
from _episodes_policy import CountingPolicy
from _lerobot import RemotePolicyConfig, TimedObservation, pickled, unpickled, with_modules
from _malformed import malformed

from vlatool.errors import DataError, DeadlineMissed, ServingError
from vlatool.runtime.interface import Action
from vlatool.serving import Access, Service
from vlatool.serving import lerobot as module
from vlatool.serving._lerobot_data import PolicySetup
from vlatool.serving._protobuf import bytes_field, fields
from vlatool.serving.lerobot import LerobotServer, assemble, values_of

INSTRUCT = "SendPolicyInstructions"
KEY = "0123456789abcdef"
FEATURES = {"observation.state": {"dtype": "float32", "shape": (1,), "names": ["a.pos"]}}


@pytest.fixture(autouse=True)
def _modules() -> Iterator[None]:
    yield from with_modules()


class Moody(CountingPolicy):
    """Fails where the observation says so."""

    def infer(self, observation: Any, *, noise: Any = None) -> Action:
        number = np.asarray(observation["t"]).item()
        if number == -1:
            raise ZeroDivisionError
        if number == -2:
            raise DeadlineMissed("There is no action within 50 ms.")
        return super().infer(observation, noise=noise)


class Client:
    """Calls as LeRobot's stubs do."""

    def __init__(self, address: str, key: str = "") -> None:
        self._channel = grpc.insecure_channel(address, [("grpc.use_local_subchannel_pool", 1)])
        self._metadata = [("authorization", f"Api-Key {key}")] if key else []

    def call(self, method: str, message: bytes = b"") -> bytes:
        return self._channel.unary_unary(f"/transport.AsyncInference/{method}")(message, 20, metadata=self._metadata)

    def begin(self, **changes: Any) -> None:
        self.call("Ready")
        setup = RemotePolicyConfig(**{"policy_type": "act", "pretrained_name_or_path": "user/model",
                                      "lerobot_features": FEATURES, "actions_per_chunk": 2, **changes})  # fmt: skip
        self.call("SendPolicyInstructions", bytes_field(1, pickled(setup)))

    def see(self, number: float, step: int = 0, must_go: bool = False) -> None:
        self.send(pickled(TimedObservation(5.0, step, {"a.pos": number, "task": "go"}, must_go)))

    def send(self, data: bytes) -> None:
        parts = [b"\x08\x01" + bytes_field(2, data[:40]), b"\x08\x02" + bytes_field(2, data[40:80]),
                 b"\x08\x03" + bytes_field(2, data[80:])]  # fmt: skip
        self.stream(parts)

    def stream(self, parts: list[bytes]) -> None:
        observe = self._channel.stream_unary("/transport.AsyncInference/SendObservations")
        observe(iter(parts), 20, metadata=self._metadata)

    def actions(self) -> list[Any]:
        data = fields(self.call("GetActions"), {1: bytes}).get(1, b"")
        return unpickled(data) if data else []

    def close(self) -> None:
        self._channel.close()


@pytest.fixture
def start(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., Client]]:
    """Serve a policy, and connect; further clients with ``start(address=...)``."""
    monkeypatch.setattr(module, "WAIT_S", 0.05)
    closing: list[Any] = []

    def begin(key: str = "", address: str = "", send_key: str = "", **options: Any) -> Client:
        if not address:
            server = LerobotServer(Service(Moody(), names={"t": "observation.state"}, **options), Access(key=key), 0)
            address = server.start()
            closing.append(server)
        client = Client(address, send_key)
        client.address = address  # type: ignore[attr-defined]
        closing.append(client)
        return client

    yield begin
    for each in reversed(closing):
        each.close()


def refused(call: Callable[[], Any], code: grpc.StatusCode) -> str:
    with pytest.raises(grpc.RpcError) as error:
        call()
    assert error.value.code() is code, error.value.details()
    return str(error.value.details())


def status(call: Callable[[], Any]) -> grpc.StatusCode:
    try:
        call()
    except grpc.RpcError as error:
        return error.code()
    return grpc.StatusCode.OK


def test_an_observation_has_timed_actions(start: Callable[..., Client]):
    client = start()
    client.begin()
    assert client.actions() == []
    client.see(4, step=9)
    actions = client.actions()
    assert [(each.timestep, round(each.timestamp, 6)) for each in actions] == [(9, 5.0), (10, 5.05)]
    assert np.allclose([each.action.tolist() for each in actions], [[400.001, 400.501], [401.001, 401.501]])
    client.see(4, step=9)
    assert client.actions() == []  # this step was answered
    client.see(4, step=9, must_go=True)
    client.see(5, step=12)
    assert client.actions()[0].action[0] == pytest.approx(500.002)  # the newest


def test_clients_have_episodes_of_their_own(start: Callable[..., Client]):
    first = start()
    second = start(address=first.address)  # type: ignore[attr-defined]
    counts = []
    for step, client in enumerate((first, first, second, first, second)):
        if step in (0, 2, 3):
            client.begin()
        client.see(0, step)
        counts.append(round(float(client.actions()[0].action[0]) * 1000))
    assert counts == [1, 2, 1, 1, 2]


def test_what_is_wrong_is_a_status_with_the_reason(start: Callable[..., Client]):
    client = start()
    code = grpc.StatusCode
    assert "no policy instructions" in refused(client.actions, code.FAILED_PRECONDITION)
    client.begin()
    assert "opcode" in refused(lambda: client.send(b"\x80\x04\xff."), code.INVALID_ARGUMENT)
    assert "no last chunk" in refused(lambda: client.stream([b"\x08\x01"]), code.INVALID_ARGUMENT)
    assert "allowed: a RemotePolicyConfig" in refused(
        lambda: client.call("SendPolicyInstructions", bytes_field(1, pickled({"a": 1}))), code.INVALID_ARGUMENT
    )
    client.see(-1, 1)
    assert "internal error: ZeroDivisionError" in refused(client.actions, code.INTERNAL)
    client.see(-2, 2)
    assert "no action within 50 ms" in refused(client.actions, code.ABORTED)
    client.send(pickled(TimedObservation(0.0, 3, {"b.pos": 1.0})))
    assert r"lacks observation.state (for t)" in refused(client.actions, code.INVALID_ARGUMENT)
    client.see(1, 4)
    assert len(client.actions()) == 2
    refused(lambda: client.call("Nothing"), code.UNIMPLEMENTED)


def test_a_client_without_the_key_is_refused_and_so_is_one_too_many(start: Callable[..., Client]):
    client = start(KEY, send_key=KEY, clients=1)
    client.begin()
    address = client.address  # type: ignore[attr-defined]
    for wrong in ("", KEY[1:]):
        assert "key" in refused(start(address=address, send_key=wrong).begin, grpc.StatusCode.UNAUTHENTICATED)
    assert "1 clients" in refused(start(address=address, send_key=KEY).begin, grpc.StatusCode.FAILED_PRECONDITION)


def test_a_stream_that_does_not_end_is_ended(start: Callable[..., Client], monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(module, "RECEIVE_S", 0.05)
    client = start()
    forever = threading.Event()

    def parts() -> Iterator[bytes]:
        yield b"\x08\x01"
        forever.wait(20)

    assert refused(lambda: client.stream(parts()), grpc.StatusCode.CANCELLED) is not None  # type: ignore[arg-type]
    forever.set()


def test_damaged_calls_harm_nobody(start: Callable[..., Client]):
    client = start()
    client.begin()
    seen = pickled(TimedObservation(5.0, 0, {"a.pos": 1.0, "x": np.zeros(3)}))
    codes: set[grpc.StatusCode] = set()
    for data in malformed([b"\x08\x03" + bytes_field(2, seen), bytes_field(1, seen)], 60, seed=4):
        codes.add(status(lambda data=data: client.stream([data])))
        codes.add(status(lambda data=data: client.call(INSTRUCT, data)))
    assert codes <= {grpc.StatusCode.OK, grpc.StatusCode.INVALID_ARGUMENT}
    client.begin()
    client.see(1, 2**40)
    assert len(client.actions()) == 2


def test_a_port_in_use_is_refused(start: Callable[..., Client]):
    port = int(start().address.rpartition(":")[2])  # type: ignore[attr-defined]
    with pytest.raises(ServingError, match=f"port {port}"):
        LerobotServer(Service(Moody()), Access(), port).start()


@pytest.mark.parametrize("parts", [
    [], [b"\x08\x00" + bytes_field(2, b"x")], [b"\x08\x04"], [b"\x08\x02"], [b"\x08"], [b"\x12\x05ab"], [b"\x0b"],
    [b"\x00\x00"], [b"\x08" + b"\xff" * 20], [b"\x08\x03" * 100],
])  # fmt: skip
def test_chunks_that_are_damaged_are_refused(parts: list[bytes]):
    with pytest.raises(DataError):
        assemble(parts)


def test_chunks_are_put_together_within_the_limit(monkeypatch: pytest.MonkeyPatch):
    parts = [
        b"\x08\x01" + bytes_field(2, b"x"),
        b"\x08\x01" + bytes_field(2, b"ab"),
        b"\x08\x03" + bytes_field(2, b"c"),
    ]
    assert assemble(parts) == b"abc"
    monkeypatch.setenv("VLATOOL_LIMITS", "message_bytes=2")
    with pytest.raises(DataError, match="message_bytes"):
        assemble(parts)


def test_numbers_and_bytes_of_messages():
    message = b"\x08\x96\x01" + bytes_field(2, b"x" * 300) + b"\x25abcd" + b"\x21abcdefgh" + bytes_field(9, b"unknown")
    assert fields(message, {1: int, 2: bytes}) == {1: 150, 2: b"x" * 300}
    assert fields(b"", {1: int}) == {}


def test_values_have_the_names_of_lerobot_too():
    features = {"observation.state": {"names": ["a", "b"]}, "observation.images.front": {"dtype": "image"},
                "observation.images.side": {}, "other": 5, "lacking": {"names": ["a", "z"]}}  # fmt: skip
    renames = {"observation.images.front": "observation.images.top"}
    values = values_of(PolicySetup("m", features, 1, renames),
                       {"a": 1.0, "b": np.float64(2), "front": np.zeros((2, 2, 3)), "task": "go"})  # fmt: skip
    assert values["observation.state"].tolist() == [1, 2]
    assert values["observation.images.top"] is values["observation.images.front"]
    assert {"observation.images.side", "other", "lacking"}.isdisjoint(values)
    with pytest.raises(DataError, match="not a number"):
        values_of(PolicySetup("m", features, 1), {"a": 1.0, "b": "text"})
    with pytest.raises(DataError, match="300 features"):
        values_of(PolicySetup("m", {str(number): {} for number in range(300)}, 1), {})
