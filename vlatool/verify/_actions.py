"""The action side of a log: recorded commands against what the policy gives for the recorded observations."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlatool.bundle.spec import PolicySpec
from vlatool.data import Recording
from vlatool.files.rows import Rows
from vlatool.runtime.policy import Policy
from vlatool.runtime.statistics import load_normaliser
from vlatool.verify._explanation import Explanation
from vlatool.verify._pairing import Pairs, pair_rows
from vlatool.verify._vectors import BETTER, MAX_UNLIKE, Array, explain_vector, match_vectors

MIN_AGREEMENT, MIN_GAIN = 0.85, 0.5
"""Share of discrete actions that an explanation must make equal, and of the disagreement that it may leave."""
REMEDY = "correct what sends the action on the robot, or labels, unit and mode of the action in the spec"


def explain_actions(policy: Policy, log: Recording, count: int) -> list[Explanation]:
    """Return what is wrong with the recorded commands of the first ``count`` rows of a log."""
    if log.actions is None:
        return []
    rows = min(count, len(log))
    given = _given(policy, log, rows)
    spec, name = policy.spec, policy.spec.action.name
    whole = pair_rows(log, log, spec.control_hz)
    pairings = {delay: kept for delay, pairs in whole.items() if len(kept := _below(pairs, rows)) >= 12}
    first = log.actions.read(0, rows) if isinstance(log.actions, Rows) else log.actions[:rows]
    commands = np.asarray(first[:, 0])
    if 0 not in pairings:
        return []
    if spec.action.kind == "discrete":
        return list(_of_indices(spec, commands, given, pairings))
    labels = spec.action.labels or tuple(map(str, range(given.shape[1])))
    commands = commands.astype(np.float64)
    match = match_vectors(commands, given, pairings)
    if match is None:
        return []
    if (absolute := _absolute(spec, log, commands, given, pairings)) is not None:
        return [absolute]
    if match.cost > MAX_UNLIKE:
        return []
    found = explain_vector(name, labels, commands, given, pairings, match, load_normaliser(spec.action, policy.bundle))
    return [Explanation(each.signal, each.kind, each.where, each.before, each.after, each.pairs, remedy=REMEDY)
            for each in found]  # fmt: skip


def in_memory(values: NDArray[Any] | Rows) -> NDArray[Any]:
    """Return an input of all rows as an array."""
    return values.read(0, len(values)) if isinstance(values, Rows) else values


def _below(pairs: Pairs, rows: int) -> Pairs:
    inside = (pairs.log < rows) & (pairs.reference < rows)
    return Pairs(pairs.log[inside], pairs.reference[inside])


def _given(policy: Policy, log: Recording, rows: int) -> Array:
    """Return the first action that the policy gives for each row: (N, A), or (N,) indices."""
    begins = log.begins()
    actions = []
    for row in range(rows):
        if begins[row]:
            policy.reset()
        actions.append(policy.infer(log.observation(row)).chunk[0])
    return np.asarray(actions, np.float64)


def _absolute(
    spec: PolicySpec, log: Recording, commands: Array, given: Array, pairings: Mapping[int, Pairs]
) -> Explanation | None:
    """Return whether commands are targets, where the policy gives differences from a state; None if not."""
    own = match_vectors(commands, given, {0: pairings[0]})
    for tensor in spec.inputs:
        values = log.inputs[tensor.name]
        if tensor.kind == "text" or values.ndim != 2 or values.shape[1] < given.shape[1] or own is None:
            continue
        state = in_memory(values)[: len(commands)].astype(np.float64)[:, : given.shape[1]]
        for words, sign in (("a target, where the policy gives a difference", 1), ("a difference from", -1)):
            less = match_vectors(commands - sign * state, given, {0: pairings[0]})
            if less is not None and less.own < BETTER * own.own and less.own < MAX_UNLIKE:
                where = f"{words}; '{tensor.name}' is between them"
                return Explanation(spec.action.name, "absolute" if sign > 0 else "delta", where, own.own, less.own,
                                   len(commands), remedy=REMEDY)  # fmt: skip
    return None


def _of_indices(
    spec: PolicySpec, commands: NDArray[np.int64], given: Array, pairings: Mapping[int, Pairs]
) -> Iterator[Explanation]:
    """Yield another order of discrete actions, or a delay, that makes commands and answers agree."""
    from scipy.optimize import linear_sum_assignment

    labels, name, rows = spec.action.labels, spec.action.name, len(commands)
    counts = np.zeros((len(labels), len(labels)), np.int64)
    np.add.at(counts, (commands, given.astype(np.int64)), 1)
    before = 1 - counts.trace() / rows
    mine, theirs = linear_sum_assignment(-counts)
    after = 1 - counts[mine, theirs].sum() / rows
    if after <= 1 - MIN_AGREEMENT and after <= MIN_GAIN * before and before > 0.1:
        moved = [
            f"{labels[one]} is sent for {labels[other]}"
            for one, other in zip(mine, theirs, strict=True)
            if one != other
        ]
        yield Explanation(name, "permuted", ", ".join(moved[:6]), before, after, rows, remedy=REMEDY)
        return
    errors = {delay: float(np.mean(commands[pairs.log] != given[pairs.reference])) for delay, pairs in pairings.items()}
    delay = min(errors, key=lambda each: (errors[each], abs(each)))
    if delay and errors[delay] <= 1 - MIN_AGREEMENT and errors[delay] <= MIN_GAIN * errors[0]:
        yield Explanation(name, "delayed", f"{delay} control steps", errors[0], errors[delay], rows, remedy=REMEDY)
