"""What a LeRobot checkpoint says of its policy: features, normalisation and statistics, read as data."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlatool.errors import SourceError, require, suggest
from vlatool.files.json import read_json
from vlatool.files.printable import truncate
from vlatool.files.small_file import read_bounded
from vlatool.sources._lerobot_conversions import (
    ABSOLUTE,
    RELATIVE,
    STATE,
    STATE_IN_PROMPT,
    Steps,
    aloha_steps,
    joint_names,
    relative_parts,
    state_prompt,
)

FAMILIES = ("act", "diffusion", "pi0", "pi05", "smolvla")
"""Types of policies that ``_lerobot_child`` traces."""
HARMLESS = ("to_batch_processor", "device_processor")
TEXT_STEPS = {
    "smolvla": ("smolvla_new_line_processor", "tokenizer_processor"),
    "pi0": ("pi0_new_line_processor", "tokenizer_processor"),
    "pi05": (STATE_IN_PROMPT, "tokenizer_processor"),
}
"""Family -> steps of its instruction, which the tokenizer that ``_lerobot_child`` writes and a prompt do."""
RENAME, NORMALIZER, UNNORMALIZER = "rename_observations_processor", "normalizer_processor", "unnormalizer_processor"
MODES = {
    "IDENTITY": (), "MEAN_STD": ("mean", "std"), "MIN_MAX": ("min", "max"), "QUANTILES": ("q01", "q99"),
    "QUANTILE10": ("q10", "q90"),
}  # fmt: skip
"""Normalisation of LeRobot (``processor/normalize_processor.py`` of 0.6) -> the statistics that it takes."""
NORMALISATION = {"op": "normalisation"}
EMPTY_CAMERA = "observation.images.empty_camera_"
"""Cameras that the policy fills with a constant itself."""
COMPLETE = "save the policy again with save_pretrained, its processors, too: config.json, model.safetensors and both "
COMPLETE += "policy_*processor.json with their .safetensors"
Statistics = Mapping[str, NDArray[np.float64]]


@dataclass(frozen=True)
class Feature:
    """An input or output of the policy.

    Args:
        key: name that a robot uses (``observation.state``), before LeRobot renames it.
        kind: ``STATE``, ``VISUAL``, ``ENV`` or ``ACTION``.
        mode: how LeRobot normalises it, of ``MODES``.
        statistics: what the mode takes, float64 of the feature's elements; (3,) for pictures.
        epsilon: what LeRobot adds to a standard deviation on the way in, not on the way out, and puts for a range of 0.
        convert: steps of the spec between the values of the robot and those of the network.
        labels: names of its elements, where the checkpoint says them.
    """

    key: str
    kind: str
    shape: tuple[int, ...]
    mode: str
    statistics: Statistics
    epsilon: float
    convert: tuple[dict[str, Any], ...] = ()
    labels: tuple[str, ...] = ()


@dataclass(frozen=True)
class Checkpoint:
    """A checkpoint as its files say.

    Args:
        inputs: key in the policy -> the feature, in the order of config.json.
        execute: actions that are executed of a chunk.
        prompt: what is written around the instruction, as a spec says it; empty where nothing is.
        ensemble: coefficient of ACT's temporal ensembling, with which it averages chunks; None without.
    """

    folder: Path
    family: str
    inputs: Mapping[str, Feature]
    action: Feature
    execute: int
    prompt: Mapping[str, Any] = field(default_factory=dict)
    ensemble: float | None = None


def read_checkpoint(folder: Path) -> Checkpoint:
    """Read the JSON files and statistics of a checkpoint; nothing that they name is imported or run.

    Raises:
        SourceError: when a file is missing or damaged, a type of policy or a processing step is unknown, a statistic is
            missing, or a step is code.
    """
    config = _mapping(folder, "config.json")
    family = config.get("type")
    if family not in FAMILIES:
        raise SourceError(
            f"{folder} is a LeRobot policy of the type {truncate(repr(family), 60)}; {suggest(str(family), FAMILIES)}.",
            "write a policy.yaml and a few lines of Python: docs/guides/lerobot-policy.md",
        )
    steps = _steps(
        folder,
        "policy_preprocessor.json",
        (*HARMLESS, *TEXT_STEPS.get(str(family), ()), RENAME, RELATIVE, NORMALIZER),
    )
    for name in TEXT_STEPS.get(str(family), ()):
        if name not in steps:
            raise SourceError(
                f"{folder / 'policy_preprocessor.json'} has no step '{name}', as {family} has it.", COMPLETE
            )
    _check_order(folder, steps, RENAME, NORMALIZER, STATE_IN_PROMPT)
    _check_order(folder, steps, *TEXT_STEPS.get(str(family), ()))
    for name in TEXT_STEPS.get(str(family), ()):
        _check_text(folder, config, name, steps[name])
    behind = _steps(folder, "policy_postprocessor.json", (*HARMLESS, UNNORMALIZER, ABSOLUTE))
    mapping = config.get("normalization_mapping")
    trained_with = mapping if isinstance(mapping, dict) else {}
    robot_key = _robot_keys(folder, steps.get(RENAME, {}).get("rename_map", {}))
    features = _features(folder, config, "input_features")
    _check_names(folder, features)
    inputs = {
        key: _feature(folder, (key, robot_key.get(key, key)), about, steps.get(NORMALIZER, {}), trained_with)
        for key, about in features.items()
        if not key.startswith(EMPTY_CAMERA)
    }
    outputs = _features(folder, config, "output_features")
    if list(outputs) != ["action"]:
        raise SourceError(f"{folder} has the outputs {sorted(outputs)}; wanted: action.", COMPLETE)
    action = _feature(folder, ("action", "action"), outputs["action"], behind.get(UNNORMALIZER, {}), trained_with)
    action = _converted(folder, action, inputs.get(STATE), (steps, behind))
    if family == "smolvla":
        inputs, action = _adapted(folder, config, inputs, action)
    execute = config.get("n_action_steps", 1)
    if not isinstance(execute, int) or execute < 1:
        raise SourceError(f"config.json of {folder} has n_action_steps {truncate(repr(execute), 40)}.", COMPLETE)
    ensemble = _ensemble(folder, config, action)
    prompt = state_prompt(folder, steps, inputs[STATE].key if STATE in inputs else "")
    executed = execute if ensemble is None else 1
    return Checkpoint(folder, str(family), inputs, action, executed, prompt, ensemble)


def _ensemble(folder: Path, config: Mapping[str, Any], action: Feature) -> float | None:
    """Return the coefficient of ACT's temporal ensembling, None without; raises SourceError where ours differs."""
    if (value := config.get("temporal_ensemble_coeff")) is None:
        return None
    number = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
    if config.get("type") != "act" or not number:
        raise SourceError(
            f"config.json of {folder} has temporal_ensemble_coeff {truncate(repr(value), 40)}; allowed: null, or a "
            "number for act.",
            COMPLETE,
        )
    if any(step["op"] == "relative" for step in action.convert):
        raise SourceError(
            f"{folder} averages actions that are relative to the states of different inferences "
            "(temporal_ensemble_coeff); temporal_ensemble of vlatool averages what the robot gets.",
            "set it to null and n_action_steps to the actions that are executed of each chunk, if the policy can do "
            "without",
        )
    return float(value)


def _check_order(folder: Path, steps: Steps, *names: str) -> None:
    """Refuse steps in another order than LeRobot has them: what one gives, the next one would not get."""
    listed = [name for name in steps if name in names]
    if listed != [name for name in names if name in steps]:
        raise SourceError(
            f"{folder / 'policy_preprocessor.json'} has its steps in the order {', '.join(listed)}; LeRobot's is "
            f"{', '.join(names)}.",
            COMPLETE,
        )


def _check_text(folder: Path, config: Mapping[str, Any], name: str, step: Mapping[str, Any]) -> None:
    """Refuse what changes the ids of an instruction in ways that the tokenizer's file does not show."""
    for key, known in (
        ("padding_side", "right"), ("task_key", "task"), ("max_length", config.get("tokenizer_max_length")),
    ):  # fmt: skip
        if (value := step.get(key)) not in (None, known):
            raise SourceError(
                f"{folder / 'policy_preprocessor.json'} has {name} with {key} {truncate(repr(value), 40)};"
                f" wanted: {known}.",
                COMPLETE,
            )


def _converted(folder: Path, action: Feature, state: Feature | None, steps: tuple[Steps, Steps]) -> Feature:
    """Return the action with what lies between it and the robot, and the names of its elements."""
    width = action.shape[-1]
    labels = tuple(joint_names(folder, steps[0], width))
    parts = relative_parts(folder, steps, (state.shape[-1] if state else 0, width))
    if not parts or state is None:
        return replace(action, labels=labels)
    return replace(action, labels=labels, convert=({"op": "relative", "to": state.key, "parts": parts},))


def _adapted(
    folder: Path, config: Mapping[str, Any], inputs: dict[str, Feature], action: Feature
) -> tuple[dict[str, Feature], Feature]:
    """Return the features with what the policy itself does to the state and the action of ALOHA."""
    state = inputs.get(STATE)
    of_state, of_action = aloha_steps(folder, config, (state.shape[-1] if state else 0, action.shape[-1]))
    if state is None or not of_state:
        return inputs, action
    adapted = [
        replace(feature, convert=(*feature.convert, *([] if feature.mode == "IDENTITY" else [NORMALISATION]), *more))
        for feature, more in ((state, of_state), (action, of_action))
    ]
    return {**inputs, STATE: adapted[0]}, adapted[1]


def _robot_keys(folder: Path, renames: Any) -> dict[str, str]:
    """Return key in the policy -> key that a robot uses, of what LeRobot renames."""
    known = isinstance(renames, dict) and all(isinstance(policy, str) for policy in renames.values())
    if not known or len(set(renames.values())) < len(renames):
        raise SourceError(f"{folder} has the rename_map {truncate(repr(renames), 80)}; wanted: key -> key.", COMPLETE)
    return {policy: robot for robot, policy in renames.items()}


def _check_names(folder: Path, keys: Iterable[str]) -> None:
    """Refuse features that the graphs cannot tell apart: their inputs are named by letters and digits alone."""
    names: dict[str, str] = {}
    for key in keys:
        if (other := names.setdefault(re.sub(r"\W", "_", key, flags=re.ASCII), key)) != key:
            raise SourceError(
                f"{folder} has the inputs '{other}' and '{key}', of one name in the graph.", "rename one of them"
            )


def _mapping(folder: Path, name: str) -> dict[str, Any]:
    try:
        content = read_bounded(folder / name, "statistics_bytes", SourceError)
    except OSError as error:
        raise SourceError(f"The LeRobot checkpoint {folder} has no {name} ({error.strerror}).", COMPLETE) from error
    value = read_json(content, f"{folder / name}", SourceError, COMPLETE)
    if not isinstance(value, dict):
        raise SourceError(f"{folder / name} holds no mapping.", COMPLETE)
    return value


def _features(folder: Path, config: Mapping[str, Any], name: str) -> dict[str, Any]:
    found = config.get(name)
    if not isinstance(found, dict) or not found or not all(isinstance(each, dict) for each in found.values()):
        raise SourceError(f"config.json of {folder} has no {name}.", COMPLETE)
    return found


def _steps(folder: Path, name: str, known: tuple[str, ...]) -> dict[str, dict[str, Any]]:
    """Return the configuration of each processing step by its registry name, with its file of statistics.

    Raises:
        SourceError: for a step that is code, or that vlatool does not know: leaving it out would change the actions.
    """
    steps: dict[str, dict[str, Any]] = {}
    listed = _mapping(folder, name).get("steps")
    if not isinstance(listed, list):
        raise SourceError(f"{folder / name} lists no steps.", COMPLETE)
    for step in listed:
        if not isinstance(step, dict) or "registry_name" not in step:
            code = truncate(str(step.get("class") if isinstance(step, dict) else step), 80)
            raise SourceError(
                f"{folder / name} has the step {code}, which names a class: that is code, and was not run.",
                "a step must have a registry_name of LeRobot; write such a step into a policy.yaml and Python of your "
                "own: docs/guides/lerobot-policy.md",
            )
        registered = str(step["registry_name"])
        found = step.get("config")
        settings: dict[str, Any] = found if isinstance(found, dict) else {}
        if registered not in known:
            raise SourceError(
                f"{folder / name} has the step '{truncate(registered, 80)}'; {suggest(registered, known)}.",
                "what the step does must be part of a policy.yaml of your own: docs/guides/lerobot-policy.md",
            )
        if registered in steps:
            raise SourceError(f"{folder / name} has the step '{registered}' twice.", COMPLETE)
        steps[registered] = {**settings, "state_file": step.get("state_file")}
    return steps


def _feature(
    folder: Path,
    keys: tuple[str, str],
    about: Mapping[str, Any],
    step: Mapping[str, Any],
    trained_with: Mapping[str, Any],
) -> Feature:
    """Return a feature with the statistics that the processing step applies to it.

    Args:
        keys: key in the policy, and the one that a robot uses.
        trained_with: kind of feature -> mode, as config.json says.
    """
    key, robot_key = keys
    shape, kind = about.get("shape"), str(about.get("type"))
    if not isinstance(shape, list) or not shape or not all(isinstance(size, int) and size > 0 for size in shape):
        raise SourceError(f"config.json of {folder} gives '{key}' the shape {truncate(repr(shape), 60)}.", COMPLETE)
    known, modes, epsilon = step.get("features"), step.get("norm_map") or {}, step.get("eps", 1e-8)
    if not isinstance(modes, dict):
        raise SourceError(f"{folder} has the norm_map {truncate(repr(modes), 60)}; wanted: kind -> mode.", COMPLETE)
    if isinstance(epsilon, bool) or not isinstance(epsilon, int | float) or not 0 <= epsilon < 1:
        raise SourceError(f"{folder} has the eps {truncate(repr(epsilon), 40)}; wanted: 0 to 1.", COMPLETE)
    chosen = step.get("normalize_observation_keys")
    if chosen is not None and not isinstance(chosen, list):
        raise SourceError(
            f"{folder} has the normalize_observation_keys {truncate(repr(chosen), 60)}; wanted: a list of keys.",
            COMPLETE,
        )
    taken = known.get(key) if isinstance(known, dict) else None
    listed = taken is not None and (chosen is None or kind == "ACTION" or key in chosen)
    mode = str(modes.get(kind, "IDENTITY")) if listed else "IDENTITY"
    said = taken.get("type", kind) if isinstance(taken, dict) else kind
    if said != kind:
        raise SourceError(
            f"config.json of {folder} has '{key}' as {truncate(kind, 40)}, its processors as "
            f"{truncate(repr(said), 40)}.",
            COMPLETE,
        )
    if mode not in MODES:
        raise SourceError(f"{folder} normalises '{key}' by {truncate(mode, 40)}; {suggest(mode, MODES)}.", COMPLETE)
    trained = str(trained_with.get(kind, mode))
    if trained != mode:
        raise SourceError(
            f"config.json of {folder} normalises {kind} by {truncate(trained, 40)}, its processors do {mode} to "
            f"'{key}'; LeRobot would pass it on as it is, silently.",
            COMPLETE,
        )
    statistics = {name: _statistic(folder, step, key, name, mode) for name in MODES[mode]}
    width = shape[0] if kind == "VISUAL" else shape[-1]
    for name, values in statistics.items():
        if values.shape != (width,) or not np.isfinite(values).all():
            raise SourceError(
                f"The statistic '{key}.{name}' of {folder} has the shape {list(values.shape)} or is not finite; wanted "
                f"{width} numbers.",
                COMPLETE,
            )
    return Feature(robot_key, kind, tuple(shape), mode, statistics, float(epsilon))


def _statistic(folder: Path, step: Mapping[str, Any], key: str, name: str, mode: str) -> NDArray[np.float64]:
    """Return one statistic of a feature from the file of a step, without axes of length 1.

    Raises:
        SourceError: when it is not there; LeRobot would pass the feature on unchanged, without a word.
    """
    file = str(step.get("state_file") or "")
    path = folder / Path(file).name
    if not file or not path.is_file():
        raise SourceError(f"{folder} lacks the file of statistics {file or '(state_file)'} for '{key}'.", COMPLETE)
    error_type = require("safetensors", "build").SafetensorError
    try:
        tensors = require("safetensors.numpy", "build").load_file(path)
    except (error_type, OSError, ValueError, TypeError) as error:  # TypeError: a dtype that NumPy has not
        raise SourceError(f"{path} cannot be read: {truncate(str(error), 200)}.", COMPLETE) from error
    if f"{key}.{name}" not in tensors:
        raise SourceError(
            f"{path} has no '{key}.{name}', which {mode} needs; LeRobot would pass '{key}' on unchanged, silently.",
            f"save the processors with the statistics of the dataset; {suggest(f'{key}.{name}', tensors)}",
        )
    return np.atleast_1d(np.asarray(tensors[f"{key}.{name}"], np.float64).squeeze())
