"""The two parts of a policy of two systems, each by itself: a slow one, and a fast one that uses its values."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from vlatool.bundle.program import ProgramStep, latent_names, slow_part
from vlatool.errors import UsageError
from vlatool.runtime.contract import not_finite
from vlatool.runtime.interface import Array
from vlatool.runtime.observation import ObservationEncoder, all_finite
from vlatool.runtime.policy import BundlePolicy
from vlatool.runtime.program import Program

Latent = Mapping[str, Any]
"""What the slow part gives the fast one: value name -> array, in the memory of the host or of the engine."""


class SlowRunner:
    """The slow part of an open bundle: it turns observations into what the fast part takes from it.

    Inputs with a ``history`` are given with all their moments.

    Attributes:
        names: Inputs of the policy that it takes.
        noise: Names of the noise that it draws.

    Raises:
        UsageError: when the policy has no slow part.
    """

    def __init__(self, policy: BundlePolicy) -> None:
        manifest = policy.bundle.manifest
        steps = _steps(policy, slow=True)
        self.noise = {name for step in steps for name in step.noise}
        self._encode = ObservationEncoder(policy.spec, policy.bundle, inputs=_inputs(policy, steps))
        self.names = tuple(self._encode.names)
        self._program = _program(policy, steps)
        self._latent = latent_names(manifest.program, manifest.spec)

    def run(self, observation: Mapping[str, Any], *, noise: Mapping[str, Array] | None = None) -> Latent:
        """Return what the fast part takes; a run that raises has no effect.

        Raises:
            DataError: when the observation or the noise does not fit.
            GraphError: when the engine fails, or a value is not finite.
            TimeoutError: when ``stop`` is called.
        """
        latent: Latent = self._program.run(self._encode(observation), noise, self._values)
        return latent

    def _values(self, values: Mapping[str, Any]) -> Latent:
        latent = {name: values[name] for name in self._latent}
        for name, value in latent.items():
            if isinstance(value, np.ndarray) and value.dtype.kind == "f" and not all_finite(value):
                raise not_finite(name, "value of the slow part")
        return latent

    def stop(self) -> None:
        """End the run in progress; see ``BundlePolicy.stop``."""
        self._program.stop()

    def resume(self) -> None:
        """Allow runs again after ``stop``."""
        self._program.resume()

    @property
    def snapshot(self) -> Any:
        """What ``restore`` takes: kept values and noise."""
        return self._program.snapshot

    def restore(self, snapshot: Any) -> None:
        """Take back what was run since a snapshot."""
        self._program.restore(snapshot)

    def reset(self, seed: int | None = None) -> None:
        """Start a new episode; see ``BundlePolicy.reset``."""
        self._program.reset(seed)


class FastPart(BundlePolicy):
    """The fast part of an open bundle, as a policy: it infers with the values of the slow part that it was given last.

    Attributes:
        latent: These values.

    Raises:
        UsageError: when the policy has no slow part.
    """

    def __init__(self, policy: BundlePolicy) -> None:
        steps = _steps(policy, slow=False)
        reference = policy.spec.reference
        inputs = _inputs(policy, steps) | ({reference.name} if reference is not None else set())
        self._fast = _FastProgram(steps, {step.graph: policy.program.sessions[step.graph] for step in steps},
                                  policy.program.seed)  # fmt: skip
        super().__init__(policy.bundle, self._fast, policy.engine, inputs=inputs)

    @property
    def latent(self) -> Latent:
        """What the next inference takes from the slow part."""
        return self._fast.latent

    @latent.setter
    def latent(self, values: Latent) -> None:
        self._fast.latent = values


class _FastProgram(Program):
    """A program that takes further values beside the inputs."""

    latent: Latent = {}

    def run(self, values: dict[str, Any], noise: Any = None, finish: Any = None) -> Any:
        """Run all steps, on the values of the slow part, too; see ``Program.run``."""
        return super().run({**values, **self.latent}, noise, finish)


def parts_of(policy: BundlePolicy) -> tuple[SlowRunner, FastPart]:
    """Return the slow and the fast part of a policy of two systems, on the sessions of this one.

    Each has its own kept values and noise. They may run at once in two threads, but not beside ``infer`` of the policy.

    Raises:
        UsageError: when it has no slow part.
    """
    return SlowRunner(policy), FastPart(policy)


def _steps(policy: BundlePolicy, *, slow: bool) -> list[ProgramStep]:
    program = policy.bundle.manifest.program
    if slow_part(program) is None:
        raise UsageError(
            f"The policy '{policy.bundle.manifest.name}' has no slow part: no step of its program says 'slow'.",
            "run it as a whole, or say in policy.yaml which steps are slow: slow: {max_age_ms: 500}",
        )
    return [step for step in program if bool(step.slow) == slow]


def _inputs(policy: BundlePolicy, steps: Iterable[ProgramStep]) -> set[str]:
    return {name for step in steps for name in step.feeds.values()} & {tensor.name for tensor in policy.spec.inputs}


def _program(policy: BundlePolicy, steps: list[ProgramStep]) -> Program:
    return Program(steps, {step.graph: policy.program.sessions[step.graph] for step in steps}, policy.program.seed)
