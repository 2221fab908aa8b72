"""A stage that changes a policy's torch modules: their structure, their weights, or both."""

from __future__ import annotations

import contextlib
import json
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from vlatool.bundle.bundle import LOCATION, Bundle, seal
from vlatool.bundle.module_bundle import export_command
from vlatool.bundle.program import ProgramStep
from vlatool.data import OBSERVATIONS_FILE, observations_for
from vlatool.errors import BundleError, GraphError, SourceError, VlatoolError, require
from vlatool.files.printable import amount, message_of
from vlatool.module.description import read_location
from vlatool.module.edits import FOLDER, Edit, apply, concatenate_edits, holds_weights, read_edits, write_module
from vlatool.module.failures import remedy_for
from vlatool.module.fake_weights import as_float32, run_on_fake_tensors
from vlatool.module.memory import refuse_hidden_state
from vlatool.module.sharded_weights import stored_modules, takes_shards, weights_on_demand
from vlatool.module.torch_policy import load_modules, policy_of, torch_policy
from vlatool.runtime.contract import OF_THE_POLICY, off_the_robot
from vlatool.stage.base import Context, Result, Transform
from vlatool.stage.finish import SEED, carry_over, history, save_npz
from vlatool.stage.record import made_by

if TYPE_CHECKING:
    from torch import nn

    from vlatool.hardware.profile import Profile


TRAINING = f"{FOLDER}/training.json"
PRUNE_LESS = "prune less, or leave out what it names; VLATOOL_DEBUG=1 shows where it was raised"
MAX_RUN_BYTES = 1 << 32
"""Bytes of weights in shards up to which the changed policy is run on them; above, shapes alone go through it."""


@dataclass(frozen=True)
class ModuleChanges:
    """What a stage did to modules, beside the weights that it changed in place.

    Args:
        edits: what is kept of the structure; the caller cuts the modules.
        training: how they were trained, as JSON values: ``losses`` of the steps, ``rounds`` of data; None when not.
        program: how the graphs run from now on; as before when None.
        played: observations that they were trained on, for the ranges of activations, name -> (N, ...); none when None.
        options: what the stage found out on this machine, under names of options of its own, so that it is made again
            in the same way wherever that is done.
        record: what it came to, for the record of the bundle, as JSON values.
        messages: sentences on what was done.
    """

    edits: tuple[Edit, ...] = ()
    training: Mapping[str, Any] | None = None
    program: tuple[ProgramStep, ...] | None = None
    played: Mapping[str, Any] | None = None
    options: Mapping[str, Any] = field(default_factory=dict)
    record: Mapping[str, Any] = field(default_factory=dict)
    messages: tuple[str, ...] = ()


class ModuleStage(Transform):
    """Takes a source bundle of a torch policy, or what such a stage made of it; runs before the export."""

    packages: ClassVar[tuple[str, ...]] = ("torch", "safetensors", "numpy")
    takes_modules: ClassVar[bool] = True
    keeps_weights: ClassVar[bool] = False
    """Whether it takes whole blocks away or changes the program alone, so that weights in shards can stay there."""
    leaves_zeros: ClassVar[bool] = False
    """Whether it sets single weights to zero, which a training after it keeps as they are."""

    def check(self, source: Bundle | None, profile: Profile | None) -> None:
        """The bundle has modules, and no graphs yet."""
        if source is not None and (source.manifest.graphs or "factory" not in source.manifest.source):
            raise BundleError(
                f"{source.path} has no torch modules that {self.name()} could change: it is exported, or an ONNX file.",
                "name the policy that it was made from",
            )

    def change(self, modules: Mapping[str, nn.Module], source: Bundle, context: Context) -> ModuleChanges:
        """Change weights in place, and return further changes; ``source`` is the bundle with the recordings."""
        raise NotImplementedError(self.name())

    def in_parts(self) -> bool:
        """Return whether ``change`` needs no more than one weight at a time, and no gradient."""
        return False

    def run(self, source: Bundle, out: Path, context: Context) -> Result:
        """Change the modules, write them, and run the policy once."""
        require("torch", "build")
        if self.keeps_weights and takes_shards(source):
            result = self._write(source, out, self._chosen_on_shards(source, context), {}, context)
            _run_once(result.bundle)
            return result
        result = self._change_and_write(source, out, context)
        changed = result.bundle
        answered = off_the_robot("the first observation", OF_THE_POLICY)
        with answered, _name_bad_weights(lambda: load_modules(changed)):
            torch_policy(changed, SEED).infer(observations_for(changed, 1)[0])
        return result

    def _change_and_write(self, bundle: Bundle, out: Path, context: Context) -> Result:
        """Change the modules and write them; nothing keeps them while what was written runs."""
        modules = load_modules(bundle)
        refuse_hidden_state(bundle, modules)
        done = self.change(modules, bundle, context)
        return self._write(bundle, out, done, apply(modules, done.edits, bundle), context)

    def _chosen_on_shards(self, bundle: Bundle, context: Context) -> ModuleChanges:
        """Return what is to be changed; no more than one weight is in memory, unless the choice needs all."""
        if not self.in_parts():
            return self.change(load_modules(bundle), bundle, context)
        stored = stored_modules(bundle)
        with weights_on_demand(stored):
            return self.change(stored.modules, bundle, context)

    def _write(
        self, bundle: Bundle, out: Path, done: ModuleChanges, modules: Mapping[str, nn.Module], context: Context
    ) -> Result:
        """Write what was changed, with the modules; without them, where the weights stay in shards."""
        recorded = made_by(self)
        recorded |= {"options": {**recorded["options"], **done.options}, **done.record}
        edits = concatenate_edits(read_edits(bundle), done.edits)
        changed = write_modules(bundle, out, edits, modules, recorded, done)
        context.progress("running the changed policy", None)
        return Result(changed, done.messages)


@contextlib.contextmanager
def _name_bad_weights(modules: Callable[[], Mapping[str, nn.Module]]) -> Iterator[None]:
    """Say of an answer that is not finite which weight makes it so, where one does."""
    try:
        yield
    except GraphError as error:
        for graph, module in modules().items():
            for name, value in module.named_parameters():
                if wrong := int((~value.detach().isfinite()).sum()):
                    raise SourceError(
                        f"The policy's weight '{name}' of '{graph}' is not finite in {wrong:,} of {value.numel():,} "
                        "values, and so is what the policy gives.",
                        "take weights from before the training that broke them",
                    ) from error
        raise


def describe_modules(bundle: Bundle) -> tuple[str, ...]:
    """Return how large the modules of a bundle without graphs are, and how to go on."""
    size = sum(record.bytes for name, record in bundle.manifest.files.items() if name.endswith(".safetensors"))
    folder, edits = read_location(bundle.path), _structure(bundle)
    export = export_command(bundle.path)
    if not holds_weights(bundle):
        streams = f"vlatool quantize weight-only {bundle.path} -o BUNDLE --trust {folder}"
        stay = f"weights stay in the shards in {folder}, {edits}; not exported yet:"
        return (stay, export, f"{streams}    # one weight in memory at a time")
    return (f"weights {size / 1e6:.2f} MB, {edits}; not exported yet:", export)


def _structure(bundle: Bundle) -> str:
    """Say how much of the structure is not as the policy's own code makes it."""
    edits = len(read_edits(bundle))
    told = f"{edits or 'no'} structural edit{'s' if edits != 1 else ''}"
    fewer = any(entry.get("stage") == "prune.steps" for entry in bundle.manifest.build)
    turns = [step.repeat for step in bundle.manifest.program if fewer and step.carry]
    return ", ".join([told, *(f"{amount(count, 'denoising step')}" for count in turns)])


def _run_once(bundle: Bundle) -> None:
    """Run a policy whose weights are in shards: with their values where that is quick, with shapes alone else."""
    stored = stored_modules(bundle)
    if stored.nbytes < MAX_RUN_BYTES:
        answered = off_the_robot("the first observation", OF_THE_POLICY)
        with weights_on_demand(stored), answered, _name_bad_weights(lambda: stored.modules):
            policy_of(bundle, stored.modules, SEED).infer(observations_for(bundle, 1)[0])
        return
    try:
        run_on_fake_tensors(bundle, as_float32(stored.modules), lambda *_: None)
    except VlatoolError:
        raise
    except Exception as error:  # the seam: the user's module may raise anything
        reason = (message_of(error).splitlines() or [""])[0]
        raise SourceError(
            f"The changed policy fails: {type(error).__name__}: {reason}.", remedy_for(error) or PRUNE_LESS
        ) from error


def write_modules(
    source: Bundle,
    out: Path,
    edits: Sequence[Edit],
    modules: Mapping[str, nn.Module],
    made_by: dict[str, Any],
    done: ModuleChanges | None = None,
) -> Bundle:
    """Write a source bundle with other modules.

    Args:
        out: an empty directory.
        edits: all edits since the factory.
        modules: graph name -> module after the edits; none where the weights are those of the policy's shards.
        done: training, program and observations played; as in the source when None.
    """
    done = done or ModuleChanges()
    write_module(out, edits, modules)
    if done.training is not None:
        (out / TRAINING).write_text(json.dumps(done.training) + "\n", encoding="utf-8")
    carry_over(source, out)
    if done.played is not None:
        (out / OBSERVATIONS_FILE).parent.mkdir(exist_ok=True)
        (out / OBSERVATIONS_FILE).unlink(missing_ok=True)  # carried over, it may be the file of the bundle before
        save_npz(out / OBSERVATIONS_FILE, done.played)
    shutil.copyfile(source.path / LOCATION, out / LOCATION)
    build = (*history(source), {**made_by, "input": source.hash})
    program = source.manifest.program if done.program is None else done.program
    return seal(out, replace(source.manifest, program=program, parent=source.hash, made_by=made_by, build=build))
