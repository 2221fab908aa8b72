"""One policy for several clients: whose turn it is, until when, in which episode, and within which limits."""

from __future__ import annotations

import itertools
import threading
import time
from collections.abc import Callable, Mapping
from types import TracebackType
from typing import Any, NamedTuple

from vlatool.bundle.spec import PolicySpec
from vlatool.errors import DeadlineMissed, ServingError
from vlatool.runtime.arguments import check_positive, check_whole
from vlatool.runtime.control.action_check import CheckedPolicy
from vlatool.runtime.control.deadline import Deadline
from vlatool.runtime.interface import Action, Policy, layers_of
from vlatool.runtime.moments import MomentWindows
from vlatool.runtime.policy import BundlePolicy
from vlatool.serving._chunk_envelope import ChunkEnvelope
from vlatool.serving._observation_names import ObservationNames

MAX_CLIENTS = 8
LONGEST_WAIT_S = 60.0
"""How long a request waits for its turn where there is no deadline."""


class Answer(NamedTuple):
    """What a client gets for an observation.

    Args:
        action: Of the policy; its chunk within the limits of the robot.
        infer_ms: Time of the inference and of the envelope, in milliseconds.
        wait_ms: Time from the request until its turn, in milliseconds.
    """

    action: Action
    infer_ms: float
    wait_ms: float


class RequestRecord(NamedTuple):
    """What became of one request for actions.

    Args:
        client: Protocol and address of the client.
        number: Number of the request of this client, from 0.
        wait_ms: Time until its turn, in milliseconds; 0 where it had none.
        answer_ms: Time until there was an answer, in milliseconds.
        missed: Whether there was no action by the deadline.
        error: Why there was no action; empty where there was one.
        checks: Names of the checks of the envelope that changed the chunk.
    """

    client: str
    number: int
    wait_ms: float
    answer_ms: float
    missed: bool
    error: str
    checks: tuple[str, ...]


class Service:
    """Answers observations of several clients with one policy, one at a time.

    Each client has an episode of its own: what the policy keeps from step to step, and its noise, are put in before
    its inference and taken out after it.

    Args:
        policy: Infers; nobody else may use it meanwhile.
        deadline_ms: Time from the arrival of a request until its actions, in milliseconds, the wait for a turn
            included: a later inference is stopped, and the client gets an error. None for no deadline.
        names: Input -> name that clients use, where they differ.
        execute: Actions of each chunk that clients play before they ask again; that of the spec, or the whole chunk,
            when 0.
        robot: Name of the robot within whose limits the chunks are; empty for none.
        clients: Clients at a time.
        telemetry: Called with a ``RequestRecord`` after each request. What it raises is counted, not passed on.
        clock: Returns seconds.

    Raises:
        UsageError: when an argument is out of its range, or the limits of the robot do not fit the action.
        ProfileError: when no robot has that name.
    """

    def __init__(
        self,
        policy: Policy,
        *,
        deadline_ms: float | None = None,
        names: Mapping[str, str] | None = None,
        execute: int = 0,
        robot: str = "",
        clients: int = MAX_CLIENTS,
        telemetry: Callable[[RequestRecord], Any] | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        check_positive("deadline_ms", deadline_ms, "a number of milliseconds", optional=True)
        check_whole("execute", execute, 0, policy.spec.chunk)
        check_whole("clients", clients, 1)
        self.spec: PolicySpec = policy.spec
        self.policy, self.robot, self.deadline_ms, self.clock = policy, robot, deadline_ms, clock
        self.execute = execute or policy.spec.execute or policy.spec.chunk
        self.names = ObservationNames(policy.spec, names)
        self.requests = self.missed = self.failed = self.failed_records = 0
        """Requests for actions; those without an action by the deadline, for another reason; records without a sink."""
        checked = policy if isinstance(policy, BundlePolicy) else CheckedPolicy(policy)
        self._limited = Deadline(checked, deadline_ms, clock=clock) if deadline_ms is not None else None
        self._infers: Policy = self._limited or checked
        self._stateful = next((layer for layer in layers_of(policy) if hasattr(layer, "restore")), None)
        self.clients = clients if self._stateful is not None else 1
        """Clients at a time: one where nothing can put their episodes in and take them out."""
        self._sessions: set[Session] = set()
        self._turn, self._count = threading.Lock(), threading.Lock()
        self._last: Session | None = None
        self._telemetry = telemetry
        self.new_envelope()  # to refuse a robot now, not its first client

    def session(self, client: str) -> Session:
        """Return the episode of a new client, to be closed when it goes.

        Args:
            client: Protocol and address, for records.

        Raises:
            ServingError: when there are as many clients as there may be.
        """
        session = Session(self, client)
        with self._count:
            if len(self._sessions) >= self.clients:
                raise ServingError(f"{len(self._sessions)} clients use the policy already.", "wait until one has gone")
            self._sessions.add(session)
        return session

    def leave(self, session: Session) -> None:
        """Forget a client."""
        with self._count:
            self._sessions.discard(session)

    @property
    def full(self) -> bool:
        """Whether there are as many clients as there may be."""
        return len(self._sessions) >= self.clients

    def new_envelope(self) -> ChunkEnvelope | None:
        """Return the envelope of a robot that is at rest; None where no robot was named."""
        return ChunkEnvelope(self.spec, self.robot) if self.robot else None

    def answer(self, session: Session, values: Mapping[str, Any], received: float, played: int) -> Answer:
        """Return the actions for what a client sees, when it is its turn.

        Args:
            received: Time of the clock at which the request arrived, from which the deadline counts.
            played: Actions of its last chunk that it has played.

        Raises:
            DeadlineMissed: when there is no action in time.
            DataError, GraphError: as the policy's ``infer`` does.
        """
        wait_s = LONGEST_WAIT_S if self.deadline_ms is None else self.deadline_ms / 1e3
        if not self._turn.acquire(timeout=max(0.0, received + wait_s - self.clock())):
            raise DeadlineMissed(f"Other clients had the policy for {wait_s * 1e3:g} ms.")
        began = self.clock()
        try:
            action = self._infer(session, values, received)
            if session.envelope is not None:
                chunk, checks = session.envelope.apply(action.chunk, values, played)
                action = action._replace(chunk=chunk, checks=(*action.checks, *checks))
        finally:
            self._turn.release()
        return Answer(action, (self.clock() - began) * 1e3, (began - received) * 1e3)

    def _infer(self, session: Session, values: Mapping[str, Any], received: float) -> Action:
        """Infer in the episode of a client; one that fails changes nothing of it."""
        if self._limited is not None:
            if self._limited.busy:
                raise DeadlineMissed("An inference that was stopped before has not ended yet.")
            self._limited.started = received
        if session is not self._last:
            self._last = None
            self._enter(session)
        self._last = None
        action = self._infers.infer(session.moments.window(values))
        session.state = getattr(self._stateful, "snapshot", None)
        self._last = session
        return action

    def _enter(self, session: Session) -> None:
        if session.state is None or self._stateful is None:
            self._infers.reset(session.seed)
        else:
            self._stateful.restore(session.state)

    def forget_last(self, session: Session) -> None:
        """Let a client enter anew at its next request: it starts an episode."""
        if self._last is session:
            self._last = None

    def note(self, record: RequestRecord) -> None:
        """Count a request, and give its record to the sink."""
        with self._count:
            self.requests += 1
            self.missed += record.missed
            self.failed += bool(record.error) and not record.missed
        if self._telemetry is None:
            return
        try:
            self._telemetry(record)
        except Exception:  # the seam: a full disk is no reason to let a robot wait
            self.failed_records += 1

    def close(self) -> None:
        """End the thread of the inferences."""
        if self._limited is not None:
            self._limited.close()


class Session:
    """The episode of one client."""

    def __init__(self, service: Service, client: str) -> None:
        self._service, self.client = service, client
        self._numbers = itertools.count()
        self._one = threading.Lock()
        self.envelope = service.new_envelope()
        self.moments = MomentWindows(service.spec, every_step=service.execute == 1)
        self.state: Any = None
        """What the policy keeps for this client; None at the start of an episode."""
        self.seed: int | None = None
        """Seed of the noise of the episode."""

    def infer(self, values: Mapping[str, Any], *, played: int | None = None) -> Answer:
        """Return the actions for what the client sees.

        Args:
            values: Name -> value, under the names of the client.
            played: Actions of its last chunk that it has played; those of ``execute`` when None.

        Raises:
            DataError: when an input is missing or does not fit.
            DeadlineMissed: when there is no action in time.
            ServingError: when the client has another request that is not answered yet.
            GraphError: as the policy's ``infer`` does.
        """
        received = self._service.clock()
        if not self._one.acquire(blocking=False):
            raise ServingError("This client has a request that is not answered yet.", "ask once at a time")
        answer, error = None, None
        try:
            observation = self._service.names(values)
            steps = self._service.execute if played is None else played
            answer = self._service.answer(self, observation, received, steps)
            return answer
        except Exception as caught:
            error = caught
            raise
        finally:
            self._one.release()
            self._note(received, answer, error)

    def _note(self, received: float, answer: Answer | None, error: Exception | None) -> None:
        what = "" if error is None else f"{type(error).__name__}: {getattr(error, 'message', error)}"
        wait_ms, checks = (0.0, ()) if answer is None else (answer.wait_ms, answer.action.checks)
        taken_ms = (self._service.clock() - received) * 1e3
        missed = isinstance(error, DeadlineMissed)
        record = RequestRecord(self.client, next(self._numbers), wait_ms, taken_ms, missed, what, checks)
        self._service.note(record)

    def reset(self, seed: int | None = None) -> None:
        """Start a new episode: what the policy keeps for this client is forgotten, its noise starts again.

        The envelope goes on: the robot is where it is.

        Raises:
            UsageError: when the seed is not a whole number from 0.
        """
        check_whole("seed", seed, 0, optional=True)
        with self._one:
            self.state, self.seed = None, seed
            self.moments.forget()
            self._service.forget_last(self)

    def close(self) -> None:
        """Make room for another client."""
        self._service.leave(self)

    def __enter__(self) -> Session:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
