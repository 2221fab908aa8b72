"""Accuracy on recorded observations: against the expert's actions, and against a baseline bundle."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import Field

from vlatool.accuracy.credibility import Credibility, credibility
from vlatool.accuracy.losses import agreeing, scale_of
from vlatool.accuracy.skill import skill, variation
from vlatool.bundle.bundle import MANIFEST, Bundle
from vlatool.bundle.program import keeps_values
from vlatool.bundle.spec import TensorSpec
from vlatool.data import MAP_HELP, Moment, Recording, carries_evaluation, evaluation_recording, named_recording
from vlatool.errors import DataError
from vlatool.evaluate._names import names_of
from vlatool.evaluate._sentences import found_wrong
from vlatool.machine.host import fingerprint
from vlatool.measures import with_derived
from vlatool.measures.actions import BASELINE, EXPERT, RELATIVE_ERROR, Reference
from vlatool.report import Measurement, Report, Row
from vlatool.runtime.contract import off_the_robot
from vlatool.runtime.interface import Array
from vlatool.runtime.policy import FIRST_RUN_S, Policy
from vlatool.stage.base import Context, Measure
from vlatool.stage.first_run import run_once_in_child
from vlatool.stage.identity import with_identity
from vlatool.stats.intervals import wilson

if TYPE_CHECKING:
    from vlatool.hardware.profile import Profile

MAKE_OTHERWISE = (
    "make the bundle otherwise (vlatool explain says where it differs), or remove a sample that is not an observation"
)
MAX_REFERENCES = 4
NEVER_VARIES = {
    EXPERT.name: "the expert's action never varies, so no error relative to its spread",
    BASELINE.name: "the baseline's action never varies, so no error relative to its spread",
}
"""Why an error against the expert or the baseline is unknown."""
REFERENCES: dict[tuple[Any, ...], Array] = {}
"""What baselines gave, of the last ``MAX_REFERENCES``."""


class Recorded(Measure):
    """Run a bundle on recorded observations and compare its actions with the expert's and with a baseline's."""

    data: Path | None = Field(
        None,
        description="recorded observations and actions; the bundle's own, or half of its calibration, when not given",
    )
    map: tuple[str, ...] = Field((), description=MAP_HELP)
    baseline: Path | None = Field(None, description="bundle to compare with, usually float32")
    samples: int = Field(100_000, ge=1, description="largest number of samples, spread over the recording")
    engine: str = Field("", description="engine of the runtime; the one that each bundle was made for when empty")

    def inputs(self) -> tuple[Path, ...]:
        """Data and the baseline's manifest."""
        return (*([self.data] if self.data else []), *([self.baseline / MANIFEST] if self.baseline else []))

    def check(self, source: Bundle | None, profile: Profile | None) -> None:
        """There is something to evaluate on."""
        if source is not None and self.data is None and not carries_evaluation(source):
            raise DataError(f"{source.path} carries no evaluation data.", "pass --data FILE.npz")

    def run(self, source: Bundle, context: Context) -> Report:
        """Evaluate and return a row for the bundle, and one for the baseline when there is one."""
        recording, reservation = evaluation_recording(source, named_recording(self.data, self.map))
        recording = recording.with_whole_chunks()
        indices = recording.spread(self.samples)
        action = source.manifest.spec.action
        expert = None if recording.actions is None else recording.actions[indices]
        episodes = None if recording.episodes is None else recording.episodes[indices]
        reference: Array | None = None
        rows = []
        bundles = [*([Bundle.open(self.baseline)] if self.baseline else []), source]
        names = names_of(bundles)
        if self.baseline:
            reference = self._reference(bundles[0], source, recording, indices, context)
            own = single_policy_measurements(action, reference, expert, episodes)
            row = Row(names[0], "baseline", measurements=tuple(own))
            rows.append(with_identity(with_derived(row), bundles[0]))
        actions = run_recorded(source, recording, indices, self.engine, context)
        measurements = single_policy_measurements(action, actions, expert, episodes)
        if reference is not None:
            measurements += compare(action, actions, reference, BASELINE)
        rows.append(with_identity(with_derived(Row(names[-1], measurements=tuple(measurements))), source))
        kind = "calibration" if reservation else "recorded"
        title = f"{source.manifest.name} on {len(indices)} {kind} observations"
        trust = credibility(rows[0]) if self.baseline else Credibility()
        text = f"{title}: {_summary(rows[-1])}."
        verdict = "inconclusive" if trust.fails else "info"
        sentences = (*trust.sentences, text)
        reserved = (reservation,) if reservation else ()
        warnings = (*reserved, *trust.warnings, *recording.unjudged_steps, *found_wrong(source))
        return Report("evaluate", title, verdict, sentences, tuple(rows), environment=fingerprint(), warnings=warnings)

    def _reference(
        self, baseline: Bundle, source: Bundle, recording: Recording, indices: Sequence[int], context: Context
    ) -> Array:
        """Run the baseline, once in a process: a search compares many bundles with it."""
        state = recording.path.stat()
        spec = json.dumps(source.manifest.spec.to_dict(), sort_keys=True)
        file = (recording.path, state.st_mtime_ns, state.st_size, len(recording))
        key = (baseline.hash, spec, file, tuple(indices), self.engine)
        if key not in REFERENCES:
            context.progress("running the baseline", None)
            while len(REFERENCES) >= MAX_REFERENCES:
                REFERENCES.pop(next(iter(REFERENCES)))
            REFERENCES[key] = run_recorded(baseline, recording, indices, self.engine, context)
            REFERENCES[key].setflags(write=False)
        return REFERENCES[key]


def _summary(row: Row) -> str:
    sentences = []
    for reference in (EXPERT, BASELINE):
        agreement, error = row.get(reference.agreement), row.get(reference.error)
        if agreement is not None:
            sentences.append(f"{agreement.value:.1%} of the actions are those of the {reference.name}")
        elif error is not None and error.known:
            sentences.append(
                f"actions differ from the {reference.name}'s by {error.value:.1%} of their standard deviation"
            )
        elif error is not None:
            sentences.append(f"{error.note}; {_worst(row, reference)}")
    return "; ".join(sentences) or "nothing to compare with"


def _worst(row: Row, reference: Reference) -> str:
    """Return the largest error of an element, in its unit."""
    element, worst = max(reference.element_error.members(row).items(), key=lambda item: item[1].value)
    unit = "" if worst.unit == "1" else f" {worst.unit}"
    return f"{element} is off by {worst.value:.3g}{unit} on average"


def single_policy_measurements(
    action: TensorSpec, got: Array, expert: Array | None, episodes: Array | None
) -> list[Measurement]:
    """Return what the actions of one policy say without another one: against the expert's, and how much they vary."""
    measured = compare(action, got, expert, EXPERT)
    if expert is not None:
        measured.append(skill(action, got, expert, episodes))
    return [*measured, *variation(action, got, expert)]


def run_recorded(bundle: Bundle, recording: Recording, indices: Sequence[int], engine: str, context: Context) -> Array:
    """Return the chunks of the policy: (N, T, A) float32 in physical units, or (N, T) int64.

    Raises:
        GraphError: when this machine computes another golden action than recorded, an inference takes longer than
            ``FIRST_RUN_S``, or the engine crashes.
    """
    run_once_in_child(bundle, engine)
    policy = Policy.open(bundle, engine=engine, threads=1, seed=0)
    policy.warm_up(1)
    policy.limit_s = FIRST_RUN_S
    chunks: list[Array] = []
    for moment in moments_of(recording, indices, keeps=keeps_values(bundle.manifest.program)):
        if len(chunks) % 16 == 0:
            context.progress("running recorded observations", len(chunks) / len(indices))
        if moment.begins:
            policy.reset()
        answered = off_the_robot(f"sample {moment.number} of {recording.path}", MAKE_OTHERWISE)
        with answered:
            chunk = policy.infer(moment.observation).chunk
        chunks += [chunk] if moment.counts else []
    return np.stack(chunks)


def moments_of(recording: Recording, indices: Sequence[int], *, keeps: bool) -> Iterator[Moment]:
    """Yield the observations that a policy is given; one that keeps values is given all that come before them, too."""
    if keeps:
        yield from recording.with_history(indices)
        return
    episode = None
    for index in indices:
        current = None if recording.episodes is None else int(recording.episodes[index])
        yield Moment(recording.observation(index), index, begins=current != episode)
        episode = current


def compare(action: TensorSpec, got: Array, wanted: Array | None, reference: Reference) -> list[Measurement]:
    """Compare actions with the expert's or the baseline's.

    Returns:
        Discrete: ``agreement_WHOSE`` (share, Wilson interval). Continuous: ``error_WHOSE.LABEL`` (mean absolute error
        in the element's unit), ``error_WHOSE`` (the mean of those, each divided by the standard deviation of the wanted
        element, or by what stands for it: ``scale_of``), and ``gripper_flips_WHOSE``: the share of steps in which a
        gripper element is on the other side of the middle of what was wanted of it.
    """
    if wanted is None:
        return []
    if action.kind == "discrete":
        same = agreeing(got, wanted)
        hits, total = int(np.sum(same)), same.size
        low, high = wilson(hits, total)
        return [reference.agreement.measurement(hits / total, samples=total, low=low, high=high)]
    steps = min(got.shape[1], wanted.shape[1])
    got, wanted = got[:, :steps].astype(np.float64), wanted[:, :steps].astype(np.float64)
    labels = action.labels or tuple(str(index) for index in range(action.robot_width))
    errors = np.abs(got - wanted)
    mean, count = errors.mean(axis=(0, 1)), len(got)
    scale = scale_of(action, wanted)
    varies = bool(scale.any())
    relative = float(np.mean(mean / scale)) if varies else math.nan
    note = "mean |error| / standard deviation" if varies else NEVER_VARIES[reference.name]
    norms = np.linalg.norm(wanted.reshape(count, -1), axis=1)
    distances = np.linalg.norm((got - wanted).reshape(count, -1), axis=1) / np.where(norms > 0, norms, 1.0)
    measured = [reference.error.measurement(relative, samples=count, note=note)]
    if reference is BASELINE:
        note = "mean over samples of |difference|2 / |action|2"
        measured.append(RELATIVE_ERROR.measurement(float(distances.mean()), samples=count, note=note))
    for index, (label, unit) in enumerate(zip(labels, action.units(), strict=True)):
        quantity = reference.element_error.quantity(label, unit)
        measured.append(quantity.measurement(float(mean[index]), samples=count, note="mean |error|"))
    measured += _gripper_flips(labels, got, wanted, reference)
    return measured


def _middles(wanted: Array) -> Array:
    """Return what lies between open and closed for each gripper: the middle of what was wanted; 0 where that is one."""
    low, high = wanted.min(axis=(0, 1)), wanted.max(axis=(0, 1))
    return np.where(low < high, (low + high) / 2, 0.0)


def _gripper_flips(labels: Sequence[str], got: Array, wanted: Array, reference: Reference) -> list[Measurement]:
    columns = [index for index, label in enumerate(labels) if "grip" in label.lower()]
    if not columns:
        return []
    middle = _middles(wanted[..., columns])
    flips = int(np.sum((got[..., columns] > middle) != (wanted[..., columns] > middle)))
    total = got[..., columns].size
    low, high = wilson(flips, total)
    return [reference.gripper_flips.measurement(flips / total, samples=total, low=low, high=high)]
