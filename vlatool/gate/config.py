"""A gate: what a candidate may cost against a baseline, as YAML that a repository keeps."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from pydantic import AliasChoices, ConfigDict, Field, ValidationError, model_validator

from vlatool import registry
from vlatool.errors import RecipeError, require
from vlatool.files.numbers import Numeric
from vlatool.files.yaml import read_mapping
from vlatool.stats.percentiles import PERCENTILES
from vlatool.stats.sequential import ALPHA, INTERIM_ANALYSES
from vlatool.stats.signed_rank import min_differences

OF_EPISODES = ("motion", "task_time", "worst_task", "disturbed")
"""Claims about the closed-loop episodes that the claim of accuracy names."""


class _Claim(Numeric):
    model_config = ConfigDict(frozen=True, extra="forbid")


class LatencyClaim(_Claim):
    """The candidate is not slower than the baseline by more than a margin; both run side by side in fresh processes."""

    margin: float = Field(0.05, ge=0, le=10, description="largest slowdown of median and mean, a share (0.05 = 5 %)")
    interim_analyses: tuple[int, ...] = Field(
        INTERIM_ANALYSES,
        validation_alias=AliasChoices("interim_analyses", "looks"),
        description="processes after which it is judged; the last one ends it (looks in older files)",
    )
    pairs: int = Field(150, ge=30, description="calls of each bundle in a process")
    warmup: int = Field(20, ge=1, description="calls of each bundle before the first that counts")
    seconds: float = Field(10.0, gt=0, description="after which a process begins no further pair (at least 30 of them)")
    worst: float = Field(0.5, ge=0, le=100, description="largest slowdown on any one observation, seen again and again")
    threads: int = Field(1, ge=1, description="intra-op threads, for every claim; state those of the robot")
    also_threads: tuple[Annotated[int, Field(ge=1)], ...] = Field(
        (), description="further numbers of threads, for each of which the same is claimed of the latency"
    )
    engine: str = Field("", description="engine of the runtime; the one that each bundle was made for when empty")
    timeout: float = Field(1800.0, gt=0, description="seconds after which a process that hangs ends, and the gate so")

    @model_validator(mode="after")
    def _an_analysis_can_decide(self) -> LatencyClaim:
        after = self.interim_analyses
        least = min_differences(ALPHA / 2 / len(after)) if after else 1  # the median and the mean share it
        if not after or list(after) != sorted(set(after)) or after[0] < least:
            raise ValueError(f"interim_analyses must ascend and begin at {least} or later, or none of them can decide")
        return self


class AccuracyClaim(_Claim):
    """The candidate is not worse than the baseline by more than a drop, on the same data or the same episodes."""

    max_drop: float = Field(0.01, ge=0, le=1, description="largest drop, a share (0.01 = 1 point)")
    data: Path | None = Field(None, description="recorded observations and actions; the baseline's own when not given")
    episodes: int = Field(0, ge=0, description="closed-loop episodes over all tasks; 0 for recorded observations alone")
    policy: Path | None = Field(None, description="directory of the policy.yaml that names environment and tasks")


class MotionClaim(_Claim):
    """The candidate moves no more roughly, and no farther, where both succeed (needs ``accuracy: episodes``)."""

    margin: float = Field(0.1, ge=0, le=10, description="largest growth of each metric, a share (0.1 = 10 %)")
    metrics: tuple[str, ...] = Field(
        (), description="metrics of motion; paths and jerk of what the environment tells when empty, or action rate"
    )

    @model_validator(mode="after")
    def _metrics_are_known(self) -> MotionClaim:
        known = registry.names("motion")
        if unknown := [name for name in self.metrics if name not in known]:
            raise ValueError(f"there is no metric of motion {', '.join(unknown)}; allowed: {', '.join(known)}")
        return self


class TaskTimeClaim(_Claim):
    """The candidate needs no more time for a task where both succeed (needs ``accuracy: episodes``)."""

    margin: float = Field(0.05, ge=0, le=10, description="largest growth, a share (0.05 = 5 %)")


class WorstTaskClaim(_Claim):
    """No task loses more successes than a drop, however well others do (needs ``accuracy: episodes``)."""

    max_drop: float = Field(0.03, ge=0, le=1, description="largest drop of any task, a share (0.03 = 3 points)")


class DisturbedClaim(_Claim):
    """Under disturbances, it loses no more successes than a drop (needs ``accuracy: episodes``)."""

    max_drop: float = Field(0.05, ge=0, le=1, description="largest drop under any of them, a share (0.05 = 5 points)")
    kinds: tuple[str, ...] = Field(
        ("all",), min_length=1, description="all, or some of delay, dropped_frames and the environment's own"
    )
    strength: float = Field(1.0, gt=0, le=10, description="1 is what an ordinary day brings")


class AnswersClaim(_Claim):
    """The candidate answers when timed as it does otherwise, and follows the baseline where nothing is recorded."""

    follows: float | None = Field(
        0.5, ge=-1, le=1, description="least correlation with the baseline's answers; null for a policy trained anew"
    )
    observations: int = Field(96, ge=24, description="observations that both answer, drawn for the purpose")
    seconds: float = Field(60.0, gt=0, description="after which no further one is answered (at least 24 of them)")


class GrowthClaim(_Claim):
    """The candidate does not take more than the baseline by more than a margin."""

    margin: float = Field(0.1, ge=0, le=10, description="largest growth, a share")


class DeadlineClaim(_Claim):
    """A percentile of the candidate's latency is below a deadline, with confidence; on this machine."""

    ms: float = Field(gt=0, description="the deadline")
    percent: float = Field(
        99.0, description=f"which percentile: {', '.join(f'{percent:g}' for percent in PERCENTILES)}"
    )

    @model_validator(mode="after")
    def _percentile_is_one(self) -> DeadlineClaim:
        if self.percent not in PERCENTILES:
            raise ValueError(f"percent must be one of {', '.join(f'{percent:g}' for percent in PERCENTILES)}")
        return self


class Gate(Numeric):
    """Everything that a candidate must keep to; a claim that is null is not examined."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    schema_: int = Field(1, alias="schema", ge=1, le=1)
    baseline: Path | None = Field(None, description="bundle to compare with; --baseline goes before it")
    latency: LatencyClaim | None = LatencyClaim()
    accuracy: AccuracyClaim | None = AccuracyClaim()
    answers: AnswersClaim | None = AnswersClaim()
    memory: GrowthClaim | None = GrowthClaim(margin=0.1)
    size: GrowthClaim | None = GrowthClaim(margin=0.1)
    deadline: DeadlineClaim | None = None
    motion: MotionClaim | None = None
    task_time: TaskTimeClaim | None = None
    worst_task: WorstTaskClaim | None = None
    disturbed: DisturbedClaim | None = None
    accept: tuple[str, ...] = Field((), description="findings of the bundles that are overruled, by name")

    @model_validator(mode="after")
    def _something_is_claimed(self) -> Gate:
        if not any((self.latency, self.accuracy, self.answers, self.memory, self.size, self.deadline)):
            raise ValueError("every claim is null, so there is nothing to examine")
        return self

    @model_validator(mode="after")
    def _episodes_are_played(self) -> Gate:
        named = [name for name in OF_EPISODES if getattr(self, name) is not None]
        if named and not (self.accuracy and self.accuracy.episodes):
            raise ValueError(f"{', '.join(named)} is claimed of closed-loop episodes; name them (accuracy: episodes)")
        return self

    def to_yaml(self) -> str:
        """Return YAML that ``read_gate`` turns back into an equal gate."""
        yaml = require("yaml", "build")
        text: str = yaml.safe_dump(self.model_dump(mode="json", by_alias=True), sort_keys=False)
        return text


def _problem(key: str, got: object, message: str) -> str:
    """One sentence about one key; what was got is shown where it is one value."""
    shown = f" (got {got!r})" if key and isinstance(got, str | int | float) else ""
    return f"{key or 'gate'}: {message}{shown}"


def _fix(error: ValidationError) -> str:
    """What to write instead; a percentage is what people write who know --max-drop 1%."""
    shares = [item for item in error.errors() if str(item["input"]).strip().endswith("%")]
    share = "write a share as a number: 0.05 is 5 %; " if shares else ""
    return f"{share}docs/reference/gate.md says what each key takes"


def read_gate(path: Path) -> Gate:
    """Read a gate file; paths in it are relative to its directory.

    Raises:
        RecipeError: when the file is missing, is not YAML, or says something impossible; lists every problem.
    """
    if not path.exists():
        raise RecipeError(f"There is no gate {path}.", "write one: vlatool gate init")
    data = read_mapping(path, f"The gate {path}", RecipeError)
    try:
        gate = Gate.model_validate(data)
    except ValidationError as error:
        problems = [_problem(".".join(map(str, item["loc"])), item["input"], item["msg"]) for item in error.errors()]
        raise RecipeError(f"The gate {path}: {'; '.join(problems)}.", _fix(error)) from error
    folder = path.parent
    accuracy = gate.accuracy
    if accuracy is not None:
        placed = {name: folder / value for name in ("data", "policy") if (value := getattr(accuracy, name)) is not None}
        accuracy = accuracy.model_copy(update=placed)
    return gate.model_copy(update={"baseline": gate.baseline and folder / gate.baseline, "accuracy": accuracy})
