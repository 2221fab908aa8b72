"""The active bundle of a store as a policy: trial after an update, rollback on its own, exchange while it runs."""

from __future__ import annotations

import contextlib
import threading
import time
import weakref
from collections import deque
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vlatool.bundle.spec import PolicySpec
from vlatool.deployment.deploy import check_same, open_slot
from vlatool.deployment.judge import Judge, check_contract
from vlatool.deployment.pointer import Pointer, Slot, Trial
from vlatool.deployment.store import LOCK_S, MAX_STARTS, Store
from vlatool.errors import DeploymentError, GraphError, UsageError, VlatoolError
from vlatool.runtime import load
from vlatool.runtime.arguments import check_positive
from vlatool.runtime.interface import Action, Array, Policy

MAX_EVENTS = 100


@dataclass
class _Running:
    """A bundle that is open, its trial, and the policy that answers when the trial fails."""

    policy: Any
    name: str
    slot: Slot
    trial: Trial | None = None
    judge: Judge | None = None
    standby: _Running | None = None
    start: float = 0.0

    @property
    def stateful(self) -> bool:
        """Whether the policy keeps values or earlier moments: it is exchanged between two episodes alone."""
        spec: PolicySpec = self.policy.spec
        program = getattr(self.policy, "program", None)
        return bool(getattr(program, "keeps", False)) or any(tensor.history for tensor in spec.inputs)


class SlotPolicy:
    """The active bundle of a store: ``infer`` and ``reset`` as of any policy.

    Each action is computed by one bundle alone: bundles are exchanged between two inferences, those that keep values
    between two episodes. A bundle on trial is committed after its ticks and seconds, and rolled back when an action is
    not in the contract or not finite, an inference fails that the bundle before it answers, inferences are late, the
    process grows, ``fail`` is called, or ``MAX_STARTS`` processes end before it is committed without ``close``. The
    files are changed by another thread, never within an inference.

    Args:
        store: a store, or its directory.
        standby: whether the bundle before stays open during a trial: it answers in the same inference in which the
            trial fails. Otherwise that inference raises, and the next one that finds it open uses it.
        clock: function that returns seconds.
        open_policy: function from the directory of a verified bundle to a policy; ``vlatool.load`` when None.
        options: arguments of ``vlatool.load``.

    Raises:
        UsageError: when the store is not a path.
        DeploymentError: when the store is unreadable or holds no bundle.
        VlatoolError: what ``vlatool.load`` raises of the active bundle, when the other one cannot be loaded either.

    Example:
        >>> with SlotPolicy("/var/lib/robot/policy") as policy:      # doctest: +SKIP
        ...     policy.watch()
        ...     policy.infer(observation).chunk
    """

    def __init__(
        self,
        store: Store | str,
        *,
        standby: bool = True,
        clock: Callable[[], float] = time.monotonic,
        open_policy: Callable[[Path], Policy] | None = None,
        **options: Any,
    ) -> None:
        self.store = store if isinstance(store, Store) else Store(store)
        self.events: deque[str] = deque(maxlen=MAX_EVENTS)
        """What happened to the slots, oldest first."""
        self._standby, self._clock = standby, clock
        self._open = open_policy or (lambda path: load(path, **options))
        self._writer = ThreadPoolExecutor(1, "vlatool-store")
        self._watcher: threading.Thread | None = None
        self._end = threading.Event()
        self._refresh_turn, self._exchange_turn = threading.Lock(), threading.Lock()
        self._stopped = False
        self._failed: set[str] = set()
        self._failure = ""
        self._sequence = 0
        self._next: _Running | None = None
        self._running = self._start()
        self._running.start = clock()

    @property
    def spec(self) -> PolicySpec:
        """Inputs, outputs and control rate of the bundle that answers."""
        return self._running.policy.spec  # type: ignore[no-any-return]

    @property
    def slot(self) -> Slot:
        """The bundle that answers."""
        return self._running.slot

    @property
    def on_trial(self) -> bool:
        """Whether it is not committed yet."""
        return self._running.trial is not None

    def infer(self, observation: Mapping[str, Any], *, noise: Mapping[str, Array] | None = None) -> Action:
        """Return the next action chunk, of one bundle; see ``vlatool.runtime.policy.BundlePolicy.infer``."""
        if self._next is not None:
            self._exchange(between_episodes=False)
        running = self._running
        if running.judge is None:
            action: Action = running.policy.infer(observation, noise=noise)
        else:
            action = self._infer_on_trial(running, running.judge, observation, noise)
        number = self._sequence
        self._sequence += 1
        return action if action.sequence == number else action._replace(sequence=number)

    def stop(self) -> None:
        """End the inference in progress, from another thread, in whichever bundle it is; see ``BundlePolicy.stop``."""
        self._stopped = True
        for policy in self._policies("stop"):
            policy.stop()

    def resume(self) -> None:
        """Allow inferences again after ``stop``."""
        self._stopped = False
        for policy in self._policies("resume"):
            policy.resume()

    @property
    def snapshot(self) -> tuple[int, list[tuple[Any, Any]]]:
        """What ``restore`` takes: the sequence number, and what each open bundle kept."""
        return self._sequence, [(policy, policy.snapshot) for policy in self._policies("restore")]

    def restore(self, snapshot: tuple[int, list[tuple[Any, Any]]]) -> None:
        """Take back the last inference: what bundles kept is as it was. One that was rolled back stays rolled back."""
        self._sequence, values = snapshot
        for policy, kept in values:
            policy.restore(kept)

    def _policies(self, method: str) -> list[Any]:
        """Return the policies that are open, which an inference may come to, as far as they have a method.

        The next one is looked at first: when another thread exchanges them meanwhile, it is the one that answers.
        """
        found = [self._next, self._running]
        found += [running.standby for running in found if running is not None]
        return [running.policy for running in found if running is not None and hasattr(running.policy, method)]

    def observe(self, observation: Mapping[str, Any]) -> None:
        """Keep the observation of a control step without an inference."""
        running = self._running
        running.policy.observe(observation)
        if running.standby is not None:
            running.standby.policy.observe(observation)

    def reset(self, seed: int | None = None) -> None:
        """Start a new episode; see ``vlatool.runtime.policy.BundlePolicy.reset``."""
        if self._next is not None:
            self._exchange(between_episodes=True)
        running = self._running
        running.policy.reset(seed)
        if running.standby is not None:
            running.standby.policy.reset(seed)
        self._sequence = 0

    def fail(self, reason: str) -> None:
        """Let the trial fail: what is outside of this policy, such as an envelope, found its actions to be wrong."""
        self._failure = reason or "the controller gave no reason"

    def refresh(self) -> bool:
        """Open the bundle that the pointer names if it is another one; it answers from one of the next inferences on.

        It takes as long as loading a bundle: call it from another thread than the control loop, or use ``watch``.

        Returns:
            Whether a bundle was opened.

        Raises:
            DeploymentError: when the store cannot be read.
        """
        with self._refresh_turn:
            pointer, running = self.store.read(), self._next or self._running
            slot = pointer.current
            if slot is None or slot.bundle == running.slot.bundle or slot.bundle in self._failed:
                return False
            try:
                bundle = open_slot(self.store, pointer.active, slot)
                check_contract(bundle.manifest.spec, self.spec)
            except VlatoolError as error:
                self._note(f"not exchanged while it runs: {error.message}")
                return False
            upcoming = self._upcoming(self._counted(pointer))
            if upcoming is None or upcoming.slot.bundle == self._running.slot.bundle:
                return False
            with self._exchange_turn:
                self._next = upcoming
            return True

    def watch(self, period_s: float = 1.0) -> None:
        """Call ``refresh`` in a thread of its own until ``close``, or until nobody holds this policy.

        Args:
            period_s: Seconds between two calls.

        Raises:
            UsageError: when the period is not a number above 0.
        """
        check_positive("period_s", period_s, "a number of seconds")
        arguments = weakref.ref(self), self._end, period_s
        self._watcher = threading.Thread(target=_watch, args=arguments, name="vlatool-watch", daemon=True)
        self._watcher.start()
        weakref.finalize(self, self._end.set)

    def wait(self) -> None:
        """Wait until the changes of the store that were begun are on the disk."""
        with contextlib.suppress(RuntimeError):  # closed
            self._writer.submit(lambda: None).result()

    def close(self) -> None:
        """End in an orderly way: a trial that was not decided does not count as a crash."""
        self._end.set()
        if self._watcher is not None:
            self._watcher.join()
        self._end_failed_trial()
        self._writer.shutdown()
        if self.on_trial:
            with contextlib.suppress(VlatoolError):
                self.store.count_start(self.slot.bundle, -1, LOCK_S)

    def __enter__(self) -> SlotPolicy:
        """Return this policy."""
        return self

    def __exit__(self, kind: type[BaseException] | None, *_error: object) -> None:
        """Close it; a controller that ends with an error has not ended in an orderly way."""
        if kind is None or not issubclass(kind, Exception):
            self.close()
        else:
            self._end.set()
            self._end_failed_trial()
            self._writer.shutdown()

    def _end_failed_trial(self) -> None:
        """Roll back a trial that ``fail`` has ended and no inference has come after."""
        if self._failure and self.on_trial:
            self._leave(self.slot, self._failure)

    def _start(self) -> _Running:
        """Open the active bundle, or the other one if that is not possible."""
        pointer = self.store.read_deployed()
        pointer = self._counted(pointer)
        try:
            return self._opened(pointer, pointer.active)
        except UsageError:
            raise
        except Exception as error:  # whatever a new bundle does to an engine
            return self._other_than(pointer, error)

    def _other_than(self, pointer: Pointer, error: Exception) -> _Running:
        """Open the slot that is not active, and go back to it; raise the error where that fails, too."""
        try:
            found = self._opened(pointer.exchange(""), pointer.inactive)
        except Exception:
            raise error from None
        self._leave(pointer.slots[pointer.active], _reason(error))
        return found

    def _opened(self, pointer: Pointer, name: str) -> _Running:
        """Open a slot of the pointer, with its trial and standby if it has one."""
        if name not in pointer.slots:
            raise DeploymentError(
                f"The store {self.store.path} holds no other bundle.", "deploy one: vlatool deploy BUNDLE"
            )
        slot = pointer.slots[name]
        bundle = open_slot(self.store, name, slot)
        policy = self._open(bundle.path)
        if not isinstance(policy, Policy):
            raise UsageError(
                f"{type(policy).__name__} does not infer; a slot is opened as a policy.",
                "leave out deadline_ms, fallback, envelope and controllers here, and wrap the SlotPolicy in them",
            )
        check_same(getattr(policy, "bundle", bundle), slot)
        running = _Running(policy, name, slot)
        trial = pointer.trial
        if trial is not None:
            running.trial, running.judge = trial, Judge(policy.spec, trial.latency_ms, trial.memory_mb)
            running.standby = self._standby_of(pointer)
        return running

    def _standby_of(self, pointer: Pointer) -> _Running | None:
        """Return what answers when the trial fails: what runs now, or the other slot, opened."""
        if not self._standby:
            return None
        running: _Running | None = getattr(self, "_running", None)
        if running is not None and running.slot.bundle == pointer.slots[pointer.inactive].bundle:
            return running
        try:
            return self._opened(pointer.exchange(""), pointer.inactive)
        except Exception as error:
            self._note(f"nothing stands by during the trial: {_reason(error)}")
            return None

    def _counted(self, pointer: Pointer) -> Pointer:
        """Count a start of the trial, and return the pointer; that of a rollback where it started too often.

        A trial whose start cannot be counted is not begun: a loop of crashes would not be found out.
        """
        slot, trial = pointer.current, pointer.trial
        if slot is None or trial is None:
            return pointer
        reason = f"{trial.starts} starts ended before the trial was over" if trial.starts >= MAX_STARTS else ""
        try:
            if not reason:
                return self.store.count_start(slot.bundle, 1, LOCK_S)
            self._note(f"rolled back {slot.bundle[:19]}: {reason}")
            return self.store.roll_back(reason, slot.bundle, LOCK_S)
        except VlatoolError as error:
            self._note(f"the trial of {slot.bundle[:19]} is not begun: {error.message}")
            return pointer.exchange(reason)

    def _upcoming(self, pointer: Pointer) -> _Running | None:
        """Open the active slot beside what runs; one that fails is rolled back."""
        slot = pointer.slots[pointer.active]
        try:
            return self._opened(pointer, pointer.active)
        except Exception as error:
            self._leave(slot, _reason(error))
            return None

    def _exchange(self, *, between_episodes: bool) -> None:
        """Let the next bundle answer from now on."""
        with self._exchange_turn:
            upcoming = self._next
            if upcoming is None or (not between_episodes and (upcoming.stateful or self._running.stateful)):
                return
            self._next = None
            upcoming.start = self._clock()
            self._running, self._failure = upcoming, ""
            self._note(f"{upcoming.slot.bundle[:19]} answers")

    def _infer_on_trial(
        self, running: _Running, judge: Judge, observation: Mapping[str, Any], noise: Mapping[str, Array] | None
    ) -> Action:
        start = self._clock()
        try:
            action: Action = running.policy.infer(observation, noise=noise)
            wrong = judge.wrong_action(action.chunk)
            if wrong:
                raise GraphError(f"{running.slot.name} on trial: {wrong}.", "the bundle before it answers from now on")
        except Exception as error:
            if not self._stopped:
                return self._answer_instead(running, observation, noise, error)
            if late := judge.count_stop():
                self._fall_back(running, late)
            raise
        overrun = self._failure or judge.overrun(1e3 * (self._clock() - start))
        if running.trial is None:
            return action
        if overrun:
            self._fall_back(running, overrun)
            return action
        if running.standby is not None and running.stateful:
            _follow(running.standby.policy, observation)
        self._commit_when_over(running, running.trial, judge)
        return action

    def _answer_instead(
        self, running: _Running, observation: Mapping[str, Any], noise: Mapping[str, Array] | None, error: Exception
    ) -> Action:
        """Return the answer of the bundle before; where it fails as well, the observation is at fault."""
        if running.standby is None:
            if isinstance(error, GraphError) and running.trial is not None:
                self._fall_back(running, _reason(error))
            raise error
        try:
            action: Action = running.standby.policy.infer(observation, noise=noise)
        except Exception:
            if self._stopped:  # it had taken the observation, and no time was left
                self._fall_back(running, _reason(error))
            raise error from None
        self._fall_back(running, _reason(error))
        return action

    def _fall_back(self, running: _Running, reason: str) -> None:
        """Let the bundle before answer from now on, and write the rollback."""
        self._failure = ""
        self._leave(running.slot, reason)
        if running.standby is not None:
            self._running = running.standby
        else:
            running.trial = None  # it is judged on, until the bundle before is open
            self._later(lambda: self._save(self.refresh))

    def _leave(self, slot: Slot, reason: str) -> None:
        self._failed.add(slot.bundle)
        self._note(f"rolled back {slot.bundle[:19]}: {reason}")
        self._later(lambda: self._save(lambda: self.store.roll_back(reason, slot.bundle, LOCK_S)))

    def _commit_when_over(self, running: _Running, trial: Trial, judge: Judge) -> None:
        if judge.count < trial.ticks or self._clock() - running.start < trial.seconds:
            return
        spare, running.standby = running.standby, None
        running.judge = running.trial = None
        self._note(f"committed {running.slot.bundle[:19]} after {judge.count} inferences")
        self._later(lambda: self._write_commit(running.slot, spare))

    def _write_commit(self, slot: Slot, _spare: _Running | None) -> None:
        """Write the commit; what stood by is held until then, so that it is closed outside of an inference."""
        self._save(lambda: self.store.commit(slot.bundle, LOCK_S))

    def _save(self, change: Callable[[], object]) -> None:
        try:
            change()
        except Exception as error:
            self._note(f"not done: {_reason(error)}")

    def _later(self, work: Callable[[], object]) -> None:
        """Do something in another thread, one after the other: a flush of a file may take longer than a tick."""
        try:
            self._writer.submit(work)
        except RuntimeError:  # closed
            work()

    def _note(self, text: str) -> None:
        self.events.append(text)


def _watch(of: weakref.ref[SlotPolicy], end: threading.Event, period_s: float) -> None:
    while not end.wait(period_s) and (policy := of()) is not None:
        policy._save(policy.refresh)
        del policy


def _follow(policy: Any, observation: Mapping[str, Any]) -> None:
    """Let a policy that stands by see an observation, if it keeps earlier moments."""
    if hasattr(policy, "observe"):
        with contextlib.suppress(VlatoolError):
            policy.observe(observation)


def _reason(error: Exception) -> str:
    return error.message if isinstance(error, VlatoolError) else f"{type(error).__name__}: {error}"
