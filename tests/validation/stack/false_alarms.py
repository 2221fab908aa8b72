"""False alarms of the anomaly monitors: on legal episodes of a sample policy, which nothing disturbs.

    vlatool export sample_models/vla-metaworld -o out/vla-metaworld
    python tests/validation/stack/false_alarms.py out/vla-metaworld sample_models/vla-metaworld --episodes 28

Prints, for each monitor: the control steps that it judged, how many raised an alarm (with an upper bound at 95 % as if
steps were independent, which they are not), episodes with one, and the largest scores. ``--option z_score=6`` changes
limits.
"""

from __future__ import annotations

import argparse
import itertools
import sys
from collections import defaultdict
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "soak"))
from delayed_chunks import jobs_of

from vlatool.episodes.play import EVALUATION_SEEDS, Worker
from vlatool.runtime.control.anomaly import Anomaly
from vlatool.stats.intervals import wilson


@dataclass
class Tally:
    """What one monitor said.

    Args:
        scores: score of each control step that has one.
        alarms: alarms.
        episodes: episodes with an alarm.
    """

    scores: list[float] = field(default_factory=list)
    alarms: int = 0
    episodes: set[int] = field(default_factory=set)


class Watched(Anomaly):
    """Monitors by the clock of the control steps, whose scores are kept."""

    tallies: defaultdict[str, Tally] = defaultdict(Tally)
    episode = steps = 0

    def __init__(self, controller: Any, **options: Any) -> None:
        ticks = itertools.count()
        super().__init__(controller, **options, clock=lambda: next(ticks) / self.spec.rate)

    def act(self, observation: Any) -> Any:
        """Act, and keep the scores."""
        action = super().act(observation)
        Watched.steps += 1
        for name, score in self.scores.items():
            tally = Watched.tallies[name]
            tally.scores.append(score)
            if name in self.alarms:
                tally.alarms += 1
                tally.episodes.add(Watched.episode)
        return action


class WatchedWorker(Worker):
    """Plays episodes with monitors around the controller."""

    options: dict[str, Any] = {}

    def controller(self, job: Any) -> Any:
        """Return the controller of a job, with monitors around it."""
        return Watched(super().controller(job), **self.options)


def play(bundle: str, policy: str, tasks: list[str], episodes: int, options: dict[str, Any]) -> dict[str, Tally]:
    """Play episodes; return what each monitor said."""
    Watched.tallies, Watched.episode, Watched.steps = defaultdict(Tally), 0, 0
    worker = WatchedWorker(bundle, "")
    worker.options = options
    for job in jobs_of(policy, tasks, episodes, EVALUATION_SEEDS)[:episodes]:
        Watched.episode += 1
        worker.play(replace(job, controller=()))
    worker.close()
    return dict(Watched.tallies)


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("bundle")
    parser.add_argument("policy")
    parser.add_argument("--tasks", nargs="*", default=[])
    parser.add_argument("--episodes", type=int, default=28)
    parser.add_argument("--option", action="append", default=[], metavar="NAME=NUMBER")
    given = parser.parse_args()
    options = {name: float(value) for name, _, value in (each.partition("=") for each in given.option)}
    found = play(given.bundle, given.policy, given.tasks, given.episodes, options)
    print(f"{Watched.episode} episodes, {Watched.steps:,} control steps")
    for name, tally in found.items():
        count, scores = len(tally.scores), np.array(tally.scores)
        high = wilson(tally.alarms, count)[1]
        largest = ", ".join(f"p{share:g} {np.percentile(scores, share):.3g}" for share in (50, 99, 100))
        print(f"  {name:12} {tally.alarms} of {count:,} steps ({tally.alarms / count:.3%}, below {high:.3%}), "
              f"{len(tally.episodes)} episodes; scores {largest}")  # fmt: skip


if __name__ == "__main__":
    main()
