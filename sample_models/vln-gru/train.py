"""Train the vln-gru policy: minigrid's bot says what is right, where it walks and then where the policy does (DAgger).

Windows are whole episodes, so that gradients pass through all that is remembered. Writes weights.safetensors,
vocabulary.json and calibration.npz beside this file.
"""

from __future__ import annotations

import argparse
import shutil
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from one_frame import BABYAI
from recurrent import NO_ACTION, WIDTH, Policy, make
from safetensors.torch import save_file

from demonstrations import Demonstrations, collect  # isort: skip  (of vln-babyai, as the next ones are)
from environment import COLOURS, TYPES, render  # isort: skip
from rollout import ARTICLES, SENTENCES, Episode, play, word_ids  # isort: skip

TASKS = {"GoToLocalS5N2": 0.2, "GoToLocalS6N3": 0.4, "GoToLocalS8N4": 0.4}
BATCH = 48  # episodes in an update
LONGEST = 40  # steps of an episode that are learnt from
VALIDATION_SEED = 1_500_000  # training seeds count up from 0
VALIDATION_EPISODES = 64
RATE = 2e-3


class Walker:
    """Chooses actions with a policy, and holds the memory of each episode."""

    def __init__(self, policy: Policy) -> None:
        self.policy, self.memories = policy, dict[int, torch.Tensor]()

    @torch.inference_mode()
    def __call__(self, episodes: Sequence[Episode]) -> np.ndarray:
        """The best action of every episode's current state."""
        frames = torch.from_numpy(render(np.stack([episode.env.view_codes[-1] for episode in episodes])))
        before = torch.tensor([[int(episode.env.past_actions[-1])] for episode in episodes])
        words = torch.tensor([word_ids(episode.env.instruction) for episode in episodes])
        zero = torch.zeros(WIDTH)
        memory = torch.stack([zero if e.length == 0 else self.memories[e.seed] for e in episodes])
        logits, memory = self.policy(frames, before, words, memory)
        self.memories.update({episode.seed: row for episode, row in zip(episodes, memory, strict=True)})
        return logits.argmax(1).numpy()


def starts_of(count: int, first: int, random: np.random.Generator) -> list[tuple[str, int]]:
    """Tasks and seeds of new episodes."""
    tasks = random.choice(list(TASKS), size=count, p=list(TASKS.values()))
    return [(str(task), first + number) for number, task in enumerate(tasks)]


def borders(seen: Demonstrations) -> np.ndarray:
    """First row of each episode, and the end of the last."""
    return np.append(np.flatnonzero(seen.facts[:, 2] == 0), len(seen))


def loss_of(policy: Policy, seen: Demonstrations, random: np.random.Generator) -> torch.Tensor:
    """Cross-entropy to the bot's actions over some episodes, with the memory carried along each."""
    edges = borders(seen)
    chosen = random.integers(len(edges) - 1, size=BATCH)
    firsts, ends = edges[chosen], np.minimum(edges[chosen + 1], edges[chosen] + LONGEST)
    article, colour, kind = seen.facts[firsts, 3:6].T
    words = torch.from_numpy(SENTENCES[article, colour, kind])
    memory, losses, count = torch.zeros(BATCH, WIDTH), [], 0
    for time_ in range(int((ends - firsts).max())):
        rows = np.minimum(firsts + time_, ends - 1)
        before = seen.facts[np.maximum(rows - 1, 0), 0] if time_ else np.full(BATCH, NO_ACTION)
        frames = torch.from_numpy(render(seen.codes[rows]))
        logits, memory = policy(frames, torch.from_numpy(np.asarray(before))[:, None], words, memory)
        own = torch.from_numpy(firsts + time_ < ends)
        wanted = torch.from_numpy(seen.facts[rows, 1])
        losses.append(torch.nn.functional.cross_entropy(logits[own], wanted[own], reduction="sum"))
        count += int(own.sum())
    return torch.stack(losses).sum() / count


def success_of(policy: Policy, task: str) -> float:
    """Share of the validation episodes of a task in which the policy succeeds."""
    starts = [(task, VALIDATION_SEED + number) for number in range(VALIDATION_EPISODES)]
    return float(np.mean([episode.success for episode in play(Walker(policy), starts)]))


def recording(seen: Demonstrations, episodes: int) -> dict[str, Any]:
    """Some episodes as the robot sees them, with the bot's actions."""
    rows = np.arange(borders(seen)[episodes])
    step, goals = seen.facts[rows, 2], seen.facts[rows, 3:6]
    before = np.where(step == 0, NO_ACTION, seen.facts[np.maximum(rows - 1, 0), 0])
    words = [f"go to {ARTICLES[article]} {COLOURS[colour]} {TYPES[kind]}" for article, colour, kind in goals]
    return {"image": render(seen.codes[rows]), "action_before": before[:, None], "instruction": np.array(words),
            "action": seen.facts[rows, 1], "episode": seen.facts[rows, 7]}  # fmt: skip


def main() -> None:
    """Parse the command line and train."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent, help="folder for the results")
    parser.add_argument("--minutes", type=float, default=14.0)
    parser.add_argument("--expert-episodes", type=int, default=1500)
    parser.add_argument("--round-episodes", type=int, default=300)
    parser.add_argument("--round-steps", type=int, default=100, help="updates between two rounds of the policy's")
    parser.add_argument("--threads", type=int, default=2)
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    torch.manual_seed(0)
    random, end = np.random.default_rng(0), time.monotonic() + 60 * arguments.minutes
    begun = time.monotonic()
    policy = make(None).train()
    optimizer = torch.optim.AdamW(policy.parameters(), lr=RATE, weight_decay=0.01)
    seen = collect(starts_of(arguments.expert_episodes, 0, random), random, None, 0.15)
    calibration, played, step = recording(seen, 24), arguments.expert_episodes, 0
    while time.monotonic() < end:
        for _ in range(arguments.round_steps):
            share = (time.monotonic() - begun) / (60 * arguments.minutes)
            optimizer.param_groups[0]["lr"] = RATE * max(0.02, 0.5 * (1 + np.cos(np.pi * min(1.0, share))))
            loss = loss_of(policy, seen, random)
            optimizer.zero_grad()
            loss.backward()
            torch.nn.utils.clip_grad_norm_(policy.parameters(), 1.0)
            optimizer.step()
            step += 1
        policy.eval()
        wins = ", ".join(f"{success_of(policy, task):.1%} in {task}" for task in ("GoToLocalS6N3", "GoToLocalS8N4"))
        print(f"{(time.monotonic() - begun) / 60:.1f} min, step {step}, loss {loss:.3f}, success {wins}", flush=True)
        starts = starts_of(arguments.round_episodes, played, random)
        seen.extend(collect(starts, random, Walker(policy), 0.1))
        played += arguments.round_episodes
        policy.train()
    save_file(policy.eval().state_dict(), arguments.out / "weights.safetensors")
    shutil.copyfile(BABYAI / "vocabulary.json", arguments.out / "vocabulary.json")
    np.savez_compressed(arguments.out / "calibration.npz", **calibration)


if __name__ == "__main__":
    main()
