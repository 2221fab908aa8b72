"""Agreement of two bundles on observations that neither was made for.

``python -m vlatool.measurement.agreement`` reads a ``PairJob`` and answers with an ``Agreement``. Both are loaded as a
robot loads them: every file is hashed, and the golden action must be computed. Each observation is answered twice, once
right after ``reset`` and once in another order without it; where values are kept by design, the second time is a row of
inferences in which both answer the same.
"""

from __future__ import annotations

import math
import random
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlatool.bundle.program import keeps_values
from vlatool.measurement.child import ask, serve
from vlatool.measurement.pairs import PairJob
from vlatool.runtime.engine_record import EngineRecord

Array = NDArray[Any]
FEWEST = 24
"""Observations that are answered however long that takes."""
MAX_STILL_SPREAD = 1e-6
"""Spread of an element, as a share of its size, up to which it is said not to vary."""
SEQUENCE = "consecutive"
"""Kind of the observations that policies which keep values answer in a row."""
MIN_SPREAD_SHARE = 0.1
"""Share of an element's usual spread (over observations of all kinds, or of its statistics) that it counts by at least
where it varies less: else the rounding of an element that happens to stand still would count as much as all motion."""
CLOSE = 0.25
"""Largest relative difference of outputs that do not vary (as of the golden action)."""


@dataclass(frozen=True)
class OutputAgreement:
    """How one output of the candidate follows the baseline's on observations of one kind.

    Args:
        kind: kind of the observations (``data.Drawn.kind``).
        correlation: over observations and elements, each by the baseline's spread: 1 gives the same everywhere, 0 is
            what a constant reaches, -1 is its opposite.
    """

    kind: str
    output: str
    correlation: float
    samples: int


@dataclass(frozen=True)
class Agreement:
    """What a process found.

    Args:
        followed: one for each output and kind of observation.
        looked: observations that the candidate answered twice.
        strays: number of them that it answered differently the second time.
        unsteady: number that the baseline did.
        skipped: observations that the baseline cannot answer.
        golden: golden error of baseline and candidate; None without a golden action.
        engines: engines of baseline and candidate.
        records: what they ran; none where neither was loaded.
    """

    followed: tuple[OutputAgreement, ...] = ()
    looked: int = 0
    strays: int = 0
    unsteady: int = 0
    skipped: int = 0
    golden: tuple[float | None, ...] = (None, None)
    engines: tuple[str, ...] = ("", "")
    records: tuple[EngineRecord, ...] = ()


def measure_agreement(job: PairJob, timeout: float | None = None) -> Agreement:
    """Measure in a fresh process; raises what a bundle raises, or GraphError when it ends or exceeds ``timeout`` s."""
    return ask("vlatool.measurement.agreement", job, Agreement, job.about, timeout)


def run_agreement(job: PairJob) -> Agreement:
    """Measure in this process; ``job.seconds`` ends it early, once ``FEWEST`` observations are answered."""
    from vlatool.bundle.bundle import Bundle
    from vlatool.measurement.turns import load_policy, pool_of

    baseline = Bundle.open(job.baseline)
    policies = [load_policy(path, job, traced=True) for path in (job.baseline, job.candidate)]
    pool = pool_of(job, baseline) if job.pairs else []
    calls, skipped = _answers(policies, pool, job)
    if keeps_values(baseline.manifest.program):
        for policy in policies:
            policy.reset()
        calls += _answers(policies, [replace(drawn, kind=SEQUENCE) for drawn in pool], job, afresh=False)[0]
    strays = [_strays(policy, calls, which, job.seed) for which, policy in enumerate(policies)]
    kinds = dict.fromkeys(call.kind for call in calls)
    usual = {tensor.name: _usual(policies[0], tensor, calls) for tensor in policies[0].spec.outputs} if calls else {}
    by_kind = ([call for call in calls if call.kind == kind] for kind in kinds)
    followed = [one for alike in by_kind for one in _agreements(policies, alike, usual)]
    return Agreement(tuple(followed), len(calls), strays[1], strays[0], skipped,
                     tuple(policy.golden_error for policy in policies),
                     tuple(policy.engine for policy in policies),
                     tuple(policy.engine_record() for policy in policies))  # fmt: skip


@dataclass(frozen=True)
class _Call:
    kind: str
    observation: Mapping[str, Any]
    noise: Mapping[str, Any] | None
    outputs: tuple[Mapping[str, Array], Mapping[str, Array]]


def _answers(
    policies: Sequence[Any], pool: Sequence[Any], job: PairJob, afresh: bool = True
) -> tuple[list[_Call], int]:
    """Ask both for every observation, some bits of which are new, right after a reset (``afresh``) or in a row."""
    from vlatool.errors import GraphError
    from vlatool.measurement.answers import vary_observation
    from vlatool.runtime.program import draw

    numbers = np.random.default_rng([job.seed, 3])
    steps, spec = policies[0].bundle.manifest.program, policies[0].spec
    calls: list[_Call] = []
    skipped = 0
    end = time.monotonic() + job.seconds
    for index, drawn in enumerate(pool):
        if index >= FEWEST and time.monotonic() > end:
            break
        observation = vary_observation(drawn.observation, spec, numbers)
        noise = {name: draw(wanted, numbers) for step in steps for name, wanted in step.noise.items()} or None
        try:
            theirs = _outputs(policies[0], observation, noise, afresh)
        except GraphError:
            skipped += 1
            continue
        calls.append(_Call(drawn.kind, observation, noise, (theirs, _outputs(policies[1], observation, noise, afresh))))
    return calls, skipped


def _outputs(
    policy: Any, observation: Mapping[str, Any], noise: Mapping[str, Any] | None, afresh: bool
) -> dict[str, Array]:
    if afresh:
        policy.reset()
    return {name: np.array(value) for name, value in policy.infer(observation, noise=noise).outputs.items()}


def _strays(policy: Any, calls: Sequence[_Call], which: int, seed: int) -> int:
    """Count the answers that are others in another order without reset; 0 for a policy that keeps values by design."""
    from vlatool.measurement.answers import Answers

    if keeps_values(policy.bundle.manifest.program):
        return 0
    answers = Answers([call.outputs[which] for call in calls])
    for index in random.Random(seed).sample(range(len(calls)), len(calls)):
        answers.look(index, policy.infer(calls[index].observation, noise=calls[index].noise).outputs)
    return answers.strays


def _usual(policy: Any, tensor: Any, calls: Sequence[_Call]) -> Array:
    """Return how much each element of an output varies: over all observations, or by its statistics if that is more."""
    from vlatool.runtime.statistics import load_normaliser

    values = _physical(policy, tensor.name, [call.outputs[0][tensor.name] for call in calls])
    spread = values.std(axis=0)
    normaliser = None if tensor.kind == "discrete" else load_normaliser(tensor, policy.bundle.path / "assets")
    return np.asarray(spread if normaliser is None else np.maximum(spread, np.abs(normaliser.scale)))


def _agreements(policies: Sequence[Any], calls: Sequence[_Call], usual: Mapping[str, Array]) -> list[OutputAgreement]:
    kind, count = calls[0].kind, len(calls)
    followed = []
    for tensor in policies[0].spec.outputs:
        theirs, mine = (
            _physical(policy, tensor.name, [call.outputs[which][tensor.name] for call in calls])
            for which, policy in enumerate(policies)
        )
        value = correlation(mine, theirs, usual[tensor.name], concordant=tensor.kind != "discrete")
        followed.append(OutputAgreement(kind, tensor.name, value, count))
    return followed


def _physical(policy: Any, name: str, values: Sequence[Array]) -> Array:
    """Return an output in physical units by the bundle's own statistics, (N, ...); logits without their mean."""
    from vlatool.runtime.statistics import load_normaliser

    tensor = next(tensor for tensor in policy.spec.outputs if tensor.name == name)
    wide = np.stack(values).astype(np.float64)
    if tensor.kind == "discrete":
        return np.asarray(wide - wide.mean(-1, keepdims=True))
    normaliser = load_normaliser(tensor, policy.bundle.path / "assets")
    return wide if normaliser is None else np.asarray(normaliser.inverse(wide.astype(np.float32)))


def correlation(mine: Array, theirs: Array, usual: Array | None = None, concordant: bool = False) -> float:
    """Return how (N, ...) answers follow others, see ``OutputAgreement``; elements that do not vary do not count.

    It is Pearson's, or the concordance correlation (Lin, Biometrics 45, 1989), for which a tenth of each answer, or one
    that lies elsewhere, is another answer: it is never larger, and equal where mean and spread are.
    Where none varies, 1 says that they are near each other and 0 that they are not.

    Args:
        mine: answers that should follow.
        theirs: outputs that they should agree with.
        usual: (...), how much each element varies elsewhere: one that stands still here counts by its share of that.
        concordant: whether scale and place count, as they do unless answers are logits.
    """
    if mine.shape != theirs.shape:
        return 0.0
    count = len(theirs)
    mine, theirs = mine.reshape(count, -1), theirs.reshape(count, -1)
    spread = theirs.std(axis=0)
    varied = spread > MAX_STILL_SPREAD * max(float(np.abs(theirs).max(initial=0.0)), 1e-12)
    if not varied.any():
        near = float(np.linalg.norm(mine - theirs)) <= CLOSE * (float(np.linalg.norm(theirs)) or 1.0)
        return float(near)
    floor = np.zeros(spread.shape) if usual is None else MIN_SPREAD_SHARE * usual.reshape(-1)
    by = np.maximum(spread, floor)[varied]
    middle = theirs.mean(axis=0)
    one, two = ((values - (middle if concordant else values.mean(axis=0)))[:, varied] / by for values in (mine, theirs))
    sizes = float(np.linalg.norm(one)), float(np.linalg.norm(two))
    size = sum(each**2 for each in sizes) / 2 if concordant else math.prod(sizes)
    return float((one * two).sum() / size) if size > 0 else 0.0


if __name__ == "__main__":
    serve(PairJob, run_agreement)
