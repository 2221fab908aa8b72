from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import pytest

from vlatool.bundle.program import ProgramStep
from vlatool.errors import DataError
from vlatool.runtime.program import Program

X = np.array([[1.0, 2.0]], np.float32)


class Fake:
    """A session that computes with numpy and remembers its feeds."""

    def __init__(self, function: Callable[..., Any], output: str = "out") -> None:
        self.function = function
        self.output = output
        self.feeds: list[dict[str, Any]] = []

    def run(self, feeds: Mapping[str, Any]) -> Mapping[str, Any]:
        self.feeds.append(dict(feeds))
        return {self.output: self.function(**feeds)}


def step(**changes: Any) -> ProgramStep:
    return ProgramStep(**{"graph": "main", "feeds": {"a": "x"}, "gives": {"out": "y"}, **changes})


def one(function: Callable[..., Any], seed: int | None = None, **changes: Any) -> tuple[Program, Fake]:
    fake = Fake(function)
    return Program([step(**changes)], {"main": fake}, seed), fake


def test_names_of_values_are_mapped_to_names_of_the_graph_and_back():
    program, fake = one(lambda a: a * 2)
    values = program.run({"x": X})
    np.testing.assert_array_equal(values["y"], X * 2)
    assert list(fake.feeds[0]) == ["a"]


def test_steps_run_in_order_and_see_what_came_before():
    steps = [step(gives={"out": "h"}), step(graph="second", feeds={"b": "h", "c": "x"})]
    program = Program(steps, {"main": Fake(lambda a: a + 1), "second": Fake(lambda b, c: b * 10 + c)})
    np.testing.assert_array_equal(program.run({"x": X})["y"], (X + 1) * 10 + X)


def test_a_carried_value_feeds_the_next_repeat():
    program, fake = one(lambda a: a * 2, repeat=3, carry={"y": "x"})
    np.testing.assert_array_equal(program.run({"x": X})["y"], X * 8)
    assert [feed["a"][0, 0] for feed in fake.feeds] == [1, 2, 4]


def test_without_carry_every_repeat_sees_the_same():
    program, fake = one(lambda a: a * 2, repeat=3)
    np.testing.assert_array_equal(program.run({"x": X})["y"], X * 2)
    assert len(fake.feeds) == 3


@pytest.mark.parametrize(
    ("numbers", "dtype"), [([0, 1, 2], np.int64), ([0.0, 0.5, 1.0], np.float32), ([0, 0.5, 1], np.float32)]
)
def test_a_schedule_gives_one_number_for_each_repeat(numbers, dtype):
    program, fake = one(lambda a, t: a, repeat=3, feeds={"a": "x", "t": "time"}, schedule={"time": numbers})
    program.run({"x": X})
    times = [feed["t"] for feed in fake.feeds]
    assert [time.tolist() for time in times] == [[number] for number in numbers]
    assert {(time.dtype, time.shape) for time in times} == {(np.dtype(dtype), (1,))}


def noisy(seed: int | None = None, distribution: str = "normal", size: int = 2) -> Program:
    noise = {"n": {"shape": [1, size], "distribution": distribution}}
    return one(lambda n: n, seed, feeds={"n": "n"}, noise=noise)[0]


def test_noise_is_drawn_once_for_all_repeats():
    program, fake = one(lambda n: n, 0, feeds={"n": "n"}, noise={"n": {"shape": [1, 2]}}, repeat=3)
    program.run({})
    assert len(fake.feeds) == 3
    for feed in fake.feeds:
        np.testing.assert_array_equal(feed["n"], fake.feeds[0]["n"])


def test_the_seed_fixes_the_noise_and_reset_restarts_it():
    first, second = noisy(seed=5), noisy(seed=5)
    drawn = [first.run({})["y"] for _ in range(3)]
    for wanted in drawn:
        np.testing.assert_array_equal(second.run({})["y"], wanted)
    assert not np.array_equal(drawn[0], drawn[1])
    first.reset()
    np.testing.assert_array_equal(first.run({})["y"], drawn[0])


def test_an_episode_may_have_a_seed_of_its_own():
    program, other = noisy(seed=5), noisy(seed=9)
    program.reset(seed=9)
    np.testing.assert_array_equal(program.run({})["y"], other.run({})["y"])
    program.reset()
    np.testing.assert_array_equal(program.run({})["y"], noisy(seed=5).run({})["y"])


def test_without_a_seed_noise_is_fresh():
    assert not np.array_equal(noisy().run({})["y"], noisy().run({})["y"])


@pytest.mark.parametrize(
    ("distribution", "mean_square", "largest"), [("normal", 1.0, np.inf), ("uniform", 1 / 3, 1.0), ("zeros", 0.0, 0.0)]
)
def test_the_distributions_of_noise(distribution, mean_square, largest):
    drawn = noisy(0, distribution, 20_000).run({})["y"]
    assert drawn.dtype == np.float32
    assert abs(drawn.mean()) < 0.03
    assert (drawn**2).mean() == pytest.approx(mean_square, abs=0.03)
    assert abs(drawn).max() <= largest


def test_given_noise_takes_the_place_of_drawn_noise():
    given = np.array([[7.0, 8.0]])
    got = noisy(seed=0).run({}, {"n": given})["y"]
    np.testing.assert_array_equal(got, given)
    assert got.dtype == np.float32


def test_given_noise_of_a_wrong_shape_is_refused():
    with pytest.raises(DataError, match=r"noise 'n' has the shape \[2\]; wanted \[1, 2\]"):
        noisy(seed=0).run({}, {"n": np.zeros(2, np.float32)})


def test_a_kept_value_starts_at_zero_survives_and_is_forgotten_on_reset():
    keep = {"memory": {"shape": [1, 2], "dtype": "float32"}}
    program, fake = one(lambda a, m: a + m, feeds={"a": "x", "m": "memory"}, gives={"out": "memory"}, keep=keep)
    for turn in range(1, 4):
        np.testing.assert_array_equal(program.run({"x": X})["memory"], X * turn)
    program.reset()
    np.testing.assert_array_equal(program.run({"x": X})["memory"], X)
    assert fake.feeds[0]["m"].dtype == np.float32


def test_a_kept_value_has_its_dtype():
    keep = {"steps": {"shape": [1], "dtype": "int64"}}
    program, _ = one(lambda s: s + 1, feeds={"s": "steps"}, gives={"out": "steps"}, keep=keep)
    assert [program.run({})["steps"].item() for _ in range(3)] == [1, 2, 3]
    assert program.run({})["steps"].dtype == np.int64
