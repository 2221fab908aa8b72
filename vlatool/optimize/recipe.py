"""A recipe: what ``optimize`` does with a policy, as YAML that a person can read, keep and repeat."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import Any

from pydantic import ConfigDict, Field, ValidationError, model_validator

from vlatool.errors import RecipeError, require
from vlatool.files.numbers import Numeric
from vlatool.files.printable import reason_of
from vlatool.files.yaml import read_mapping
from vlatool.machine.instruction_sets import saturates
from vlatool.runtime.engine import DEFAULT_ENGINE, class_for

StageList = tuple[dict[str, dict[str, Any]], ...]
"""Stages in order, each a mapping of one name to its options."""


class Limits(Numeric):
    """What a candidate must keep to."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    max_drop: float = Field(0.01, ge=0, le=1, description="largest drop against float32, a share (0.01 = 1 point)")
    max_distance: float = Field(
        0.25,
        ge=0,
        description="largest distance from float32's own actions: mean |difference| / standard deviation, "
        "or the share of other answers",
    )
    max_motion: float | None = Field(
        None, ge=0, description="largest growth of jerk, path and task time where both succeed, a share (0.05 = 5 %)"
    )
    worst_task: float | None = Field(
        None, ge=0, le=1, description="largest drop of the task that loses most, a share (0.03 = 3 points)"
    )
    min_task_share: float = Field(
        0.95, ge=0, le=1, description="least share of an inference's speed-up that is left when steps are counted"
    )
    metric: str = Field("", description="a measurement that decides instead, such as relative_error, or unit:m")
    max_metric: float | None = Field(None, ge=0, description="largest value of that measurement")
    hz: float | None = Field(None, gt=0, description="inferences per second")
    max_latency_ms: float | None = Field(None, gt=0, description="largest latency of one inference")
    max_memory_mb: float | None = Field(None, gt=0, description="largest memory of the process, 10^6 bytes")

    accept: tuple[str, ...] = Field((), description="findings of a bundle that are overruled, by name")

    @model_validator(mode="after")
    def _metric_has_a_bound(self) -> Limits:
        if bool(self.metric) != (self.max_metric is not None):
            raise ValueError("metric and max_metric belong together")
        return self

    @property
    def latency_ms(self) -> float | None:
        """What one inference may take, by rate and latency."""
        limits = [1000.0 / self.hz] if self.hz else []
        limits += [self.max_latency_ms] if self.max_latency_ms else []
        return min(limits) if limits else None


class Effort(Numeric):
    """How much is measured."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    episodes: int = Field(200, ge=0, description="closed-loop episodes of each candidate; 0 for none")
    environment_timeout: float = Field(
        0.0, ge=0, le=1e6, description="seconds that a call of the environment may take; when 0, what policy.yaml says"
    )
    iterations: int = Field(200, ge=20, description="timed inferences of each candidate")
    threads: int = Field(1, ge=1, description="intra-op threads while timing")
    every_candidate: bool = Field(
        False, description="play the episodes of every candidate, also of those that a faster one rules out"
    )


class Pruning(Numeric):
    """What is tried of pruned policies; each is trained to do what the whole one does, then quantized."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    trials: int = Field(0, ge=0, le=10_000, description="policies that are pruned, trained and tried; 0 for none")
    study: str = Field("", description="URL or file that keeps the trials, so that several machines share them")
    recover: StageList = Field(({"distill.policy": {}},), description="what trains a pruned policy")
    episodes: int = Field(300, ge=1, description="closed-loop episodes of each trial")
    least: float = Field(0.25, gt=0, lt=1, description="share of the work of a policy that stays in any case")
    seed: int = Field(0, ge=0, description="of what is tried next")


class Recipe(Numeric):
    """Export, candidates and limits of one ``optimize`` run."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    schema_: int = Field(1, alias="schema", ge=1, le=1)
    export: StageList = ({"export.onnx": {}},)
    candidates: dict[str, StageList] = Field(min_length=1)
    search: bool = False
    pruning: Pruning = Pruning()
    limits: Limits = Limits()
    effort: Effort = Effort()

    def to_yaml(self) -> str:
        """Return YAML that ``read_recipe`` turns back into an equal recipe."""
        yaml = require("yaml", "build")
        plain = self.model_dump(mode="json", by_alias=True)
        text: str = yaml.safe_dump(plain, sort_keys=False, default_flow_style=False)
        return text


def default_recipe(
    limits: Limits, effort: Effort, calibrated: bool, engine: str = DEFAULT_ENGINE, features: Collection[str] = ()
) -> Recipe:
    """Return the candidates that are tried when the user names none.

    Args:
        calibrated: Whether the policy brings calibration data, without which static quantization is impossible.
        engine: The engine of the board. One that is searched brings its own plans; others get standard QDQ operators
            with symmetric int8, as does one that vlatool does not run.
        features: Of the processor that it runs on, as ``/proc/cpuinfo`` names them: whether int8 products saturate.
    """
    library = class_for(engine)
    weights = {"reduce_range": True} if saturates(features) else {}
    own, layout = library.searched, {**library.int8, **weights}
    candidates: dict[str, StageList] = {}
    if own or not calibrated:
        candidates["dynamic_int8"] = ({"quantize.dynamic_int8": dict(weights)},)
    if calibrated:
        candidates["static_int8"] = ({"quantize.static_int8": layout},)
        if not own:
            candidates["static_int8_percentile"] = ({"quantize.static_int8": {"method": "percentile", **layout}},)
    return Recipe(candidates=candidates, search=own, limits=limits, effort=effort)


def read_recipe(path: Path) -> Recipe:
    """Read a recipe file; raises RecipeError with every problem: missing, not YAML, impossible values."""
    if not path.exists():
        raise RecipeError(
            f"There is no recipe {path}.", "check the path; the output of vlatool optimize holds a recipe.yaml"
        )
    data = read_mapping(path, f"The recipe {path}", RecipeError)
    try:
        return Recipe.model_validate(data)
    except ValidationError as error:
        problems = [
            f"{'.'.join(map(str, item['loc'])) or 'recipe'}: {reason_of(item['msg'])}" for item in error.errors()
        ]
        raise RecipeError(f"The recipe {path}: {'; '.join(problems)}.", "correct it in the file") from error


def stage_entries(stages: StageList) -> list[tuple[str, dict[str, Any]]]:
    """Return (name, options) of each stage; raises RecipeError for an entry that does not map one name to options."""
    entries: list[tuple[str, dict[str, Any]]] = []
    for entry in stages:
        if len(entry) != 1:
            raise RecipeError(
                f"A stage is one name with its options; got {entry}.",
                "write it as '- quantize.static_int8: {exclude: [head*]}', or as the name alone",
            )
        entries.extend(entry.items())
    return entries
