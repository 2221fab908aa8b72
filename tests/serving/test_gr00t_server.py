"""GR00T's protocol: endpoints, names, axes, tokens, errors; over a socket where the socket matters."""

from __future__ import annotations

import io
from collections.abc import Iterator
from typing import Any

import msgpack
import numpy as np
import pytest
import zmq
from _episodes_policy import CountingPolicy
from _malformed import malformed

from vlatool.bundle.spec import PolicySpec, TensorSpec
from vlatool.errors import ServingError
from vlatool.runtime.interface import Action
from vlatool.serving import Access, Service
from vlatool.serving.gr00t import Gr00tServer

KEY = "0123456789abcdef"


def encode(value: Any) -> Any:
    """As GR00T's client has it."""
    stream = io.BytesIO()
    np.save(stream, value, allow_pickle=False)
    return {"__ndarray_class__": True, "as_npy": stream.getvalue()}


def decode(value: Any) -> Any:
    return np.load(io.BytesIO(value["as_npy"]), allow_pickle=False) if "__ndarray_class__" in value else value


def request(endpoint: str | None = None, **data: Any) -> bytes:
    named = {} if endpoint is None else {"endpoint": endpoint}
    token = {"api_token": data.pop("token")} if "token" in data else {}
    return msgpack.packb({**named, **token, **({"data": data} if data else {})}, default=encode)


def built(policy: Any = None, key: str = "", killed: list[int] | None = None, **options: Any) -> Gr00tServer:
    service = Service(CountingPolicy() if policy is None else policy, **options)
    return Gr00tServer(service, Access("127.0.0.1", key), 0, None if killed is None else lambda: killed.append(1))


def ask(server: Gr00tServer, message: bytes, client: bytes = b"a") -> Any:
    return msgpack.unpackb(server.answer(client, message), object_hook=decode)


def see(number: Any) -> bytes:
    return request("get_action", observation={"state": {"t": np.float32([[[number]]])}}, options=None)


@pytest.fixture
def served() -> Iterator[Gr00tServer]:
    server = built(names={"t": "state.t"}, clients=3)
    server.start()
    yield server
    server.close()


def test_clients_of_a_socket_have_episodes_of_their_own(served: Gr00tServer):
    with zmq.Context() as context, context.socket(zmq.REQ) as first, context.socket(zmq.REQ) as second:
        for socket in (first, second):
            socket.connect(f"tcp://127.0.0.1:{served.port}")
        numbers = []
        again = request("reset", options=None)
        for socket, message in ((first, see(1)), (first, see(1)), (second, see(1)), (first, again), (first, see(1)),
                                (second, see(1))):  # fmt: skip
            socket.send(message)
            assert socket.poll(10_000)
            answer = msgpack.unpackb(socket.recv(), object_hook=decode)
            numbers.append(round(float(answer[0]["a"][0, 0, 0] % 1 * 1000)) if answer else None)
    assert numbers == [1, 2, 1, None, 1, 2]


def test_a_client_that_is_silent_makes_way(monkeypatch: pytest.MonkeyPatch):
    server = built(names={"t": "state.t"}, clients=2)
    assert all(isinstance(ask(server, see(1), client), list) for client in (b"a", b"b", b"a"))
    assert "2 clients use the policy" in ask(server, see(1), b"c")["error"]
    monkeypatch.setattr("vlatool.serving._clients.IDLE_S", -1.0)
    assert isinstance(ask(server, see(1), b"c"), list)
    assert len(server._clients.all()) == 2


def test_the_endpoints():
    server = built()
    assert ask(server, request("ping"))["status"] == "ok"
    modalities = ask(server, request("get_modality_config"))
    assert modalities["state"]["as_json"] == {"delta_indices": [0], "modality_keys": ["t"]}
    assert modalities["action"]["as_json"] == {"delta_indices": [0, 1, 2], "modality_keys": ["a"]}
    action, info = ask(server, request(observation={"t": 4}, options={}))  # get_action is the default
    assert (action["a"].shape, action["a"].dtype) == ((1, 3, 2), np.float32)
    assert set(info) == {"infer_ms", "wait_ms", "checks"}
    assert ask(server, request("reset", options={"seed": 5})) == {}


@pytest.mark.parametrize(("message", "error"), [
    (request("get_actions"), "allowed: a mapping for get_action"),
    (request("reset", options={"seed": -1}), "seed is -1"),
    (request("get_action"), "no observation"), (request(observation={"x": 1}), "lacks t; it has: x"),
    (request(observation=5), "no observation"), (msgpack.packb([1]), "allowed: a mapping"), (b"", "MessagePack"),
    (msgpack.packb({"endpoint": {"a": 1}}), "allowed"),
    (msgpack.packb({"data": np.zeros(3)}, default=encode), "allowed"),
    (request(observation=np.zeros(2)), "no observation"), (request("reset", options=np.zeros(2)), "seed is"),
    (request(observation={"t": {"__ndarray_class__": True, "as_npy": b"\x80\x04."}}), "cannot be read"),
    (msgpack.packb({"data": {b"x": 1}}), "name that is bytes"), (request("kill"), "no key"),
])  # fmt: skip
def test_a_request_that_is_refused_is_answered_by_an_error(message: bytes, error: str):
    assert error in ask(built(killed=[]), message)["error"]


def test_an_array_of_objects_is_not_unpickled():
    stream = io.BytesIO()
    np.save(stream, np.array([{"a": 1}], dtype=object), allow_pickle=True)
    answer = ask(
        built(),
        msgpack.packb({"data": {"observation": {"t": {"__ndarray_class__": True, "as_npy": stream.getvalue()}}}}),
    )
    assert "error" in answer


def test_a_policy_that_raises_is_an_answer():
    class Failing(CountingPolicy):
        def infer(self, observation: Any, *, noise: Any = None) -> Action:
            raise ZeroDivisionError

    assert ask(built(Failing()), request(observation={"t": 1})) == {"error": "internal error: ZeroDivisionError"}


def test_a_key_is_asked_for_and_lets_a_client_end_the_server():
    killed: list[int] = []
    server = built(key=KEY, killed=killed)
    for message in (request("ping"), request("kill"), request("kill", token=KEY[1:]), request("ping", token=5)):
        assert "api_token" in ask(server, message)["error"]
    assert killed == []
    assert ask(server, request("ping", token=KEY))["status"] == "ok"
    assert ask(server, request("kill", token=KEY)) is None
    assert killed == [1]


SPEC = PolicySpec(
    (TensorSpec("top", (1, 4, 4, 3), dtype="uint8"), TensorSpec("arm", (1, 2)),
     TensorSpec("task", (1, 4), kind="text", dtype="int64", tokenizer="w.json", max_tokens=4)),
    (TensorSpec("action", (1, 3, 3), parts={"arm": (0, 2), "hand": (2, 3)}),), 10, 3,
)  # fmt: skip


def test_axes_of_batch_and_time_are_left_out_and_parts_come_apart():
    seen: list[Any] = []

    class Seeing(CountingPolicy):
        def infer(self, observation: Any, *, noise: Any = None) -> Action:
            seen.append(observation)
            return Action(np.ones((3, 3), np.float32), (), 0.0, 0, {})

    server = built(Seeing(SPEC), names={"top": "video.top", "arm": "state.arm", "task": "language.task"})
    observation = {"video": {"top": np.zeros((1, 1, 4, 4, 3), np.uint8)}, "state": {"arm": np.float32([[[1, 2]]])},
                   "language": {"task": [["lift"]]}}  # fmt: skip
    action, _ = ask(server, request(observation=observation, options=None))
    assert {name: part.shape for name, part in action.items()} == {"arm": (1, 3, 2), "hand": (1, 3, 1)}
    assert (seen[0]["top"].shape, seen[0]["arm"].tolist(), seen[0]["task"]) == ((4, 4, 3), [1, 2], "lift")
    modalities = ask(server, request("get_modality_config"))
    assert {name: config["as_json"]["modality_keys"] for name, config in modalities.items()} == {
        "video": ["video.top"], "state": ["state.arm"], "language": ["language.task"], "action": ["arm", "hand"]
    }  # fmt: skip


def test_damaged_requests_are_answers():
    server = built(names={"t": "state.t"})
    errors = 0
    for message in malformed([see(1), request("ping"), request("reset", options={"seed": 1})], 1000, seed=2):
        answer = ask(server, message)
        errors += isinstance(answer, dict) and "error" in answer
    assert errors > 500
    assert isinstance(ask(server, see(1)), list)


def test_what_is_no_request_of_a_client_is_dropped(served: Gr00tServer):
    with zmq.Context() as context, context.socket(zmq.DEALER) as strange, context.socket(zmq.REQ) as client:
        for socket in (strange, client):
            socket.linger = 0
            socket.connect(f"tcp://127.0.0.1:{served.port}")
        for frames in ([b""], [b"", b"", b""], [b"x", request("ping")], [b"", b"\xc1"]):
            strange.send_multipart(frames)
        client.send(request("ping"))
        assert client.poll(10_000)
        assert msgpack.unpackb(client.recv())["status"] == "ok"


def test_a_port_in_use_is_refused(served: Gr00tServer):
    server = built()
    server.port = served.port
    with pytest.raises(ServingError, match="port"):
        server.start()
