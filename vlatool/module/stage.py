"""A stage that changes a policy's torch modules: their structure, their weights, or both."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from vlatool.bundle.bundle import LOCATION, Bundle, seal
from vlatool.bundle.program import ProgramStep
from vlatool.data import observations_for
from vlatool.errors import BundleError, require
from vlatool.module.description import read_location
from vlatool.module.edits import FOLDER, Edit, apply, joined_edits, read_edits, write_module
from vlatool.module.origin import factory_of
from vlatool.module.torch_policy import load_modules, torch_policy
from vlatool.stage.base import Context, Transform, source_of
from vlatool.stage.finish import SEED, carry_over, history

if TYPE_CHECKING:
    from torch import nn

    from vlatool.hardware.profile import Profile


TRAINING = f"{FOLDER}/training.json"


@dataclass(frozen=True)
class Changed:
    """What a stage did to modules, beside the weights that it changed in place.

    Args:
        edits: What is kept of the structure; the caller cuts the modules.
        training: How they were trained, as JSON values: ``losses`` of the steps, ``rounds`` of data; None when not.
        program: How the graphs run from now on; as before when None.
        options: What the stage found out on this machine, under names of options of its own, so that it is made again
            in the same way wherever that is done.
    """

    edits: tuple[Edit, ...] = ()
    training: Mapping[str, Any] | None = None
    program: tuple[ProgramStep, ...] | None = None
    options: Mapping[str, Any] = field(default_factory=dict)


class ModuleStage(Transform):
    """Takes a source bundle of a torch policy, or what such a stage made of it; runs before the export."""

    packages: ClassVar[tuple[str, ...]] = ("torch", "safetensors", "numpy")
    takes_modules: ClassVar[bool] = True

    def check(self, source: Bundle | None, profile: Profile | None) -> None:
        """The bundle has modules, and no graphs yet."""
        if source is not None and (source.manifest.graphs or "factory" not in source.manifest.source):
            raise BundleError(
                f"{source.path} has no torch modules that {self.name()} could change: it is exported, or an ONNX file.",
                "name the policy that it was made from",
            )

    def runs(self, source: Bundle | None) -> str:
        """The policy's factory is called."""
        return factory_of(source)

    def change(self, modules: Mapping[str, nn.Module], source: Bundle, context: Context) -> Changed:
        """Change weights in place, and return what else is to be changed.

        Args:
            modules: Graph name -> module, as the source has it.
            source: For recordings.
            context: For progress.
        """
        raise NotImplementedError(self.name())

    def lines(self, bundle: Bundle) -> tuple[str, ...]:
        """Return how large the modules are, and how to go on."""
        size = sum(record.bytes for name, record in bundle.manifest.files.items() if name.endswith(".safetensors"))
        folder = read_location(bundle.path)
        return (
            f"weights {size / 1e6:.2f} MB, {len(read_edits(bundle))} structural edits; not exported yet:",
            f"vlatool export {bundle.path} -o BUNDLE --trust {folder}",
        )

    def run(self, source: Bundle | None, out: Path, context: Context) -> Bundle:
        """Change the modules, write them, and run the policy once."""
        require("torch", "build")
        bundle = source_of(source, self.name())
        self.check(bundle, None)
        modules = load_modules(bundle)
        done = self.change(modules, bundle, context)
        modules = apply(modules, done.edits, bundle)
        made_by = self.made_by()
        made_by["options"] = {**made_by["options"], **done.options}
        edits = joined_edits(read_edits(bundle), done.edits)
        changed = write_changed(bundle, out, edits, modules, made_by, done.training, done.program)
        context.tell("running the changed policy", None)
        torch_policy(changed, SEED).infer(observations_for(changed, 1)[0])
        return changed


def write_changed(
    source: Bundle,
    out: Path,
    edits: Sequence[Edit],
    modules: Mapping[str, nn.Module],
    made_by: dict[str, Any],
    training: Mapping[str, Any] | None = None,
    program: tuple[ProgramStep, ...] | None = None,
) -> Bundle:
    """Write a source bundle with other modules.

    Args:
        source: What it is made from.
        out: An empty directory.
        edits: All edits since the factory.
        modules: Graph name -> module after the edits.
        made_by: Stage, options and versions.
        training: How they were trained, if they were.
        program: How they run; as in the source when None.
    """
    write_module(out, edits, modules)
    if training is not None:
        (out / TRAINING).write_text(json.dumps(training) + "\n", encoding="utf-8")
    carry_over(source, out)
    shutil.copyfile(source.path / LOCATION, out / LOCATION)
    build = (*history(source), {**made_by, "input": source.hash})
    program = source.manifest.program if program is None else program
    return seal(out, replace(source.manifest, program=program, parent=source.hash, made_by=made_by, build=build))
