"""A user's environment, held against what gymnasium promises: every breach is a sentence with its remedy."""

from __future__ import annotations

import contextlib
import inspect
from collections.abc import Collection, Mapping
from typing import Any

import numpy as np

from vlatool.accuracy.success import truth_of
from vlatool.bundle.spec import PolicySpec
from vlatool.errors import DataError
from vlatool.files.limits import LIMITS_VARIABLE, limit
from vlatool.files.printable import amount
from vlatool.machine.watched_calls import watched_call

SECONDS = "environment_seconds"
GUIDE = "docs/guides/environment.md has a wrapper of ten lines"


def timeout_of(environment: Mapping[str, Any]) -> float:
    """Return how long a call may take, in seconds, as a declaration of an environment says it; 0 where it does not.

    Raises:
        DataError: when it is not a number above 0.
    """
    value = environment.get("timeout", 0.0)
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value < 1e9:
        raise DataError(
            f"'timeout' of the environment is {value!r:.60}; allowed: seconds above 0.",
            f"write timeout: {limit(SECONDS)} under environment in policy.yaml, or leave it out",
        )
    return float(value)


def time_limit(
    call: str, task: str, seed: int | None = None, timeout_s: float = 0.0, when: str = "at"
) -> contextlib.AbstractContextManager[None]:
    """Let whoever watches this process end it where a call of an environment, the block, takes too long.

    Args:
        seed: seed of the episode; None before there is one.
        timeout_s: Seconds that it may take; the limit ``environment_seconds`` when 0.
        when: How the call is related to the seed: ``at`` or ``after``.
    """
    allowed = timeout_s or limit(SECONDS)
    of = f"of task '{task}'" if seed is None else f"of task '{task}' {when} seed {seed}"
    longer = f"{2 * allowed:g}"
    everywhere = "" if timeout_s else f"{LIMITS_VARIABLE}={SECONDS}={longer}, or "
    asked = f"--environment-timeout {longer} (evaluate closed-loop, optimize)"
    raised = f"{everywhere}timeout: {longer} under environment in policy.yaml, or {asked}"
    own = f"make(task={task!r})" + (f".reset(seed={seed})" if call in ("reset()", "step()") else "")
    fix = f"where it needs longer, raise the limit: {raised}; else call {own} of the environment yourself and see where"
    whose = f"{call} of the environment of task '{task}'"
    at = "" if seed is None else f"{when} seed {seed}"
    return watched_call(f"{call} {of}", whose, at, f"{fix} it hangs", allowed)


class World:
    """Resets and steps an environment, and gives observations as the policy takes them.

    Args:
        timeout_s: Seconds that a call may take; see ``time_limit``.

    Raises:
        DataError: when it has no ``reset`` and ``step``, or ``reset`` takes no ``seed``.
    """

    def __init__(self, environment: Any, task: str, spec: PolicySpec, timeout_s: float = 0.0) -> None:
        self._environment = environment
        self._task, self._timeout_s = task, timeout_s
        self._seed: int | None = None
        self._name = f"the environment of task '{task}'"
        self._inputs = [tensor.name for tensor in spec.inputs]
        lacking = [name for name in ("reset", "step") if not callable(getattr(environment, name, None))]
        if lacking:
            raise DataError(
                f"What makes {self._name} gives {_describe(environment)}, which has no {' and no '.join(lacking)}.",
                "return an environment with gymnasium's interface",
            )
        if not _takes_seed(environment.reset):
            raise DataError(
                f"reset() of {self._name} takes no 'seed', so no two policies would see the same episode.",
                f"write reset(self, *, seed=None, options=None), as gymnasium has it; {GUIDE}",
            )

    def reset(self, seed: int) -> tuple[Mapping[str, Any], Any]:
        """Begin an episode; return its first observation and its info; raises DataError when it does not give both."""
        self._seed = seed
        with self._limited("reset()"):
            answer = self._environment.reset(seed=seed)
        if not (isinstance(answer, tuple) and len(answer) == 2):
            raise DataError(
                f"reset() of {self._name} gives {_describe(answer)}; it must give (observation, info).",
                f"return observation, {{}}: that is gymnasium's interface, and no longer gym's; {GUIDE}",
            )
        return self._observation(answer[0]), answer[1]

    def step(self, action: Any) -> tuple[Mapping[str, Any], bool, Any]:
        """Take an action; return the next observation, whether the episode is over, and the info.

        The environment gets a copy of it, and may write into that.

        Raises:
            DataError: when it does not give the five values of gymnasium, or does not say whether the episode is over.
        """
        with self._limited("step()"):
            answer = self._environment.step(action.copy() if isinstance(action, np.ndarray) else action)
        if not (isinstance(answer, tuple | list) and len(answer) == 5):
            raise DataError(
                f"step() of {self._name} gives {_describe(answer)}; it must give five values: observation, reward, "
                "terminated, truncated, info.",
                f"return observation, reward, done, False, info where gym had observation, reward, done, info; {GUIDE}",
            )
        observation, _, terminated, truncated, info = answer
        flags = [self._flag("terminated", terminated), self._flag("truncated", truncated)]
        return self._observation(observation), any(flags), info

    def disturbances(self) -> tuple[str, ...]:
        """Return the disturbances that are offered; raises DataError unless they are words, with ``disturb``."""
        named = self._own("disturbances")
        if named is None:
            return ()
        listed = isinstance(named, Collection) and not isinstance(named, str | bytes)
        if not listed or not all(isinstance(kind, str) and kind.isidentifier() for kind in named):
            raise DataError(
                f"'disturbances' of {self._name} is {named!r:.60}; it must be a list of words.",
                f"write disturbances = ('light', 'start_pose'); {GUIDE}",
            )
        if not callable(self._own("disturb")):
            raise DataError(
                f"{self._name.capitalize()} names disturbances, and has no disturb(kind, strength, seed).", GUIDE
            )
        return tuple(named)

    def disturb(self, kind: str, strength: float, seed: int) -> None:
        """Disturb the episodes from the next reset on; raises DataError when the environment does not offer that."""
        known = self.disturbances()
        if kind not in known:
            raise DataError.unknown(f"{self._name.capitalize()} offers no disturbance '{kind}'", kind, known)
        self._seed = seed
        with self._limited("disturb()"):
            self._own("disturb")(kind, strength, seed)

    def _limited(self, call: str) -> contextlib.AbstractContextManager[None]:
        return time_limit(call, self._task, self._seed, self._timeout_s)

    def _own(self, name: str) -> Any:
        """Return an attribute of the environment, or of what its wrappers wrap."""
        found = getattr(self._environment, name, None)
        return getattr(getattr(self._environment, "unwrapped", None), name, None) if found is None else found

    def _flag(self, name: str, value: Any) -> bool:
        """Return what ``terminated`` or ``truncated`` says: true or false, whatever an array of one of them holds."""
        if (flag := truth_of(value)) is not None:
            return flag
        if np.size(value) != 1:
            raise DataError(
                f"step() of {self._name} tells of {np.size(value)} episodes at once whether they are over.",
                "name a single environment, not a vector of them",
            )
        raise DataError(
            f"{name} of step() of {self._name} is {value!r:.60}; allowed: true or false (or 1 or 0).",
            f"return bool(...) of the condition that ends an episode, not a text or None; {GUIDE}",
        )

    def _observation(self, observation: Any) -> Mapping[str, Any]:
        """Return an observation by the names of the policy; one that has no name is that of its only input."""
        if isinstance(observation, Mapping):
            return observation
        if len(self._inputs) == 1:
            return {self._inputs[0]: observation}
        raise DataError(
            f"{self._name.capitalize()} gives its observation as {_describe(observation)}, without names; the policy "
            f"takes {', '.join(self._inputs)}.",
            f"wrap it, so that it gives a dict with these names; {GUIDE}",
        )


def _takes_seed(reset: Any) -> bool:
    """Say whether ``reset`` can be called with ``seed=``; what hides its parameters is believed to."""
    try:
        parameters = inspect.signature(reset).parameters.values()
    except (TypeError, ValueError):
        return True
    named = (inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY)
    return any(
        parameter.kind is inspect.Parameter.VAR_KEYWORD or (parameter.name == "seed" and parameter.kind in named)
        for parameter in parameters
    )


def _describe(value: Any) -> str:
    """Return what something is, as a part of a sentence."""
    if isinstance(value, tuple | list):
        return amount(len(value), "value")
    if isinstance(value, np.ndarray):
        return f"an array of {value.dtype} with the shape {list(value.shape)}"
    name = type(value).__name__
    return f"{'an' if name[0].lower() in 'aeio' else 'a'} {name}"
