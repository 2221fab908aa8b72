"""The interpreter of a bundle's program: order, repeats, carried tensors, schedules, noise."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from vlatool.bundle.program import ProgramStep
from vlatool.errors import DataError, GraphError, VlatoolError, fix_for, suggest
from vlatool.runtime.contract import not_finite
from vlatool.runtime.observation import all_finite

Array = NDArray[Any]


Run = Callable[[Mapping[str, Any]], Mapping[str, Any]]


class Session(Protocol):
    """One open graph on one engine."""

    def run(self, feeds: Mapping[str, Any]) -> Mapping[str, Any]:
        """Run the graph: input name -> array, output name -> array, both of NumPy and in the memory of the host.

        In whose memory they are meanwhile is the session's affair; later runs do not change what it gave. A session
        with an attribute ``deadline`` raises ``TimeoutError`` when a run goes beyond it. One with ``stop()`` does so
        when that is called from another thread, and again at each run until ``resume()``.
        """


class Program:
    """Runs the steps of a program over open sessions.

    Args:
        seed: Seed of the noise; fresh entropy when None. The slow part of a policy of two systems draws from a
            generator of its own, so that a program of either part alone draws the same.
        outputs: Values that the caller takes from ``run``; what only one graph gives another then stays in the memory
            of their engine, where that can do so (``leave_on_device``). All values are arrays when None.
    """

    def __init__(
        self,
        steps: Iterable[ProgramStep],
        sessions: Mapping[str, Session],
        seed: int | None = None,
        outputs: Iterable[str] | None = None,
    ) -> None:
        self.steps = tuple(steps)
        self.sessions = sessions
        if outputs is not None:
            leave_between_graphs(self.steps, sessions, outputs)
        self.seed = seed
        self._schedules = [schedule_arrays(step) for step in self.steps]
        self._plain = self._plain_step()
        self._parts_with_noise = {bool(step.slow) for step in self.steps if step.noise}
        self._noisy = bool(self._parts_with_noise)
        self.reset()

    def _plain_step(self) -> tuple[Run, list[tuple[str, str]], list[tuple[str, str]]] | None:
        """The parts of a program that is one graph, run once, with nothing beside inputs and outputs."""
        if len(self.steps) != 1:
            return None
        step = self.steps[0]
        if step.repeat != 1 or step.sources() or step.carry:
            return None
        return self.sessions[step.graph].run, list(step.feeds.items()), list(step.gives.items())

    def reset(self, seed: int | None = None) -> None:
        """Zero the kept values and restart the noise: from this seed, or from that of the program when None."""
        chosen = self.seed if seed is None else seed
        self._random = {  # NumPy imports its generators here, for which a robot without noise need not wait
            slow: np.random.default_rng([chosen, 1] if slow and chosen is not None else chosen)
            for slow in self._parts_with_noise
        }
        self._kept = {
            name: np.zeros(kept["shape"], kept.get("dtype", "float32"))
            for step in self.steps
            for name, kept in step.keep.items()
        }

    @property
    def plain(self) -> bool:
        """Whether it is one graph, run once: there is nothing to take back when an inference fails."""
        return self._plain is not None

    @property
    def keeps(self) -> bool:
        """Whether an inference depends on those before it."""
        return bool(self._kept)

    @property
    def kept_values(self) -> dict[str, Array]:
        """What the next inference is given of those before, value name -> array."""
        return dict(self._kept)

    @kept_values.setter
    def kept_values(self, values: Mapping[str, Array]) -> None:
        self._kept = dict(values)

    @property
    def snapshot(self) -> tuple[dict[str, Array], Any]:
        """What ``restore`` takes: the kept values, and the state of the noise where any is drawn."""
        return self._kept, self._noise_states() if self._noisy else None

    def restore(self, snapshot: tuple[dict[str, Array], Any]) -> None:
        """Go back to the kept values and the noise of a snapshot."""
        self._kept, noise = snapshot
        if noise is not None:
            self._restore_noise(noise)

    def _noise_states(self) -> dict[bool, Any]:
        return {part: random.bit_generator.state for part, random in self._random.items()}

    def _restore_noise(self, states: Mapping[bool, Any]) -> None:
        for part, state in states.items():
            self._random[part].bit_generator.state = state

    def stop(self) -> None:
        """End the run in progress, from another thread; it and later ones raise TimeoutError until ``resume``.

        An engine stops between two nodes of a graph. It does so from the first call of ``resume`` on.
        """
        for session in self.sessions.values():
            if hasattr(session, "stop"):
                session.stop()

    def resume(self) -> None:
        """Allow runs again after ``stop``."""
        for session in self.sessions.values():
            if hasattr(session, "resume"):
                session.resume()

    def run(
        self,
        values: dict[str, Any],
        noise: Mapping[str, Array] | None = None,
        finish: Callable[[dict[str, Any]], Any] | None = None,
    ) -> Any:
        """Run all steps and return every value; ``values`` (the encoded inputs) is filled in place.

        When anything raises, ``finish`` included, the kept values and the noise generator are as they were before.

        Args:
            noise: Value name -> floating array, instead of what the program would draw.

        Raises:
            DataError: when the noise does not fit.
            GraphError: when a graph fails, or a kept value is not finite or of another shape or dtype than declared.
        """
        drawn = self._caller_noise(noise) if noise is not None else {}
        if self._plain is not None:
            run, feeds, gives = self._plain
            results = run({name: values[value] for name, value in feeds})
            for name, value in gives:
                values[value] = results[name]
            return values if finish is None else finish(values)
        before = self._noise_states() if self._noisy else None
        try:
            self._run_steps(values, drawn)
            kept = {name: _checked(name, values[name], zero) for name, zero in self._kept.items()}
            result = values if finish is None else finish(values)
        except BaseException as error:
            if before is not None:
                self._restore_noise(before)
            if isinstance(error, VlatoolError) and (before or self._kept):
                _note_rollback(error)
            raise
        self._kept = kept
        return result

    def _run_steps(self, values: dict[str, Any], drawn: Mapping[str, Array]) -> None:
        values.update(self._kept)
        for step, schedules in zip(self.steps, self._schedules, strict=True):
            for name, noise in step.noise.items():
                values[name] = drawn[name] if name in drawn else draw(noise, self._random[bool(step.slow)])
            self._run_step(step, schedules, values)

    def _run_step(self, step: ProgramStep, schedules: dict[str, list[Array]], values: dict[str, Any]) -> None:
        session = self.sessions[step.graph]
        for turn in range(step.repeat):
            for name, numbers in schedules.items():
                values[name] = numbers[turn]
            outputs = session.run({name: values[value] for name, value in step.feeds.items()})
            for name, value in step.gives.items():
                values[value] = outputs[name]
            for source, target in step.carry.items():
                values[target] = values[source]

    def _caller_noise(self, noise: Mapping[str, Array]) -> dict[str, Array]:
        """Return the noise of the caller as float32."""
        known = {name: entry for step in self.steps for name, entry in step.noise.items()}
        if not isinstance(noise, Mapping):
            raise DataError(
                f"The noise is a {type(noise).__name__}; it must be a mapping of names to arrays.",
                "pass noise={NAME: array}, or leave it out: the program draws its own",
            )
        arrays = {}
        for name, value in noise.items():
            if name not in known:
                raise DataError(
                    f"The program draws no noise '{name}'; {suggest(str(name), known)}.", fix_for(str(name), known)
                )
            array, shape = np.asarray(value), tuple(known[name]["shape"])
            if array.dtype.kind != "f":
                raise DataError(f"The noise '{name}' is {array.dtype}; wanted float32.", "cast it to float32")
            if array.shape != shape:
                raise DataError(
                    f"The noise '{name}' has the shape {list(array.shape)}; wanted {list(shape)}.",
                    f"pass np.random.standard_normal({list(shape)}).astype(np.float32), or leave it out",
                )
            arrays[name] = array.astype(np.float32, copy=False)
        return arrays


def leave_between_graphs(steps: Iterable[ProgramStep], sessions: Mapping[str, Session], outputs: Iterable[str]) -> None:
    """Tell each session which of its outputs only other graphs take, and which of its inputs may be such ones."""
    steps = tuple(steps)
    needed = {*outputs, *(name for step in steps for name in step.keep)}
    carried = [pair for step in steps for pair in step.carry.items()]
    while more := {source for source, target in carried if target in needed} - needed:
        needed |= more
    fed = {value for step in steps for value in step.feeds.values()}
    fed |= {source for source, target in carried if target in fed}
    given = {value for step in steps for value in step.gives.values()} & fed - needed
    passed = given | {target for source, target in carried if source in given}
    for graph, session in sessions.items():
        mine = [step for step in steps if step.graph == graph]
        gives = [pair for step in mine for pair in step.gives.items()]
        stay = {name for name, _ in gives} - {name for name, value in gives if value not in given}
        arrive = {name for step in mine for name, value in step.feeds.items() if value in passed}
        if (stay or arrive) and hasattr(session, "leave_on_device"):
            session.leave_on_device(stay, arrive)


def draw(noise: Mapping[str, Any], random: np.random.Generator) -> Array:
    """Draw float32 noise as a program asks for it: ``normal`` N(0, 1), ``uniform`` on [-1, 1) or ``zeros``."""
    shape = tuple(noise["shape"])
    distribution = noise.get("distribution", "normal")
    if distribution == "zeros":
        return np.zeros(shape, np.float32)
    if distribution == "uniform":
        return random.uniform(-1, 1, shape).astype(np.float32)
    return random.standard_normal(shape, np.float32)


def schedule_arrays(step: ProgramStep) -> dict[str, list[Array]]:
    """Return the schedules of a step: value name -> an array of shape (1,) for each repeat."""
    schedules = {}
    for name, numbers in step.schedule.items():
        whole = all(isinstance(number, int) for number in numbers)
        schedules[name] = [np.array([number], np.int64 if whole else np.float32) for number in numbers]
    return schedules


def _checked(name: str, value: Array, zero: Array) -> Array:
    """Return a kept value that is as the program declares it."""
    if value.shape != zero.shape or value.dtype != zero.dtype:
        raise GraphError(
            f"The kept value '{name}' is {value.dtype} {list(value.shape)}; "
            f"the program declares {zero.dtype} {list(zero.shape)}.",
            "declare under 'keep' what the graph gives, and export the policy again",
        )
    if value.dtype.kind == "f" and not all_finite(value):
        raise not_finite(name, "kept value")
    return value


def _note_rollback(error: VlatoolError) -> None:
    """Add to an error that the inference counts as if it had never been."""
    error.message += " The state that the policy keeps is as it was before this inference."
    error.fix = "; ".join(filter(None, [error.fix, "continue with a good observation, or start over with reset()"]))
