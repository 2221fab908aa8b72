"""Run both sides on the same observations in this process: actions, and the stages between as far as known."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from vlatool.bundle.bundle import Bundle
from vlatool.bundle.spec import PolicySpec
from vlatool.data import NamedRecording, Recording, read_recording, recordings_of, synthetic_observations
from vlatool.module.torch_policy import torch_policy
from vlatool.runtime.interface import Array
from vlatool.runtime.policy import Policy, relative_error
from vlatool.runtime.program import draw
from vlatool.user_code.children import OnProgress
from vlatool.verify._causes import causes
from vlatool.verify._original import Original, as_fed
from vlatool.verify._sample import MAX_ERROR, Sample, error_of


def compare(job: Mapping[str, Any], tell: OnProgress) -> dict[str, Any]:
    """Run both on the observations of a job; return what was found, as JSON values."""
    bundle = Bundle.open(Path(job["bundle"]))
    seed, tolerance = int(job["seed"]), float(job["tolerance"])
    policy = Policy.open(bundle, threads=1, seed=seed) if bundle.manifest.graphs else torch_policy(bundle, seed)
    original = Original(job["against"], Path(job["folder"]), policy.spec)
    recording = _recording(bundle, NamedRecording(Path(job["data"]), job["names"]) if job["data"] else None)
    random = np.random.default_rng(seed)
    samples = []
    for index, (number, observation, begins) in enumerate(_observations(policy, recording, int(job["samples"]))):
        tell("running both", index / int(job["samples"]))
        if begins:
            policy.reset()
            original.reset()
        samples.append(_sample(policy, original, number, observation, random))
    stages = _stages(policy, samples, tolerance)
    differing = [sample for sample in samples if not sample.error <= tolerance]
    sentences = causes(policy, samples, stages, tolerance) if differing else ([], True)
    return {
        "samples": len(samples), "steps": min(len(sample.expected) for sample in samples),
        "differing": len(differing), "first": differing[0].number if differing else -1,
        "error": _worst([sample.error for sample in samples]), "elements": _elements(policy.spec, samples),
        "stages": stages, "causes": sentences[0], "certain": sentences[1], "hooks": original.hooks,
        "observations": "recorded observations" if recording else "random observations",
        "warnings": _warnings(policy, original, recording),
    }  # fmt: skip


def _recording(bundle: Bundle, data: NamedRecording | None) -> Recording | None:
    own = recordings_of(bundle)
    path = data or own.evaluation or own.calibration
    return None if path is None else read_recording(path, bundle.manifest.spec)


def _observations(
    policy: Policy, recording: Recording | None, count: int
) -> Iterator[tuple[int, dict[str, Any], bool]]:
    """Yield the place of each observation, the observation, and whether an episode begins with it.

    A policy that keeps values sees observations that follow each other.
    """
    keeps = policy.program.keeps
    if recording is None:
        for number, observation in enumerate(synthetic_observations(policy.bundle, count)):
            yield number, observation, not keeps or number == 0
        return
    before = None
    for number in range(min(count, len(recording))) if keeps else recording.spread(count):
        episode = None if recording.episodes is None else int(recording.episodes[number])
        yield number, recording.observation(number), not keeps or number == 0 or episode != before
        before = episode


def _sample(
    policy: Policy, original: Original, number: int, observation: dict[str, Any], random: np.random.Generator
) -> Sample:
    steps = policy.bundle.manifest.program
    noise = {name: draw(expected, random) for step in steps for name, expected in step.noise.items()}
    encoded = policy.encode(observation)
    encoded.update({name: value.copy() for name, value in encoded.items()})
    action = policy.infer(observation, noise=noise)
    expected = original.act(observation, noise, number)
    chunk = action.chunk.astype(expected.dtype)[: len(expected)]
    tensors = {tensor.name: tensor for tensor in policy.spec.inputs}
    inputs = {name: as_fed(tensors[name], value) for name, value in original.preprocess(observation, number).items()}
    return Sample(
        number, observation, noise, encoded, action.outputs[policy.spec.action.name], chunk, expected, inputs,
        original.raw(observation, noise, number), error_of(policy, chunk, expected),
    )  # fmt: skip


def _elements(spec: PolicySpec, samples: list[Sample]) -> list[dict[str, Any]]:
    """Return the largest difference of each element of the action, and where it is."""
    if spec.action.kind == "discrete":
        return []
    labels = spec.action.labels or tuple(str(index) for index in range(spec.action.robot_width))
    errors = np.stack([np.abs(sample.chunk - sample.expected).max(axis=0) for sample in samples])
    sizes = np.max([np.abs(sample.expected).max(axis=0) for sample in samples], axis=0)
    rows = []
    for index, (label, unit) in enumerate(zip(labels, spec.action.units(), strict=True)):
        worst = int(errors[:, index].argmax())
        largest = float(errors[worst, index])
        relative = largest / (float(sizes[index]) or 1.0)
        rows.append({"element": label, "unit": unit, "max error": float(f"{largest:.4g}"),
                      "relative": float(f"{relative:.4g}"),
                      "observation": samples[worst].number})  # fmt: skip
    return rows


def _stages(policy: Policy, samples: list[Sample], tolerance: float) -> list[dict[str, Any]]:
    """Return the stages that could be compared, in the order in which an observation goes through them."""
    stages = []
    for tensor in policy.spec.inputs:
        if all(tensor.name in sample.inputs for sample in samples):
            what = f"tokenizer of '{tensor.name}'" if tensor.kind == "text" else (
                f"normalisation of '{tensor.name}' ({tensor.normalisation})")  # fmt: skip
            errors = [_error(sample.encoded[tensor.name], sample.inputs[tensor.name]) for sample in samples]
            stages.append(_stage(what, tensor.name, samples, errors, tolerance))
    if all(sample.expected_raw is not None for sample in samples):
        errors = [_error(sample.raw, np.asarray(sample.expected_raw)) for sample in samples]
        stages.append(_stage("network", "", samples, errors, tolerance))
    errors = [sample.error for sample in samples]
    stages.append(_stage(f"action ({policy.spec.action.normalisation})", "", samples, errors, tolerance))
    return stages


def _stage(what: str, name: str, samples: list[Sample], errors: list[float], tolerance: float) -> dict[str, Any]:
    differing = [sample.number for sample, error in zip(samples, errors, strict=True) if not error <= tolerance]
    return {"stage": what, "input": name, "relative error": _worst(errors), "differs": len(differing),
            "first": differing[0] if differing else None}  # fmt: skip


def _error(got: Array, expected: Array) -> float:
    """Return the relative L2 difference; the largest number for other sizes, of which a batch axis is none."""
    if got.size == expected.size and not np.isfinite(expected).all():  # an input that takes NaN and infinity
        got, expected = got.reshape(-1), expected.reshape(-1)
        alike = (got == expected) | (np.isnan(got) & np.isnan(expected))
        got, expected = got[~alike | np.isfinite(got)], expected[~alike | np.isfinite(got)]
    return min(relative_error(got, expected), MAX_ERROR)


def _worst(errors: list[float]) -> float:
    return float(np.nanmax([MAX_ERROR if error != error else error for error in errors], initial=0.0))


def _warnings(policy: Policy, original: Original, recording: Recording | None) -> list[str]:
    warnings = []
    if recording is None:
        warnings.append("nothing is recorded, so both ran on random observations: pass --data FILE.npz to compare on "
                     "what the policy is for")  # fmt: skip
    if any(step.noise for step in policy.bundle.manifest.program) and not original.takes_noise:
        warnings.append("the policy draws noise, and act() takes none: the difference is also that of the noise; write "
                     "act(observation, noise) with noise, a dict of arrays by the names in policy.yaml")  # fmt: skip
    if policy.program.keeps and original._reset is None:
        warnings.append("the policy keeps values from step to step, and the original has no reset() beside act()")
    return warnings
