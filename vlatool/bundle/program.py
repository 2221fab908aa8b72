"""A program: in which order the graphs of a policy run, and what goes from one to the next."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from vlatool.bundle.spec import DTYPES, PolicySpec
from vlatool.errors import SpecError, suggest
from vlatool.files.limits import check_limit
from vlatool.files.messages import field_values
from vlatool.files.printable import amount
from vlatool.files.validate import (
    Kind,
    element_count,
    finite_number,
    known_keys,
    mapping,
    name_problem,
    short_repr,
    text,
)

DISTRIBUTIONS = ("normal", "uniform", "zeros")


def check_graph_name(name: Any, error: Kind) -> None:
    """Refuse the name of a graph after which no file can be called: exporters write ``NAME.onnx``, ``NAME.xml``."""
    if problem := name_problem(name):
        raise error(f"A graph has the name {short_repr(name)}: {problem}.", "call it by letters and digits, as in main")


def check_step(step: ProgramStep) -> None:
    """Refuse wrong types, and values beyond the limits, in an entry; raises SpecError with the word and the graph."""
    text(step.graph, "The graph of a step", SpecError, empty=False)
    check_graph_name(step.graph, SpecError)
    for word in ("feeds", "gives", "carry", "schedule", "noise", "keep", "slow"):
        mapping(getattr(step, word), f"'{word}' of '{step.graph}'", SpecError)
    for word in ("feeds", "gives", "carry"):
        for value in getattr(step, word).values():
            text(value, f"A value in '{word}' of '{step.graph}'", SpecError, empty=False)
    _check_repeat(step)
    for value, noise in step.noise.items():
        _check_noise(value, noise)
    for value, kept in step.keep.items():
        _check_kept(value, kept)
    if step.slow:
        _check_slow(step)


def drawn_and_kept(step: ProgramStep) -> int:
    """Return the elements of the noise and of the kept values of an entry that was checked."""
    values = (*step.noise.values(), *step.keep.values())
    return sum(element_count(value["shape"], "a shape", SpecError) for value in values)


def _check_repeat(step: ProgramStep) -> None:
    if isinstance(step.repeat, bool) or not isinstance(step.repeat, int) or step.repeat < 1:
        raise SpecError(f"The program repeats '{step.graph}' {short_repr(step.repeat)} times; allowed: from 1.")
    check_limit("repeat", step.repeat, f"The step of '{step.graph}'", SpecError)
    for value, numbers in step.schedule.items():
        if not isinstance(numbers, list | tuple):
            raise SpecError(f"The schedule of '{value}' must be a list of numbers; got {short_repr(numbers)}.")
        if len(numbers) != step.repeat:
            got = f"{amount(len(numbers), 'number')}, but '{step.graph}' runs {amount(step.repeat, 'time')}"
            raise SpecError(f"The schedule of '{value}' has {got}.")
        for entry in numbers:
            finite_number(entry, f"A number in the schedule of '{value}'", SpecError)
            if isinstance(entry, int) and not -(2**63) <= entry < 2**63:
                raise SpecError(f"The schedule of '{value}' has a number that no int64 holds.")


def _check_noise(value: str, noise: Any) -> None:
    noise = mapping(noise, f"The noise '{value}'", SpecError)
    known_keys(noise, ("shape", "distribution"), f"The noise '{value}'", SpecError)
    if noise.get("distribution", "normal") not in DISTRIBUTIONS or not noise.get("shape"):
        raise SpecError(f"The noise '{value}' needs a shape and a distribution of {', '.join(DISTRIBUTIONS)}.")
    elements = element_count(noise["shape"], f"the shape of the noise '{value}'", SpecError)
    check_limit("elements", elements, f"The noise '{value}'", SpecError)


def _check_kept(value: str, kept: Any) -> None:
    shape = kept.get("shape") if isinstance(kept, Mapping) else kept
    if not isinstance(kept, Mapping) or not shape:
        raise SpecError(
            f"The kept value '{value}' needs a shape of one axis or more; got {short_repr(shape)}.",
            f"write it as {value}: {{shape: [1], dtype: float32}}; a single number is such a value, too, and "
            "forward() takes and returns it with that axis",
        )
    known_keys(kept, ("shape", "dtype"), f"The kept value '{value}'", SpecError)
    if kept.get("dtype", "float32") not in DTYPES:
        raise SpecError(
            f"The kept value '{value}' has the dtype {short_repr(kept['dtype'])}; allowed: {', '.join(DTYPES)}.",
            "keep it as one of them, bfloat16 as float32, and let forward() convert it when it takes and returns it",
        )
    elements = element_count(kept["shape"], f"the shape of the kept value '{value}'", SpecError)
    check_limit("elements", elements, f"The kept value '{value}'", SpecError)


def _check_slow(step: ProgramStep) -> None:
    where = f"'slow' of '{step.graph}'"
    known_keys(step.slow, ("max_age_ms", "hz"), where, SpecError)
    if "max_age_ms" not in step.slow:
        raise SpecError(
            f"{where} has no 'max_age_ms': how old its values may be when they are used, in milliseconds.",
            "write it as slow: {max_age_ms: 500}, or slow: {max_age_ms: 500, hz: 5}",
        )
    for name, unit in (("max_age_ms", "milliseconds"), ("hz", "Hz")):
        if name in step.slow and finite_number(step.slow[name], f"'{name}' in {where}", SpecError) <= 0:
            raise SpecError(
                f"'{name}' in {where} is {short_repr(step.slow[name])}; allowed: a number of {unit} above 0."
            )


@dataclass(frozen=True)
class ProgramStep:
    """One entry of a program: run a graph, once or several times.

    Args:
        graph: name of the graph.
        feeds: graph input name -> value name.
        gives: graph output name -> value name.
        repeat: how often the graph runs.
        carry: given value -> the value that it replaces before the next repeat.
        schedule: value -> one number for each repeat, presented as an array of shape (1,).
        noise: value -> {shape, distribution}; drawn once before the first repeat, from the seedable generator.
        keep: value -> {shape, dtype}; zero after ``reset``, else what the last inference gave under that name.
        slow: {max_age_ms, hz} of a step of the slow part of a policy of two systems: how old what it gives may be when
            the fast part uses it, in milliseconds, and how often it runs; without ``hz`` whenever it is ready. Empty
            for a step that runs at each inference.
    """

    graph: str
    feeds: dict[str, str]
    gives: dict[str, str]
    repeat: int = 1
    carry: dict[str, str] = field(default_factory=dict)
    schedule: dict[str, list[float]] = field(default_factory=dict)
    noise: dict[str, dict[str, Any]] = field(default_factory=dict)
    keep: dict[str, dict[str, Any]] = field(default_factory=dict)
    slow: dict[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check_step(self)

    def sources(self) -> set[str]:
        """Values that this entry creates before its graph runs."""
        return {*self.schedule, *self.noise, *self.keep}


class SlowPart(NamedTuple):
    """How the slow part of a policy of two systems runs, beside the fast part, which uses its newest values.

    Args:
        max_age_ms: Age above which its values are not used, in milliseconds, from the observation that they answer.
        hz: Rate at which it runs in Hz; whenever it is ready when None.
    """

    max_age_ms: float
    hz: float | None


def slow_part(program: Iterable[ProgramStep]) -> SlowPart | None:
    """Return how the slow part of a program runs; None for a program without one."""
    found = next((step.slow for step in program if step.slow), None)
    return None if found is None else SlowPart(float(found["max_age_ms"]), found.get("hz"))


def latent_names(program: Iterable[ProgramStep], spec: PolicySpec) -> set[str]:
    """Return the values that the fast part of a program, or an output of the spec, takes from its slow part."""
    program = tuple(program)
    parts = [step for step in program if step.slow], [step for step in program if not step.slow]
    slow, own = ({*_given(part), *(name for step in part for name in step.sources())} for part in parts)
    fast = {name for step in parts[1] for name in step.feeds.values()}
    return slow & (fast | {tensor.name for tensor in spec.outputs} - own)


def keeps_values(program: Iterable[ProgramStep]) -> bool:
    """Return whether what a policy gives depends on the observations before, too."""
    return any(step.keep for step in program)


def program_from(data: Any) -> tuple[ProgramStep, ...]:
    """Build a program from a list of mappings with ``graph``, ``feeds`` and ``gives``; raises SpecError otherwise."""
    if not isinstance(data, list | tuple):
        raise SpecError(f"The program must be a list of steps; got {type(data).__name__}.")
    check_limit("steps", len(data), "The program", SpecError)
    steps = []
    for number, entry in enumerate(data):
        if not isinstance(entry, Mapping) or not {"graph", "feeds", "gives"} <= set(entry):
            raise SpecError(f"Step {number} of the program lacks 'graph', 'feeds' or 'gives': {short_repr(entry)}.")
        steps.append(ProgramStep(**field_values(ProgramStep, entry, f"Step {number} of the program", SpecError)))
    return tuple(steps)


def single_graph(spec: PolicySpec, graph: str = "main") -> tuple[ProgramStep, ...]:
    """Return the program of a policy that is one graph whose inputs and outputs are the spec's."""
    feeds = {tensor.name: tensor.name for tensor in spec.inputs}
    gives = {tensor.name: tensor.name for tensor in spec.outputs}
    return (ProgramStep(graph, feeds, gives),)


def check_program(program: Iterable[ProgramStep], graphs: Iterable[str], spec: PolicySpec) -> None:
    """Check that every value is there when it is needed and that every output of the spec is given.

    Raises:
        SpecError: naming the step and the value.
    """
    graph_names = list(graphs)
    program = tuple(program)
    check_limit("steps", len(program), "The program", SpecError)
    check_limit("runs", sum(step.repeat for step in program), "The program", SpecError)
    check_limit("state_elements", sum(map(drawn_and_kept, program)), "Noise and kept values of the program", SpecError)
    values = {tensor.name for tensor in spec.inputs}
    for number, step in enumerate(program):
        if step.graph not in graph_names:
            raise SpecError(f"Step {number} runs the graph '{step.graph}'; {suggest(step.graph, graph_names)}.")
        values |= step.sources()
        for name in step.feeds.values():
            if name not in values:
                raise SpecError(
                    f"Step {number} ({step.graph}) needs the value '{name}' before it exists; {suggest(name, values)}."
                )
        for source in step.carry:
            if source not in step.gives.values():
                raise SpecError(f"Step {number} carries '{source}', which '{step.graph}' does not give.")
        values |= set(step.gives.values())
    if slow_part(program) is not None:
        _check_two_parts(program, spec)
    for tensor in spec.outputs:
        if tensor.name not in values:
            raise SpecError(f"No step of the program gives the output '{tensor.name}'; {suggest(tensor.name, values)}.")


def _check_two_parts(program: tuple[ProgramStep, ...], spec: PolicySpec) -> None:
    """Refuse a slow part that cannot run beside the fast one; raises SpecError naming the step."""
    slow, fast = [step for step in program if step.slow], [step for step in program if not step.slow]
    graph = slow[0].graph
    if list(program) != slow + fast or not fast:
        raise SpecError(
            f"The slow part ('{graph}') is not followed by a fast part alone: its steps stand first, together.",
            "order the program so, with the steps without 'slow' last",
        )
    for step in slow:
        if step.slow != slow[0].slow:
            raise SpecError(f"'slow' of '{step.graph}' is {step.slow}, that of '{graph}' {slow[0].slow}.",
                            "write the same in each step of the slow part")  # fmt: skip
    if shared := {step.graph for step in slow} & {step.graph for step in fast}:
        raise SpecError(f"Both parts run the graph '{min(shared)}', perhaps at once.",
                        "give each part a graph of its own")  # fmt: skip
    for ours, others in ((slow, fast), (fast, slow)):
        own, given = _given(ours), _given(others)
        kept = {name for step in ours for name in step.keep}
        if foreign := sorted((kept - own) & given):
            raise SpecError(f"'{foreign[0]}' is kept by one part and given by the other.", "keep a part's own values")
    drawn = [{name for step in part for name in step.noise} for part in (slow, fast)]
    if both := drawn[0] & drawn[1]:
        raise SpecError(f"Both parts draw the noise '{min(both)}'.", "give each part noise with a name of its own")
    if spec.action.name not in _given(fast):
        raise SpecError(f"The fast part does not give the action '{spec.action.name}'.", "leave 'slow' out")
    if not latent_names(program, spec):
        raise SpecError(f"The fast part uses nothing of the slow part ('{graph}').", "feed it what that gives")


def _given(steps: Iterable[ProgramStep]) -> set[str]:
    return {name for step in steps for name in (*step.gives.values(), *step.carry.values())}
