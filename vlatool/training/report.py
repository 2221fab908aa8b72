"""The report of a training, beside the bundle: it has times, and is not part of the bundle's identity."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from datetime import datetime, timezone
from typing import Any

from vlatool.bundle.bundle import REPORTS, Bundle
from vlatool.files.printable import amount
from vlatool.machine.host import fingerprint
from vlatool.measures import series, tables
from vlatool.measures.training import TRAINING_TIME
from vlatool.module.stage import TRAINING
from vlatool.render import write_reports
from vlatool.report import Report, Row
from vlatool.stage.identity import with_identity
from vlatool.training.forecast import duration
from vlatool.training.generalization_gap import ADVICE_RATIO, LOSS_KEY, NEW_ROUND, PREVIOUS_ROUND
from vlatool.training.supervision import teacher_lines, teacher_record

Record = dict[str, Any]


def write_training_report(made: Bundle, seconds: float, command: str) -> None:
    """Write ``reports/`` of a bundle that was trained.

    Args:
        made: bundle with ``module/training.json``.

    Raises:
        OSError: when it cannot be written.
    """
    training = json.loads(made.file(TRAINING).read_bytes())
    stage = str(made.manifest.made_by["stage"])
    took = TRAINING_TIME.quantity(stage).measurement(seconds)
    row = Row(
        made.manifest.name,
        measurements=(took,),
        raw={series.LOSSES.name(stage): training["losses"]},
        details={
            tables.ROUNDS.name(stage): [_round(round_) for round_ in training["rounds"]],
            tables.TEACHER.name(stage): [teacher_record(training)],
        },
    )
    result = f"{course(training)} and {duration(seconds)}."
    report = Report(
        "training", f"{made.manifest.name}: {stage}", rows=(with_identity(row, made),), command=command,
        summary=(*along_lines(training), result, *teacher_lines(training)),
        created=datetime.now(timezone.utc).isoformat(timespec="seconds"), environment=fingerprint(),
    )  # fmt: skip
    write_reports(report, made.path / REPORTS)


def course(training: Mapping[str, Any]) -> str:
    """Say how the loss fell."""
    first, last = _loss_ends(training["losses"])
    return f"{training['loss']} {first:.4g} -> {last:.4g} in {amount(len(training['losses']), 'step')}"


def _loss_ends(losses: Sequence[float]) -> tuple[float, float]:
    """Return the mean of the first, and of the last twentieth of the losses."""
    few = max(1, len(losses) // 20)
    return sum(losses[:few]) / few, sum(losses[-few:]) / few


def along_lines(training: Mapping[str, Any]) -> tuple[str, ...]:
    """Say how far a student that keeps values is from its teacher over whole episodes, where it was trained."""
    about = training.get("along")
    if about is None:
        return ()
    of = f"{amount(about['observations'], 'observation')} of {about['episodes']} whole episodes"
    losses = f"{training['loss']} {about['before']:.4g} -> {about['after']:.4g}"
    return (f"{losses} over {of}, with what is kept carried along", *_warning(training))


def _warning(training: Mapping[str, Any]) -> tuple[str, ...]:
    """Say whether a student that keeps values does worse along episodes than before, or than in its windows."""
    about, (_, in_windows) = training["along"], _loss_ends(training["losses"])
    if about["after"] > about["before"]:
        worse = "it is further from its teacher than before the training"
    elif about["after"] > ADVICE_RATIO * in_windows:
        worse = f"it is {about['after'] / in_windows:.1f} times as far from its teacher as in its windows"
    else:
        return ()
    cut = about.get("burn_in")
    shorter = f"what a robot keeps by then is not what it had there (--burn-in {cut}): leave --burn-in out"
    remedy = "take a longer --window, or a lower --learning-rate" if cut is None else shorter
    return (f"warning: over whole episodes {worse} ({in_windows:.4g} in windows): {remedy}",)


def _round(about: Record) -> Record:
    """Return what a person wants to know of a round."""
    episodes = about.get("episodes")
    success = f"{about['successes'] / episodes:.1%}" if episodes else None
    who = about["actor"] if episodes else "batches" if about.get("yielded") else "recordings"
    losses = about.get(LOSS_KEY, {})
    return {"before step": about["step"] + 1, "who acted": who, "episodes": episodes, "success": success,
            "observations": about["observations"], "loss, not trained on": _digits(losses.get(NEW_ROUND)),
            "of the round before": _digits(losses.get(PREVIOUS_ROUND))}  # fmt: skip


def _digits(loss: float | None) -> float | None:
    return None if loss is None else float(f"{loss:.4g}")
