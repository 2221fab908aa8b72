"""What a policy with discrete actions sees of a camera, an instruction and its own past actions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vlatool.bundle.spec import PolicySpec, TensorSpec
from vlatool.errors import UsageError

Array = NDArray[Any]


class Observed(NamedTuple):
    """Names of a policy's inputs, and how many moments they hold.

    Args:
        image: Input of camera frames.
        frames: How many frames it holds, the oldest first; 1 for one without an axis of moments.
        shape: (H, W, C) of a frame; None where the bundle resizes frames itself.
        instruction: Input of the text; empty where the policy has none.
        actions: Input of past actions; empty where the policy has none.
        past: How many past actions it holds, the oldest first.
        labels: Names of the actions; the number of labels stands for an action before the first.
    """

    image: str
    frames: int
    shape: tuple[int, ...] | None
    instruction: str
    actions: str
    past: int
    labels: tuple[str, ...]


def observed_by(spec: PolicySpec) -> Observed:
    """Return how an observation of a policy is built.

    Raises:
        UsageError: when its action is not discrete, or an input is neither a camera, a text nor past actions.
    """
    labels = spec.action.labels
    if spec.action.kind != "discrete" or not labels:
        raise UsageError(
            f"The action '{spec.action.name}' of the policy is of the kind '{spec.action.kind}'; allowed: discrete, "
            "with labels.",
            "use a policy that chooses between motions, or run it with: vlatool run policy",
        )
    texts = [tensor for tensor in spec.inputs if tensor.kind == "text"]
    images = [tensor for tensor in spec.inputs if tensor.image is not None or _is_frames(tensor)]
    others = [tensor for tensor in spec.inputs if tensor not in texts and tensor not in images]
    past = [tensor for tensor in others if tensor.dtype.startswith("int") and len(tensor.shape) == 2]
    if len(images) != 1 or len(texts) > 1 or len(past) != len(others) or len(past) > 1:
        known = ", ".join(f"{tensor.name} {tensor.dtype} {list(tensor.shape)}" for tensor in spec.inputs)
        raise UsageError(
            f"The inputs of the policy are {known}; allowed: one camera, at most one text, at most one of past "
            "actions.",
            "wrap the policy so that it has these inputs alone",
        )
    camera = images[0]
    frames = int(camera.shape[1]) if len(camera.shape) == 5 and not camera.history else 1
    shape = None if camera.image is not None else tuple(int(size) for size in camera.shape[-3:])
    return Observed(
        camera.name, frames, shape, texts[0].name if texts else "", past[0].name if past else "",
        int(past[0].shape[1]) if past else 0, tuple(labels),
    )  # fmt: skip


def _is_frames(tensor: TensorSpec) -> bool:
    return tensor.dtype == "uint8" and len(tensor.shape) in (4, 5)


def observation(
    observed: Observed, frames: Sequence[Array], actions: Sequence[int], instruction: str
) -> dict[str, Any]:
    """Return an observation; moments before the first are black frames and no action.

    Args:
        frames: uint8 (H, W, 3) each, the oldest first.
        actions: Indices of the past actions, the oldest first.
        instruction: What the policy is asked to do.

    Raises:
        UsageError: when frames have another size than the policy takes.
    """
    recent = list(frames)[-observed.frames :]
    if observed.shape is not None and recent[-1].shape != observed.shape:
        raise UsageError(
            f"The frames of the camera are {recent[-1].shape}; the policy takes {observed.shape}.",
            "set the camera to this size, or export the policy with an image: block that resizes frames",
        )
    if observed.frames > 1:
        black = [np.zeros_like(recent[-1])] * (observed.frames - len(recent))
        image = np.stack([*black, *recent])
    else:
        image = recent[-1]
    values: dict[str, Any] = {observed.image: image}
    if observed.instruction:
        values[observed.instruction] = instruction
    if observed.actions:
        recent_actions = list(actions)[-observed.past :]
        padding = [len(observed.labels)] * (observed.past - len(recent_actions))
        values[observed.actions] = np.array([*padding, *recent_actions], np.int64)
    return values


def choose(policy: Any, values: Mapping[str, Any]) -> int:
    """Return the index of the action that a policy chooses: of a controller, or of a plain policy."""
    if hasattr(policy, "act"):
        return int(np.asarray(policy.act(values)).reshape(-1)[0])
    return int(np.asarray(policy.infer(values).chunk).reshape(-1)[0])
