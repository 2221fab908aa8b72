"""openpi's websocket protocol: a frame that says what is served, then one of actions for each observation."""

from __future__ import annotations

import asyncio
import contextlib
import http
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from vlatool.errors import DataError, DeadlineMissed, UsageError, VlatoolError, require
from vlatool.files.limits import limit
from vlatool.files.messages import to_json
from vlatool.machine.version import VERSION
from vlatool.runtime.openpi_messages import flat, pack, unpack
from vlatool.serving._access import Access
from vlatool.serving._endpoint import CLOSE_S, EXTRA, Endpoint
from vlatool.serving._service import Answer, Service, Session

OPEN_S = 10.0
"""How long a client has for its handshake."""
PING_S = 20.0
"""Seconds between two pings, and until a client that does not answer one is given up."""
FAULT, FULL = 1011, 1013
"""Codes of the websocket protocol: an error; try again later."""
OWN_NAME = "vlatool"
"""Name of what other servers and clients of the protocol do not have."""


class OpenpiServer(Endpoint):
    """Clients of openpi connect unchanged: ``WebsocketClientPolicy``, and what wraps it.

    The names of an observation are those of the client, of mappings within it ``images.top``. An observation that is
    refused is answered by a text and the end of the connection, as openpi does it; a missed deadline by a text alone.
    """

    default_port = 8000

    def __init__(self, service: Service, access: Access, port: int, on_kill: Callable[[], None] | None = None) -> None:
        super().__init__(service, access, port, on_kill)
        self._websockets = require("websockets.asyncio.server", EXTRA)
        self._closed: type[Exception] = require("websockets.exceptions", EXTRA).ConnectionClosed
        require("msgpack", EXTRA)
        self._metadata = pack({OWN_NAME: describe(service)})

    def start(self) -> str:
        """Begin to serve; see ``Endpoint.start``."""
        self._loop = asyncio.new_event_loop()
        self._pool = ThreadPoolExecutor(thread_name_prefix="vlatool-openpi")
        self._thread = threading.Thread(target=self._loop.run_forever, name="vlatool-openpi", daemon=True)
        self._thread.start()
        try:
            self._server: Any = asyncio.run_coroutine_threadsafe(self._serve(), self._loop).result()
        except OSError as error:
            self._end()
            raise self.bind_error(error) from None
        self.port = self._server.sockets[0].getsockname()[1]
        host = f"[{self.access.host}]" if ":" in self.access.host else self.access.host
        return f"ws://{host}:{self.port}"

    async def _serve(self) -> Any:
        return await self._websockets.serve(
            self._converse, self.access.host, self.port, process_request=self._admit, origins=[None],
            compression=None, max_size=limit("message_bytes"), max_queue=1, open_timeout=OPEN_S,
            ping_interval=PING_S, ping_timeout=PING_S, close_timeout=CLOSE_S / 2, server_header=None,
        )  # fmt: skip

    def close(self) -> None:
        """End; see ``Endpoint.close``."""

        async def end() -> None:
            self._server.close()
            with contextlib.suppress(asyncio.TimeoutError):
                await asyncio.wait_for(self._server.wait_closed(), CLOSE_S)

        asyncio.run_coroutine_threadsafe(end(), self._loop).result()
        self._end()

    def _end(self) -> None:
        self._pool.shutdown(wait=False, cancel_futures=True)
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()

    def _admit(self, connection: Any, request: Any) -> Any:
        """Answer a request for the state, and refuse a client without the key or without a place; else None."""
        if request.path == "/healthz":
            return connection.respond(http.HTTPStatus.OK, "OK\n")
        found = request.headers.get_all("Authorization")
        if not self.access.admits_header(found[0] if len(found) == 1 else None):
            text = "The key is missing or wrong: send the header Authorization: Api-Key KEY.\n"
            return connection.respond(http.HTTPStatus.UNAUTHORIZED, text)
        if self.service.full:
            return connection.respond(http.HTTPStatus.SERVICE_UNAVAILABLE, "There are too many clients.\n")
        return None

    async def _converse(self, connection: Any) -> None:
        """Answer the frames of one client until it goes."""
        with contextlib.suppress(self._closed):
            try:
                session = self.service.session(f"openpi {_address(connection)}")
            except VlatoolError as error:
                await connection.close(FULL, error.message[:100])
                return
            with session:
                await connection.send(self._metadata)
                await self._answer_frames(connection, session)

    async def _answer_frames(self, connection: Any, session: Session) -> None:
        previous_ms: float | None = None
        while True:
            frame = await connection.recv()
            began = self.service.clock()
            try:
                answer = await self._loop.run_in_executor(self._pool, self._answer, session, frame, previous_ms)
            except DeadlineMissed as error:
                await connection.send(str(error))
                continue
            except Exception as error:  # the seam: whatever a policy raises ends one connection, not the server
                known = isinstance(error, VlatoolError)
                await connection.send(str(error) if known else f"internal error: {type(error).__name__}")
                await connection.close(FAULT, "The request was refused; the frame before says why.")
                return
            await connection.send(answer)
            previous_ms = (self.service.clock() - began) * 1e3

    def _answer(self, session: Session, frame: Any, previous_ms: float | None) -> bytes:
        """Return the answer to a frame, in a thread that may wait."""
        values = unpack(frame)
        if OWN_NAME in values:
            return pack({OWN_NAME: _perform(session, values[OWN_NAME])})
        return pack(message_of(session.infer(flat(values)), previous_ms))


def describe(service: Service) -> dict[str, Any]:
    """Return what clients may know of a policy: its spec, and how many actions of a chunk are played."""
    bundle = getattr(service.policy, "bundle", None)
    named = {} if bundle is None else {"name": bundle.manifest.name, "version": bundle.manifest.version,
                                       "identity": getattr(service.policy, "identity", "")}  # fmt: skip
    return {
        "vlatool": VERSION, **named, "spec": to_json(service.spec, defaults=False), "names": service.names.sources,
        "execute": service.execute, "deadline_ms": service.deadline_ms, "robot": service.robot,
    }  # fmt: skip


def message_of(answer: Answer, previous_ms: float | None = None) -> dict[str, Any]:
    """Return an answer as openpi's clients take it."""
    timing = {"infer_ms": answer.infer_ms} | ({} if previous_ms is None else {"prev_total_ms": previous_ms})
    own = {"sequence": answer.action.sequence, "checks": list(answer.action.checks), "wait_ms": answer.wait_ms}
    return {"actions": answer.action.chunk, "server_timing": timing, OWN_NAME: own}


def _perform(session: Session, asked: Any) -> dict[str, Any]:
    """Do what only vlatool's own clients ask for: a new episode."""
    if not isinstance(asked, dict) or set(asked) != {"reset"}:
        raise DataError(
            f"'{OWN_NAME}' has {str(asked)[:80]}; allowed: reset.", f'send {{"{OWN_NAME}": {{"reset": SEED}}}}'
        )
    try:
        session.reset(asked["reset"])
    except UsageError as error:
        raise DataError(error.message, error.fix) from None
    return {"reset": True}


def _address(connection: Any) -> str:
    address = connection.remote_address
    return ":".join(map(str, address[:2])) if isinstance(address, tuple) else str(address)
