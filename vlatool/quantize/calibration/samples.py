"""What a policy is given while its activations are looked at: samples, and what leads to them where it keeps values."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

from vlatool.bundle.bundle import Bundle
from vlatool.bundle.program import keeps_values
from vlatool.data import Moment, Recording, played_observations
from vlatool.module.torch_policy import torch_policy
from vlatool.runtime.policy import Policy
from vlatool.stage.base import SampleSet


def recorded_moments(bundle: Bundle, recording: Recording, numbers: Sequence[int], seen: SampleSet) -> Iterator[Moment]:
    """Yield recorded samples; each after those before it in its episode, for a policy that keeps values.

    Args:
        bundle: Of the policy.
        recording: Its observations.
        numbers: Of the samples, ascending.
        seen: Takes the hash of each sample that goes by.
    """
    keeps = keeps_values(bundle.manifest.program)
    plain = (Moment(recording.observation(number), number) for number in numbers)
    return _hashed(recording.along(numbers) if keeps else plain, seen)


def played_moments(bundle: Bundle, seen: SampleSet) -> list[Moment]:
    """Return what a training kept of its episodes, in order; none where it kept none."""
    keeps = keeps_values(bundle.manifest.program)
    moments = (Moment(each, row, each.begins and keeps) for row, each in enumerate(played_observations(bundle)))
    return list(_hashed(moments, seen))


def led_to(bundle: Bundle, moments: Iterable[Moment]) -> Iterator[tuple[Mapping[str, Any], dict[str, Any]]]:
    """Yield the samples that count, each with what the policy, as it is, keeps before it: value name -> array.

    A policy that keeps nothing is not run.
    """
    policy: Policy | None = None
    for moment in moments:
        if keeps_values(bundle.manifest.program) and policy is None:
            policy = Policy.open(bundle, threads=1, seed=0) if bundle.manifest.graphs else torch_policy(bundle, 0)
        if policy is not None and moment.begins:
            policy.reset(moment.number)
        if moment.counts:
            yield moment.observation, {} if policy is None else policy.program.kept
        if policy is not None:
            policy.infer(moment.observation)


def _hashed(moments: Iterable[Moment], seen: SampleSet) -> Iterator[Moment]:
    for moment in moments:
        if moment.counts:
            next(seen.watch([moment.observation]))
        yield moment
