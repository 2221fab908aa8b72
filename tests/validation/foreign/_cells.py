"""What is done with each policy: one cell of the table for each command."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from _foreign import Foreign

VLATOOL, ANSWERS = "vlatool", "answers"
BOARD = "jetson-orin-nano"
JUDGED = (0, 1, 5)
"""Exit codes of a command that judges: kept, not kept, cannot be decided. All three are answers."""


@dataclass(frozen=True)
class Cell:
    """One command on one policy.

    Args:
        row: The row of the table.
        words: Arguments of `vlatool`, or of the program that compares answers.
        program: ``vlatool`` or ``answers``.
        codes: Exit codes that mean that the command did its work.
        drift: Largest relative difference from the original's own actions that is right; None where none is measured.
    """

    row: str
    words: tuple[str, ...]
    program: str = VLATOOL
    codes: tuple[int, ...] = (0,)
    drift: float | None = None


QUANTIZED = (
    # row, words, largest drift that is no mistake: half of an action is gone where it is above
    ("float16", ("float16",), 0.02),
    ("bfloat16", ("bfloat16",), 0.2),
    ("float8", ("float8",), 0.5),
    ("smooth-quant", ("smooth-quant",), 0.001),
    ("dynamic-int8", ("dynamic-int8",), 0.5),
    ("static-int8", ("static-int8",), 0.5),
    ("static-int8, qdq", ("static-int8", "--layout", "qdq"), 0.5),
    ("static-int8, openvino", ("static-int8", "--layout", "openvino"), 0.5),
    ("weight-only, 8 bits", ("weight-only", "--bits", "8"), 0.1),
    ("weight-only, rtn", ("weight-only", "--method", "rtn"), 0.6),
    ("weight-only, hqq", ("weight-only", "--method", "hqq"), 0.6),
    ("weight-only, gptq", ("weight-only", "--method", "gptq"), 0.6),
    ("weight-only, awq", ("weight-only", "--method", "awq"), 0.6),
)


def cells(policy: Foreign) -> Iterator[Cell]:
    """Every command on a policy, in an order in which each finds what it needs."""
    source, float32 = policy.exported, f"out/{policy.name}/float32"
    yield Cell("export", ("export", source, "-o", float32))
    yield Cell("infer, ONNX Runtime", (float32, policy.name, "ort_cpu"), ANSWERS, drift=1e-5)
    yield Cell("infer, OpenVINO", (float32, policy.name, "openvino"), ANSWERS, drift=1e-4)
    if policy.verified:
        against = ("--against", f"{policy.name}/original.py:act", "--data", f"{policy.name}/evaluation.npz")
        yield Cell("verify", ("verify", source, *against, "--samples", "8"))
    yield Cell("inspect", ("inspect", float32, "--probe"))
    yield Cell("hwselect SOURCE", ("hwselect", source, "--hz", "10"), codes=JUDGED)
    yield Cell("hwselect BUNDLE", ("hwselect", float32, "--hz", "10"), codes=JUDGED)
    yield Cell("simulate SOURCE", ("simulate", source, "--profile", BOARD))
    yield Cell("simulate BUNDLE", ("simulate", float32, "--profile", BOARD))
    yield from _quantized(policy, float32)
    yield from _measured(policy, float32, f"out/{policy.name}/static-int8")


def _quantized(policy: Foreign, float32: str) -> Iterator[Cell]:
    data = ("--calibration", f"{policy.name}/calibration.npz") if policy.source else ()
    for row, words, drift in QUANTIZED:
        made = f"out/{policy.name}/{row.replace(', ', '-').replace(' ', '-')}"
        given = data if needs_data(words) else ()
        yield Cell(f"quantize {row}", ("quantize", words[0], float32, *words[1:], *given, "-o", made))
        yield Cell(f"infer {row}", (made, policy.name, ""), ANSWERS, drift=drift)


def needs_data(words: tuple[str, ...]) -> bool:
    """Whether a method takes recordings: an ONNX file has none beside it that a bundle could hold."""
    return words[0] in ("static-int8", "float8", "smooth-quant") or words[-1] in ("gptq", "awq")


def _measured(policy: Foreign, float32: str, int8: str) -> Iterator[Cell]:
    folder, data = f"out/{policy.name}", ("--data", f"{policy.name}/evaluation.npz")
    few = ("--iterations", "20", "--duration", "1", "--no-cold")
    yield Cell("evaluate recorded", ("evaluate", "recorded", int8, "--baseline", float32, *data), codes=JUDGED)
    if policy.environment:
        episodes = ("--policy", policy.name, "--baseline", float32, "--episodes", "20")
        yield Cell("evaluate closed-loop", ("evaluate", "closed-loop", int8, *episodes), codes=JUDGED)
    yield Cell("explain", ("explain", int8, "--baseline", float32, "--samples", "4", "--seconds", "30", *data))
    yield Cell("benchmark latency", ("benchmark", "latency", float32, "--against", int8, *few))
    yield Cell("benchmark overhead", ("benchmark", "overhead", float32, "--iterations", "100"))
    yield Cell("compare", ("compare", float32, int8, "--iterations", "20"))
    yield Cell("rebuild", ("rebuild", int8, "--source", policy.exported, "--check"))
    yield Cell("gate init", ("gate", "init", f"{folder}/repository", "--baseline", "models/base", "--force"))
    yield Cell(
        "gate run", ("gate", "run", int8, "--baseline", float32, "--config", f"{folder}/gate.yaml"), codes=JUDGED
    )
    limits = ("--no-search", "--iterations", "20", "--episodes", "20", "--force")
    yield Cell("optimize", ("optimize", policy.exported, *limits, "-o", f"{folder}/optimized"), codes=JUDGED)


def gate_file(policy: Foreign) -> str:
    """Contents of a gate with recordings to judge by."""
    return f"accuracy: {{data: ../../{policy.name}/evaluation.npz, max_drop: 0.5}}\nlatency: {{margin: 0.5}}\n"
