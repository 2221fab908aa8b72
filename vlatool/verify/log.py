"""Is the robot wired right? A raw log of what it fed and did, against a recording of what the policy was trained on."""

from __future__ import annotations

import functools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vlatool.bundle.bundle import Bundle
from vlatool.bundle.spec import PolicySpec, TensorSpec
from vlatool.data import Recording, read_recording, recordings_of
from vlatool.errors import DataError
from vlatool.machine.host import fingerprint
from vlatool.measures.actions import RELATIVE_ERROR_MAX
from vlatool.report import Report, Row
from vlatool.runtime.policy import Policy
from vlatool.runtime.statistics import Normaliser, load_normaliser
from vlatool.stage.base import Context
from vlatool.stage.identity import with_identity
from vlatool.verify._actions import explain_actions, in_memory
from vlatool.verify._distributions import explain_moments, explain_statistics
from vlatool.verify._explanation import Explanation
from vlatool.verify._images import explain_images, is_image
from vlatool.verify._pairing import Pairs, pair_rows
from vlatool.verify._vectors import BETTER, MAX_UNLIKE, Match, explain_vector, match_vectors

Array = NDArray[np.float64]
EXPLANATIONS = "explanations"
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
    found, paired = explain_inputs(bundle, log, references, own=options.reference is None)
    if bundle.manifest.graphs and not _shifts_actions(spec, found):
        context.progress("comparing commands", None)
        found += explain_actions(Policy.open(bundle, threads=1, seed=0), log, options.samples)
    return _report(bundle, options, log, found, paired)


def _shifts_actions(spec: PolicySpec, found: Sequence[Explanation]) -> bool:
    """Return whether the state that actions are relative to is wrong, which alone makes them other actions."""
    return spec.reference is not None and any(each.signal == spec.reference.name for each in found)


def explain_inputs(
    bundle: Bundle, log: Recording, references: Sequence[Recording], *, own: bool
) -> tuple[list[Explanation], bool]:
    """Return what is wrong with the inputs of a log, and whether its rows are of the same moments as the reference's.

    Args:
        references: recordings of right wiring, of which one may be of the episodes of the log.
        own: whether they are the policy's own.
    """
    found: list[Explanation] = []
    for reference in references:
        pairings = pair_rows(log, reference, bundle.manifest.spec.control_hz)
        signals = Signals(bundle, log, reference, pairings, own)
        if _same_episodes(signals):
            return _distinct([*_of_pairs(signals), *_of_statistics(signals)]), True
        found += [*_of_distributions(signals), *_of_statistics(signals)]
    return _distinct(found), False


def _references(bundle: Bundle, options: LogOptions) -> list[Path]:
    own = recordings_of(bundle)
    paths = [options.reference] if options.reference else [own.evaluation, own.calibration]
    if not (known := [path for path in paths if path is not None]):
        raise DataError(f"{bundle.path} carries no recording to compare with.", "pass --reference RECORDING")
    return known


def _distinct(found: Sequence[Explanation]) -> list[Explanation]:
    """Return one explanation of each signal and kind."""
    return list({(each.signal, each.kind, each.where): each for each in found}.values())


def _same_episodes(signals: Signals) -> bool:
    """Return whether at least half of what can be compared says that the rows are of the same moments."""
    if 0 not in signals.pairings:
        return False
    shares = [match.cost for match in signals.matches.values()]
    shares += [unlike for _, unlike in signals.explained_images.values()]
    near = sum(share < MAX_UNLIKE for share in shares)
    near += sum(signals.matches[name].cost >= MAX_UNLIKE for name in _exchanged(signals))
    return near > 0 and 2 * near >= len(shares)


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


def _of_distributions(signals: Signals) -> Iterator[Explanation]:
    """Yield what means and spreads alone tell, where the episodes are others."""
    for tensor in signals.vectors():
        mine, right = (signals.values(each, tensor.name) for each in (signals.log, signals.reference))
        labels = signals.labels(tensor, mine.shape[1])
        explanation = explain_moments(tensor.name, labels, mine, right, signals.normaliser(tensor))
        if explanation is not None and np.dtype(tensor.dtype).kind == "f":
            yield explanation


def _of_statistics(signals: Signals) -> Iterator[Explanation]:
    """Yield inputs whose statistics are not of the data that the policy was trained on."""
    for tensor in signals.vectors():
        normaliser = signals.normaliser(tensor)
        if normaliser is not None and tensor.normalisation == "mean_std":
            right = signals.values(signals.reference, tensor.name)
            labels = signals.labels(tensor, right.shape[1])
            explanation = explain_statistics(tensor.name, labels, right, normaliser, whole=signals.own)
            if explanation is not None:
                yield explanation


def _report(bundle: Bundle, options: LogOptions, log: Recording, found: Sequence[Explanation], paired: bool) -> Report:
    """Return what was found as a report: ``fail`` when a signal is wrong, ``pass`` otherwise."""
    name = bundle.manifest.name
    how = "row by row" if paired else "by means and spreads, since the episodes are others"
    result = f"{len(found)} signals are wired wrong" if len(found) != 1 else "1 signal is wired wrong"
    first = f"{options.log.name} fits {name}" if not found else f"In {options.log.name}, {result}"
    sentences = (f"{first}: compared {how}, on {len(log)} rows.", *(each.sentence() for each in found))
    unseen = () if paired else (
        "delays, and most signs and orders, are seen only in a log of episodes that the reference holds, too: replay "
        "one on the robot, and pass it with --reference",
    )  # fmt: skip
    worst = max((min(each.before, 1e9) for each in found), default=0.0)
    measured = [RELATIVE_ERROR_MAX.measurement(worst, samples=len(log), note="of signals that are wrong")]
    details = {EXPLANATIONS: [each.record() for each in found]} if found else {}
    row = with_identity(Row(name, measurements=tuple(measured), details=details), bundle)
    return Report("verify", f"Wiring of {name} in {options.log.name}", "fail" if found else "pass", sentences, (row,),
                  environment=fingerprint(), warnings=unseen)  # fmt: skip
