"""How long pruned policies take: each is exported; all take turns in one run here, or are predicted for a board."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np

from vlatool.bundle.bundle import Bundle
from vlatool.errors import RecipeError
from vlatool.hardware.profile import Profile
from vlatool.latency_model.predict import predictions
from vlatool.measurement import agent
from vlatool.measurement.jobs import LatencyJob
from vlatool.module.edits import Edit, apply, concatenate_edits, read_edits
from vlatool.module.stage import write_modules
from vlatool.module.torch_policy import load_modules
from vlatool.stage.base import Context, Transform
from vlatool.stage.build import build_stage

CALLS, SECONDS = 200, 3.0
"""Of each policy in a run, at least."""
UNDISTURBED = 25
"""Percentile of the calls whose ratios are compared: where other programs run, more than half may be held up."""


class Clock:
    """Exports and times what edits leave of a policy, in float32.

    Args:
        source: The policy before the edits.
        scratch: An empty directory.
        engine: Of the runtime; the default one when empty.
        threads: Intra-op threads.
        made_by: For the manifests of what is exported.
        context: For progress.
    """

    def __init__(
        self, source: Bundle, scratch: Path, engine: str, threads: int, made_by: dict[str, Any], context: Context
    ) -> None:
        self._source, self._scratch, self._made_by = source, scratch, made_by
        self._engine, self._threads, self._context = engine, threads, context
        self._exported = 0
        self._whole = self._export(())

    def times(self, pruned: Sequence[Sequence[Edit]]) -> tuple[float, list[float]]:
        """Return the milliseconds of the whole policy, and of it with each list of edits, from one interleaved run.

        They are medians of the whole policy's calls times ratios of lower percentiles, which other programs move less.
        """
        paths = [self._whole, *self._exports(pruned)]
        job = LatencyJob(tuple(map(str, paths)), self._engine, self._threads, CALLS, SECONDS, check=False)
        measured = agent.measure(job, self._context.progress)
        low, *others = (float(np.percentile(policy.samples, UNDISTURBED)) for policy in measured.policies)
        whole = float(np.median(measured.policies[0].samples))
        return whole, [ms / low * whole for ms in others]

    def _exports(self, pruned: Sequence[Sequence[Edit]]) -> Iterator[Path]:
        """Export the policy after each list of edits, and tell how far that is."""
        for number, edits in enumerate(pruned, 1):
            if len(pruned) > 1:
                self._context.progress(f"exporting without some of it: {number} of {len(pruned)}", number / len(pruned))
            yield self._export(edits)

    def _export(self, edits: Sequence[Edit]) -> Path:
        """Return the place of a bundle in ONNX of the policy after edits."""
        self._exported += 1
        made, exported = (self._scratch / f"{self._exported}-{what}" for what in ("modules", "graphs"))
        made.mkdir()
        exported.mkdir()
        modules = apply(load_modules(self._source), edits, self._source)
        everything = concatenate_edits(read_edits(self._source), edits)
        bundle = write_modules(self._source, made, everything, modules, self._made_by)
        stage = cast(Transform, build_stage("export.onnx", {}))
        stage.run(bundle, exported, replace(self._context, progress=lambda _what, _share: None))
        return exported


class BoardClock(Clock):
    """Exports what edits leave of a policy, and predicts how long it takes on a board, in float32.

    Args:
        profile: The board.
        others: What ``Clock`` takes.
    """

    def __init__(self, profile: Profile, *others: Any) -> None:
        self._profile = profile
        super().__init__(*others)

    def times(self, pruned: Sequence[Sequence[Edit]]) -> tuple[float, list[float]]:
        """Return the milliseconds of the whole policy, and of it with each list of edits.

        Raises:
            RecipeError: when the latency model has no ground for this board and engine.
        """
        whole, *others = (self._ms(path) for path in [self._whole, *self._exports(pruned)])
        return whole, others

    def _ms(self, path: Path) -> float:
        number = predictions(self._profile, Bundle.open(path), self._engine)[0]
        if not number.known:
            raise RecipeError(
                f"The latency on {self._profile.name} cannot be predicted: {number.note}.",
                "name another engine of the board (--engine), or prune by work: vlatool prune structured",
            )
        return number.value
