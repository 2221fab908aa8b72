"""Comparison of a policy with its original code, and of a robot's log with recordings of right wiring."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from vlatool.bundle.bundle import Bundle
from vlatool.errors import UsageError
from vlatool.machine.host import fingerprint
from vlatool.measures.actions import ERROR_MAX_OF, RELATIVE_ERROR_MAX
from vlatool.module.factory import factory_file, split_factory
from vlatool.report import Report, Row
from vlatool.stage.base import Context
from vlatool.stage.identity import with_identity
from vlatool.user_code import children, trust

PRELOAD = ("torch", "onnxruntime", "vlatool.verify._compare")
STAGES, ELEMENTS = "stage by stage", "action, element by element"
HOOKS = "let the file define preprocess(observation) and raw(observation) too: then each stage is compared"


@dataclass(frozen=True)
class Options:
    """What is compared.

    Args:
        against: ``original.py:act`` or ``package.module:act``.
        data: recorded observations; the policy's own when None.
        names: name in the spec -> name in ``data``, where they differ.
        samples: observations at most.
        tolerance: largest relative error of an action, of an input and of the network's output.
        seed: seed of the noise that both are given.
    """

    against: str
    data: Path | None = None
    samples: int = 32
    tolerance: float = 1e-3
    seed: int = 0
    names: Mapping[str, str] = field(default_factory=dict)


def verify(bundle: Bundle, options: Options, context: Context) -> Report:
    """Run the policy and the original on the same observations, in a child process, and compare.

    Args:
        bundle: a source bundle, whose torch modules run, or one with graphs.

    Raises:
        SourceError: when the original cannot be imported, fails, or gives something that is not an action.
        DataError: when the observations cannot be read.
    """
    file = factory_file(options.against, Path.cwd())
    if file is not None:
        trust.allow(file.parent)
    job = {
        "bundle": str(bundle.path.absolute()), "against": options.against, "folder": str(Path.cwd()),
        "data": str(options.data.absolute()) if options.data else "",
        "names": dict(options.names), "samples": options.samples,
        "tolerance": options.tolerance, "seed": options.seed,
    }  # fmt: skip
    about = split_factory(options.against)[0]
    comparison = children.call("vlatool.verify._compare:compare", job, context.progress, about, PRELOAD)
    return _report(bundle, options, comparison)


def check(options: Options) -> None:
    """Raise a usage error for invalid options."""
    if not 0 <= options.tolerance < 1:
        raise UsageError(
            f"--tolerance is {options.tolerance:g}; allowed: from 0, below 1.", "give a share such as --tolerance 0.001"
        )


def _report(bundle: Bundle, options: Options, comparison: Mapping[str, Any]) -> Report:
    """Return what was found as a report.

    Its verdict is ``fail`` when the actions differ, and ``inconclusive`` when they are the same as far as the original
    gives them, which is not as far as they are executed.
    """
    name, count, spec = bundle.manifest.name, int(comparison["samples"]), bundle.manifest.spec
    steps, worst = int(comparison["steps"]), float(comparison["error"])
    verdict = "fail" if comparison["differing"] else "inconclusive" if steps < spec.executed_actions else "pass"
    observations = str(comparison["observations"]).removesuffix("s" if count == 1 else "")
    title = f"{name} against {options.against} on {count} {observations}"
    sentences = _sentences(name, options, comparison, verdict, spec.executed_actions)
    compared = f"Compared: {steps} of the {spec.chunk} steps of a chunk, of which {spec.executed_actions} are executed"
    sentences += [f"{compared}, on {count} {observations}."] if spec.chunk > 1 else []
    note = f"action, in physical units, {steps} of {spec.chunk} steps"
    measurements = [RELATIVE_ERROR_MAX.measurement(worst, samples=count, note=note)]
    measurements += [
        ERROR_MAX_OF.quantity(str(element["element"]), str(element["unit"])).measurement(
            float(element["max error"]), samples=count, note="largest |difference|"
        ) for element in comparison["elements"]
    ]  # fmt: skip
    details = {ELEMENTS: list(comparison["elements"]), STAGES: list(comparison["stages"])}
    row = Row(name, measurements=tuple(measurements), details={key: value for key, value in details.items() if value})
    return Report(
        "verify", title, verdict, tuple(sentences), (with_identity(row, bundle),), environment=fingerprint(),
        warnings=tuple(comparison["warnings"]), limits={"tolerance": options.tolerance},
    )  # fmt: skip


def _sentences(name: str, options: Options, comparison: Mapping[str, Any], verdict: str, executed: int) -> list[str]:
    """Return what was found in words, the verdict first."""
    worst, allowed = float(comparison["error"]), options.tolerance
    if verdict == "pass":
        return [f"{name} gives what {options.against} gives: the largest relative error is {worst:.3g} (allowed: "
                f"{allowed:g})."]  # fmt: skip
    if verdict == "inconclusive":
        return [
            f"Whether {name} gives what {options.against} gives is not decided: {comparison['steps']} of the "
            f"{executed} steps that are executed could be compared, which are the same (largest relative error "
            f"{worst:.3g}).",
            f"Let {options.against} return all steps of the chunk that the controller executes.",
        ]
    hooks = [] if comparison["hooks"] or comparison["certain"] else [HOOKS[0].upper() + HOOKS[1:] + "."]
    return [
        f"{name} does not give what {options.against} gives: {comparison['differing']} of {comparison['samples']} "
        f"observations differ by more than {allowed:g}, the first is observation {comparison['first']}; the largest "
        f"relative error is {worst:.3g}.",
        *map(str, comparison["causes"]),
        *hooks,
    ]
