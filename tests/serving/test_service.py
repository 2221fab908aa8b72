"""One policy for several clients: turns, episodes, deadlines, names, limits."""

from __future__ import annotations

import contextlib
import json
import os
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from _episodes_policy import CountingPolicy
from _fake_clock import FakeClock, FakeWorker, SlowPolicy
from _numbered import NumberedPolicy, spec_of

from vlatool.bundle.spec import PolicySpec, TensorSpec
from vlatool.errors import DataError, DeadlineMissed, ProfileError, ServingError, UsageError
from vlatool.runtime.interface import Action
from vlatool.serving import Access, ChunkEnvelope, ObservationNames, RequestLog, RequestRecord, Service
from vlatool.serving._request_log import _Lines

JOINTS = tuple(f"joint{number}" for number in range(1, 8))
PANDA = PolicySpec(
    (TensorSpec("q", (1, 7), labels=JOINTS),), (TensorSpec("a", (1, 5, 7), labels=JOINTS, mode="absolute"),), 50, 5, 3
)
REST = np.array([0, -0.5, 0, -2, 0, 1.5, 0.7], np.float32)


def service(policy: Any = None, **options: Any) -> Service:
    return Service(CountingPolicy() if policy is None else policy, **options)


def counts(session: Any, steps: int) -> list[int]:
    """The number of the inference within its episode, as each chunk says it."""
    return [round(float(session.infer({"t": 0}).action.chunk[0, 0]) * 1000) for _ in range(steps)]


def test_each_client_has_an_episode_of_its_own():
    served = service()
    with served.session("a") as first, served.session("b") as second:
        assert [counts(first, 2), counts(second, 1), counts(first, 1), counts(second, 2)] == [[1, 2], [1], [3], [2, 3]]
        first.reset()
        assert (counts(second, 1), counts(first, 2)) == ([4], [1, 2])
        second.reset(40)
        assert (counts(first, 1), counts(second, 1)) == ([3], [41])
    with pytest.raises(UsageError, match="seed is -1"):
        first.reset(-1)


def slow(delays_ms: list[float], **options: Any) -> tuple[Service, FakeClock, SlowPolicy]:
    clock = FakeClock()
    policy = SlowPolicy(spec_of(chunk=3), clock, delays_ms)
    served = Service(policy, deadline_ms=50, clock=clock, **options)
    served._limited._worker = FakeWorker(clock)
    return served, clock, policy


def test_a_late_inference_is_refused_and_has_no_effect():
    records: list[RequestRecord] = []
    served, _, _ = slow([10, 200, 10], telemetry=records.append)
    with served.session("a") as session:
        assert session.infer({"t": 1}).action.chunk[0, 0] == 100
        with pytest.raises(DeadlineMissed, match="no action within 50 ms"):
            session.infer({"t": 2})
        assert session.infer({"t": 3}).action.chunk[0, 0] == 300
    assert [(record.number, record.missed, bool(record.error)) for record in records] == [
        (0, False, False), (1, True, True), (2, False, False)
    ]  # fmt: skip
    assert (served.requests, served.missed, served.failed) == (3, 1, 0)
    assert records[0].answer_ms == pytest.approx(10)


def test_the_wait_for_another_client_counts():
    served, _, _ = slow([])
    with served.session("a") as session:
        assert served._turn.acquire()
        with pytest.raises(DeadlineMissed, match="Other clients had the policy for 50 ms"):
            session.infer({"t": 1})
        served._turn.release()
        assert session.infer({"t": 1}).action.chunk[0, 0] == 100


def test_a_policy_of_others_is_checked_and_its_errors_are_the_clients():
    class Wrong(NumberedPolicy):
        def infer(self, observation: Any, *, noise: Any = None) -> Action:
            action = super().infer(observation, noise=noise)
            if self.asked[-1] == 2:
                raise ZeroDivisionError
            return action._replace(chunk=action.chunk * np.nan)

    served = service(Wrong(spec_of(chunk=3)))
    with served.session("a") as session:
        with pytest.raises(Exception, match="not finite"):
            session.infer({"t": 1})
        with pytest.raises(ZeroDivisionError):
            session.infer({"t": 2})
    assert (served.requests, served.failed) == (2, 2)


def test_clients_beyond_the_limit_are_refused_until_one_goes():
    served = service(clients=2)
    first, second = served.session("a"), served.session("b")
    with pytest.raises(ServingError, match="2 clients"):
        served.session("c")
    second.close()
    served.session("c")
    first.close()
    stateless = service(NumberedPolicy(spec_of()), clients=5)  # nobody could put its episodes in and take them out
    stateless.session("a")
    with pytest.raises(ServingError, match="1 clients"):
        stateless.session("b")


def test_a_client_asks_once_at_a_time():
    entered, leave = threading.Event(), threading.Event()

    class Waiting(CountingPolicy):
        def infer(self, observation: Any, *, noise: Any = None) -> Action:
            entered.set()
            assert leave.wait(10)
            return super().infer(observation, noise=noise)

    with service(Waiting()).session("a") as session:
        asked = threading.Thread(target=session.infer, args=({"t": 1},))
        asked.start()
        assert entered.wait(10)
        with pytest.raises(ServingError, match="not answered yet"):
            session.infer({"t": 2})
        leave.set()
        asked.join()


def test_a_sink_that_fails_is_counted():
    def full(record: RequestRecord) -> None:
        raise OSError

    served = service(telemetry=full)
    with served.session("a") as session:
        assert counts(session, 1) == [1]
    assert served.failed_records == 1


@pytest.mark.parametrize("wrong", [
    {"deadline_ms": 0}, {"deadline_ms": 1e300}, {"deadline_ms": np.nan}, {"execute": 4}, {"execute": -1},
    {"clients": 0}, {"names": {"x": "t"}},
])  # fmt: skip
def test_an_argument_out_of_its_range_is_refused(wrong: dict[str, Any]):
    with pytest.raises(UsageError):
        service(**wrong)


SPEC = PolicySpec((TensorSpec("state", (1, 3)), TensorSpec("goal", (1, 2))), (TensorSpec("a", (1, 2)),), 10)


def test_names_of_clients_become_inputs():
    values = {"arm": np.arange(4.0), "hand": np.array([9.0]), "goal": [1, 2], "other": object()}
    found = ObservationNames(SPEC, {"state": "arm[1:3]+hand"})(values)
    assert (found["state"].tolist(), found["goal"], list(found)) == ([1, 2, 9], [1, 2], ["state", "goal"])
    assert ObservationNames(SPEC, {"goal": "arm[2]", "state": "arm"})(values)["goal"].tolist() == [2]


@pytest.mark.parametrize(("names", "message"), [
    ({}, r"lacks state, goal; it has: arm, text"),
    ({"state": "pose", "goal": "arm"}, r"lacks pose \(for state\)"),
    ({"state": "arm[7:9]", "goal": "arm"}, "takes no element"),
    ({"state": "text[0:1]", "goal": "arm"}, "no 'text'"),
    ({"state": "arms+arm", "goal": "arm"}, "no 'arms'"),
])  # fmt: skip
def test_what_is_missing_is_named(names: dict[str, str], message: str):
    with pytest.raises(DataError, match=message):
        ObservationNames(SPEC, names)({"arm": np.arange(4.0), "text": "go"})


def looking_back(execute: int) -> Service:
    spec = PolicySpec((TensorSpec("t", (1, 3, 1), history=3),), (TensorSpec("a", (1, 2, 1)),), 10, 2, execute)

    class Windows(CountingPolicy):
        def infer(self, observation: Any, *, noise: Any = None) -> Action:
            chunk = np.tile(np.float32([[int("".join(str(int(value)) for value in observation["t"].ravel()))]]), (2, 1))
            return Action(chunk, (), 0.0, 0, {})

        def observe(self, observation: Any) -> None:
            raise NotImplementedError

    return Service(Windows(spec))


def test_clients_of_a_policy_that_looks_back_have_windows_of_their_own():
    served = looking_back(execute=1)
    with served.session("a") as first, served.session("b") as second:
        seen = [[session.infer({"t": [number]}).action.chunk[0, 0] for number in numbers]
                for session, numbers in ((first, (1, 2)), (second, (7,)), (first, (3, 4)))]  # fmt: skip
        assert seen == [[111, 112], [777], [123, 234]]
        first.reset()
        assert first.infer({"t": [[5]]}).action.chunk[0, 0] == 555
        assert first.infer({"t": [[1], [2], [3]]}).action.chunk[0, 0] == 123
        with pytest.raises(DataError, match=r"shape \[2\]"):
            first.infer({"t": [1, 2]})


def test_one_moment_is_refused_where_clients_play_several_actions():
    with looking_back(execute=2).session("a") as session:
        with pytest.raises(DataError, match="looks back 3 control steps"):
            session.infer({"t": [1]})
        assert session.infer({"t": [[1], [2], [3]]}).action.chunk[0, 0] == 123


def ramp(start: float, step: float) -> Any:
    chunk = np.tile(REST, (5, 1))
    chunk[:, 0] = start + step * np.arange(5)
    return chunk


def test_a_chunk_within_the_limits_passes_bit_for_bit_and_another_is_bounded():
    envelope = ChunkEnvelope(PANDA, "franka-panda")
    legal = ramp(0, 1e-4)
    sent, checks = envelope.apply(legal, {"q": REST}, 0)
    assert (sent is legal, checks) == (True, ())
    sent, checks = envelope.apply(ramp(3e-4, 0.05), {"q": REST}, 3)
    assert checks
    assert np.abs(np.diff(sent[:, 0])).max() < 0.05


def test_a_chunk_begins_after_the_actions_that_were_played():
    for played, jumps in ((3, False), (0, True)):
        envelope = ChunkEnvelope(PANDA, "franka-panda")
        assert envelope.apply(ramp(0, 4e-3), {"q": REST}, 0)[1] == ()
        assert envelope.apply(ramp(4e-3 * 3, 4e-3), {"q": REST}, 3)[1] == ()
        assert bool(envelope.apply(ramp(4e-3 * 6, 4e-3), {"q": REST}, played)[1]) is jumps


def test_a_robot_outside_of_its_limits_and_one_that_nobody_knows_are_refused():
    class Still(CountingPolicy):
        def infer(self, observation: Any, *, noise: Any = None) -> Action:
            return Action(ramp(0, 0), JOINTS, 0.0, 0, {})

    served = service(Still(PANDA), robot="franka-panda")
    with served.session("a") as session:
        with pytest.raises(DataError, match="joint1 is at 9"):
            session.infer({"q": REST + 9})
        assert session.infer({"q": REST}).action.checks == ()
    with pytest.raises(ProfileError, match="did you mean 'franka-panda'"):
        service(robot="franka-pandas")
    with pytest.raises(UsageError, match="elements"):
        service(robot="franka-panda")


@pytest.mark.parametrize(("host", "key", "message"), [
    ("0.0.0.0", "", "anybody could use the policy"), ("::", "", "anybody"), ("", "", "anybody"),
    ("127.0.0.1", "short", "16 or more"), ("0.0.0.0", "a" * 20 + "\n", "printable"),
    ("no such host", "", "not an address"),
])  # fmt: skip
def test_an_address_that_others_reach_needs_a_key(host: str, key: str, message: str):
    with pytest.raises(UsageError, match=message):
        Access(host, key)


def test_a_key_admits_who_knows_it():
    key = "0123456789abcdef"
    access = Access("0.0.0.0", key)
    assert key not in repr(access)
    assert access.admits(key)
    assert access.admits_header(f"Api-Key {key}")
    for wrong in ("", key[:-1], key + "0", "é" * 16, None, 5, b"0123456789abcdef"):
        assert not access.admits(wrong)
    for header in (None, "", key, f"Bearer {key}", "Api-Key ", f"api-key {key}x"):
        assert not access.admits_header(header)
    assert Access("::1").admits_header(None)


def request(number: int) -> RequestRecord:
    return RequestRecord("a", number, 0.0, 5.0, False, "", ())


def test_a_disk_that_does_not_answer_keeps_no_request_and_no_end_waiting(tmp_path: Path):
    """A pipe that nobody reads: its 64 KiB are written, the rest is counted."""
    path, count = tmp_path / "requests", 3000
    os.mkfifo(path)
    reader = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    log = RequestLog(path, waiting=100)
    for number in range(count):
        log(request(number))
    log.close(0.1)
    written = os.read(reader, 1 << 16).splitlines()
    assert log.lost_count == count - len(written) > 0
    assert [json.loads(line)["client"] for line in written[:5]] == ["a"] * 5
    log(request(0))  # after the end: nobody takes it
    while log._telemetry.outlets[0]._thread.is_alive():
        with contextlib.suppress(BlockingIOError):
            os.read(reader, 1 << 16)
    os.close(reader)


def test_records_that_a_full_disk_does_not_take_are_counted():
    log = RequestLog(Path("/dev/full"))
    for number in range(5):
        log(request(number))
    assert log._telemetry.flush()
    assert log.lost_count == 5
    log.close()
    assert log.lost_count == 5


def test_a_line_after_one_that_was_cut_off_begins_anew(tmp_path: Path):
    lines = _Lines(tmp_path / "requests")
    whole = lines._file

    class Full:
        def write(self, content: bytes) -> int:
            return int(whole.write(content[:20]))

    lines._file = Full()
    with pytest.raises(OSError, match="20 of"):
        lines(request(0))
    lines._file = whole
    lines(request(1))
    lines.close()
    assert json.loads((tmp_path / "requests").read_text().splitlines()[1])["number"] == 1
    assert lines.written == 1


def test_requests_are_written_as_lines(tmp_path: Path):
    log = RequestLog(tmp_path / "requests.jsonl")
    for number in range(3):
        log(request(number)._replace(answer_ms=5.0 + number))
    log.close()
    assert not [thread for thread in threading.enumerate() if thread is log._telemetry.outlets[0]._thread]
    assert (tmp_path / "requests.jsonl").read_text().count('"client": "a"') == 3
    assert (log.times_ms()["p50"], log.lost_count) == (6.0, 0)
    assert RequestLog().times_ms() == {}
    with pytest.raises(Exception, match="cannot be written"):
        RequestLog(tmp_path)
