"""What the steps of a LeRobot checkpoint do to states and actions beside statistics, as a spec says it."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from vlatool.errors import SourceError
from vlatool.files.printable import truncate

RELATIVE, ABSOLUTE = "relative_actions_processor", "absolute_actions_processor"
STATE = "observation.state"
STATE_IN_PROMPT = "pi05_prepare_state_tokenizer_processor_step"
STATE_PROMPT = {
    "template": "Task: {}, State: {state};\nAction: ", "strip": True, "replace": {"_": " ", "\n": " "},
}  # fmt: skip
"""The prompt of pi0.5, as ``policies/pi05/processor_pi05.py`` of LeRobot 0.6.1 has it."""
Steps = Mapping[str, Mapping[str, Any]]
ALOHA = "adapt_to_pi_aloha"
FLIPPED_JOINTS, GRIPPERS = [1, 2, 8, 9], [6, 13]
"""Joints of ALOHA whose sign the pi models have the other way, and its grippers."""
FLIP = {"op": "scale", "parts": FLIPPED_JOINTS, "factor": -1}
GRIPPER_OF_STATE = [
    {"op": "range", "parts": GRIPPERS, "robot": [0, 1], "network": [0.01844, 0.058]},
    {"op": "linkage", "parts": GRIPPERS, "arm_length": 0.036, "horn_radius": 0.022},
    {"op": "range", "parts": GRIPPERS, "robot": [0.4, 1.5], "network": [0, 1]},
]
"""Finger position (share, then m) -> angle of the horn (rad, then share), as ``modeling_smolvla.py`` has it."""
GRIPPER_OF_ACTION = [
    {"op": "range", "parts": GRIPPERS, "robot": [0, 1], "network": [-0.6213, 1.491]},
    {"op": "range", "parts": GRIPPERS, "robot": [0.4, 1.5], "network": [0, 1]},
]
SAVE_BOTH = "save the processors of the policy again, as LeRobot makes them: relative_actions_processor before "
SAVE_BOTH += "normalizer_processor, absolute_actions_processor after unnormalizer_processor, both enabled or both not"


def relative_parts(folder: Path, steps: tuple[Steps, Steps], widths: tuple[int, int]) -> list[list[int]]:
    """Return the parts of the action, [start, stop), that are differences from the state; none where none are.

    As LeRobot 0.6 has it (``processor/relative_action_processor.py``): the state that was observed when the chunk was
    inferred is added to the whole chunk, element by element, after the statistics are applied.

    Args:
        steps: those of the preprocessor and of the postprocessor, in their order.
        widths: elements of the state, 0 where there is none, and of the action.

    Raises:
        SourceError: for an order or a setting with which LeRobot would do something else.
    """
    before, behind = steps
    on = [_enabled(folder, step, name) for step, name in ((before, RELATIVE), (behind, ABSOLUTE))]
    if on[0] != on[1]:
        done = "stay relative" if on[0] else "become absolute, although none were made relative"
        raise SourceError(f"{folder} has {RELATIVE} {_on(on[0])} and {ABSOLUTE} {_on(on[1])}: actions would {done}.",
                          SAVE_BOTH)  # fmt: skip
    if not on[0]:
        return []
    for ordered in (
        _order(before, "rename_observations_processor", RELATIVE, "normalizer_processor"),
        _order(behind, "unnormalizer_processor", ABSOLUTE),
    ):
        if ordered != sorted(ordered):
            raise SourceError(
                f"{folder} has its steps for relative actions on the wrong side of the statistics: states and actions "
                "would be added in other units.",
                SAVE_BOTH,
            )
    if widths[0] < widths[1]:
        raise SourceError(
            f"{folder} has actions of {widths[1]} elements that are relative to {widths[0]} of '{STATE}'.", SAVE_BOTH
        )
    return _runs(_mask(folder, before[RELATIVE], widths[1]))


def state_prompt(folder: Path, steps: Steps, state: str) -> dict[str, Any]:
    """Return the prompt of a policy that reads its state as text; empty for any other policy.

    Args:
        state: name of the state as a robot has it; empty where there is none.

    Raises:
        SourceError: where the policy has no state.
    """
    if STATE_IN_PROMPT not in steps:
        return {}
    if not state:
        raise SourceError(
            f"config.json of {folder} has no '{STATE}', which '{STATE_IN_PROMPT}' writes into the prompt.",
            "train the policy with a state, as LeRobot wants it",
        )
    return {**STATE_PROMPT, "state": {"input": state}}


def aloha_steps(folder: Path, config: Mapping[str, Any], widths: tuple[int, int]) -> tuple[list[Any], list[Any]]:
    """Return what SmolVLA does to states and actions of ALOHA, behind the statistics, as LeRobot does it.

    Args:
        widths: elements of the state, 0 where there is none, and of the action.

    Raises:
        SourceError: where the policy has not the 14 joints of ALOHA.
    """
    adapts = config.get(ALOHA, False)
    if not isinstance(adapts, bool) or (adapts and min(widths) <= max(GRIPPERS)):
        raise SourceError(
            f"config.json of {folder} has {ALOHA} {truncate(repr(adapts), 40)} and {widths[0]} elements of the state, "
            f"{widths[1]} of the action; it is for the 14 joints of ALOHA.",
            f"write {ALOHA}: false where the robot is another one",
        )
    return ([FLIP, *GRIPPER_OF_STATE], [FLIP, *GRIPPER_OF_ACTION]) if adapts else ([], [])


def joint_names(folder: Path, steps: Steps, width: int) -> list[str]:
    """Return the names of the action's elements; none where the step for relative actions does not say them."""
    names = _words(folder, steps.get(RELATIVE, {}), "action_names")
    return names if len(names) == len(set(names)) == width else []


def _enabled(folder: Path, steps: Steps, name: str) -> bool:
    enabled = steps.get(name, {}).get("enabled", False)
    if not isinstance(enabled, bool):
        raise SourceError(f"{folder} has {name} with enabled {truncate(repr(enabled), 40)}; wanted: true or false.",
                          SAVE_BOTH)  # fmt: skip
    return enabled


def _on(enabled: bool) -> str:
    return "enabled" if enabled else "not enabled"


def _order(steps: Steps, *names: str) -> list[int]:
    listed = list(steps)
    return [listed.index(name) for name in names if name in listed]


def _mask(folder: Path, step: Mapping[str, Any], width: int) -> list[bool]:
    """Return whether each element is relative: a joint whose name contains an excluded one is not; all without names.

    LeRobot compares them in lower case, and takes elements without a name as relative.
    """
    excluded = [name.lower() for name in _words(folder, step, "exclude_joints") if name]
    names = [name.lower() for name in _words(folder, step, "action_names")[:width]]
    mask = [not any(token in name for token in excluded) for name in names]
    return mask + [True] * (width - len(mask))


def _words(folder: Path, step: Mapping[str, Any], key: str) -> list[str]:
    words = step.get(key)
    if words is None:
        return []
    if not isinstance(words, list) or not all(isinstance(word, str) for word in words):
        raise SourceError(f"{folder} has the {key} {truncate(repr(words), 80)}; wanted: a list of names.", SAVE_BOTH)
    return words


def _runs(mask: Sequence[bool]) -> list[list[int]]:
    """Return [start, stop) of each run of elements that are chosen."""
    runs, stop = [], 0
    for chosen, group in itertools.groupby(mask):
        start, stop = stop, stop + len(list(group))
        runs += [[start, stop]] if chosen else []
    return runs
