"""A recorded run computed again: with the bundle that ran, in a stack that is built as the file says."""

from __future__ import annotations

import os
from typing import Any

from vlatool.errors import DataError
from vlatool.runtime import load
from vlatool.runtime.stack import Fallback, build_stack
from vlatool.runtime.telemetry.replay import RecordedAnswers, Replay, ReplayResult
from vlatool.runtime.telemetry.run_file import OF_A_FUNCTION, RunHeader


def replay(
    path: str | os.PathLike[str],
    bundle: str | os.PathLike[str],
    *,
    fallback: str | os.PathLike[str] | None = None,
    envelope: Any = None,
) -> ReplayResult:
    """Compute a recorded run again and compare every output and action.

    Args:
        path: File that ``load(..., record=)`` or ``vlatool record`` has written.
        bundle: The bundle that ran.
        fallback: The second bundle that ran; its recorded answers are used when None.
        envelope: The function that was the envelope, where that was no robot's name.

    Raises:
        DataError: when the file is damaged, or of another bundle or envelope.
        VlatoolError: as ``load`` and ``build_stack`` do.
    """
    trace = Replay(path)
    about = trace.about
    if about.envelope == OF_A_FUNCTION and envelope is None:
        raise DataError(f"{path} was recorded within an envelope that a function put around the controller.",
                        "call vlatool.runtime.replay.replay(..., envelope=FUNCTION)")  # fmt: skip
    policy = load(bundle, engine=about.engine, threads=about.threads, seed=about.seed)
    _check_same(trace, "bundle", about.policy, policy.identity)
    options = None
    if about.fallback is not None:
        options = Fallback(_second(trace, about, fallback, policy.spec), **about.fallback)
    stack = build_stack(policy, controllers=about.controllers, envelope=envelope or about.envelope or None,
                        deadline_ms=about.deadline_ms, fallback=options, recorder=trace)  # fmt: skip
    return trace.run(stack)


def _second(trace: Replay, about: RunHeader, fallback: Any, spec: Any) -> Any:
    """Return the second policy, or what stands for it; None where there was none."""
    if not about.second:
        return None
    if fallback is None or about.second == OF_A_FUNCTION:
        return RecordedAnswers(spec)
    second = load(fallback, threads=about.threads, seed=about.seed)
    _check_same(trace, "fallback", about.second, second.identity)
    return second


def _check_same(trace: Replay, what: str, recorded: str, identity: str) -> None:
    if recorded != identity:
        raise DataError(f"{trace.path} was recorded with another {what}: {recorded}, and this is {identity}.",
                        f"pass the {what} that ran")  # fmt: skip
