"""A policy on another machine: a client of ``vlatool serve``, or of any other server of openpi's protocol."""

from __future__ import annotations

import threading
import time
import weakref
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from vlatool.bundle.spec import PolicySpec
from vlatool.errors import DataError, ServingError, SpecError, UsageError, require
from vlatool.files.limits import limit
from vlatool.files.validate import short_repr
from vlatool.runtime.arguments import check_positive, check_whole
from vlatool.runtime.interface import Action, Array
from vlatool.runtime.moments import MomentWindows
from vlatool.runtime.openpi_messages import EXTRA, pack, unpack

REMOTE = "remote"
"""Source of the actions of another machine."""
SCHEMES = ("ws://", "wss://")
OWN_NAME = "vlatool"
FIRST_RETRY_S, MAX_RETRY_S = 0.25, 8.0
"""Time without an attempt after a connection failed: doubled with each failure."""
MOST_LABELS = 2**31


class RemotePolicy:
    """Asks a server for each chunk: one request, one answer.

    An answer belongs to the request before it. Where none comes within ``answer_s``, the connection is given up, so
    that a late one is never taken for the answer to another observation; the next ``infer`` connects anew. Around it, a
    ``Deadline`` returns to the control loop in time whatever the network does, and discards what comes later.

    The policy's episode is that of the connection. A connection that is lost begins a new one, which matters to
    policies that keep values from step to step. Inputs with a ``history`` are sent with all of their moments.

    Args:
        url: ``ws://HOST:PORT`` or ``wss://...``.
        spec: Of a policy with the same inputs and actions, for servers that do not say what they serve and for those
            that cannot be reached yet. A chunk that is longer than that of the spec is cut.
        key: Key that the server asks for.
        names: Input -> name that the server uses, where they differ and ``vlatool serve`` does not say so.
        connect_s: Time until a connection, in seconds.
        answer_s: Time until an answer, in seconds.
        clock: Returns seconds.

    Raises:
        UsageError: when an argument is invalid, or the server serves something else than the ``spec`` says.
        ServingError: without a ``spec``, when the server cannot be reached or does not say what it serves.
        SpecError: when what it says is not a spec.
        MissingExtra: when websockets or msgpack is not installed.
    """

    def __init__(
        self,
        url: str,
        spec: PolicySpec | None = None,
        *,
        key: str = "",
        names: Mapping[str, str] | None = None,
        connect_s: float = 2.0,
        answer_s: float = 2.0,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        if not isinstance(url, str) or not url.startswith(SCHEMES):
            raise UsageError(f"The URL is {short_repr(url)}; allowed: ws://HOST:PORT.", "write ws://HOST:8000")
        self.url = url
        for name, value in (("connect_s", connect_s), ("answer_s", answer_s)):
            check_positive(name, value, "a number of seconds")
        self._connect = require("websockets.sync.client", EXTRA).connect
        require("msgpack", EXTRA)
        self._key, self._given_names, self._connect_s, self._answer_s = key, names, connect_s, answer_s
        self._clock, self._turn, self._observing = clock, threading.Lock(), threading.Lock()
        self._open: list[Any] = []
        """The connection, if there is one."""
        weakref.finalize(self, _close, self._open)
        self._pause_s, self._not_before = 0.0, -float("inf")
        self._sequence, self._reset = 0, False
        self._seed: int | None = None
        self.metadata: Mapping[str, Any] = {}
        """What the server said of itself."""
        self._names: dict[str, str] = {}
        self._expected = spec
        self._served: PolicySpec | None = None
        try:
            self._connection()
        except ServingError:
            if spec is None:
                raise
        self.spec: PolicySpec = self._served or spec or self._unknown()
        self._expected = self.spec
        self._moments = MomentWindows(self.spec)

    def _unknown(self) -> PolicySpec:
        raise ServingError(
            f"The server at {self.url} does not say what its actions mean.",
            "pass the spec of a bundle that acts alike: RemotePolicy(url, spec=policy.spec)",
        )

    def infer(self, observation: Mapping[str, Any], *, noise: Mapping[str, Array] | None = None) -> Action:
        """Return the next action chunk; waits up to ``connect_s`` and ``answer_s``.

        Raises:
            DataError: when an input is missing.
            UsageError: for a noise, which the server draws; as ``__init__`` does, of a server that came back.
            ServingError: when there is no connection or no answer, or the server refuses the observation.
            SpecError: as ``__init__`` does, of a server that came back.
        """
        if noise is not None:
            raise UsageError("The server draws the noise itself.", "leave noise out")
        start = self._clock()
        with self._observing:
            message = self._message(self._moments.window(observation))
        with self._turn:
            chunk, checks = self._ask(message)
            sequence, self._sequence = self._sequence, self._sequence + 1
        taken_ms = (self._clock() - start) * 1e3
        return Action(chunk, self.spec.action.labels, taken_ms, sequence, {}, REMOTE, taken_ms, checks)

    def observe(self, observation: Mapping[str, Any]) -> None:
        """Keep the observation of a control step without an inference, for inputs with a ``history``; nothing is sent.

        Raises:
            DataError: when an input with a history is missing or has another shape.
        """
        with self._observing:
            self._moments.window(observation)

    def reset(self, seed: int | None = None) -> None:
        """Start a new episode with the next ``infer``, before which a server of vlatool is told; nothing is sent now.

        Raises:
            UsageError: when the seed is not a whole number from 0.
        """
        check_whole("seed", seed, 0, optional=True)
        with self._observing:
            self._moments.forget()
        self._reset, self._seed, self._sequence = True, seed, 0

    def close(self) -> None:
        """Close the connection; the next ``infer`` opens another."""
        _close(self._open)

    def _message(self, observation: Mapping[str, Any]) -> dict[str, Any]:
        """Return the inputs under the names of the server."""
        missing = [tensor.name for tensor in self.spec.inputs if tensor.name not in observation]
        if missing:
            raise DataError(f"The observation has no '{missing[0]}'.", f"give all inputs: {', '.join(missing)}")
        values = {tensor.name: observation[tensor.name] for tensor in self.spec.inputs}
        return {self._names.get(name, name): value if isinstance(value, str) else np.asarray(value)
                for name, value in values.items()}  # fmt: skip

    def _ask(self, message: dict[str, Any]) -> tuple[Array, tuple[str, ...]]:
        """Return a chunk and the checks that changed it; a connection that fails in between is closed."""
        connection = self._connection()
        try:
            if self._reset and self.metadata:
                self._exchange(connection, {OWN_NAME: {"reset": self._seed}})
            self._reset = False
            answer = self._exchange(connection, message)
        except ServingError:
            raise
        except Exception as error:  # the seam: what a network does to a connection has many names
            self._give_up()
            raise ServingError(f"{self.url} gave no answer: {_reason(error)}.", "see that the server runs") from None
        return self._chunk(answer), tuple(map(str, _mapping(answer.get(OWN_NAME)).get("checks") or ()))

    def _exchange(self, connection: Any, message: dict[str, Any]) -> dict[str, Any]:
        connection.send(pack(message))
        answer = connection.recv(self._answer_s)
        if isinstance(answer, str):  # the server says why: the connection is fine, or it closes it
            raise ServingError(
                f"{self.url} refused the observation: {answer.strip()[:300]}", "see the server's records"
            )
        return unpack(answer)

    def _chunk(self, answer: dict[str, Any]) -> Array:
        """Return the actions of an answer: (T, A) float32, or (T,) int64 indices; ``CheckedPolicy`` checks the rest."""
        actions = answer.get("actions")
        if not isinstance(actions, np.ndarray) or actions.dtype.kind not in "iuf" or not actions.ndim * actions.size:
            self._give_up()
            raise ServingError(f"{self.url} answered without actions.", "serve a policy with openpi's protocol")
        actions = actions[: self.spec.chunk]
        if self.spec.action.kind != "discrete":
            with np.errstate(over="ignore"):  # what is too large becomes infinite, and is refused as such
                return np.array(actions, np.float32)
        if not np.all((np.abs(actions) < MOST_LABELS) & (actions == np.floor(actions))):
            self._give_up()
            raise ServingError(f"{self.url} answered with numbers that are not indices of labels.",
                               "serve a policy whose actions are the labels of the spec")  # fmt: skip
        return np.array(actions, np.int64)

    def _connection(self) -> Any:
        """Return the connection, or a new one.

        Raises:
            ServingError: when the server cannot be reached, or the last attempt failed shortly before.
            SpecError, UsageError: when it serves something else than expected.
        """
        if self._open:
            return self._open[0]
        if self._clock() < self._not_before:
            raise ServingError(f"{self.url} could not be reached shortly before.", "see that the server runs")
        try:
            headers = {"Authorization": f"Api-Key {self._key}"} if self._key else None
            context = self._connect(
                self.url, compression=None, max_size=limit("message_bytes"), proxy=None, additional_headers=headers,
                open_timeout=self._connect_s,
            )  # fmt: skip
            connection = context.__enter__()  # it stays open beyond this call; ``_close`` ends it
            self._open.append(connection)
            self._agree(_mapping(unpack(connection.recv(self._connect_s)).get(OWN_NAME)))
        except (SpecError, UsageError):
            self._give_up()
            raise
        except Exception as error:  # the seam: so many ways in which a network fails
            self._give_up()
            raise ServingError(f"{self.url} cannot be used: {_reason(error)}.", "see that the server runs") from None
        self._pause_s, self._sequence = 0.0, 0
        return connection

    def _agree(self, metadata: Mapping[str, Any]) -> None:
        """Take what the server says of itself, if it serves what is expected.

        Raises:
            UsageError: when its actions mean something else, or it takes other inputs.
            SpecError: when its spec is none.
        """
        if "spec" in metadata:
            served = spec_of(metadata["spec"])
            if self._expected is not None:
                check_agrees(self._expected, served)
            self._served = served
        names = _mapping(metadata.get("names"))
        self._names = {**{name: str(other) for name, other in names.items()}, **(self._given_names or {})}
        self.metadata = metadata

    def _give_up(self) -> None:
        _close(self._open)
        self._pause_s = min(MAX_RETRY_S, 2 * self._pause_s or FIRST_RETRY_S)
        self._not_before = self._clock() + self._pause_s


def check_agrees(expected: PolicySpec, served: PolicySpec) -> None:
    """Refuse a server whose actions mean something else than expected, or that takes an input that there is not.

    Raises:
        UsageError: naming the first difference.
    """
    from vlatool.runtime.stack import check_same_actions

    check_same_actions(expected, served)
    if other := {tensor.name for tensor in served.inputs} - {tensor.name for tensor in expected.inputs}:
        raise UsageError(f"The server takes {', '.join(sorted(other))}, which the other policy does not.",
                         "serve a policy with the same inputs")  # fmt: skip


def spec_of(values: Any) -> PolicySpec:
    """Return the spec that a server says; raises SpecError when it is none."""
    if not isinstance(values, Mapping):
        raise SpecError(f"The spec is a {type(values).__name__}; allowed: a mapping.")
    return PolicySpec.from_dict(values)


def _mapping(value: Any) -> Mapping[str, Any]:
    return value if isinstance(value, Mapping) else {}


def _reason(error: Exception) -> str:
    text = (str(getattr(error, "message", error)).strip().splitlines() or [""])[0].rstrip(".")
    return f"{type(error).__name__}: {text}"[:300]


def _close(connections: list[Any]) -> None:
    """Close a connection without waiting for the other side."""
    while connections:
        connection = connections.pop()
        connection.close_timeout = 0.0
        try:
            connection.close()
        except Exception:  # the seam: it is gone in any case
            continue
