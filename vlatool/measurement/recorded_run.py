"""Control steps on this machine without a robot, recorded so that they can be replayed bit by bit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from vlatool.bundle.bundle import Bundle
from vlatool.data import observations_for
from vlatool.errors import OutputError
from vlatool.measurement.dry_run import OBSERVATIONS, play_paced
from vlatool.runtime import load
from vlatool.runtime.stack import Fallback, Stack, rate_factor
from vlatool.runtime.telemetry.recorder import Recorder


@dataclass(frozen=True)
class RecordedRun:
    """What ``vlatool record`` wrote.

    Args:
        file: The file.
        bytes: Its size.
        steps: Control steps in it.
        seed: Seed of the noise.
        failed: Control steps that could not be written.
    """

    file: str
    bytes: int
    steps: int
    seed: int
    failed: int

    def to_dict(self) -> dict[str, Any]:
        """Return it as plain values for JSON."""
        return asdict(self)


def record_run(
    path: Path,
    output: Path,
    *,
    robot: str = "",
    deadline_ms: float | None = None,
    fallback: Path | None = None,
    neutral: str = "",
    controllers: Sequence[str] = (),
    engine: str = "",
    threads: int | None = None,
    steps: int = 200,
    seed: int = 0,
) -> RecordedRun:
    """Play control steps on recorded or random observations, as ``dry_run`` does, and record them.

    Args:
        output: A new file.
        deadline_ms: Time in which a control step is answered; the control period when None.
        seed: Seed of the noise.

    Raises:
        UsageError, SpecError, BundleError, GraphError: as ``vlatool.runtime.load`` does.
        DataError: when the file exists or cannot be created.
        OutputError: when a control step could not be written.
    """
    bundle = Bundle.open(path)
    rate = bundle.manifest.spec.rate * rate_factor(controllers)
    second = None if fallback is None else load(fallback, threads=threads, seed=seed)
    options = Fallback(second, neutral=neutral)
    stack = load(path, engine=engine, threads=threads, seed=seed, controllers=controllers, envelope=robot or None,
                 deadline_ms=1000 / rate if deadline_ms is None else deadline_ms, fallback=options,
                 record=output)  # fmt: skip
    if not isinstance(stack, Stack) or not isinstance(stack.recorder, Recorder):
        raise TypeError("a recorder makes a stack")
    try:
        play_paced(stack, observations_for(bundle, OBSERVATIONS), steps - 1, rate)
    finally:
        stack.close()
    failed = stack.recorder.failure_count
    if failed:
        raise OutputError(f"{failed} of {steps} control steps could not be written to {output}.",
                          "see whether the disk is full")  # fmt: skip
    return RecordedRun(str(output), output.stat().st_size, steps, seed, failed)
