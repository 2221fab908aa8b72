"""LeRobot's asynchronous inference over gRPC: observations come in chunks, actions are asked for."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

from vlatool.errors import DataError, DeadlineMissed, ServingError, VlatoolError, require
from vlatool.files.limits import check_limit, limit
from vlatool.serving._access import Access
from vlatool.serving._clients import Clients
from vlatool.serving._endpoint import CLOSE_S, EXTRA, Endpoint
from vlatool.serving._lerobot_data import PolicySetup, TimedObservation, read_observation, read_setup, write_actions
from vlatool.serving._protobuf import bytes_field, fields
from vlatool.serving._service import Service, Session

SERVICE = "transport.AsyncInference"
WAIT_S = 2.0
"""How long a request for actions waits for an observation, as LeRobot's server does."""
RECEIVE_S = 10.0
"""How long the chunks of an observation may take."""
END = 3
"""State of the last chunk of an observation; 1 is that of the first."""
BEGIN, STATES = 1, (1, 2, 3)
MAX_FEATURES = 256
IMAGES = "observation.images."


class LerobotServer(Endpoint):
    """LeRobot's ``RobotClient`` connects unchanged.

    What it sends are pickles: they are read without unpickling, and anything but plain data in them is refused by name.
    An observation has LeRobot's names (``observation.state``, ``observation.images.front``, ``task``), beside those of
    the robot. The newest one waits, an older one is dropped, and so is one of a control step that was answered before,
    unless it has to be answered.
    """

    default_port = 8080

    def __init__(self, service: Service, access: Access, port: int, on_kill: Callable[[], None] | None = None) -> None:
        super().__init__(service, access, port, on_kill)
        self._grpc = require("grpc", EXTRA)
        self._clients: Clients[_Client] = Clients(service, "lerobot", _Client)
        self._stop = threading.Event()

    def start(self) -> str:
        """Begin to serve; see ``Endpoint.start``."""
        grpc, size = self._grpc, limit("message_bytes")
        workers = 2 * self.service.clients + 2
        self._server = grpc.server(
            ThreadPoolExecutor(workers, thread_name_prefix="vlatool-lerobot"),
            handlers=[grpc.method_handlers_generic_handler(SERVICE, self._methods())],
            options=[("grpc.max_receive_message_length", size), ("grpc.max_send_message_length", size),
                     ("grpc.so_reuseport", 0), ("grpc.max_metadata_size", 16_384)],
            maximum_concurrent_rpcs=workers,
        )  # fmt: skip
        host = f"[{self.access.host}]" if ":" in self.access.host else self.access.host
        try:
            self.port = self._server.add_insecure_port(f"{host}:{self.port}")
        except RuntimeError as error:
            self._server.stop(0)
            raise self.bind_error(OSError(str(error).splitlines()[0][:200])) from None
        self._server.start()
        return f"{host}:{self.port}"

    def close(self) -> None:
        """End; see ``Endpoint.close``."""
        self._stop.set()
        for client in self._clients.all():
            client.wake()
        self._server.stop(CLOSE_S).wait()

    def _methods(self) -> dict[str, Any]:
        grpc = self._grpc
        return {
            "Ready": grpc.unary_unary_rpc_method_handler(self._guarded(self._ready)),
            "SendPolicyInstructions": grpc.unary_unary_rpc_method_handler(self._guarded(self._instruct)),
            "SendObservations": grpc.stream_unary_rpc_method_handler(self._guarded(self._observe)),
            "GetActions": grpc.unary_unary_rpc_method_handler(self._guarded(self._act)),
        }

    def _guarded(self, method: Callable[[_Client, Any], bytes]) -> Callable[[Any, Any], bytes]:
        """Return a method that checks the key, and ends a call with a status where something is wrong."""

        def call(request: Any, context: Any) -> bytes:
            code, text = self._grpc.StatusCode.INTERNAL, ""
            try:
                self._check_key(context)
                with self._limited(request, context):
                    return method(self._clients.get(context.peer()), request)
            except VlatoolError as error:
                code, text = self._code(error), str(error)
            except Exception as error:  # the seam: whatever a policy raises ends a call, not the server
                text = f"internal error: {type(error).__name__}"
            context.abort(code, text[:1000])
            return b""

        return call

    def _check_key(self, context: Any) -> None:
        found = [value for name, value in context.invocation_metadata() if name == "authorization"]
        if not self.access.admits_header(found[0] if len(found) == 1 else None):
            raise _WrongKey("The key is missing or wrong.", "send the metadata authorization: Api-Key KEY")

    def _code(self, error: VlatoolError) -> Any:
        code = self._grpc.StatusCode
        if isinstance(error, _WrongKey):
            return code.UNAUTHENTICATED
        if isinstance(error, DeadlineMissed):
            return code.ABORTED
        if isinstance(error, ServingError):
            return code.FAILED_PRECONDITION
        return code.INVALID_ARGUMENT if isinstance(error, DataError) else code.INTERNAL

    @contextlib.contextmanager
    def _limited(self, request: Any, context: Any) -> Iterator[None]:
        """End a call whose request, a stream, does not come to an end."""
        if isinstance(request, bytes):
            yield
            return
        timer = threading.Timer(RECEIVE_S, context.cancel)
        timer.daemon = True
        timer.start()
        try:
            yield
        finally:
            timer.cancel()

    def _ready(self, client: _Client, request: bytes) -> bytes:
        client.reset()
        return b""

    def _instruct(self, client: _Client, request: bytes) -> bytes:
        client.setup = read_setup(fields(request, {1: bytes}).get(1, b""))
        return b""

    def _observe(self, client: _Client, request: Iterable[bytes]) -> bytes:
        client.put(read_observation(assemble(request)))
        return b""

    def _act(self, client: _Client, request: bytes) -> bytes:
        if client.setup is None:
            raise ServingError("This client has sent no policy instructions.", "call SendPolicyInstructions first")
        seen = client.take(WAIT_S, self._stop)
        if seen is None:
            return b""
        spec = self.service.spec
        chunk = client.answer(seen, client.setup)[: client.setup.actions]
        period_s = 1 / spec.control_hz if spec.control_hz else 0.0
        return bytes_field(1, write_actions(client.setup.module, seen.timestamp, seen.timestep, period_s, chunk))


class _WrongKey(ServingError):
    """A client without the key."""


class _Client:
    """What is known of one client: what it expects, and the newest observation that waits."""

    def __init__(self, session: Session) -> None:
        self.session = session
        self.setup: PolicySetup | None = None
        self._waiting: TimedObservation | None = None
        self._answered = self._begin = -1
        self._change = threading.Condition()

    def reset(self) -> None:
        """Start a new episode."""
        with self._change:
            self._waiting, self._answered, self._begin = None, -1, -1
        self.session.reset()

    def put(self, seen: TimedObservation) -> None:
        """Let an observation wait in place of an older one."""
        with self._change:
            if seen.must_go or seen.timestep > self._answered:
                self._waiting = seen
                self._change.notify_all()

    def take(self, seconds: float, stop: threading.Event) -> TimedObservation | None:
        """Return the observation that waits; None where none comes in so many seconds, or the server ends."""
        with self._change:
            self._change.wait_for(lambda: self._waiting is not None or stop.is_set(), seconds)
            seen, self._waiting = self._waiting, None
            return seen

    def wake(self) -> None:
        """Let those that wait look again."""
        with self._change:
            self._change.notify_all()

    def answer(self, seen: TimedObservation, setup: PolicySetup) -> Any:
        """Return the chunk for an observation."""
        played = seen.timestep - self._begin if self._begin >= 0 else 0
        chunk = self.session.infer(values_of(setup, seen.observation), played=max(0, played)).action.chunk
        with self._change:
            self._answered = self._begin = seen.timestep
        return chunk


def assemble(parts: Iterable[bytes]) -> bytes:
    """Return what the chunks of an observation hold together.

    Raises:
        DataError: when a chunk is damaged, the last is missing, or they are too large together.
    """
    content: list[bytes] = []
    size = 0
    for part in parts:
        found = fields(part, {1: int, 2: bytes})
        state, data = found.get(1, 0), found.get(2, b"")
        if state not in STATES:
            raise DataError(f"A chunk of the observation has the state {state}; allowed: 1, 2 and 3.", "send it again")
        if state == BEGIN:
            content, size = [], 0
        size += len(data)
        check_limit("message_bytes", size, "The observation", DataError)
        content.append(data)
        if state == END:
            return b"".join(content)
    raise DataError("The observation has no last chunk.", "send it again")


def values_of(setup: PolicySetup, raw: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values of a robot by its own and by LeRobot's names: vectors put together, pictures, renamed.

    Raises:
        DataError: when an element of a vector is not a number, or there are too many features.
    """
    if len(setup.features) > MAX_FEATURES:
        raise DataError(f"The policy instructions have {len(setup.features)} features.", f"send {MAX_FEATURES} at most")
    values = dict(raw)
    for name, feature in setup.features.items():
        if name.startswith(IMAGES) and name.removeprefix(IMAGES) in raw:
            values[name] = raw[name.removeprefix(IMAGES)]
        elif isinstance(feature, dict) and isinstance(feature.get("names"), list | tuple):
            elements = [raw[element] for element in feature["names"] if isinstance(element, str) and element in raw]
            if elements and len(elements) == len(feature["names"]):
                values[name] = _vector(name, elements)
    return values | {new: values[old] for old, new in setup.renames.items() if old in values}


def _vector(name: str, elements: list[Any]) -> Any:
    if not all(isinstance(element, float | int | np.floating | np.integer) for element in elements):
        raise DataError(f"'{name}' has an element that is not a number.", "send numbers for all that 'names' has")
    return np.array(elements, np.float32)
