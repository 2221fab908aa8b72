"""Samples for a policy under calibration, with the observations before them where it keeps values."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

from vlatool.bundle.bundle import Bundle
from vlatool.bundle.program import keeps_values
from vlatool.data import Moment, Recording, played_observations
from vlatool.module.torch_policy import torch_policy
from vlatool.runtime.policy import Policy
from vlatool.stage.record import SampleSet


def recorded_moments(
    bundle: Bundle, recording: Recording, numbers: Sequence[int], samples: SampleSet
) -> Iterator[Moment]:
    """Yield recorded samples; for a policy that keeps values, each after the earlier ones of its episode.

    Args:
        samples: Collector of the hash of each sample.
    """
    keeps = keeps_values(bundle.manifest.program)
    plain = (Moment(recording.observation(number), number) for number in numbers)
    return _hash_samples(recording.with_history(numbers) if keeps else plain, samples)


def played_moments(bundle: Bundle, samples: SampleSet) -> list[Moment]:
    """Return the observations of episodes that a training saved, in order; empty without any."""
    keeps = keeps_values(bundle.manifest.program)
    moments = (Moment(each, row, each.begins and keeps) for row, each in enumerate(played_observations(bundle)))
    return list(_hash_samples(moments, samples))


def samples_with_state(bundle: Bundle, moments: Iterable[Moment]) -> Iterator[tuple[Mapping[str, Any], dict[str, Any]]]:
    """Yield the samples that count, each with the state that the unquantized policy keeps before it: name -> array.

    A policy without state is not run.
    """
    policy: Policy | None = None
    for moment in moments:
        if keeps_values(bundle.manifest.program) and policy is None:
            policy = Policy.open(bundle, threads=1, seed=0) if bundle.manifest.graphs else torch_policy(bundle, 0)
        if policy is not None and moment.begins:
            policy.reset(moment.number)
        if moment.counts:
            yield moment.observation, {} if policy is None else policy.program.kept_values
        if policy is not None:
            policy.infer(moment.observation)


def _hash_samples(moments: Iterable[Moment], samples: SampleSet) -> Iterator[Moment]:
    for moment in moments:
        if moment.counts:
            next(samples.watch([moment.observation]))
        yield moment
