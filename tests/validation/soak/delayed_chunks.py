"""Controllers under delay: success and seams of chunks, on the same episodes of a sample policy.

Plays each episode with ``chunked`` without a delay and with each controller under each delay, in this process, and
writes a line of JSON for each, so that a run can be stopped and continued at any time. The table shows the episodes
that all of them have played.

    vlatool export sample_models/vla-metaworld -o out/vla-metaworld
    python tests/validation/soak/delayed_chunks.py out/vla-metaworld sample_models/vla-metaworld -o out/delayed.jsonl
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections import defaultdict
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from vlatool.bundle.bundle import Bundle
from vlatool.episodes.play import EVALUATION_SEEDS, EpisodesJob, Worker
from vlatool.module.source import describe
from vlatool.stats.intervals import wilson

REFERENCE = ("chunked", 0.0)
LIMIT = "MAX_STEPS"
DELAYS_MS = (0.0, 25.0, 50.0, 100.0, 200.0, 300.0)
CONTROLLERS = ("rtc", "late", "late:execute={chunk}", "asynchronous")
MOTION = ("seam_jump", "action_rate", "jerk")
Key = tuple[str, int]


def jobs_of(policy: str, tasks: list[str], episodes: int, first: int) -> list[EpisodesJob]:
    """Return one job for each episode, task by task for each seed."""
    named = describe(Path(policy)).environment
    tasks = tasks or list(named["tasks"])
    seeds = range(first, first - (-episodes // len(tasks)))
    return [EpisodesJob(named["make"], policy, task, (seed,)) for seed in seeds for task in tasks]


def settings_of(controllers: list[str], delays: list[float], chunk: int) -> list[tuple[str, float]]:
    """Return controllers with their delays in ms, the reference first."""
    return [REFERENCE, *((name.format(chunk=chunk), delay) for delay in delays for name in controllers)]


def allow(environment: Any, steps: int) -> None:
    """Let an environment of the sample policies play so many control steps before it ends an episode."""
    own = sys.modules[type(environment.unwrapped).__module__]
    if not hasattr(own, LIMIT):
        raise SystemExit(f"{own.__name__} has no {LIMIT}; leave --steps out")
    setattr(own, LIMIT, steps)


def play(worker: Worker, job: EpisodesJob, controller: str, delay_ms: float) -> dict[str, Any]:
    """Play an episode; return how it ended."""
    (outcome,) = worker.play(replace(job, latency_ms=delay_ms, controller=tuple(controller.split(","))))
    motion = {name: outcome.motion.get(name) for name in MOTION}
    return {"controller": controller, "delay_ms": delay_ms, "task": job.task, "seed": job.seeds[0],
            "success": outcome.success, "steps": outcome.steps, **motion}  # fmt: skip


def table(lines: list[dict[str, Any]], within: float = math.inf) -> str:
    """Return success, its difference from the reference, steps and motion, of the episodes that all have played.

    Args:
        within: Control steps after which a success does not count.
    """
    lines = [{**line, "success": line["success"] and line["steps"] <= within} for line in lines]
    played: dict[tuple[str, float], dict[Key, dict[str, Any]]] = defaultdict(dict)
    for line in lines:
        played[line["controller"], line["delay_ms"]][line["task"], line["seed"]] = line
    common = set.intersection(*(set(each) for each in played.values()))
    reference = played[REFERENCE]
    rows = ["| controller | delay, ms | success (95 % interval) | lost, points | steps | seam jump | action rate |",
            "|---|---|---|---|---|---|---|"]  # fmt: skip
    for (controller, delay), outcomes in played.items():
        own = [outcomes[key] for key in sorted(common)]
        wins = sum(line["success"] for line in own)
        low, high = wilson(wins, len(own), 0.95)
        lost = [reference[key]["success"] - outcomes[key]["success"] for key in sorted(common)]
        margin = 196 * float(np.std(lost)) / len(lost) ** 0.5
        seam, rate = (_mean(own, name) for name in ("seam_jump", "action_rate"))
        rows.append(f"| `{controller}` | {delay:g} | {wins / len(own):.1%} ({low:.1%}-{high:.1%}) | "
                    f"{100 * float(np.mean(lost)):.1f} +- {margin:.1f} | {_mean(own, 'steps'):.0f} | {seam:.2f} | "
                    f"{rate:.4g} |")  # fmt: skip
    return "\n".join([f"{len(common)} paired episodes", *rows])


def _mean(lines: list[dict[str, Any]], name: str) -> float:
    values = [line[name] for line in lines if line[name] is not None]
    return float(np.mean(values)) if values else float("nan")


def main() -> None:
    """Play what has not been played yet, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("bundle")
    parser.add_argument("policy")
    parser.add_argument("--episodes", type=int, default=500)
    parser.add_argument("--first-seed", type=int, default=EVALUATION_SEEDS)
    parser.add_argument("--delays", type=float, nargs="+", default=list(DELAYS_MS), help="ms")
    parser.add_argument("--controllers", nargs="+", default=list(CONTROLLERS))
    parser.add_argument("--steps", type=int, help="control steps of an episode; those of the environment when left out")
    parser.add_argument("--within", type=int, nargs="+", default=[], help="count successes within so many steps, too")
    parser.add_argument("--tasks", nargs="+", default=[], help="all when left out")
    parser.add_argument("-o", "--output", type=Path, required=True)
    options = parser.parse_args()
    spec = Bundle.open_lazily(options.bundle).manifest.spec
    settings = settings_of(options.controllers, options.delays, spec.chunk)
    lines = [json.loads(line) for line in options.output.read_text().splitlines()] if options.output.exists() else []
    done = {(line["controller"], line["delay_ms"], line["task"], line["seed"]) for line in lines}
    worker = Worker(options.bundle, "")
    with options.output.open("a") as file:
        for job in jobs_of(options.policy, options.tasks, options.episodes, options.first_seed):
            for controller, delay in settings:
                if (controller, delay, job.task, job.seeds[0]) not in done:
                    if options.steps:
                        allow(worker.environment(job), options.steps)
                    lines.append(play(worker, job, controller, delay))
                    print(json.dumps(lines[-1]), file=file, flush=True)
    wanted = set(settings)
    shown = [line for line in lines if (line["controller"], line["delay_ms"]) in wanted]
    for steps in (*options.within, math.inf):
        print(f"\nSuccesses within {steps:g} steps, {table(shown, steps)}")


if __name__ == "__main__":
    main()
