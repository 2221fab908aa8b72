"""Which topics are the inputs of a policy, and what its actions command: read from a map, checked against the spec.

A map has two parts. ``inputs``: input of the spec -> ``topic``, ``type``, and for a vector ``elements``: element ->
``JOINT.position`` of a JointState, or a path such as ``pose.pose.position.x`` of another message. A text has ``topic``
or ``text``, past actions have ``source: actions``. ``output``: ``topic``, ``type``, and ``elements``: element of the
action -> joint, or path in a Twist; of discrete actions, ``labels``: label -> path -> number. What is not used is in
``ignore``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from vlatool.bundle.spec import PolicySpec, TensorSpec
from vlatool.errors import UsageError
from vlatool.messages import Message, find_type
from vlatool.messages.geometry_msgs import Twist, TwistStamped
from vlatool.messages.sensor_msgs import CompressedImage, Image, JointState
from vlatool.messages.std_msgs import String
from vlatool.messages.trajectory_msgs import JointTrajectory

SI = {
    "": 1.0, "1": 1.0, "m": 1.0, "cm": 1e-2, "mm": 1e-3, "rad": 1.0, "deg": math.pi / 180, "m/s": 1.0, "cm/s": 1e-2,
    "mm/s": 1e-3, "rad/s": 1.0, "deg/s": math.pi / 180, "N": 1.0, "Nm": 1.0, "N*m": 1.0, "s": 1.0, "A": 1.0, "V": 1.0,
    "m/s^2": 1.0, "m/s2": 1.0,
}  # fmt: skip
"""Unit of a spec -> how many of the SI unit that messages have it is."""
QUANTITIES = ("position", "velocity", "effort")
IMAGE, FRAMES, VECTOR, TEXT, ACTIONS = "image", "frames", "vector", "text", "actions"
"""What an input takes: one frame, several frames, numbers, a text, its own past actions."""
OUTPUTS: tuple[type[Message], ...] = (JointTrajectory, JointState, Twist, TwistStamped)
PRINT = "print a map to correct: vlatool run policy --bundle BUNDLE --print-map > map.yaml"


@dataclass(frozen=True)
class InputMap:
    """One input of the policy.

    Args:
        name: Name in the spec.
        kind: ``IMAGE`` and the words beside it.
        topic: Topic; empty for a constant text and for past actions.
        message: Class of the messages.
        paths: Of a vector, where each element is in a message, as (joint or path, quantity of a joint).
        scales: Of a vector, what an SI value is multiplied with for the unit of the spec.
        text: Constant text.
        count: Frames or past actions that the input holds.
        stale_s: Largest age.
        noisy: Whether a repeated value is the same measurement.
        channels: Order of the channels that the spec takes: ``rgb``, ``bgr``, ``grey``, ...
    """

    name: str
    kind: str
    topic: str = ""
    message: type[Message] = Message
    paths: tuple[tuple[str, str], ...] = ()
    scales: tuple[float, ...] = ()
    text: str = ""
    count: int = 1
    stale_s: float = 0.5
    noisy: bool = False
    channels: str = "rgb"


@dataclass(frozen=True)
class OutputMap:
    """What the actions command.

    Args:
        topic: Topic.
        message: Class of the messages.
        mode: ``absolute``, ``delta`` or ``velocity``; empty for discrete actions.
        indices: Elements of the action that are used.
        names: Joint of each, or path in a Twist.
        scales: What each is multiplied with for its SI value.
        labels: Of discrete actions, path -> number for each index.
        frame: ``frame_id`` of the messages.
    """

    topic: str
    message: type[Message]
    mode: str
    indices: tuple[int, ...] = ()
    names: tuple[str, ...] = ()
    scales: tuple[float, ...] = ()
    labels: tuple[Mapping[str, float], ...] = ()
    frame: str = ""


def check_map(values: Mapping[str, Any]) -> None:
    """Raise UsageError where a map has other parts than ``inputs`` and ``output``."""
    for key, value in values.items():
        if key not in ("inputs", "output"):
            raise UsageError.unknown(f"The map has the part '{key}'", str(key), ("inputs", "output"))
        if not isinstance(value, Mapping):
            raise UsageError(f"The part '{key}' of the map is {value!r:.60}; it must be a mapping.", PRINT)


def read_inputs(values: Mapping[str, Any], spec: PolicySpec) -> tuple[InputMap, ...]:
    """Return how each input of a spec is filled.

    Raises:
        UsageError: for inputs that are not mapped, that are not in the spec, or that the map describes wrongly.
    """
    entries = values.get("inputs", {})
    names = [tensor.name for tensor in spec.inputs]
    for name in entries:
        if name not in names:
            raise UsageError.unknown(
                f"The map has the input '{name}', which the policy does not take", str(name), names
            )
    missing = [tensor.name for tensor in spec.inputs if tensor.name not in entries]
    if missing:
        raise UsageError(f"The map does not say which topic is the input {', '.join(map(repr, missing))}.", PRINT)
    return tuple(_input(tensor, entries[tensor.name]) for tensor in spec.inputs)


def kind_of(tensor: TensorSpec) -> str:
    """Return what an input takes; raises UsageError for one that no topic can be."""
    moment = tensor.moment
    if tensor.kind == "text":
        return TEXT
    if tensor.image is not None or (moment.dtype == "uint8" and len(moment.shape) == 4):
        return IMAGE
    if tensor.dtype == "uint8" and len(tensor.shape) == 5:
        return FRAMES
    if tensor.dtype.startswith("int") and len(tensor.shape) == 2:
        return ACTIONS
    if tensor.dtype.startswith("float") and len(moment.shape) == 2:
        return VECTOR
    raise UsageError(
        f"The input '{tensor.name}' is {tensor.dtype} {list(tensor.shape)}; a topic can be a camera (uint8, or with an "
        "image: block), a vector of floats, a text, or past actions.",
        "export the policy with an image: block, which says how a frame becomes this input",
    )


KEYS = {
    TEXT: ("topic", "type", "text"), ACTIONS: ("source",), IMAGE: ("topic", "type", "stale_s", "noisy"),
    FRAMES: ("topic", "type", "stale_s", "noisy"), VECTOR: ("topic", "type", "elements", "scale", "stale_s", "noisy"),
}  # fmt: skip


def _input(tensor: TensorSpec, entry: Any) -> InputMap:
    kind, where = kind_of(tensor), f"The map of the input '{tensor.name}'"
    _check_keys(entry, KEYS[kind], where)
    stale_s = _number(entry.get("stale_s", 0.5), f"{where}: stale_s")
    noisy = entry.get("noisy", False)
    if not isinstance(noisy, bool):
        raise UsageError(f"{where}: noisy is {noisy!r:.40}; it must be true or false.", "write noisy: true")
    shared: dict[str, Any] = {"stale_s": stale_s, "noisy": noisy}
    if kind == ACTIONS:
        if entry.get("source") != "actions":
            raise UsageError(f"{where} is {entry!r:.60}; it holds past actions.", "write source: actions")
        return InputMap(tensor.name, kind, count=int(tensor.shape[1]))
    if kind == TEXT and "text" in entry:
        if not isinstance(text := entry["text"], str):
            raise UsageError(f"{where}: its text is {text!r:.40}; it must be a text.", "write it in quotes")
        return InputMap(tensor.name, kind, text=text)
    topic = _topic(entry, where)
    if kind == TEXT:
        return InputMap(tensor.name, kind, topic, _type(entry, (String,), where))
    if kind in (IMAGE, FRAMES):
        message = _type(entry, (Image, CompressedImage), where)
        count = int(tensor.shape[1]) if kind == FRAMES else 1
        return InputMap(tensor.name, kind, topic, message, count=count, channels=_channels(tensor), **shared)
    message = _type(entry, (JointState,), where, others=True)
    paths, scales = _elements(tensor, entry, message, where)
    return InputMap(tensor.name, kind, topic, message, paths, scales, **shared)


def _channels(tensor: TensorSpec) -> str:
    if tensor.image is not None and tensor.image.frame:
        return tensor.image.frame
    if tensor.shape[-1] == 1 or len(tensor.moment.shape) == 3:
        return "grey"
    return tensor.unit if isinstance(tensor.unit, str) and tensor.unit in ("rgb", "bgr") else "rgb"


def _elements(
    tensor: TensorSpec, entry: Mapping[str, Any], message: type[Message], where: str
) -> tuple[tuple[tuple[str, str], ...], tuple[float, ...]]:
    """Return where each element of a vector is in a message, and its scale."""
    labels = _labels(tensor)
    given = entry.get("elements", {})
    _check_labels(given, labels, where, entry.get("ignore", ()))
    missing = [label for label in labels if label not in given]
    if missing:
        raise UsageError(f"{where} does not say what is {', '.join(map(repr, missing))}.", PRINT)
    scales = entry.get("scale", {})
    paths, factors = [], []
    for label, unit in zip(labels, tensor.units(), strict=True):
        path = str(given[label])
        joint, dot, quantity = path.rpartition(".")
        if message is JointState:
            paths.append((joint, quantity) if dot and quantity in QUANTITIES else (path, "position"))
        else:
            paths.append((path, ""))
        factors.append(1 / _scale(scales, label, unit, where))
    return tuple(paths), tuple(factors)


def read_output(values: Mapping[str, Any], spec: PolicySpec) -> OutputMap:
    """Return what the actions of a spec command.

    Raises:
        UsageError: for elements or labels that are not mapped, or that the map describes wrongly.
    """
    entry, action, where = values.get("output"), spec.action, "The map of the output"
    if entry is None:
        raise UsageError(f"The map does not say what the action '{action.name}' commands.", PRINT)
    discrete = action.kind == "discrete"
    keys = ("labels",) if discrete else ("elements", "scale", "ignore", "mode")
    _check_keys(entry, ("topic", "type", "frame", *keys), where)
    topic = _topic(entry, where)
    message = _type(entry, (Twist, TwistStamped) if discrete else OUTPUTS, where, required=not discrete)
    frame = str(entry.get("frame", ""))
    if discrete:
        return OutputMap(topic, message, "", labels=_label_map(entry, action.labels, where), frame=frame)
    labels = _labels(action)
    given, ignored = entry.get("elements", {}), entry.get("ignore", ())
    _check_labels(given, labels, where, ignored)
    missing = [label for label in labels if label not in given and label not in ignored]
    if missing:
        raise UsageError(f"{where} does not say what is {', '.join(map(repr, missing))}.",
                         f"name it in elements, or in ignore; {PRINT}")  # fmt: skip
    indices = tuple(index for index, label in enumerate(labels) if label in given)
    names = tuple(str(given[labels[index]]) for index in indices)
    units = action.units()
    scales = tuple(_scale(entry.get("scale", {}), labels[index], units[index], where) for index in indices)
    _check_names(names, message, where)
    mode = _mode(str(entry.get("mode", action.mode)), action, message, where)
    return OutputMap(topic, message, mode, indices, names, scales, frame=frame)


def _mode(mode: str, action: TensorSpec, message: type[Message], where: str) -> str:
    allowed = ("velocity",) if message in (Twist, TwistStamped) else ("absolute", "delta", "velocity")
    if mode not in allowed:
        raise UsageError(
            f"{where}: the action '{action.name}' has the mode {mode or 'unknown'!r}; a {message.__name__} takes "
            f"{', '.join(allowed)}.",
            f"write mode: {allowed[0]} into the map if that is what the numbers are",
        )
    return mode


def _check_names(names: Sequence[str], message: type[Message], where: str) -> None:
    if double := next((name for name in names if names.count(name) > 1), ""):
        raise UsageError(f"{where} commands '{double}' twice.", "name each joint or path once")
    for name in names if message in (Twist, TwistStamped) else ():
        _check_path(name, where)


def _label_map(entry: Mapping[str, Any], labels: Sequence[str], where: str) -> tuple[Mapping[str, float], ...]:
    given = entry.get("labels", {})
    _check_labels(given, labels, where, ())
    missing = [label for label in labels if label not in given]
    if missing:
        raise UsageError(f"{where} does not say how to move for {', '.join(map(repr, missing))}.", PRINT)
    found = []
    for label in labels:
        if not isinstance(given[label], Mapping):
            raise UsageError(f"{where}: the label '{label}' is {given[label]!r:.40}; it must be a mapping.", PRINT)
        for path in given[label]:
            _check_path(str(path), where)
        found.append({str(path): _number(value, f"{where}: '{label}'", 0.0) for path, value in given[label].items()})
    return tuple(found)


def _check_path(path: str, where: str) -> None:
    if path not in (paths := [f"{part}.{axis}" for part in ("linear", "angular") for axis in "xyz"]):
        raise UsageError.unknown(f"{where} names '{path}' of a Twist", path, paths)


def _labels(tensor: TensorSpec) -> tuple[str, ...]:
    return tensor.labels or tuple(map(str, range(tensor.robot_width)))


def _check_labels(given: Any, labels: Sequence[str], where: str, ignored: Any) -> None:
    if not isinstance(given, Mapping) or not isinstance(ignored, list | tuple):
        raise UsageError(f"{where}: its elements or labels are {given!r:.60}; they must be a mapping.", PRINT)
    for name in (*given, *ignored):
        if name not in labels:
            raise UsageError.unknown(f"{where} has '{name}', which the policy does not have", str(name), labels)


def _check_keys(entry: Any, keys: Sequence[str], where: str) -> None:
    if not isinstance(entry, Mapping):
        raise UsageError(f"{where} is {entry!r:.60}; it must be a mapping.", PRINT)
    for key in entry:
        if key not in keys:
            raise UsageError.unknown(f"{where} has '{key}'", str(key), keys)


def _topic(entry: Mapping[str, Any], where: str) -> str:
    topic = entry.get("topic")
    if not isinstance(topic, str) or not topic.startswith("/"):
        raise UsageError(f"{where} has the topic {topic!r:.60}; it begins with a slash.", "write topic: /NAME")
    return topic


def _type(
    entry: Mapping[str, Any], allowed: Sequence[type[Message]], where: str, *, others: bool = False,
    required: bool = False,
) -> type[Message]:  # fmt: skip
    """Return the class of messages that a map names: the first of those that are allowed when it names none."""
    name = entry.get("type")
    if name is None and not required:
        return allowed[0]
    message = find_type(str(name)) if name is not None else None
    if message is None or (message not in allowed and not others):
        raise UsageError(f"{where} has the type {name!r:.60}; allowed: {', '.join(each.TYPE for each in allowed)}.",
                         f"write type: {allowed[0].TYPE}")  # fmt: skip
    return message


def _scale(scales: Any, label: str, unit: str, where: str) -> float:
    """Return how many SI units one unit of an element is."""
    if isinstance(scales, Mapping) and label in scales:
        return _number(scales[label], f"{where}: the scale of '{label}'", -math.inf)
    if unit not in SI:
        raise UsageError(f"{where}: '{label}' is in '{unit}', whose SI value is unknown.",
                         f"write scale: {{{label}: NUMBER}}, the SI value of one {unit}")  # fmt: skip
    return SI[unit]


def _number(value: Any, where: str, least: float = 1e-9) -> float:
    """Return a finite number above a bound; a bound of 0 means any, as for a speed."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise UsageError(f"{where} is {value!r:.40}; it must be a number.", PRINT)
    if (value == 0.0 and least == -math.inf) or 0 < least > value:
        raise UsageError(f"{where} is {value!r:.40}; it must be above 0.", PRINT)
    return float(value)
