"""Episodes that end when the limit on the drop is decided: the same episodes, only fewer."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests._reach import EAGER, bundle_of
from vlatool.accuracy.paired import Outcome
from vlatool.episodes.play import EpisodesJob, jobs_for
from vlatool.errors import UsageError
from vlatool.evaluate._sequential import played_until, sentence
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
    stage = ClosedLoop(policy=good.path.parent / "policy", baseline=good.path, episodes=400, limit=0.2,
                       disturb=("delay",), strength=3.0)  # fmt: skip
    stage.check(eager, None)
    report = stage.run(eager, Context())
    base, row = report.rows
    assert report.verdict == "pass"
    count = len(row.raw["success"])
    assert count < 200
    assert base.raw["seed"] == row.raw["seed"]
    assert row.get("success_drop").high <= 0.2
    assert f"decided by {count} of at most 400 paired episodes" in report.summary[0]
    assert row.details["under disturbances"][0]["episodes"] == count


@pytest.mark.parametrize("options", [{}, {"control": "random"}])
def test_a_limit_needs_something_to_hold_against(policy_template: Path, float_bundle, options: dict[str, str]):
    with pytest.raises(UsageError, match="--limit is the largest drop against a baseline"):
        ClosedLoop(policy=policy_template, limit=0.01, **options).check(float_bundle, None)
