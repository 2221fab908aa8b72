"""Measures closed-loop success per task on held-out seeds, with the right or a wrong instruction.

`acting` says which policy acts: vla-flow brings its own, and uses this file.
"""

import argparse
import json
import math
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import environment as tasks
import torch
from acting import load_runner
from rich.console import Console
from rich.table import Table

HELD_OUT_SEED = 1_000_000
EXECUTE = 4


@dataclass(frozen=True)
class Work:
    """The episodes of one task that one worker runs."""

    task: str
    instruction: str
    first_seed: int
    episodes: int
    folder: Path


def wilson(successes: int, trials: int) -> tuple[float, float]:
    """Wilson's 95 % interval of a success rate."""
    z = 1.959964
    rate = successes / trials
    centre = rate + z * z / (2 * trials)
    spread = z * math.sqrt(rate * (1 - rate) / trials + z * z / (4 * trials * trials))
    scale = 1 + z * z / trials
    return max(0.0, (centre - spread) / scale), min(1.0, (centre + spread) / scale)


def run_episode(env: tasks.MetaWorldEnv, runner: Callable[[Any], Any], seed: int) -> tuple[bool, int]:
    """Plays one episode, four actions per inference; returns success and the number of control steps."""
    observation, _ = env.reset(seed=seed)
    steps = 0
    while True:
        for action in runner(observation)[:EXECUTE]:
            observation, _, terminated, truncated, info = env.step(action)
            steps += 1
            if terminated or truncated:
                return bool(info["success"]), steps


def run_work(work: Work) -> list[tuple[bool, int]]:
    """Plays the episodes of one worker."""
    torch.set_num_threads(1)
    env = tasks.make(work.task, work.instruction)
    runner = load_runner(work.folder)
    results = [run_episode(env, runner, work.first_seed + index) for index in range(work.episodes)]
    env.close()
    return results


def evaluate(
    folder: Path,
    episodes: int,
    instruction: str = "right",
    workers: int = 1,
    first_seed: int = HELD_OUT_SEED,
    names: Sequence[str] = tasks.TASKS,
) -> dict[str, list[tuple[bool, int]]]:
    """Per task the (success, steps) of `episodes` held-out episodes."""
    work = [Work(task, instruction, first_seed, episodes, folder) for task in names]
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        return dict(zip(names, pool.map(run_work, work), strict=True))


def show(results: dict[str, list[tuple[bool, int]]], title: str, console: Console) -> None:
    """Prints the table of successes with Wilson intervals."""
    table = Table("task", "success", "95 % interval", "n", "mean steps", title=title)
    pooled = [episode for episodes in results.values() for episode in episodes]
    for name, episodes in [*results.items(), ("all", pooled)]:
        won = sum(success for success, _ in episodes)
        low, high = wilson(won, len(episodes))
        steps = sum(steps for _, steps in episodes) / len(episodes)
        rate = f"{100 * won / len(episodes):.1f} %"
        table.add_row(name, rate, f"{100 * low:.1f} .. {100 * high:.1f} %", str(len(episodes)), f"{steps:.0f}")
    console.print(table)


def main(folder: Path) -> None:
    """Command line: prints the table of the right instruction, then that of the wrong one."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--folder", type=Path, default=folder, help="weights, vocabulary, statistics")
    parser.add_argument("--episodes", type=int, default=64, help="per task, right instruction")
    parser.add_argument("--wrong-episodes", type=int, default=32, help="per task, wrong instruction")
    parser.add_argument("--tasks", nargs="+", choices=tasks.TASKS, default=tasks.TASKS)
    parser.add_argument("--seed", type=int, default=HELD_OUT_SEED, help="first episode seed")
    parser.add_argument("--threads", type=int, default=1, help="worker processes, one thread each")
    parser.add_argument("--json", type=Path, help="also write every episode's outcome here")
    options = parser.parse_args()
    console = Console()
    outcomes = {}
    for instruction, episodes in (("right", options.episodes), ("wrong", options.wrong_episodes)):
        if episodes:
            results = evaluate(options.folder, episodes, instruction, options.threads, options.seed, options.tasks)
            show(results, f"{instruction} instruction", console)
            outcomes[instruction] = results
    if options.json:
        options.json.write_text(json.dumps(outcomes))
