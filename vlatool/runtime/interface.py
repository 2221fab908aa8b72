"""What a control loop calls: a policy, which infers chunks of actions, and a controller, which acts on an observation.

Anything that wraps a policy (to record it, or to change its actions) is itself a ``Policy``, and anything that acts
with one is a ``Controller``. So wrappers compose in any order, and callers need only these methods.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple, Protocol, runtime_checkable

from numpy.typing import NDArray

from vlatool.bundle.spec import PolicySpec
from vlatool.errors import PluginError

Array = NDArray[Any]
POLICY, CHUNK, FALLBACK, HOLD, STOP = "policy", "chunk", "fallback", "hold", "stop"
"""Sources of an action: the policy, as planned; the rest of an earlier chunk, because no new one came in time; a second
policy; the last command again or no motion; a stop. A wrapper that computes actions of its own adds its own word."""


class Origin(NamedTuple):
    """Where one action came from.

    A controller has that of its last action as ``origin``; a wrapper starts from ``origin_of`` the controller inside it
    and passes it on, extended (``altered_by``) or replaced.

    Args:
        source: What computed it: ``POLICY`` and the words beside it; empty where a controller does not say.
        age_ms: Time from the observation that it answers to the return of the action, in milliseconds; None where
            nobody says.
        checks: Names of the checks and limits that altered it, in the order in which they did.
        latent_age_ms: Of a policy of two systems, time from the observation that the slow part's values answer to the
            return of the action, in milliseconds; None where there is none, or nobody says.
    """

    source: str = POLICY
    age_ms: float | None = None
    checks: tuple[str, ...] = ()
    latent_age_ms: float | None = None

    def altered_by(self, *checks: str) -> Origin:
        """Return the same with further checks that altered the action."""
        return self._replace(checks=(*self.checks, *checks))


class Action(NamedTuple):
    """Result of an inference: what the robot should do.

    Args:
        chunk: (T, A) float32 in the units of the spec, or (T,) int64 indices of discrete actions.
        labels: Name of each index for discrete actions, otherwise of each element.
        latency_ms: Time from the call of ``infer`` to this result, in milliseconds.
        sequence: Number of this inference since the last reset, from 0.
        outputs: Every output of the spec by name, as the graph returned it (not un-normalised).
        source: What computed the chunk: ``POLICY`` and the words beside it.
        age_ms: Time from the observation that it answers to this result, in milliseconds.
        checks: Names of the checks and limits that altered it, in the order in which they did.
        latent_age_ms: Of a policy of two systems, time from the observation that the slow part's values answer to this
            result, in milliseconds; None where both parts ran for it.
    """

    chunk: Array
    labels: tuple[str, ...]
    latency_ms: float
    sequence: int
    outputs: Mapping[str, Array]
    source: str = POLICY
    age_ms: float = 0.0
    checks: tuple[str, ...] = ()
    latent_age_ms: float | None = None

    def origin(self, later_ms: float = 0.0) -> Origin:
        """Return where an action of this chunk comes from that is returned ``later_ms`` milliseconds after it."""
        latent = None if self.latent_age_ms is None else self.latent_age_ms + later_ms
        return Origin(self.source, self.age_ms + later_ms, self.checks, latent)


@runtime_checkable
class Policy(Protocol):
    """Maps an observation to a chunk of actions; may keep values from inference to inference."""

    @property
    def spec(self) -> PolicySpec:
        """Inputs, outputs and control rate."""

    def infer(self, observation: Mapping[str, Any], *, noise: Mapping[str, Array] | None = None) -> Action:
        """Return the next action chunk; see ``vlatool.runtime.policy.BundlePolicy.infer``."""

    def reset(self, seed: int | None = None) -> None:
        """Start a new episode, with noise of this seed; that of the policy when None."""


@runtime_checkable
class Observer(Protocol):
    """A policy whose inputs hold several moments (``TensorSpec.history``): it sees every control step."""

    def observe(self, observation: Mapping[str, Any]) -> None:
        """Keep the observation of a control step at which the policy does not infer."""


@runtime_checkable
class Controller(Protocol):
    """Maps the observation of each control step to one action."""

    @property
    def fresh(self) -> bool:
        """Whether the last action was the first of a chunk."""

    def act(self, observation: Mapping[str, Any]) -> Array:
        """Return the action of this control step: (A,) float32, or a 0-d int64 index of a discrete action."""

    def reset(self, seed: int | None = None) -> None:
        """Start a new episode, with noise of this seed; that of the policy when None."""


def layers_of(layer: Any) -> list[Any]:
    """Return a layer and all those inside it, the outermost first: what it has as ``controller`` or ``policy``."""
    found = [layer]
    while (inner := getattr(found[-1], "controller", None) or getattr(found[-1], "policy", None)) is not None:
        found.append(inner)
    return found


def origin_of(controller: Controller) -> Origin:
    """Return where the last action of a controller came from; without a source and an age if it does not say."""
    origin = getattr(controller, "origin", None)
    return origin if isinstance(origin, Origin) else Origin("")


def observer_of(policy: Policy) -> Observer | None:
    """Return the policy if a controller has to give it the observation of every control step, else None.

    Raises:
        PluginError: when inputs of its spec hold several moments, but it lacks ``observe``.
    """
    looking_back = [tensor.name for tensor in policy.spec.inputs if tensor.history]
    if not looking_back:
        return None
    if not isinstance(policy, Observer):
        raise PluginError(
            f"{type(policy).__name__} has no method observe(); its input '{looking_back[0]}' holds several moments, of "
            "control steps at which it does not infer, too.",
            "add observe(observation), which passes the observation on to the wrapped policy",
        )
    return policy
