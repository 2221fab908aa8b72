"""What a policy consumes and produces: names, shapes, dtypes, units, normalisation, control rate, chunk length."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

from vlatool.errors import SpecError, suggest
from vlatool.files.limits import check_limit
from vlatool.files.messages import field_values, to_json
from vlatool.files.printable import amount
from vlatool.files.validate import finite_number, integer, path_problem, short_repr, text

if TYPE_CHECKING:  # a robot imports them where its policy has one
    from vlatool.bundle.conversion import Conversion, Layout, Span
    from vlatool.bundle.image import Image
    from vlatool.bundle.prompt import Prompt

DTYPES = (
    "float32", "float16", "int64", "int32", "uint8", "bool", "float64", "int8", "int16", "uint16", "uint32", "uint64",
)  # fmt: skip
KINDS = ("tensor", "text", "discrete")
STATISTICS_OF = {
    "none": (), "mean_std": ("mean", "std"), "min_max": ("min", "max"), "quantiles": ("q01", "q99"),
    "quantile10": ("q10", "q90"),
}  # fmt: skip
NORMALISATIONS = tuple(STATISTICS_OF)
CHANGE_UNITS = ("scale", "range", "linkage")
"""Steps of ``convert`` behind which a value is in another unit than that of the robot."""
MODES = ("", "delta", "absolute", "velocity", "relative")
MAX_INDICES = 2**18
"""Most labels that are generated for a discrete output without labels: more than any token vocabulary has."""


MAX_HZ = 100_000
UNKNOWN = "unknown"
"""What a policy.yaml says in the place of a rate that nobody knows."""


@dataclass(frozen=True)
class TensorSpec:
    """One named input or output of a policy.

    Args:
        name: key in the observation or in the result.
        shape: axes, the batch first; a string names a dynamic axis. Empty for a scalar, which an action may not be.
        dtype: dtype in the graph: float32, float16, float64, int8 to int64, uint8 to uint64 or bool; uint8 for pixels.
        kind: ``tensor``; ``text`` (the observation holds a string, the graph sees token ids); ``discrete`` (an output
            of logits over ``labels``; the action is the index of the largest).
        unit: one unit for all elements, or one for each element of the last axis (SI symbols, ``rgb``, ``1``).
        labels: names of the elements of the last axis; the indices for a discrete output without names.
        mode: way in which a controller applies an action: ``delta``, ``absolute``, ``velocity`` or ``relative``.
        normalisation: mapping from physical values to the graph's values, and back for outputs: ``none``, ``mean_std``,
            ``min_max``, ``quantiles`` or ``quantile10``.
        statistics: ``file#key`` of the statistics that the normalisation needs; file relative to the assets.
        tokenizer: file of the tokenizer, relative to the assets (``kind: text``).
        max_tokens: number of ids that the tokenizer pads or cuts to (``kind: text``).
        finite: False for a float input in which the policy itself handles NaN and infinity, such as missing returns in
            a depth image; in any other input they are refused.
        image: what a camera frame becomes before the network: the observation then holds a raw frame, uint8 (H, W, C)
            or (H, W) of any size; None for an input that is given as the graph sees it.
        epsilon: added to a std on the way in, and put for a range of 0, as LeRobot does with 1e-8: an element that
            never moved in training then has statistics, too. 0 refuses it.
        history: number of moments that the second axis of an input holds, oldest first, from 2; 0 for an input of one
            moment. The robot gives one moment at each control step, and the runtime keeps the last ones.
        prompt: what is written around the text of an input before it becomes ids (``kind: text``); nothing when None.
        parts: names of parts of the vector that the robot gives or gets: name -> [start, stop), or one place.
        convert: steps between the values of the robot and those of the network, from the robot to the network; the
            shape is that of the network, labels, units and parts are those of the robot.
    """

    name: str
    shape: tuple[int | str, ...]
    dtype: str = "float32"
    kind: str = "tensor"
    unit: str | tuple[str, ...] = ""
    labels: tuple[str, ...] = ()
    mode: str = ""
    normalisation: str = "none"
    statistics: str = ""
    tokenizer: str = ""
    max_tokens: int = 0
    finite: bool = True
    image: Image | None = None
    epsilon: float = 0.0
    history: int = 0
    prompt: Prompt | None = None
    parts: dict[str, Span] = field(default_factory=dict)
    convert: tuple[Conversion, ...] = ()

    def __post_init__(self) -> None:
        self._check_words()
        object.__setattr__(self, "parts", _parts(self.parts, f"'{self.name}'"))
        object.__setattr__(self, "convert", _conversions(self.convert))
        self._check_shape()
        self._check_conversions()
        self._check_history()
        self._check_kind()
        if self.normalisation != "none" and "#" not in self.statistics:
            raise SpecError(
                f"'{self.name}' is normalised by {self.normalisation}, but 'statistics' is '{self.statistics}'.",
                "name the statistics as FILE#KEY, for example statistics.json#proprio",
            )
        epsilon = finite_number(self.epsilon, f"The epsilon of '{self.name}'", SpecError)
        if not 0 <= epsilon < 1 or (epsilon and self.normalisation == "none"):
            raise SpecError(
                f"'{self.name}' has epsilon {epsilon:g} and normalisation {self.normalisation}; allowed: 0 to 1, and "
                "above 0 with a normalisation."
            )
        for file in self.assets():
            if reason := path_problem(file):
                raise SpecError(
                    f"'{self.name}' names the file {short_repr(file)}: {reason}.",
                    "statistics and tokenizers belong in the policy's folder; name them relative to it",
                )

    def _check_words(self) -> None:
        text(self.name, "The name of a tensor", SpecError, empty=False)
        for name in ("statistics", "tokenizer"):
            text(getattr(self, name), f"The {name} of '{self.name}'", SpecError)
        if not isinstance(self.labels, tuple) or not isinstance(self.unit, str | tuple):
            got = f"labels {short_repr(self.labels)} and unit {short_repr(self.unit)}"
            raise SpecError(f"'{self.name}' has {got}; labels must be a list.")
        for word in (*self.labels, *(self.unit if isinstance(self.unit, tuple) else (self.unit,))):
            text(word, f"A label or unit of '{self.name}'", SpecError)
        integer(self.max_tokens, f"The max_tokens of '{self.name}'", SpecError)
        check_limit("tokens", self.max_tokens, f"'{self.name}'", SpecError)
        allowed = {"dtype": DTYPES, "kind": KINDS, "normalisation": NORMALISATIONS, "mode": MODES}
        for name, values in allowed.items():
            got = getattr(self, name)
            if got not in values:
                allowed_values = suggest(got, [v for v in values if v]) if isinstance(got, str) else "it must be text"
                raise SpecError(f"'{self.name}' has {name} {short_repr(got)}; {allowed_values}.")

    def _check_shape(self) -> None:
        for axis in self.shape:
            if isinstance(axis, bool) or not isinstance(axis, int | str) or (isinstance(axis, int) and axis < 1):
                raise SpecError(
                    f"'{self.name}' has the shape {short_repr(self.shape)}; an axis is a whole number from 1 or a name."
                )
            if isinstance(axis, str):
                text(axis, f"An axis of '{self.name}'", SpecError, empty=False)
        check_limit("elements", self.elements, f"'{self.name}'", SpecError)
        width = self.robot_width
        if self.convert and self.width and width < 1:
            raise SpecError(
                f"'{self.name}' has {amount(self.width, 'element')}; its rotations alone have more in the network."
            )
        where = "" if width == self.width else ", as the robot has it"
        for name in ("labels", "unit"):
            value = getattr(self, name)
            if isinstance(value, tuple) and value and len(value) != width:
                raise SpecError(
                    f"'{self.name}' has {amount(len(value), name.removesuffix('s'))} for a last axis of {width}{where}."
                )

    def _check_conversions(self) -> None:
        if not self.convert and not self.parts:
            return
        if self.kind != "tensor" or self.image is not None or self.width < 1:
            raise SpecError(
                f"'{self.name}' has {'convert' if self.convert else 'parts'} and is "
                f"{'an image' if self.image else self.kind} {list(self.shape)}; they are for vectors of a known width.",
                "leave them out there",
            )
        if both := [name for name in self.parts if name in self.labels]:
            raise SpecError(f"'{self.name}' has a part and a label of the name '{both[0]}'.", "rename the part")
        if self.convert and (not self.dtype.startswith("float") or not self.finite):
            raise SpecError(
                f"'{self.name}' has convert, is {self.dtype} and has finite: {str(self.finite).lower()}; finite floats "
                "alone are converted."
            )
        robot = self.layouts()[0]
        for name, (_, stop) in self.parts.items():
            robot.spans(((stop - 1),), f"The part '{name}' of '{self.name}'")
        marks = [index for index, step in enumerate(self.convert) if step.op == "normalisation"]
        if marks and (len(marks) > 1 or self.normalisation == "none"):
            raise SpecError(
                f"'{self.name}' has {amount(len(marks), 'step')} 'normalisation' in convert, and normalisation "
                f"{self.normalisation}; allowed: one, with a normalisation."
            )
        if marks and any(step.op == "relative" for step in self.convert[marks[0] :]):
            raise SpecError(
                f"'{self.name}' is relative behind its normalisation; the state is in the units of the robot.",
                "let the step 'relative' stand before it: statistics are then those of the differences",
            )
        if marks and any(step.growth for step in self.convert[marks[0] :]):
            raise SpecError(
                f"'{self.name}' has another number of elements behind its normalisation.",
                "let such steps stand before it: statistics have one number for each element of the network",
            )

    def _check_kind(self) -> None:
        if self.kind == "text" and (not self.tokenizer or self.max_tokens < 1):
            raise SpecError(
                f"The text input '{self.name}' needs 'tokenizer' (a file) and 'max_tokens' (from 1); "
                f"got '{self.tokenizer}' and {self.max_tokens}."
            )
        if self.kind == "discrete" and not self.labels:
            raise SpecError(
                f"The discrete output '{self.name}' needs 'labels', one for each action.",
                "name them, or give the last axis of 'shape' as a number: the labels are then its indices",
            )

        if not isinstance(self.finite, bool):
            raise SpecError(f"'{self.name}' has finite {short_repr(self.finite)}; it must be true or false.")
        if not self.finite and (self.kind != "tensor" or not self.dtype.startswith("float")):
            raise SpecError(
                f"'{self.name}' says finite: false, but is {'text' if self.kind == 'text' else self.dtype}.",
                "leave it out: NaN and infinity are values of floats alone",
            )
        if self.image is not None:
            self._check_image(self.image)
        if self.prompt is not None:
            self._check_prompt(self.prompt)

    def _check_prompt(self, prompt: Prompt) -> None:
        from vlatool.bundle.prompt import Prompt

        if not isinstance(prompt, Prompt) or self.kind != "text":
            raise SpecError(
                f"'{self.name}' has a prompt and is {self.kind}; what is written around a text belongs to kind: text."
            )

    def _check_image(self, image: Image) -> None:
        from vlatool.bundle.image import Image

        if not isinstance(image, Image):
            raise SpecError(f"'{self.name}' has image {short_repr(image)}; it must be a mapping.")
        if self.kind != "tensor" or self.normalisation != "none" or not self.finite:
            raise SpecError(
                f"'{self.name}' is an image of kind {self.kind}, normalisation {self.normalisation} and finite: "
                f"{str(self.finite).lower()}; an image is a finite tensor with a mean and std of its own.",
                "leave those out; write mean and std into 'image'",
            )
        image.check_input(self.name, self.moment.shape, self.dtype)

    def _check_history(self) -> None:
        if not integer(self.history, f"The history of '{self.name}'", SpecError):
            return
        if self.kind != "tensor" or self.history < 2 or self.shape[1:2] != (self.history,):
            raise SpecError(
                f"'{self.name}' has the history {self.history} and, as {self.kind}, the shape {list(self.shape)}; the "
                "second axis of a tensor with a history counts its moments, from 2.",
                f"write its shape as [1, {max(2, self.history)}, ...], or leave the history out: the observation then "
                "holds what the graph takes",
            )
        if not all(isinstance(axis, int) for axis in self.shape):
            raise SpecError(
                f"'{self.name}' has a history and the dynamic shape {list(self.shape)}.",
                "write its axes as numbers: moments of different shapes cannot be stacked",
            )

    def assets(self) -> list[str]:
        """Return the files, relative to the assets, that this tensor needs."""
        file = self.statistics.partition("#")[0]
        return [*([file] if self.statistics else []), *([self.tokenizer] if self.tokenizer else [])]

    @property
    def width(self) -> int:
        """Length of the last axis; 0 when it is dynamic or there is none."""
        last = self.shape[-1] if self.shape else 0
        return last if isinstance(last, int) else 0

    @property
    def robot_width(self) -> int:
        """Length of the last axis as the robot has it; ``width`` where nothing else is said."""
        return self.width - sum(step.growth * len(step.parts or ("all",)) for step in self.convert)

    def layouts(self) -> list[Layout]:
        """Return the layout on the side of the robot of each conversion, and that of the network at the end.

        Raises:
            SpecError: for parts that are not there, or overlap.
        """
        from vlatool.bundle.conversion import Layout, layouts_of

        counts = Counter(self.labels)  # a label of two elements names neither
        places = {label: (index, index + 1) for index, label in enumerate(self.labels) if counts[label] == 1}
        return layouts_of(Layout(self.robot_width, {**places, **self.parts}), self.convert)

    @property
    def moment(self) -> TensorSpec:
        """Spec of what the robot gives at one control step: without the axis of moments, if it has a history."""
        return replace(self, shape=(self.shape[0], *self.shape[2:]), history=0) if self.history else self

    @property
    def elements(self) -> int:
        """Number of elements with every dynamic axis counted as 1."""
        return math.prod(axis if isinstance(axis, int) else 1 for axis in self.shape)

    def units(self) -> tuple[str, ...]:
        """Return one unit for each element of the last axis, as the robot has it."""
        return self.unit if isinstance(self.unit, tuple) else (self.unit,) * self.robot_width

    @property
    def observation(self) -> TensorSpec:
        """The input as observations have it: where it is an image, a frame of the camera; before all conversions."""
        if self.convert:
            shape = (*self.shape[:-1], self.robot_width)
            return replace(self, shape=shape, convert=(), normalisation="none", statistics="", epsilon=0.0)
        if self.image is None:
            return self
        moments = (self.history,) if self.history else ()
        shape = (1, *moments, *self.image.frame_shape(self.shape))
        return replace(self, shape=shape, dtype="uint8", image=None, unit="", labels=())

    @property
    def schema(self) -> int:
        """The first version of the manifest that has all that this tensor says."""
        later = self.image or self.epsilon or self.history or self.prompt or self.parts or self.convert
        return 2 if later or self.normalisation == "quantile10" else 1

    @property
    def name_in_prompt(self) -> str:
        """The input that the prompt of this one has in it; empty where it has none."""
        return self.prompt.state.input if self.prompt is not None and self.prompt.state is not None else ""

    @property
    def frame(self) -> str:
        """Order of the channels of the frames that observations have, empty where they have none."""
        return self.image.frame if self.image else ""

    @property
    def gripper(self) -> int | None:
        """Index of the action's element whose label contains "grip"; None when there is none or more than one."""
        found = [index for index, label in enumerate(self.labels) if "grip" in label.lower()]
        return found[0] if len(found) == 1 and self.kind != "discrete" else None

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> TensorSpec:
        """Build a tensor's spec from a mapping as in ``manifest.json`` or ``policy.yaml``.

        Raises:
            SpecError: for an unknown key or an impossible value.
        """
        name = short_repr(data.get("name", "?") if isinstance(data, Mapping) else data)
        values = field_values(cls, data, f"The tensor {name}", SpecError)
        if values.get("kind") == "text":
            values.setdefault("dtype", "int64")
            values.setdefault("shape", (1, values.get("max_tokens", 1)))
        if "name" not in values or not isinstance(values.get("shape"), tuple):
            raise SpecError(f"A tensor needs 'name' and 'shape' (a list); got {short_repr(values.get('shape'))}.")
        if values.get("image") is not None:
            from vlatool.bundle.image import Image

            values["image"] = Image.from_dict(values["image"])
        if values.get("prompt") is not None:
            from vlatool.bundle.prompt import Prompt

            values["prompt"] = Prompt.from_dict(values["prompt"])
        values["convert"] = _conversions(values.get("convert", ()))
        if values.get("kind") == "discrete":
            values.setdefault("labels", _indices(values["shape"]))
        return cls(**values)

    def to_dict(self) -> dict[str, Any]:
        """Return the fields that differ from their defaults, with tuples as lists."""
        plain: dict[str, Any] = to_json(self, defaults=False)
        return plain


def _indices(shape: tuple[Any, ...]) -> tuple[str, ...]:
    """Return labels for unnamed actions, such as 256 action tokens: the last axis' indices, none if it is dynamic."""
    width = shape[-1] if shape else 0
    return tuple(map(str, range(width))) if type(width) is int and 0 < width <= MAX_INDICES else ()


def _parts(data: Any, where: str) -> dict[str, Span]:
    """Return the named parts of a vector; see ``parts_from``."""
    if isinstance(data, dict) and not data:
        return {}
    from vlatool.bundle.conversion import parts_from

    return parts_from(data, where)


def _conversions(data: Any) -> tuple[Conversion, ...]:
    """Return the steps of ``convert``; see ``conversions_from``."""
    if isinstance(data, list | tuple) and not data:
        return ()
    from vlatool.bundle.conversion import conversions_from

    return conversions_from(data)


@dataclass(frozen=True)
class PolicySpec:
    """What a policy consumes and produces.

    Args:
        inputs: inputs in the order in which the source takes them.
        outputs: outputs, the action first.
        control_hz: rate of the control loop in Hz; None where nobody said it (``unknown`` in a policy.yaml).
        chunk: number of actions from one inference.
        execute: number of actions executed before the next inference; 0 for the whole chunk.
    """

    inputs: tuple[TensorSpec, ...]
    outputs: tuple[TensorSpec, ...]
    control_hz: float | None
    chunk: int = 1
    execute: int = 0

    def __post_init__(self) -> None:
        if not self.inputs or not self.outputs:
            raise SpecError("A policy needs at least one input and one output.")
        check_limit("tensors", len(self.inputs) + len(self.outputs), "The spec", SpecError)
        names = [tensor.name for tensor in (*self.inputs, *self.outputs)]
        for name in names:
            if names.count(name) > 1:
                raise SpecError(
                    f"The name '{name}' occurs {names.count(name)} times; each input and output needs its own."
                )
        for tensor in self.outputs:
            if not tensor.finite:
                raise SpecError(
                    f"The output '{tensor.name}' says finite: false; a policy answers finite values.",
                    "leave it out there; it is for inputs",
                )
            if tensor.image is not None:
                raise SpecError(
                    f"The output '{tensor.name}' has an image; only a frame of a camera has one.",
                    "leave it out there; it is for inputs",
                )
            if tensor.history:
                raise SpecError(f"The output '{tensor.name}' has a history.", "leave it out there; it is for inputs")
        self._check_conversions()
        self._check_prompts()
        if not self.action.shape:
            raise SpecError(f"The action '{self.action.name}' has no axes; write its shape as [1, 1].")
        hz = self.control_hz
        if hz is not None and (isinstance(hz, bool) or not (isinstance(hz, int | float) and 0 < hz < MAX_HZ)):
            allowed = f"a rate in Hz above 0 and below {MAX_HZ:,}, or {UNKNOWN}"
            raise SpecError(f"control_hz is {short_repr(self.control_hz)}; allowed: {allowed}.")
        integer(self.chunk, "chunk", SpecError, 1)
        check_limit("elements", self.chunk, "chunk", SpecError)
        if integer(self.execute, "execute", SpecError) > self.chunk:
            raise SpecError(f"chunk is {self.chunk!r} and execute {self.execute!r}; allowed: 1 <= execute <= chunk.")

    def _check_conversions(self) -> None:
        """Refuse steps that stand where they are not done, and states that are not there."""
        for tensor in (*self.inputs, *self.outputs[1:]):
            for step in tensor.convert:
                if step.of_outputs_alone or tensor in self.outputs:
                    raise SpecError(
                        f"'{tensor.name}' has the step '{step.op}' in convert; that is for the action "
                        f"'{self.action.name}' alone."
                    )
        steps = [step for step in self.action.convert if step.op == "relative"]
        if len({step.to for step in steps}) > 1:
            raise SpecError(f"'{self.action.name}' is relative to several inputs; allowed: one, with all of its parts.")
        if steps and self.action.mode not in ("", "absolute"):
            raise SpecError(
                f"'{self.action.name}' has the mode {self.action.mode}, and is made absolute by its step 'relative'.",
                "write mode: absolute, or leave the step out: the controller then adds the state itself",
            )
        for step in steps:
            self._check_units(step, self.state_spans(step))

    def _check_prompts(self) -> None:
        """Refuse prompts that have in them what is not a vector of numbers."""
        known = {tensor.name: tensor for tensor in self.inputs}
        for tensor in (each for each in self.inputs if each.name_in_prompt):
            where, state = f"The prompt of '{tensor.name}' has '{tensor.name_in_prompt}' in it", tensor.name_in_prompt
            if state not in known:
                raise SpecError(f"{where}, which is not an input; {suggest(state, known)}.")
            given = known[state]
            if given.kind != "tensor" or given.image or not given.dtype.startswith("float") or len(given.shape) != 2:
                raise SpecError(
                    f"{where}, {given.dtype} {list(given.shape)}; wanted: floats of one moment, [1, WIDTH]."
                )

    def _check_units(self, relative: Conversion, spans: tuple[tuple[Span, Span], ...]) -> None:
        """Refuse a step ``relative`` behind one that changes units which the action and the state have in common."""
        before = self.action.convert[: self.action.convert.index(relative)]
        if self.reference is None or any(step.growth for step in before):  # then they are not where the robot has them
            return
        mine, theirs = self.action.units(), self.reference.units()
        common = {
            own + index: theirs[other + index]
            for (own, stop), (other, _) in spans
            for index in range(stop - own)
            if mine[own + index] == theirs[other + index] != ""
        }
        for step, layout in zip(before, self.action.layouts(), strict=False):
            changed = layout.spans(step.parts, step.where) if step.op in CHANGE_UNITS else ()
            for index in (index for start, stop in changed for index in range(start, stop) if index in common):
                raise SpecError(
                    f"{relative.where} stands behind the step '{step.op}', and '{relative.to}' is in {common[index]} "
                    "as the robot has it.",
                    "let the step 'relative' stand first; where robot and state differ, name the unit of each",
                )

    def state_spans(self, step: Conversion) -> tuple[tuple[Span, Span], ...]:
        """Return, for a step ``relative`` of the action, the places in the action and those in the state.

        Raises:
            SpecError: when the state is not an input, or has not as many elements as the action.
        """
        state = next((tensor for tensor in self.inputs if tensor.name == step.to), None)
        if state is None:
            known = [tensor.name for tensor in self.inputs]
            raise SpecError(
                f"{step.where} is relative to '{step.to}', which is not an input; {suggest(step.to, known)}."
            )
        vector = len(state.shape) == (3 if state.history else 2)
        if state.kind != "tensor" or state.image or not state.dtype.startswith("float") or not vector:
            raise SpecError(
                f"{step.where} is relative to '{step.to}', {state.dtype} {list(state.shape)}; wanted: a vector of "
                "floats, [1, WIDTH], with a history [1, MOMENTS, WIDTH]."
            )
        layout = self.action.layouts()[self.action.convert.index(step)]
        spans = layout.spans(step.parts, step.where)
        whole = not step.parts and ((0, layout.width),)
        theirs = whole or state.layouts()[0].spans(step.state or step.parts, f"{step.where} of the state '{step.to}'")
        for mine, other in zip(spans, theirs, strict=True):
            if mine[1] - mine[0] != other[1] - other[0] or other[1] > state.robot_width:
                raise SpecError(
                    f"{step.where} takes the elements {list(mine)} of the action from {list(other)} of '{step.to}', "
                    f"which has {state.robot_width}.",
                    "name as many elements of the state under 'state' as of the action under 'parts'",
                )
        return tuple(zip(spans, theirs, strict=True))

    @property
    def reference(self) -> TensorSpec | None:
        """The input that the action is relative to; None when there is none."""
        names = {step.to for step in self.action.convert if step.op == "relative"}
        return next((tensor for tensor in self.inputs if tensor.name in names), None)

    @property
    def schema(self) -> int:
        """The first version of the manifest that has all that this spec says."""
        return max(tensor.schema for tensor in (*self.inputs, *self.outputs))

    @property
    def action(self) -> TensorSpec:
        """The output that a controller executes."""
        return self.outputs[0]

    @property
    def rate(self) -> float:
        """Rate of the control loop in Hz.

        Raises:
            SpecError: when nobody said it.
        """
        if self.control_hz is None:
            raise SpecError(
                "The rate of the control loop is unknown, and this needs it.",
                "write control_hz: NUMBER into the policy.yaml (vlatool new POLICY --from SOURCE makes one)",
            )
        return self.control_hz

    @property
    def inference_hz(self) -> float:
        """Inferences per second that the control rate and the number of executed actions require."""
        return self.rate / self.executed_actions

    def unknown(self) -> tuple[str, ...]:
        """Return what nobody said of the robot: the rate, and unit and mode of the action."""
        action = self.action
        silent = () if action.kind == "discrete" else ("unit", "mode")
        of_action = tuple(f"{word} of '{action.name}'" for word in silent if not getattr(action, word))
        return (("control rate",) if self.control_hz is None else ()) + of_action

    @property
    def executed_actions(self) -> int:
        """Number of actions executed from each chunk."""
        return self.execute or self.chunk

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> PolicySpec:
        """Build a policy's spec from a mapping.

        Raises:
            SpecError: for a missing or unknown key or an impossible value.
        """
        values = field_values(cls, data, "The spec", SpecError)
        for key in ("inputs", "outputs"):
            listed = values.get(key)
            if not isinstance(listed, tuple):
                raise SpecError(f"The spec needs '{key}', a list of tensors; got {short_repr(listed)}.")
            values[key] = tuple(TensorSpec.from_dict(item) for item in listed)
        if "control_hz" not in values:
            raise SpecError("The spec needs 'control_hz', the rate of the control loop in Hz.")
        if values["control_hz"] == UNKNOWN:
            values["control_hz"] = None
        return cls(**values)

    def to_dict(self) -> dict[str, Any]:
        """Return a mapping that ``from_dict`` turns back into an equal spec."""
        plain: dict[str, Any] = to_json(self, defaults=False)
        return plain


def unknown_warning(spec: PolicySpec) -> tuple[str, ...]:
    """Return a sentence for a report on what nobody said of the robot; none where all is said, or a rate at least."""
    if spec.control_hz is not None:
        return ()
    return (f"unknown, since nobody said it: {', '.join(spec.unknown())}; a policy.yaml says it",)
