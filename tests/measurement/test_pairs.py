"""What a process measures is counted, ordered and compared; no test asserts a time."""

from __future__ import annotations

import itertools
import math
import random
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from _policies import Garbage, Memoising, Wrapped

from vlatool.bundle.bundle import Bundle, seal
from vlatool.data import Drawer, read_recording, save_drawn
from vlatool.errors import BundleError, GraphError
from vlatool.measurement import turns
from vlatool.measurement.pairs import FEWEST, PairJob, Pairs, measure_pairs
from vlatool.measurement.turns import (
    CONFIRM,
    Turns,
    halve,
    observation_count,
    observation_of,
    run_job,
    sequence,
    variant_index,
)

sys.path.insert(0, str(Path(__file__).parents[1] / "validation/soak/attacks"))


@pytest.fixture
def job(float_bundle: Bundle, int8_bundle: Bundle, monkeypatch: pytest.MonkeyPatch) -> PairJob:
    monkeypatch.setattr(turns, "WARMUP_MS", 0.0)
    monkeypatch.setattr(turns.gc, "freeze", lambda: None)
    return PairJob(str(float_bundle.path), str(int8_bundle.path), warmup=1, pairs=40)


@pytest.fixture
def wrapped(monkeypatch: pytest.MonkeyPatch):
    """A function that puts a policy around each one that a process loads, or around the candidate alone."""

    def wrap(around, only=""):
        real = turns.load
        made = []

        def load(path, **more):
            policy = real(path, **more)
            if only in str(path):
                policy = around(policy)
                made.append(policy)
            return policy

        monkeypatch.setattr(turns, "load", load)
        return made

    return wrap


def test_every_call_of_both_is_kept(job: PairJob) -> None:
    found = run_job(job)
    assert len(found.baseline_ms) == len(found.candidate_ms) == len(found.places) == 40
    assert min(found.baseline_ms + found.candidate_ms) > 0
    assert len({observation_of(place)[0] for place in found.places}) == observation_count(40) == 14
    assert (found.strays, found.unsteady) == (0, 0)
    assert found.looked > 5


def test_a_slow_policy_is_called_less_often_but_often_enough(job: PairJob) -> None:
    found = run_job(PairJob(**{**vars(job), "seconds": 1e-9}))
    assert len(found.baseline_ms) == len(found.candidate_ms) == FEWEST
    assert sorted(map(found.places.count, set(found.places))) == [3] * 10, "each observation three times"


def test_a_fresh_process_measures_the_same(job: PairJob) -> None:
    found = measure_pairs(job)
    assert len(found.baseline_ms) == len(found.candidate_ms) == 40
    assert math.isfinite(found.log_ratio + found.mean_log_ratio)


def test_the_log_ratio_is_of_medians_and_positive_is_slower() -> None:
    assert Pairs((1.0, 2.0, 90.0), (3.0, 4.0, 5.0)).log_ratio == pytest.approx(math.log(2))
    assert Pairs((2.0,), (1.0,)).log_ratio < 0


def test_the_mean_is_of_medians_of_observations() -> None:
    pairs = Pairs((1.0, 1.0, 1.0, 1.0, 1.0, 50.0), (3.0, 3.0, 1.0, 1.0, 99.0, 1.0), (7, 7, 8, 8, 7, 8))
    assert pairs.medians(pairs.candidate_ms) == {7: 3.0, 8: 1.0}
    assert pairs.mean_log_ratio == pytest.approx(math.log(2) / 2), "3 counts for 2"
    assert Pairs((1.0, 1.0), (1.0, 2.0)).mean_log_ratio == pytest.approx(math.log(2) / 2)
    interrupted = Pairs((1.0,) * 10, (1.0,) * 9 + (80.0,))
    assert interrupted.mean_log_ratio == pytest.approx(math.log(2) / 10)


@pytest.mark.parametrize("seed", range(5))
def test_no_observation_comes_twice_in_a_row(seed: int) -> None:
    found = sequence(range(10), random.Random(seed))
    assert sorted(found) == sorted([*range(10)] * 3)
    assert all(one != two for one, two in itertools.pairwise(found))
    assert sequence([4], random.Random(seed)) == [4, 4, 4]


@pytest.mark.parametrize("count", [1, 2, 7, 10])
def test_half_of_a_block_is_exact_another_half_each_time(count: int) -> None:
    order = random.Random(3)
    seen = set()
    for _ in range(60):
        places = halve(range(count), order)
        assert [observation_of(place)[0] for place in places] == list(range(count))
        exact = {number for number, exact in map(observation_of, places) if exact}
        assert len(exact) in {count // 2, (count + 1) // 2}
        seen |= {variant_index(number, number in exact) for number in range(count)}
    assert seen == set(range(2 * count)), "each observation has been both"


def test_both_get_the_same_bits_which_are_exact_or_never_seen(job: PairJob, wrapped) -> None:
    class Spy(Wrapped):
        def infer(self, observation, **more):
            told.append((id(self), observation["image"].tobytes(), observation["instruction"]))
            return super().infer(observation, **more)

    told: list[tuple] = []
    policies = wrapped(Spy)
    turns = Turns(job)
    told.clear()
    turns._time()
    images = [[image for who, image, _ in told if who == id(policy)] for policy in policies]
    assert images[0] == images[1]
    drawn = [each.observation["image"].tobytes() for each in turns.pool]
    exact = [image for image, place in zip(images[0], turns.places, strict=True) if observation_of(place)[1]]
    assert exact == [drawn[number] for number, exact in map(observation_of, turns.places) if exact]
    new = [image for image, place in zip(images[0], turns.places, strict=True) if not observation_of(place)[1]]
    assert len(set(new) - set(drawn)) == len(new) == 40 - len(exact)
    assert 10 < len(exact) < 30
    assert len({text for *_, text in told}) > 3
    firsts = [who for who, *_ in told[::2]]
    assert 0.2 < firsts.count(id(policies[0])) / len(firsts) < 0.8, "neither is always the first"


def test_each_is_loaded_first_in_some_process(job: PairJob, monkeypatch) -> None:
    told: list[str] = []
    real = turns.load
    monkeypatch.setattr(turns, "load", lambda path, **more: told.append(path) or real(path, **more))
    for seed in range(6):
        Turns(PairJob(**{**vars(job), "seed": seed}))
    assert len(set(told[::2])) == 2


def test_other_answers_than_in_a_fresh_session_are_told(job: PairJob, wrapped) -> None:
    wrapped(lambda policy: Garbage(policy, after=8), only=job.candidate)
    found = run_job(job)
    assert found.strays > found.looked // 2
    assert found.unsteady == 0


def test_answers_from_memory_are_of_no_use(job: PairJob, wrapped) -> None:
    made = wrapped(Memoising, only=job.candidate)
    found = run_job(job)
    exact = [place for place in found.places if observation_of(place)[1]]
    assert found.strays == 0
    computed = 40 - (len(exact) - len(set(exact)))
    assert computed > 20, "most calls are not answered from memory, so that the median is not"
    assert made[0].calls >= 40 - len(exact), "what is varied is never answered from memory"


def test_what_seems_slow_is_called_again_and_again(job: PairJob, wrapped) -> None:
    class SlowOnText(Wrapped):
        def infer(self, observation, **more):
            end = turns.time.perf_counter_ns() + (3_000_000 if observation["instruction"] else 0)
            action = super().infer(observation, **more)
            while turns.time.perf_counter_ns() < end:
                pass
            return action

    wrapped(SlowOnText, only=job.candidate)
    found = run_job(job)
    assert len(found.slow) == CONFIRM
    assert "instruction '" in found.slow_input
    assert "instruction ''" not in found.slow_input
    assert sum(ratio > math.log(1.5) for ratio in found.slow) > CONFIRM // 2
    assert len(found.candidate_ms) == len(found.places) == 40, "further calls are no part of the others"


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch):
    """A clock that stands still until it is told otherwise, in nanoseconds."""
    found = SimpleNamespace(now=1)
    read = SimpleNamespace(perf_counter_ns=lambda: found.now, monotonic=lambda: found.now / 1e9)
    monkeypatch.setattr(turns, "time", read)
    return found


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("slow", "words"), [(True, "drawn"), (False, "drawn, slightly varied")])
def test_what_is_slow_on_exact_inputs_alone_or_on_varied_ones_is_found(job, wrapped, clock, slow, words, seed) -> None:
    class Slow(Wrapped):
        def infer(self, observation, **more):
            exact = observation["image"].tobytes() in drawn
            clock.now += 5_000_000 if exact is slow else 1_000_000
            return super().infer(observation, **more)

    class Steady(Wrapped):
        def infer(self, observation, **more):
            clock.now += 1_000_000
            return super().infer(observation, **more)

    drawn: set[bytes] = set()
    wrapped(Steady, only=job.baseline)
    wrapped(Slow, only=job.candidate)
    turns = Turns(PairJob(**{**vars(job), "pairs": 60, "seed": seed}))
    drawn.update(each.observation["image"].tobytes() for each in turns.pool)
    found = turns.measure()
    assert found.mean_log_ratio == pytest.approx(math.log(2) / 2, rel=0.2), "half of the places, each counted for 2"
    assert found.slow == (math.log(5),) * CONFIRM
    assert found.slow_input.split(", instruction")[0] == words
    assert observation_of(max(found.places, key=lambda place: found.medians(found.candidate_ms)[place]))[1] is slow


def test_observations_come_from_the_file(job: PairJob, float_bundle: Bundle, tmp_path, wrapped) -> None:
    seen = set()

    class Spy(Wrapped):
        def infer(self, observation, **more):
            seen.add(observation["instruction"])
            return super().infer(observation, **more)

    recording = read_recording(float_bundle.path / "data/evaluation.npz", float_bundle.manifest.spec)
    drawn = [
        each for each in Drawer(float_bundle, [recording]).draw(60, np.random.default_rng(0)) if each.kind == "recorded"
    ]
    save_drawn(tmp_path / "drawn.npz", drawn[:10])
    wrapped(Spy)
    Turns(PairJob(**{**vars(job), "observations": str(tmp_path / "drawn.npz")}))._time()
    assert seen - {"go to the red"} <= {"go to the ball", "go to the box", "red ball", "blue box"}


def test_what_the_baseline_cannot_answer_is_left_out(job: PairJob, wrapped) -> None:
    class Fails(Wrapped):
        def infer(self, observation, **more):
            if observation["instruction"] == "" and self.calls > 3:
                raise GraphError("not finite")
            return super().infer(observation, **more)

    wrapped(Fails)
    turns = Turns(job)
    found = turns.measure()
    assert len(found.baseline_ms) == len(found.candidate_ms) == len(found.places) < 40
    assert all(turns.pool[observation_of(place)[0]].observation["instruction"] for place in found.places)


def test_what_the_candidate_alone_cannot_answer_is_an_error(job: PairJob, wrapped) -> None:
    class Fails(Wrapped):
        def infer(self, observation, **more):
            if observation["instruction"] == "" and self.calls > 3:
                raise GraphError("The output 'action' is not finite.")
            return super().infer(observation, **more)

    wrapped(Fails, only=job.candidate)
    with pytest.raises(
        GraphError, match=r"fails where the baseline answers .*instruction ''.*: The output 'action' is"
    ):
        run_job(job)


@pytest.mark.parametrize("side", ["baseline", "candidate"])
def test_a_bundle_that_load_refuses_is_not_timed(job: PairJob, copied, side: str) -> None:
    made = copied(Bundle.open(getattr(job, side)))
    with np.load(made.path / "golden/golden.npz") as stored:
        arrays = {name: stored[name] for name in stored.files}
    np.savez(made.path / "golden/golden.npz", **{**arrays, "out.action": -arrays["out.action"]})
    sealed = seal(made.path, made.manifest)
    with pytest.raises(GraphError, match="a different golden action than recorded"):
        run_job(PairJob(**{**vars(job), side: str(sealed.path)}))


@pytest.mark.parametrize("side", ["baseline", "candidate"])
def test_a_file_that_was_changed_is_not_timed(job: PairJob, copied, side: str) -> None:
    made = copied(Bundle.open(getattr(job, side)))
    with (made.path / "graphs/main.onnx").open("ab") as stream:
        stream.write(b"x")
    with pytest.raises(BundleError, match=r"main\.onnx"):
        run_job(PairJob(**{**vars(job), side: str(made.path)}))


def test_a_bundle_that_cannot_run_is_named(job: PairJob, tmp_path) -> None:
    with pytest.raises(BundleError, match=r"No bundle at .*none"):
        measure_pairs(PairJob(**{**vars(job), "candidate": str(tmp_path / "none")}))


def test_a_process_that_hangs_is_ended(job: PairJob) -> None:
    with pytest.raises(GraphError, match="no result after"):
        measure_pairs(job, timeout=0.01)
