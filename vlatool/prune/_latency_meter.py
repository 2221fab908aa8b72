"""Latency of pruned policies: exported, then measured in one interleaved run here, or predicted for a board."""

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

MIN_CALLS, MIN_SECONDS = 200, 3.0
"""Least measurement of each policy in a run."""
RATIO_PERCENTILE = 25
"""Percentile of the calls whose ratios are compared: other programs may slow down more than half of them."""


class LatencyMeter:
    """Exports and measures a policy after edits, in float32.

    Args:
        source: The policy before the edits.
        scratch: An empty directory.
        engine: Engine of the runtime; the default one when empty.
        made_by: Entry for the manifests of the exports.
    """

    def __init__(
        self, source: Bundle, scratch: Path, engine: str, threads: int, made_by: dict[str, Any], context: Context
    ) -> None:
        self._source, self._scratch, self._made_by = source, scratch, made_by
        self._engine, self._threads, self._context = engine, threads, context
        self._exported = 0
        self._unpruned = self._export(())

    def times(self, edit_lists: Sequence[Sequence[Edit]]) -> tuple[float, list[float]]:
        """Return the milliseconds of the unpruned policy, and of each list of edits, from one interleaved run.

        They are medians of the unpruned policy's calls times ratios of lower percentiles, which are less disturbed.
        """
        paths = [self._unpruned, *self._export_each(edit_lists)]
        job = LatencyJob(tuple(map(str, paths)), self._engine, self._threads, MIN_CALLS, MIN_SECONDS, check=False)
        measured = agent.measure(job, self._context.progress)
        low, *others = (float(np.percentile(policy.samples, RATIO_PERCENTILE)) for policy in measured.policies)
        whole = float(np.median(measured.policies[0].samples))
        return whole, [ms / low * whole for ms in others]

    def _export_each(self, edit_lists: Sequence[Sequence[Edit]]) -> Iterator[Path]:
        """Export the policy after each list of edits, with progress."""
        for number, edits in enumerate(edit_lists, 1):
            if len(edit_lists) > 1:
                self._context.progress(f"exporting a trial: {number} of {len(edit_lists)}", number / len(edit_lists))
            yield self._export(edits)

    def _export(self, edits: Sequence[Edit]) -> Path:
        """Return the path of an ONNX bundle of the policy after edits."""
        self._exported += 1
        modules_dir, graphs_dir = (self._scratch / f"{self._exported}-{what}" for what in ("modules", "graphs"))
        modules_dir.mkdir()
        graphs_dir.mkdir()
        modules = apply(load_modules(self._source), edits, self._source)
        everything = concatenate_edits(read_edits(self._source), edits)
        bundle = write_modules(self._source, modules_dir, everything, modules, self._made_by)
        stage = cast(Transform, build_stage("export.onnx", {}))
        stage.run(bundle, graphs_dir, replace(self._context, progress=lambda _what, _share: None))
        return graphs_dir


class LatencyPredictor(LatencyMeter):
    """Exports a policy after edits and predicts its float32 latency on a board; takes what ``LatencyMeter`` takes."""

    def __init__(self, profile: Profile, *others: Any) -> None:
        self._profile = profile
        super().__init__(*others)

    def times(self, edit_lists: Sequence[Sequence[Edit]]) -> tuple[float, list[float]]:
        """Return the milliseconds of the unpruned policy, and of each list of edits."""
        whole, *others = (self._ms(path) for path in [self._unpruned, *self._export_each(edit_lists)])
        return whole, others

    def _ms(self, path: Path) -> float:
        number = predictions(self._profile, Bundle.open(path), self._engine)[0]
        if not number.known:
            raise RecipeError(
                f"The latency on {self._profile.name} cannot be predicted: {number.note}.",
                "name another engine of the board (--engine), or prune by work: vlatool prune structured",
            )
        return number.value
