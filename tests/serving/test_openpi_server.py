"""openpi's protocol over a socket: frames, errors, keys, limits, the end."""

from __future__ import annotations

import threading
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from _episodes_policy import CountingPolicy
from _malformed import malformed
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect

from vlatool.errors import DeadlineMissed, ServingError
from vlatool.runtime.interface import Action
from vlatool.runtime.openpi_messages import pack, unpack
from vlatool.serving import Access, Service
from vlatool.serving.openpi import OpenpiServer

KEY = "0123456789abcdef"


class Moody(CountingPolicy):
    """Fails where the observation says so."""

    def infer(self, observation: Any, *, noise: Any = None) -> Action:
        if observation["t"] == -1:
            raise ZeroDivisionError
        if observation["t"] == -2:
            raise DeadlineMissed("There is no action within 50 ms.")
        return super().infer(observation, noise=noise)


Start = Callable[..., str]


@pytest.fixture
def start() -> Iterator[Start]:
    """Serve a policy; returns the address. All are closed at the end."""
    servers: list[OpenpiServer] = []

    def begin(key: str = "", **options: Any) -> str:
        server = OpenpiServer(Service(Moody(), **options), Access("127.0.0.1", key), 0)
        address = server.start()
        servers.append(server)
        return address

    yield begin
    for server in servers:
        server.close()


def client(address: str, key: str = "", **options: Any) -> ClientConnection:
    headers = {"Authorization": f"Api-Key {key}"} if key else None
    return connect(address, compression=None, max_size=None, additional_headers=headers, proxy=None, **options)


def ask(connection: ClientConnection, message: Any) -> Any:
    connection.send(message if isinstance(message, bytes | str) else pack(message))
    answer = connection.recv(10)
    return answer if isinstance(answer, str) else unpack(answer)


def test_a_frame_says_what_is_served_and_each_observation_has_an_answer(start: Start):
    with client(start(names={"t": "state.time"})) as connection:
        metadata = unpack(connection.recv(10))["vlatool"]
        assert (metadata["execute"], metadata["spec"]["chunk"]) == (2, 3)
        first = ask(connection, {"state": {"time": 1}, "unknown": "x"})
        second = ask(connection, {"state.time": np.float32(2)})
    assert first["actions"].dtype == np.float32
    assert np.allclose(first["actions"], [[100.001, 100.501], [101.001, 101.501], [102.001, 102.501]])
    assert set(first["server_timing"]) == {"infer_ms"}
    assert set(second["server_timing"]) == {"infer_ms", "prev_total_ms"}
    assert (second["vlatool"]["sequence"], second["vlatool"]["checks"]) == (2, [])


@pytest.mark.parametrize(("message", "answer"), [
    ({"x": 1}, "lacks t; it has: x"), (b"\xc1", "not MessagePack"), ("text", "allowed: bytes"), (b"", "MessagePack"),
    ({"t": -1}, "internal error: ZeroDivisionError"), ({"vlatool": 5}, "allowed: reset"),
    ({"vlatool": {"reset": -5}}, "seed is -5"), ({"vlatool": {"reset": None, "kill": 1}}, "allowed: reset"),
])  # fmt: skip
def test_a_request_that_is_refused_ends_the_connection_with_the_reason(start: Start, message: Any, answer: str):
    with client(start()) as connection:
        connection.recv(10)
        assert answer in ask(connection, message)
        with pytest.raises(ConnectionClosed) as ended:
            connection.recv(10)
    assert ended.value.rcvd is not None
    assert ended.value.rcvd.code == 1011


def test_a_missed_deadline_ends_nothing(start: Start):
    with client(start()) as connection:
        connection.recv(10)
        assert "no action within 50 ms" in ask(connection, {"t": -2})
        assert ask(connection, {"t": 1})["vlatool"]["sequence"] == 1


def test_clients_have_episodes_of_their_own_and_may_start_new_ones(start: Start):
    address = start()
    with client(address) as first, client(address) as second:
        for connection in (first, second):
            connection.recv(10)
        assert [ask(each, {"t": 1})["vlatool"]["sequence"] for each in (first, first, second)] == [1, 2, 1]
        assert ask(first, {"vlatool": {"reset": None}}) == {"vlatool": {"reset": True}}
        assert [ask(each, {"t": 1})["vlatool"]["sequence"] for each in (first, second)] == [1, 2]


def status(address: str, path: str = "/healthz") -> tuple[int, bytes]:
    try:
        with urllib.request.urlopen(address.replace("ws:", "http:") + path, timeout=10) as answer:
            return answer.status, answer.read()
    except urllib.error.HTTPError as error:
        with error:
            return error.code, error.read()


def test_the_state_can_be_asked_for_without_a_key(start: Start):
    address = start(KEY)
    assert status(address) == (200, b"OK\n")
    assert status(address, "/")[0] == 401
    assert status(start(), "/")[0] == 426


def test_a_client_without_the_key_is_refused(start: Start):
    address = start(KEY)
    for wrong in ("", KEY[:-1], KEY + "x"):
        with pytest.raises(InvalidStatus, match="401"):
            client(address, wrong)
    with client(address, KEY) as connection:
        assert "vlatool" in unpack(connection.recv(10))


def test_web_pages_and_clients_beyond_the_limit_are_refused(start: Start):
    address = start(clients=1)
    with pytest.raises(InvalidStatus, match="403"):
        client(address, origin="http://example.com")
    with client(address) as connection:
        connection.recv(10)
        with pytest.raises(InvalidStatus, match="503"):
            client(address)
    for _ in range(200):  # the server notices shortly after that the first is gone
        try:
            with client(address) as connection:
                connection.recv(10)
            break
        except InvalidStatus:
            threading.Event().wait(0.01)
    else:
        pytest.fail("the place of a client that is gone stays taken")


def test_a_message_beyond_the_limit_ends_the_connection(start: Start, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("VLATOOL_LIMITS", "message_bytes=1000")
    with client(start()) as connection:
        connection.recv(10)
        with pytest.raises(ConnectionClosed, match="1009"):
            ask(connection, bytes(2000))


def test_damaged_frames_harm_nobody(start: Start):
    address = start()
    for frame in malformed([pack({"t": 1}), pack({"t": np.float32([1])}), pack({"vlatool": {"reset": 3}})], 40, seed=1):
        with client(address) as connection:
            connection.recv(10)
            ask(connection, frame)
    with client(address) as connection:
        connection.recv(10)
        assert ask(connection, {"t": 1})["vlatool"]["sequence"] == 1


def test_a_port_in_use_is_refused_and_the_end_says_goodbye(start: Start):
    server = OpenpiServer(Service(Moody()), Access(), 0)
    address = server.start()
    with pytest.raises(ServingError, match=r"127\.0\.0\.1 port \d+"):
        OpenpiServer(Service(Moody()), Access(), server.port).start()
    with client(address) as connection:
        connection.recv(10)
        server.close()
        with pytest.raises(ConnectionClosed, match="1001"):
            connection.recv(10)
