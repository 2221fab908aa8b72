"""Is the robot wired right? A raw log of what it fed and did, against a recording of what the policy was trained on."""

from __future__ import annotations

import functools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vlatool.bundle.bundle import Bundle
from vlatool.bundle.spec import PolicySpec, TensorSpec
from vlatool.data import Recording, read_recording, recordings_of
from vlatool.errors import DataError
from vlatool.files.printable import amount
from vlatool.machine.host import fingerprint
from vlatool.measures.actions import RELATIVE_ERROR_MAX
from vlatool.report import Report, Row
from vlatool.runtime.policy import Policy
from vlatool.runtime.statistics import Normaliser, load_normaliser
from vlatool.stage.base import Context
from vlatool.stage.identity import with_identity
from vlatool.verify._actions import explain_actions, in_memory
from vlatool.verify._diagnosis import Scales
from vlatool.verify._distributions import explain_statistics, scales_of
from vlatool.verify._explanation import Explanation
from vlatool.verify._images import explain_images, is_image
from vlatool.verify._other_episodes import Judge, Outcome
from vlatool.verify._pairing import Pairs, pair_rows
from vlatool.verify._reading import names_of
from vlatool.verify._texts import explain_paired
from vlatool.verify._vectors import BETTER, MAX_UNLIKE, Match, explain_vector, match_vectors

Array = NDArray[np.float64]
EXPLANATIONS = "explanations"
SAME_MOMENT = 0.3
"""Share of a signal's spread by which two recordings of the same moment differ at most, after a known change."""
MAX_WIDTH = 256
"""Elements of a signal that is compared element by element; images, and what is larger, are not."""


@dataclass(frozen=True)
class LogOptions:
    """What is compared.

    Args:
        log: recording of what the robot fed and did.
        reference: recording of right wiring; the policy's own, calibration and evaluation, when None.
        samples: rows for which the policy is run to judge the recorded commands.
    """

    log: Path
    reference: Path | None = None
    samples: int = 128


@dataclass(frozen=True, eq=False)
class Signals:
    """A log and the reference recording it is compared with.

    Args:
        pairings: delay in control steps -> rows that are of the same moment; empty when the episodes are others.
        own: whether the reference is the policy's own.
    """

    bundle: Bundle
    log: Recording
    reference: Recording
    pairings: Mapping[int, Pairs]
    own: bool

    @property
    def tensors(self) -> list[TensorSpec]:
        """The inputs as observations have them: of an image that is preprocessed, the frame of the camera."""
        return [tensor.observation for tensor in self.bundle.manifest.spec.inputs]

    def labels(self, tensor: TensorSpec, width: int) -> Sequence[str]:
        """Return a name for each element of a signal."""
        return tensor.labels if len(tensor.labels) == width else [f"[{index}]" for index in range(width)]

    def vectors(self) -> list[TensorSpec]:
        """Return the inputs that are compared element by element."""
        return [tensor for tensor in self.tensors
                if tensor.kind != "text" and not is_image(tensor) and self._width(tensor) <= MAX_WIDTH
                and self.log.inputs[tensor.name].shape[1:] == self.reference.inputs[tensor.name].shape[1:]]  # fmt: skip

    def images(self) -> list[TensorSpec]:
        """Return the inputs that are images."""
        return [tensor for tensor in self.tensors if is_image(tensor)]

    def values(self, recording: Recording, name: str) -> Array:
        """Return an input of a recording as (N, A)."""
        return in_memory(recording.inputs[name]).astype(np.float64).reshape(len(recording), -1)

    def normaliser(self, tensor: TensorSpec) -> Normaliser | None:
        """Return the normaliser of an input; None when it has none, or one of another width than its elements."""
        return load_normaliser(tensor, self.bundle) if len(tensor.shape) == 2 else None

    @functools.cached_property
    def matches(self) -> dict[str, Match]:
        """Name of each vector that moves -> how its elements match those of the reference."""
        found = {
            tensor.name: match_vectors(
                self.values(self.log, tensor.name), self.values(self.reference, tensor.name), self.pairings
            )
            for tensor in self.vectors()
        }
        return {name: match for name, match in found.items() if match is not None}

    @functools.cached_property
    def explained_images(self) -> dict[str, tuple[Explanation | None, float]]:
        """Name of each image -> what is wrong with it, and how unlike the reference it is with that."""
        found = {}
        for tensor in self.images():
            same = {each.name: self.reference.inputs[each.name] for each in self.images() if each.shape == tensor.shape}
            found[tensor.name] = explain_images(tensor, self.log.inputs[tensor.name], same, self.pairings)
        return found

    def _width(self, tensor: TensorSpec) -> int:
        return int(np.prod(self.log.inputs[tensor.name].shape[1:]))


def verify_log(bundle: Bundle, options: LogOptions, context: Context) -> Report:
    """Compare a robot's log with a reference, and name what is wired wrong.

    Raises:
        DataError: when the log or the reference cannot be read or does not fit the spec, or there is no reference.
    """
    spec = bundle.manifest.spec
    log = read_recording(options.log, spec)
    context.progress("comparing inputs", None)
    references = [read_recording(path, spec) for path in _references(bundle, options)]
    outcome, paired = explain_inputs(bundle, log, references, own=options.reference is None)
    if bundle.manifest.graphs and not _shifts_actions(spec, outcome.explanations):
        context.progress("comparing commands", None)
        commands = explain_actions(Policy.open(bundle, threads=1, seed=0), log, options.samples)
        outcome = replace(outcome, explanations=_distinct([*outcome.explanations, *commands]))
    return _report(bundle, options, log, outcome, paired)


def _shifts_actions(spec: PolicySpec, found: Sequence[Explanation]) -> bool:
    """Return whether the state that actions are relative to is wrong, which alone makes them other actions."""
    return spec.reference is not None and any(each.signal == spec.reference.name for each in found)


def explain_inputs(
    bundle: Bundle, log: Recording, references: Sequence[Recording], *, own: bool, judge: Judge | None = None
) -> tuple[Outcome, bool]:
    """Return what is wrong with the inputs of a log, and whether its rows are of the same moments as the reference's.

    Args:
        references: recordings of right wiring, of which one may be of the episodes of the log.
        own: whether they are the policy's own.
        judge: what other episodes are compared with, if it was fitted already to one of them.
    """
    spec, wrong = bundle.manifest.spec, list[Explanation]()
    for reference in references:
        signals = Signals(bundle, log, reference, pair_rows(log, reference, spec.control_hz), own)
        if _same_episodes(signals):
            return Outcome(_distinct([*_of_pairs(signals), *_of_statistics(signals)])), True
        wrong += _of_statistics(signals)
    longest = max(references, key=len)
    judge = judge or Judge.of(spec, names_of(spec, log, longest, MAX_WIDTH), longest)
    outcome = judge.explain(log, _scales(signals))
    return replace(outcome, explanations=_distinct([*outcome.explanations, *wrong])), False


def _scales(signals: Signals) -> Scales:
    """Return offset and scale of each vector that is normalised."""
    known = {tensor.name: signals.normaliser(tensor) for tensor in signals.vectors()}
    return {name: scales_of(each) for name, each in known.items() if each is not None}


def _references(bundle: Bundle, options: LogOptions) -> list[Path]:
    own = recordings_of(bundle)
    paths = [options.reference] if options.reference else [own.evaluation, own.calibration]
    if not (known := [path for path in paths if path is not None]):
        raise DataError(f"{bundle.path} carries no recording to compare with.", "pass --reference RECORDING")
    return known


def _distinct(found: Sequence[Explanation]) -> tuple[Explanation, ...]:
    """Return one explanation of each signal and kind."""
    return tuple({(each.signal, each.kind, each.where): each for each in found}.values())


def _same_episodes(signals: Signals) -> bool:
    """Return whether more than half of what can be compared says that the rows are of the same moments."""
    if 0 not in signals.pairings:
        return False
    shares = [match.cost for match in signals.matches.values()]
    shares += [unlike for _, unlike in signals.explained_images.values()]
    near = sum(share < SAME_MOMENT for share in shares)
    near += sum(signals.matches[name].cost >= MAX_UNLIKE for name in _exchanged(signals))
    return 2 * near > len(shares)


def _of_pairs(signals: Signals) -> Iterator[Explanation]:
    """Yield what is wrong where rows of the log and the reference are of the same moments."""
    if 0 not in signals.pairings:
        return
    exchanged = _exchanged(signals)
    yield from exchanged.values()
    matches = signals.matches
    for tensor in signals.vectors():
        if tensor.name in exchanged or tensor.name not in matches:
            continue
        mine, right = (signals.values(each, tensor.name) for each in (signals.log, signals.reference))
        labels = signals.labels(tensor, mine.shape[1])
        yield from explain_vector(
            tensor.name, labels, mine, right, signals.pairings, matches[tensor.name], signals.normaliser(tensor)
        )
    for name in (tensor.name for tensor in signals.tensors if tensor.kind == "text"):
        both = signals.pairings[0]
        sides = (signals.log, both.log), (signals.reference, both.reference)
        yield from explain_paired(
            name, *(in_memory(each.inputs[name])[rows].astype(str).tolist() for each, rows in sides)
        )
    for name, (explanation, unlike) in signals.explained_images.items():
        if explanation is not None:
            yield explanation
        elif unlike > MAX_UNLIKE:
            words = "no known change makes it what was recorded"
            yield Explanation(name, "unexplained", words, unlike, unlike, len(signals.pairings[0]))


def _exchanged(signals: Signals) -> dict[str, Explanation]:
    """Return what takes the place of another signal of its width: name -> explanation."""
    found: dict[str, Explanation] = {}
    same_moment = {0: signals.pairings[0]}
    for tensor in signals.vectors():
        mine = signals.values(signals.log, tensor.name)
        for other in signals.vectors():
            right = signals.values(signals.reference, other.name)
            if other is tensor or mine.shape[1] != right.shape[1]:
                continue
            own = match_vectors(mine, signals.values(signals.reference, tensor.name), same_moment)
            crossed = match_vectors(mine, right, same_moment)
            if own and crossed and crossed.own < BETTER * own.cost and crossed.own < MAX_UNLIKE:
                words = f"it holds '{other.name}'"
                rows = len(signals.pairings[0])
                found[tensor.name] = Explanation(tensor.name, "swapped", words, own.own, crossed.own, rows)
    return found


def _of_statistics(signals: Signals) -> Iterator[Explanation]:
    """Yield inputs whose statistics are not of the data that the policy was trained on."""
    for tensor in signals.vectors():
        normaliser = signals.normaliser(tensor)
        if normaliser is not None:
            right = signals.values(signals.reference, tensor.name)
            labels = signals.labels(tensor, right.shape[1])
            kind = tensor.normalisation
            explanation = explain_statistics(tensor.name, labels, right, normaliser, kind, whole=signals.own)
            if explanation is not None:
                yield explanation


def _report(bundle: Bundle, options: LogOptions, log: Recording, outcome: Outcome, paired: bool) -> Report:
    """Return what was found as a report.

    Its verdict is ``fail`` when a signal is wrong, ``inconclusive`` when something differs that no wrong wiring
    explains, and ``pass`` otherwise.
    """
    name, found = bundle.manifest.name, outcome.explanations
    how = "row by row" if paired else "by what holds in each right episode, since the episodes are others"
    result = f"{len(found)} signals are wired wrong" if len(found) != 1 else "1 signal is wired wrong"
    if outcome.suspicious and not found:
        result = "nothing is proven wrong, but something differs"
    first = f"In {options.log.name}, {result}" if found or outcome.suspicious else f"{options.log.name} fits {name}"
    sentences = (f"{first}: compared {how}, on {amount(len(log), 'row')}.", *(each.sentence() for each in found),
                 *(f"Suspicious: {each}." for each in outcome.suspicious))  # fmt: skip
    worst = max((min(each.before, 1e9) for each in found if each.evidence is None), default=0.0)
    measured = [RELATIVE_ERROR_MAX.measurement(worst, samples=len(log), note="of signals that are wrong")]
    details = {EXPLANATIONS: [each.record() for each in found]} if found else {}
    row = with_identity(Row(name, measurements=tuple(measured), details=details), bundle)
    verdict = "fail" if found else "inconclusive" if outcome.suspicious else "pass"
    return Report("verify", f"Wiring of {name} in {options.log.name}", verdict, sentences, (row,),
                  environment=fingerprint(), warnings=outcome.unseen)  # fmt: skip
