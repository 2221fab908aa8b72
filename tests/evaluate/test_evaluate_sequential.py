"""Episodes that end when the limit on the drop is decided: the same episodes, only fewer."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests._reach import EAGER, bundle_of
from vlatool.accuracy.success_comparison import Outcome
from vlatool.episodes.play import EpisodesJob, jobs_for
from vlatool.errors import UsageError
from vlatool.evaluate._sequential import played_until, sentence
from vlatool.evaluate._training_overlap import seen_in_training
from vlatool.evaluate.closed_loop import ClosedLoop
from vlatool.stage.base import Context

TASKS = ("open", "close", "press")


def player(lost: float, blocks: list[int]):
    """Plays episodes that fail with a probability, whatever the block that they are in."""

    def play(jobs: list[EpisodesJob]) -> list[Outcome]:
        blocks.append(sum(len(job.seeds) for job in jobs))
        draws = {(job.task, seed): np.random.default_rng((seed, TASKS.index(job.task))).random() >= lost
                 for job in jobs for seed in job.seeds}  # fmt: skip
        return [Outcome(task, seed, bool(won), 5) for (task, seed), won in draws.items()]

    return play


def compared(lost: float, limit: float, episodes: int = 999):
    jobs = jobs_for(EpisodesJob("e.py:make", "", "", ()), TASKS, episodes, 100)
    blocks: list[int] = []
    return *played_until(jobs, limit, player(0.0, []), player(lost, blocks), Context()), blocks


@pytest.mark.parametrize(("lost", "verdict"), [(0.0, "pass"), (0.25, "fail"), (0.03, "inconclusive")])
def test_it_stops_when_it_is_decided(lost: float, verdict: str):
    base, own, decision, blocks = compared(lost, 0.03)
    assert decision.verdict == verdict
    assert len(own) == len(base) == decision.pairs == sum(blocks)
    assert decision.pairs < 500 or verdict == "inconclusive"
    order = [(outcome.task, outcome.seed) for outcome in own]
    assert order == [(outcome.task, outcome.seed) for outcome in base]
    assert order == [(task, 100 + number) for task in TASKS for number in range(decision.pairs // 3)]
    assert {"pass": "is at most 3 points", "fail": "is more than 3 points",
            "inconclusive": "is not decided by"}[verdict] in sentence(decision)  # fmt: skip


def test_all_episodes_are_played_where_the_last_ones_decide():
    _, own, decision, blocks = compared(0.0, 0.01, 300)
    assert decision.verdict == "inconclusive"
    assert len(own) <= 300
    assert all(block % 3 == 0 for block in blocks), "each block has as many of each task"


def test_bundles_are_compared_until_it_is_decided(tmp_path: Path):
    good, eager = bundle_of(tmp_path / "good"), bundle_of(tmp_path / "eager", EAGER)
    stage = ClosedLoop(policy=good.path.parent / "policy", baseline=good.path, episodes=400, limit=0.4,
                       disturb=("delay",), strength=3.0)  # fmt: skip
    stage.check(eager, None)
    report = stage.run(eager, Context())
    base, row = report.rows
    assert report.verdict == "pass"
    count = len(row.raw["success"])
    assert count < 200
    assert base.raw["seed"] == row.raw["seed"]
    assert row.get("success_drop").high <= 0.4
    assert f"decided by {count} of at most 400 paired episodes" in report.summary[0]
    assert row.details["under disturbances"][0]["episodes"] == count


@pytest.mark.parametrize("options", [{}, {"control": "random"}])
def test_a_limit_needs_something_to_hold_against(policy_template: Path, float_bundle, options: dict[str, str]):
    with pytest.raises(UsageError, match="--limit is the largest drop against a baseline"):
        ClosedLoop(policy=policy_template, limit=0.01, **options).check(float_bundle, None)


@pytest.mark.parametrize(("lost", "starts", "verdict"), [(0.0, 3, "inconclusive"), (0.9, 3, "inconclusive"),
                                                         (0.0, 7, "inconclusive"), (0.0, 300, "pass")])  # fmt: skip
def test_pairs_of_few_distinct_starts_decide_nothing(lost: float, starts: int, verdict: str):
    """Three hundred pairs that are three episodes, a hundred times each."""

    def alike(play):
        return lambda jobs: [replace(each, start=f"{each.seed % starts}") for each in play(jobs)]

    jobs = jobs_for(EpisodesJob("e.py:make", "", "", ()), TASKS[:1], 300, 100)
    _, own, decision = played_until(jobs, 0.05, alike(player(0.0, [])), alike(player(lost, [])), Context())
    assert decision.verdict == verdict
    assert (decision.high - decision.low > 0.3) == (starts < 8), "the interval is that of the distinct ones"
    told = sentence(decision, len({each.begins for each in own}))
    assert f"({min(starts, len(own))} distinct starts)" in told


def test_seeds_of_a_training_decide_nothing(tmp_path: Path):
    good = bundle_of(tmp_path / "good")
    options = {"episodes": 100, "steps": 1000, "every": 250, "student_episodes": 50, "first_seed": 10}
    record = ({"stage": "sources.torch_module"}, {"stage": "distill.policy", "options": options})
    trained = replace(good, manifest=replace(good.manifest, build=record))
    pauses = len(range(250, 850, 250))
    last = 10 + 50 + pauses * 25 - 1  # two tasks
    policy = good.path.parent / "policy"
    for first, episodes, seen in ((0, 30, 5), (0, 20, 0), (last, 20, 1), (last + 1, 20, 0), (5_000_000, 20, 0)):
        jobs = ClosedLoop(policy=policy, episodes=episodes, first_seed=first)._jobs(trained)
        found = seen_in_training([good, trained], jobs)
        assert [f"{seen} of the {episodes // 2} seeds" in text for text in found] == [True] * bool(seen), first
        stage = ClosedLoop(policy=policy, baseline=good.path, episodes=episodes, first_seed=first, limit=0.2)
        if not seen:
            stage.check(trained, None)
            continue
        with pytest.raises(UsageError, match=f"Nothing can be decided: {seen} of .* distill.policy .*10 to {last}"):
            stage.check(trained, None)
    report = ClosedLoop(policy=policy, episodes=4, first_seed=20).run(trained, Context())
    assert any("2 of the 2 seeds" in warning for warning in report.warnings)


@pytest.mark.parametrize("options", [None, {"first_seed": "x"}, {"unknown": 1}, {"steps": None}])
def test_a_record_that_is_none_says_nothing(tmp_path: Path, options):
    good = bundle_of(tmp_path / "good")
    for stage in ("distill.policy", "distill.unknown", "quantize.static_int8", ""):
        odd = replace(good, manifest=replace(good.manifest, build=({"stage": stage, "options": options},)))
        jobs = ClosedLoop(policy=good.path.parent / "policy", episodes=4)._jobs(odd)
        assert seen_in_training([odd], jobs) == ()
