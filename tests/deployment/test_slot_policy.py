"""The active bundle as a policy: trial, rollback and exchange while it runs; no action is computed by two bundles."""

import mmap
import shutil
import threading
from pathlib import Path

import numpy as np
import pytest
from _fake_clock import FakeWorker
from _slots import OBSERVATION, TRIAL, Clock, FakePolicy, bundle_of, install

from vlatool.bundle.bundle import Bundle
from vlatool.deployment import slot_policy
from vlatool.deployment.judge import LATE_SHARE, MEMORY_PERIOD, MIN_LATE, Judge
from vlatool.deployment.pointer import FILES
from vlatool.deployment.slot_policy import SlotPolicy
from vlatool.deployment.store import MAX_STARTS, Store
from vlatool.errors import DataError, DeadlineMissed, DeploymentError, GraphError, UsageError
from vlatool.runtime import ChunkQueue
from vlatool.runtime.control.deadline import Deadline
from vlatool.runtime.interface import Action, Policy


@pytest.fixture(scope="module")
def bundles(tmp_path_factory) -> list[Bundle]:
    folder = tmp_path_factory.mktemp("bundles")
    return [bundle_of(folder / str(value), value) for value in (1, 2, 3)]


@pytest.fixture
def store(tmp_path, bundles) -> Store:
    """A store whose second bundle is on trial."""
    found = Store(tmp_path / "store")
    install(found, bundles[0])
    install(found, bundles[1])
    return found


class Robot:
    """A process of a controller: opens the store with fake policies, of which the one on trial may fail."""

    def __init__(self, store: Store, bundles: list[Bundle], act=None, **options) -> None:
        self.clock = Clock()
        self.opened: list[float] = []
        values = {bundle.hash: float(number) for number, bundle in enumerate(bundles, 1)}

        def open_policy(path: Path) -> Policy:
            bundle = Bundle.open(path)
            value = values[bundle.hash]
            self.opened.append(value)
            return FakePolicy(bundle.manifest.spec, value, act if value == 2 else None)

        self.policy = SlotPolicy(store, clock=self.clock, open_policy=open_policy, **options)

    def value(self, seconds: float = 0.0) -> float:
        """Infer once; return the value that all elements of the chunk have."""
        self.clock.now += seconds
        (value,) = set(self.policy.infer(OBSERVATION).chunk.ravel().tolist())
        return value


def active(store: Store, bundles: list[Bundle]) -> tuple[int, bool]:
    """The number of the active bundle, and whether it is on trial."""
    pointer = store.read()
    return [bundle.hash for bundle in bundles].index(pointer.current.bundle) + 1, pointer.trial is not None


def test_a_good_bundle_is_committed_after_its_ticks_and_its_seconds(store, bundles):
    robot = Robot(store, bundles)
    assert [robot.value() for _ in range(2 * TRIAL.ticks)] == [2.0] * 8
    assert robot.policy.on_trial
    robot.value(TRIAL.seconds)
    assert not robot.policy.on_trial
    robot.policy.close()
    assert active(store, bundles) == (2, False)
    assert robot.opened == [2.0, 1.0]


def test_seconds_alone_do_not_commit(store, bundles):
    robot = Robot(store, bundles)
    robot.value(100 * TRIAL.seconds)
    assert robot.policy.on_trial


def raising(kind):
    def act(_number):
        raise kind("on purpose")

    return act


def late_from(first: int, clock: list):
    def act(number):
        if number >= first:
            clock[0].now += 0.2

    return act


@pytest.mark.parametrize("standby", [True, False])
@pytest.mark.parametrize("act", [
    lambda number: np.full((3, 2), np.nan, np.float32) if number == 3 else None,
    lambda number: np.full((3, 2), np.inf, np.float32) if number == 1 else None,
    lambda number: np.zeros((3, 3), np.float32), lambda number: np.zeros((2, 2), np.float32), lambda number: [[0.0]],
    raising(GraphError),
], ids=["NaN at tick 3", "infinity", "wide", "short", "list", "error"])  # fmt: skip
def test_a_wrong_action_never_leaves_and_the_bundle_before_answers(store, bundles, act, standby):
    robot = Robot(store, bundles, act, standby=standby)
    values = []
    for _ in range(6):
        try:
            values.append(robot.value(1.0))
        except GraphError:
            assert not standby
            robot.policy.wait()
    assert set(values) <= {1.0, 2.0}
    assert values[-1] == 1.0
    robot.policy.close()
    assert active(store, bundles) == (1, False)
    assert "rolled back" in robot.policy.events[0]
    assert Robot(store, bundles).opened == [1.0]


@pytest.mark.parametrize("kind", [RuntimeError, MemoryError, ZeroDivisionError, DataError])
def test_any_error_that_the_bundle_before_does_not_have_is_its_fault(store, bundles, kind):
    robot = Robot(store, bundles, raising(kind))
    assert robot.value() == 1.0
    robot.policy.close()
    assert active(store, bundles) == (1, False)


def test_an_observation_that_both_refuse_is_no_reason_to_roll_back(tmp_path, bundles):
    store = Store(tmp_path / "store")
    for bundle in bundles[:2]:
        install(store, bundle)
    policy = SlotPolicy(store)
    with pytest.raises(DataError):
        policy.infer({"x": [1.0, 2.0, 3.0]})
    assert policy.infer(OBSERVATION).chunk[0, 0] == 2.0
    policy.close()
    assert active(store, bundles) == (2, True)


def test_overruns_roll_back_and_their_actions_are_used(store, bundles):
    clock = []
    robot = Robot(store, bundles, late_from(2, clock))
    clock.append(robot.clock)
    assert [robot.value() for _ in range(6)] == [2.0] * (1 + MIN_LATE) + [1.0] * (5 - MIN_LATE)
    robot.policy.close()
    assert active(store, bundles) == (1, False)
    assert "took longer than 100 ms" in store.read().rollback


class Stoppable(FakePolicy):
    """Knows whether it was told to stop, and what it kept."""

    stopped = False
    snapshot = property(lambda self: self.inferences)

    def stop(self) -> None:
        self.stopped = True

    def resume(self) -> None:
        self.stopped = False

    def restore(self, snapshot: int) -> None:
        self.inferences = snapshot


def limited(store, bundles, delays_ms, monkeypatch) -> tuple[Robot, Deadline]:
    """A deadline of 50 ms around a store whose bundles can be stopped; each inference takes so many milliseconds."""
    monkeypatch.setitem(Robot.__init__.__globals__, "FakePolicy", Stoppable)
    clock = Clock()

    def act(_number: int) -> None:
        clock.now += delays_ms.pop(0) / 1e3
        if clock.now > due[0]:
            robot.policy.stop()
            raise TimeoutError

    robot = Robot(store, bundles, act)
    deadline = Deadline(robot.policy, 50, clock=clock, worker=FakeWorker(clock))
    due = [0.0]
    infer = deadline.infer

    def timed(observation):
        due[0] = clock.now + 0.05
        return infer(observation)

    deadline.infer = timed
    return robot, deadline


def test_a_deadline_stops_and_takes_back_whichever_bundle_answers(store, bundles, monkeypatch):
    robot, deadline = limited(store, bundles, [10, 70, 10], monkeypatch)
    assert deadline.infer(OBSERVATION).sequence == 0
    with pytest.raises(DeadlineMissed):
        deadline.infer(OBSERVATION)
    assert robot.policy._running.policy.stopped
    assert robot.policy._running.standby.policy.stopped
    assert deadline.infer(OBSERVATION).sequence == 1
    assert not robot.policy._running.policy.stopped
    robot.policy.close()


def test_missed_deadlines_of_a_trial_count_as_late_and_the_bundle_before_does_not_answer_them(
    store, bundles, monkeypatch
):
    robot, deadline = limited(store, bundles, [10] + [70] * MIN_LATE, monkeypatch)
    deadline.infer(OBSERVATION)
    for _ in range(MIN_LATE):
        assert robot.policy.on_trial
        with pytest.raises(DeadlineMissed):
            deadline.infer(OBSERVATION)
    assert deadline.infer(OBSERVATION).chunk[0, 0] == 1.0
    robot.policy.close()
    assert "took longer than 100 ms, or were stopped" in store.read().rollback


def test_what_a_late_inference_kept_is_taken_back(store, bundles, monkeypatch):
    monkeypatch.setitem(Robot.__init__.__globals__, "FakePolicy", Stoppable)
    robot = Robot(store, bundles)
    robot.policy.infer(OBSERVATION)
    kept = robot.policy.snapshot
    robot.policy.infer(OBSERVATION)
    robot.policy.restore(kept)
    assert robot.policy.snapshot == kept
    assert robot.policy._running.policy.inferences == 1
    robot.policy.close()


def test_a_new_bundle_that_fails_before_a_standby_without_time_is_left(store, bundles, monkeypatch):
    robot = Robot(store, bundles, raising(GraphError))
    standby = robot.policy._running.standby.policy

    def stopped(_observation, *, noise=None):
        robot.policy.stop()
        raise TimeoutError

    monkeypatch.setattr(standby, "infer", stopped)
    with pytest.raises(GraphError):
        robot.policy.infer(OBSERVATION)
    assert not robot.policy.on_trial
    robot.policy.close()


def test_growth_rolls_back(store, bundles):
    grown = []

    def grow(_number: int) -> None:
        grown.append(mmap.mmap(-1, 2_800_000))  # 64 MB are allowed; what the process has freed before is not used again
        grown[-1].write(bytes(2_800_000))

    robot = Robot(store, bundles, grow)
    robot.clock.now = -1e9  # no commit
    robot.policy._running.start = 0.0
    assert [robot.value() for _ in range(2 * MEMORY_PERIOD)][-1] == 2.0
    assert [robot.value() for _ in range(2 * MEMORY_PERIOD)][-1] == 1.0
    robot.policy.close()
    assert "the process grew" in store.read().rollback
    for each in grown:
        each.close()


def test_what_is_outside_may_let_the_trial_fail(store, bundles):
    robot = Robot(store, bundles)
    assert robot.value() == 2.0
    robot.policy.fail("the envelope rejected 3 actions")
    robot.value()
    assert robot.value() == 1.0
    robot.policy.close()
    assert store.read().rollback == "the envelope rejected 3 actions"


@pytest.mark.parametrize(("reason", "written"), [("a collision", "a collision"), ("", "the controller gave no reason")])
@pytest.mark.parametrize("error", [None, ValueError])
def test_a_trial_that_failed_is_rolled_back_at_the_end(store, bundles, reason, written, error):
    robot = Robot(store, bundles)
    assert robot.value() == 2.0
    robot.policy.fail(reason)
    robot.policy.__exit__(error, None, None)
    assert active(store, bundles) == (1, False)
    assert store.read().rollback == written


@pytest.mark.parametrize("period", [0, -1, float("nan"), float("inf"), "1"])
def test_a_period_in_which_nothing_could_be_watched_is_refused(store, bundles, period):
    robot = Robot(store, bundles)
    with pytest.raises(UsageError, match="period_s is"):
        robot.policy.watch(period)
    robot.policy.close()


def test_a_loop_of_crashes_is_rolled_back(store, bundles):
    for _ in range(MAX_STARTS):
        assert Robot(store, bundles).opened == [2.0, 1.0]  # it crashes
    robot = Robot(store, bundles)
    assert robot.opened == [1.0]
    assert active(store, bundles) == (1, False)
    assert f"{MAX_STARTS} starts ended" in store.read().rollback


def test_orderly_ends_are_no_crashes(store, bundles):
    for _ in range(MAX_STARTS + 2):
        with Robot(store, bundles).policy as policy:
            policy.infer(OBSERVATION)
    assert active(store, bundles) == (2, True)
    for _ in range(MAX_STARTS):
        with pytest.raises(ZeroDivisionError), Robot(store, bundles).policy:
            raise ZeroDivisionError
    assert Robot(store, bundles).opened == [1.0]


def test_a_trial_that_cannot_be_counted_is_not_begun(store, bundles):
    with store.lock(), pytest.MonkeyPatch.context() as patch:
        patch.setattr(slot_policy, "LOCK_S", 0.01)
        robot = Robot(store, bundles)
    assert robot.opened == [1.0]
    assert "is not begun" in robot.policy.events[0]


@pytest.mark.parametrize("damage", ["file", "missing", "another bundle", "manifest", "graph"])
@pytest.mark.parametrize("trial", [True, False])
def test_an_active_slot_that_does_not_load_is_left(store, bundles, damage, trial):
    if not trial:
        store.commit(bundles[1].hash)
    folder = store.folder(store.read().active)
    if damage == "another bundle":
        shutil.rmtree(folder)
        shutil.copytree(bundles[2].path, folder)
    elif damage == "missing":
        shutil.rmtree(folder)
    else:
        name = {"file": "golden/golden.npz", "manifest": "manifest.json", "graph": "graphs/main.onnx"}[damage]
        (folder / name).write_bytes(b"x")
    policy = SlotPolicy(store)
    assert policy.infer(OBSERVATION).chunk[0, 0] == 1.0
    policy.close()
    assert active(store, bundles) == (1, False)


def test_when_neither_slot_loads_the_error_is_that_of_the_active_one(store, bundles):
    for name in "ab":
        (store.folder(name) / "graphs/main.onnx").write_bytes(name.encode())
    with pytest.raises(Exception, match=f"{store.read().active}/graphs/main.onnx"):
        SlotPolicy(store)


def test_what_is_not_a_policy_is_refused_and_nothing_is_rolled_back(store, bundles):
    with pytest.raises(UsageError, match="does not infer"):
        SlotPolicy(store, open_policy=lambda path: path)
    assert active(store, bundles) == (2, True)


@pytest.mark.parametrize("wrong", [3, None, b"store", ["store"]])
def test_what_is_no_path_is_no_store(wrong):
    for opened in (SlotPolicy, Store):
        with pytest.raises(UsageError, match="The path of the store is a"):
            opened(wrong)


def test_an_empty_store_is_refused(tmp_path):
    with pytest.raises(DeploymentError, match="holds no bundle"):
        SlotPolicy(str(tmp_path))


def test_bundles_are_exchanged_between_two_inferences_of_a_running_controller(tmp_path, bundles):
    store = Store(tmp_path / "store")
    install(store, bundles[0])
    robot = Robot(store, bundles)
    queue = ChunkQueue(robot.policy)
    seen = []
    for step in range(30):
        if step == 4:
            install(store, bundles[1])
            assert robot.policy.refresh()
            assert not robot.policy.refresh()
        if step == 13:
            store.roll_back("an operator")
            robot.policy.refresh()
        seen.append(queue.act(OBSERVATION).tolist())
    assert all(one == other for one, other in seen)
    assert [value for value, _ in seen] == [1.0] * 6 + [2.0] * 9 + [1.0] * 15


def test_the_numbers_of_actions_go_on_over_an_exchange(store, bundles):
    robot = Robot(store, bundles)
    numbers = [robot.policy.infer(OBSERVATION).sequence for _ in range(3)]
    store.roll_back("an operator")
    robot.policy.refresh()
    numbers += [robot.policy.infer(OBSERVATION).sequence for _ in range(2)]
    robot.policy.reset()
    numbers.append(robot.policy.infer(OBSERVATION).sequence)
    assert numbers == [0, 1, 2, 3, 4, 0]


def test_a_stateful_policy_is_exchanged_between_two_episodes(tmp_path, bundles):
    store = Store(tmp_path / "store")
    install(store, bundles[0])
    robot = Robot(store, bundles)
    robot.policy._running.policy.program = type("Program", (), {"keeps": {"h": 1}})
    install(store, bundles[1])
    robot.policy.refresh()
    assert robot.value() == 1.0
    robot.policy.reset()
    assert robot.value() == 2.0


def test_another_contract_is_not_exchanged_while_it_runs(tmp_path, bundles):
    store = Store(tmp_path / "store")
    install(store, bundles[0])
    robot = Robot(store, bundles)
    install(store, bundle_of(tmp_path / "faster", 5, control_hz=20.0))
    assert not robot.policy.refresh()
    assert "another contract than the active one: control_hz is 20.0" in robot.policy.events[-1]
    assert robot.value() == 1.0


def test_a_new_bundle_that_does_not_load_beside_the_running_one_is_rolled_back(tmp_path, bundles):
    store = Store(tmp_path / "store")
    install(store, bundles[0])
    policy = SlotPolicy(store)
    install(store, bundles[1])
    (store.folder("b") / "graphs/main.onnx").write_bytes(b"x")
    assert not policy.refresh()
    assert policy.infer(OBSERVATION).chunk[0, 0] == 1.0
    policy.close()
    assert active(store, bundles) == (1, False)


def test_a_pointer_that_decays_does_not_touch_what_runs(store, bundles):
    robot = Robot(store, bundles)
    for name in FILES:
        (store.path / name).write_bytes(b"x")
    with pytest.raises(DeploymentError, match="cannot be read"):
        robot.policy.refresh()
    assert robot.value() == 2.0


def test_no_action_is_mixed_while_another_thread_exchanges_bundles(tmp_path, bundles):
    store = Store(tmp_path / "store")
    install(store, bundles[0], trial=None)
    install(store, bundles[1], trial=None)
    robot = Robot(store, bundles)
    done = threading.Event()

    def turn() -> None:
        for _ in range(8):
            store.roll_back("next")
            robot.policy.refresh()
        done.set()

    thread = threading.Thread(target=turn)
    thread.start()
    chunks = []
    while not done.is_set():
        chunks.append(robot.policy.infer(OBSERVATION).chunk)
    thread.join()
    values = [set(chunk.ravel().tolist()) for chunk in chunks]
    assert all(len(value) == 1 for value in values)
    assert set().union(*values) == {1.0, 2.0}


def test_watching_finds_a_new_bundle(tmp_path, bundles):
    store = Store(tmp_path / "store")
    install(store, bundles[0])
    robot = Robot(store, bundles)
    robot.policy.watch(0.005)
    install(store, bundles[1])
    for _ in range(5000):
        if robot.value() == 2.0:
            break
        threading.Event().wait(0.002)
    robot.policy.close()
    assert active(store, bundles) == (2, True)


def test_nobody_watches_for_a_policy_that_nobody_holds(store, bundles):
    policy = SlotPolicy(store, open_policy=lambda path: FakePolicy(Bundle.open(path).manifest.spec, 1.0))
    policy.watch(3600)
    watcher = policy._watcher
    del policy
    watcher.join(10)
    assert not watcher.is_alive()


@pytest.mark.parametrize("late", [0, MIN_LATE - 1])
def test_a_few_overruns_are_no_violation(bundles, late):
    judge = Judge(bundles[0].manifest.spec, 10.0, 0.0)
    action = Action(np.zeros((3, 2), np.float32), (), 0.0, 0, {})
    found = [judge.violation(action, 11.0 if number < late else 9.0) for number in range(300)]
    assert set(found) == {""}
    assert judge.late == late <= max(MIN_LATE, LATE_SHARE * 300)
