"""GR00T's protocol over ZeroMQ: a request names an endpoint, an answer is what it returns or an error."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

import numpy as np

from vlatool.bundle.spec import TensorSpec
from vlatool.errors import DataError, ServingError, UsageError, VlatoolError, require
from vlatool.files.array_bytes import npy_array, npy_bytes
from vlatool.files.limits import limit
from vlatool.files.validate import short_repr
from vlatool.runtime.openpi_messages import decode_message, encode_message, flat
from vlatool.serving._access import Access
from vlatool.serving._clients import Clients
from vlatool.serving._endpoint import CLOSE_S, EXTRA, Endpoint
from vlatool.serving._service import Service, Session

ARRAY, CONFIG = "__ndarray_class__", "__ModalityConfig_class__"
POLL_MS = 100
MAX_QUEUED = 4
"""Requests of one connection that wait."""
ENDPOINTS = ("get_action", "get_modality_config", "kill", "ping", "reset")


class Gr00tServer(Endpoint):
    """Clients of GR00T (``PolicyClient``) connect unchanged.

    A value is named by its modality and its key, ``state.arm``, or flat. Leading axes of 1 (batch, time) are left out
    where the policy has none. The action is (1, chunk, width) under the name of its output, or of each of its parts.
    """

    default_port = 5555

    def __init__(self, service: Service, access: Access, port: int, on_kill: Callable[[], None] | None = None) -> None:
        super().__init__(service, access, port, on_kill)
        self._zmq = require("zmq", EXTRA)
        require("msgpack", EXTRA)
        self._clients: Clients[Session] = Clients(service, "gr00t", lambda session: session)
        self._ranks = {tensor.name: len(tensor.observation.shape) - 1 for tensor in service.spec.inputs}
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._work, name="vlatool-gr00t", daemon=True)

    def start(self) -> str:
        """Begin to serve; see ``Endpoint.start``."""
        zmq = self._zmq
        self._context = zmq.Context()
        self._socket = self._context.socket(zmq.ROUTER)
        options = {
            zmq.LINGER: int(CLOSE_S * 1000), zmq.MAXMSGSIZE: limit("message_bytes"), zmq.RCVHWM: MAX_QUEUED,
            zmq.SNDHWM: MAX_QUEUED, zmq.IPV6: ":" in self.access.host,
        }  # fmt: skip
        for option, value in options.items():
            self._socket.setsockopt(option, value)
        host = f"[{self.access.host}]" if ":" in self.access.host else self.access.host
        try:
            self._socket.bind(f"tcp://{host}:{self.port or '*'}")
        except zmq.ZMQError as error:
            self._context.destroy(0)
            raise self.bind_error(OSError(error.errno, error.strerror)) from None
        self.port = int(self._socket.getsockopt_string(zmq.LAST_ENDPOINT).rpartition(":")[2])
        self._thread.start()
        return f"tcp://{host}:{self.port}"

    def close(self) -> None:
        """End; see ``Endpoint.close``."""
        self._stop.set()
        self._thread.join()
        self._context.term()

    def _work(self) -> None:
        while not self._stop.is_set():
            if not self._socket.poll(POLL_MS):
                continue
            frames = self._socket.recv_multipart()
            if len(frames) == 3 and not frames[1]:
                self._socket.send_multipart([*frames[:2], self.answer(frames[0], frames[2])])
        self._socket.close()

    def answer(self, client: bytes, message: bytes) -> bytes:
        """Return the answer to a request: whatever is wrong with it is said there.

        Args:
            client: Who asks, as the socket names it.
            message: In MessagePack.
        """
        try:
            return encode_message(self._perform(client, decode_message(message, _decode)), _encode)
        except VlatoolError as error:
            return encode_message({"error": str(error)}, _encode)
        except Exception as error:  # the seam: whatever a policy raises is an answer, not the end
            return encode_message({"error": f"internal error: {type(error).__name__}"}, _encode)

    def _perform(self, client: bytes, request: dict[str, Any]) -> Any:
        if not self.access.admits(request.get("api_token")):
            raise ServingError("The api_token is missing or wrong.", "send the key of the server with each request")
        endpoint, data = request.get("endpoint", "get_action"), request.get("data")
        data = {} if data is None else data
        if not isinstance(endpoint, str) or endpoint not in ENDPOINTS or not isinstance(data, dict):
            got = f"{short_repr(endpoint)} with {type(data).__name__}"
            raise DataError(f"The request is {got}; allowed: a mapping for {', '.join(ENDPOINTS)}.", "name one of them")
        if endpoint == "ping":
            return {"status": "ok", "message": "Server is running"}
        if endpoint == "kill":
            return self._kill()
        if endpoint == "get_modality_config":
            return self._modalities()
        session = self._clients.get(client)
        return self._reset(session, data) if endpoint == "reset" else self._act(session, data)

    def _kill(self) -> None:
        if not self.access.key or self.on_kill is None:
            raise ServingError("No client may end this server: it has no key.", "serve with --key FILE")
        self.on_kill()

    def _reset(self, session: Session, data: dict[str, Any]) -> dict[str, Any]:
        options = data.get("options")
        seed = options.get("seed") if isinstance(options, dict) else options
        try:
            session.reset(seed)
        except UsageError as error:
            raise DataError(error.message, error.fix) from None
        return {}

    def _act(self, session: Session, data: dict[str, Any]) -> list[Any]:
        observation = data.get("observation")
        if not isinstance(observation, dict):
            raise DataError("The request has no observation.", "send data: {observation: {...}, options: null}")
        values = flat(observation)
        sources = {source: self._ranks[name] for name, source in self.service.names.sources.items()}
        answer = session.infer({name: _without_axes(value, sources.get(name)) for name, value in values.items()})
        info = {"infer_ms": answer.infer_ms, "wait_ms": answer.wait_ms, "checks": list(answer.action.checks)}
        return [{name: part[None] for name, part in self._parts(answer.action.chunk).items()}, info]

    def _parts(self, chunk: Any) -> dict[str, Any]:
        """Return a chunk (T, A) by part of the action, (T, width) each; whole under its name where it has none."""
        action: TensorSpec = self.service.spec.action
        if not action.parts or chunk.ndim < 2:
            return {action.name: chunk}
        return {name: chunk[:, start:stop] for name, (start, stop) in action.parts.items()}

    def _modalities(self) -> dict[str, Any]:
        """Return what is taken and given: modality -> keys, and the moments of each."""
        spec = self.service.spec
        groups: dict[str, list[TensorSpec]] = {"video": [], "state": [], "language": []}
        for tensor in spec.inputs:
            groups[_modality(tensor)].append(tensor)
        sources = self.service.names.sources
        found = {
            modality: _config([sources[tensor.name] for tensor in tensors],
                              range(1 - max(tensor.history or 1 for tensor in tensors), 1))
            for modality, tensors in groups.items() if tensors
        }  # fmt: skip
        names = list(spec.action.parts) or [spec.action.name]
        return {**found, "action": _config(names, range(spec.chunk))}


def _modality(tensor: TensorSpec) -> str:
    if tensor.kind == "text":
        return "language"
    return "video" if tensor.observation.dtype == "uint8" else "state"


def _config(keys: list[str], deltas: range) -> dict[str, Any]:
    return {CONFIG: True, "as_json": {"delta_indices": list(deltas), "modality_keys": keys}}


def _without_axes(value: Any, rank: int | None) -> Any:
    """Return a value without leading axes of 1 beyond those that an input has, and a text out of its lists."""
    if isinstance(value, np.ndarray) and rank is not None:
        while value.ndim > rank and value.shape[0] == 1:
            value = value[0]
    while isinstance(value, list | tuple) and len(value) == 1:
        value = value[0]
    if isinstance(value, np.ndarray) and value.dtype.kind == "U" and value.size == 1:
        return str(value.reshape(()))
    return value


def _encode(value: Any) -> Any:
    if isinstance(value, np.ndarray) and value.dtype.kind in "biufU":
        return {ARRAY: True, "as_npy": npy_bytes(value)}
    raise TypeError(f"it holds a {type(value).__name__}")


def _decode(value: dict[Any, Any]) -> Any:
    if ARRAY in value:
        return npy_array(value.get("as_npy"))
    if CONFIG in value:
        return value.get("as_json")
    if not all(isinstance(key, str) for key in value):
        raise DataError("A mapping in the message has a name that is bytes; allowed: text.", "send names as text")
    return value
