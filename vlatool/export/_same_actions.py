"""A bundle whose graphs were rewritten for another engine: finished, and held against the one that it was made of."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from vlatool.bundle.bundle import Bundle
from vlatool.bundle.manifest import Graph
from vlatool.data import observations_for, recorded_observations
from vlatool.errors import GraphError
from vlatool.files.printable import amount
from vlatool.runtime.policy import Policy, relative_error
from vlatool.stage.base import Context, Transform
from vlatool.stage.finish import MAX_COMPARED, carry_over, finish, reference_policy
from vlatool.stage.record import made_by

OBSERVATIONS = 8
ROUNDING = 1e-4
"""Largest relative L2 difference of actions that are the same but for the order of sums."""


def largest_difference(policy: Policy, other: Policy, observations: list[dict[str, Any]]) -> float:
    """Return the largest relative L2 difference of an output over observations, one after the other without a reset."""
    for each in (policy, other):
        each.reset(0)
    largest = 0.0
    for observation in observations:
        one, two = policy.infer(observation).outputs, other.infer(observation).outputs
        largest = max([largest, *(relative_error(two[name], one[name]) for name in one)])
    return largest


def finish_rewritten(
    stage: Transform,
    source: Bundle,
    out: Path,
    graphs: Mapping[str, Graph],
    context: Context,
    changes: Mapping[str, Any] | None = None,
) -> Bundle:
    """Finish a bundle of rewritten graphs, which are run on the observations of the source.

    Args:
        changes: further fields of the manifest.
    """
    carry_over(source, out)
    context.progress("running the graphs", None)
    return finish(
        source, out, made_by=made_by(stage), graphs=dict(graphs), observations=observations_for(source, MAX_COMPARED),
        recorded=bool(recorded_observations(source, 1)), changes=changes,
    )  # fmt: skip


def refuse_other_actions(source: Bundle, made: Bundle, allowed: float = ROUNDING, fix: str = "") -> float:
    """Compare what the graphs of two bundles say, operator by operator; return the largest difference.

    Raises:
        GraphError: when it is larger than allowed.
    """
    observations = observations_for(source, OBSERVATIONS)
    error = largest_difference(reference_policy(source), reference_policy(made), observations)
    if not error <= allowed:
        raise GraphError(
            f"The new graphs give other actions than those that they were made of: relative L2 error {error:.3g} on "
            f"{amount(len(observations), 'observation')}, allowed {allowed:g}.",
            fix or "use the bundle as it is, or export the policy anew in the version that the engine takes",
        )
    return error
