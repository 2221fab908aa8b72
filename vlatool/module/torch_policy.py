"""Run a policy's torch modules through the same program as its graphs."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vlatool.bundle.bundle import Bundle
from vlatool.bundle.program import ProgramStep
from vlatool.errors import require
from vlatool.module.batched_program import run_module
from vlatool.module.edits import apply_bundle, is_changed, load_tensors, read_tensors
from vlatool.module.modules import modules_of
from vlatool.module.origin import origin_of
from vlatool.module.sharded_weights import fill_modules, stored_modules, takes_shards
from vlatool.runtime.policy import Policy
from vlatool.runtime.program import Program
from vlatool.weights.shards import read_header, shard_files

if TYPE_CHECKING:
    from torch import nn


def load_modules(source: Bundle) -> dict[str, nn.Module]:
    """Build the modules of a source bundle, in evaluation mode: graph name -> module.

    They are what the factory makes, changed by the edits of the bundle, with the weights of the bundle.

    Raises:
        SourceError: when the code has changed since the bundle was made, or gives something else than modules.
    """
    if is_changed(source) and takes_shards(source):
        require("torch", "build")
        origin_of(source).check()
        return fill_modules(stored_modules(source))
    return apply_bundle(unedited_modules(source), source)


def unedited_modules(source: Bundle) -> dict[str, nn.Module]:
    """Build the factory's modules without the bundle's changes: graph name -> module; raises as ``load_modules``."""
    require("torch", "build")
    origin = origin_of(source)
    origin.check()
    modules = modules_of(origin.build(), sorted({step.graph for step in source.manifest.program}))
    if origin.weights:
        for name, module in modules.items():
            _load_weights(name, module, origin.folder, origin.weights)
    return modules


def _load_weights(graph: str, module: nn.Module, folder: Path, pattern: str) -> None:
    """Fill a module from shards whose tensors are named as in ``state_dict()``, or ``GRAPH.`` before that."""
    stored: dict[str, Any] = {}
    for file in shard_files(folder, pattern):
        read_header(file)
        stored.update(read_tensors(file))
    load_tensors(graph, module, stored, str(folder / pattern))


def torch_policy(source: Bundle, seed: int | None = None) -> Policy:
    """Open a source bundle in eager torch behind the interface of the runtime's policy.

    Args:
        seed: seed of the program's noise, from which every ``reset`` starts again; fresh entropy when None.
    """
    return policy_of(source, load_modules(source), seed)


def policy_of(source: Bundle, modules: Mapping[str, nn.Module], seed: int | None = None) -> Policy:
    """Open modules behind the interface of the runtime's policy, as ``torch_policy`` does."""
    sessions = {step.graph: TorchSession(modules[step.graph], step) for step in source.manifest.program}
    return Policy(source, Program(source.manifest.program, sessions, seed), "torch eager")


class TorchSession:
    """One torch module behind the session interface; remembers the feeds of its first run and of the last two.

    Args:
        module: the module; takes the feeds positionally in the order of ``step.feeds``.
    """

    def __init__(self, module: nn.Module, step: ProgramStep) -> None:
        self.module = module
        self.step = step
        self.first_feeds: dict[str, Any] | None = None
        self.last_feeds: deque[Mapping[str, Any]] = deque(maxlen=2)

    def run(self, feeds: Mapping[str, Any]) -> Mapping[str, Any]:
        """Run the module on numpy arrays; raises SourceError as ``run_module`` does."""
        torch = require("torch", "build")
        if self.first_feeds is None:
            self.first_feeds = dict(feeds)
        self.last_feeds.append(dict(feeds))
        arguments = [torch.from_numpy(np.array(feeds[name])) for name in self.step.feeds]  # it may change them
        with torch.inference_mode():
            outputs = run_module(self.module, self.step, arguments)
        wide = (value.float() if value.dtype == torch.bfloat16 else value for value in outputs)  # numpy has no bfloat16
        return {name: value.numpy() for name, value in zip(self.step.gives, wide, strict=True)}
