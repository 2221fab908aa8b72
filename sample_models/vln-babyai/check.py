"""Check what the README claims of the renderer, the fast training path, the ONNX export and the sample files.

Prints one line per claim; the exit status is 1 if one does not hold.
"""

from __future__ import annotations

import contextlib
import io
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import onnxruntime
import torch
from demonstrations import collect
from environment import make as make_environment
from environment import render
from numpy.typing import NDArray
from policy import Policy
from policy import make as make_policy
from rollout import LADDER, word_ids
from torch import nn
from train import TilePolicy

FOLDER = Path(__file__).parent
ONNX_TOLERANCE = 1e-4
BFLOAT16_TOLERANCE = 0.01  # of the largest patch embedding: training computes in bfloat16
SAMPLE_BYTES = 6_000_000
Inputs = dict[str, NDArray[Any]]


def renderer_mismatches(episodes: int = 20) -> tuple[int, int]:
    """Compare every frame of random episodes with minigrid's own wrapper; returns (mismatches, frames)."""
    from minigrid.wrappers import RGBImgPartialObsWrapper

    mismatches = frames = 0
    for task in LADDER:
        ours = make_environment(task)
        theirs = RGBImgPartialObsWrapper(gymnasium.make(f"BabyAI-{task}-v0", disable_env_checker=True), tile_size=8)
        rng = np.random.default_rng(0)
        for seed in range(episodes):
            image, reference, over = ours.reset(seed=seed)[0]["image"], theirs.reset(seed=seed)[0]["image"], False
            while not over:
                mismatches += not np.array_equal(image[-1], reference)
                frames += 1
                action = int(rng.integers(3))
                observation, _, success, time_is_up, _ = ours.step(action)
                image, reference, over = observation["image"], theirs.step(action)[0]["image"], success or time_is_up
    return mismatches, frames


def samples() -> list[Inputs]:
    """The policy's inputs of evaluation.npz, one sample at a time, as the graph takes them."""
    stored = np.load(FOLDER / "evaluation.npz")
    ids = np.array([word_ids(text) for text in stored["instruction"]])
    columns = {"image": stored["image"], "actions": stored["actions"], "instruction": ids}
    return [{name: column[row : row + 1] for name, column in columns.items()} for row in range(len(ids))]


def export(policy: nn.Module, sample: Inputs, path: Path) -> onnxruntime.InferenceSession:
    """Export at batch 1 with static shapes, opset 20, and load the graph on one thread."""
    arguments = tuple(torch.from_numpy(value) for value in sample.values())
    torch.onnx.export(policy, arguments, path, dynamo=True, opset_version=20, input_names=list(sample), verbose=False)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    return onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])


def largest_difference(policy: nn.Module, session: onnxruntime.InferenceSession, inputs: list[Inputs]) -> float:
    """Largest difference of a logit between torch and ONNX Runtime."""
    differences = []
    for sample in inputs:
        expected = policy(*(torch.from_numpy(value) for value in sample.values())).numpy()
        differences.append(np.abs(session.run(None, sample)[0] - expected).max())
    return float(max(differences))


def latency(session: onnxruntime.InferenceSession, inputs: list[Inputs]) -> float:
    """Median milliseconds of one batch-1 inference."""
    times = []
    for sample in inputs * 3:
        started = time.perf_counter()
        session.run(None, sample)
        times.append(time.perf_counter() - started)
    return 1e3 * float(np.median(times))


def fast_path_difference(policy: Policy) -> float:
    """Largest difference of a patch embedding between pixels and training's tile codes, relative to the largest."""
    starts = [(task, index) for index, task in enumerate(LADDER)]
    demonstrations = collect(starts, np.random.default_rng(0), None, noise=0.1)
    codes = demonstrations.batch(np.arange(len(demonstrations))).codes
    expected = policy.vision.embed_patches(torch.from_numpy(render(codes)))
    fast = TilePolicy(policy).image_patches(torch.from_numpy(codes).long())
    return float((fast - expected).abs().max() / expected.abs().max())


def step_milliseconds(steps: int = 2_000) -> float:
    """Mean time of one environment step with its image."""
    env = make_environment("GoToLocal")
    env.reset(seed=0)
    started = time.perf_counter()
    for _ in range(steps):
        env.step(0)
    return 1e3 * (time.perf_counter() - started) / steps


@torch.inference_mode()
def main() -> int:
    """Run all checks."""
    torch.set_num_threads(1)
    policy, inputs = make_policy(), samples()
    with contextlib.redirect_stdout(io.StringIO()):  # minigrid's own environment prints "Sampling rejected"
        mismatches, frames = renderer_mismatches()
    with tempfile.TemporaryDirectory() as folder:
        session = export(policy, inputs[0], Path(folder) / "policy.onnx")
    difference, fast = largest_difference(policy, session, inputs), fast_path_difference(policy)
    size = sum((FOLDER / name).stat().st_size for name in ("calibration.npz", "evaluation.npz"))
    claims = {
        f"renderer equals minigrid's: {mismatches} mismatches in {frames} frames": mismatches == 0,
        f"ONNX Runtime equals torch: {difference:.1e} apart in {len(inputs)} samples": difference < ONNX_TOLERANCE,
        f"training's tile path equals the pixels': {100 * fast:.1f} % apart in bfloat16": fast < BFLOAT16_TOLERANCE,
        f"sample files: {size / 1e6:.2f} MB": size < SAMPLE_BYTES,
        f"batch-1 ONNX Runtime latency, one thread: {latency(session, inputs):.2f} ms": True,
        f"environment step: {step_milliseconds():.2f} ms": True,
        f"parameters: {sum(parameter.numel() for parameter in policy.parameters()):,}": True,
    }
    for claim, holds in claims.items():
        print("ok  " if holds else "FAIL", claim)
    return 0 if all(claims.values()) else 1


if __name__ == "__main__":
    sys.exit(main())
