"""The table of controllers under delay: paired episodes alone, and successes in time."""

from __future__ import annotations

from typing import Any

from delayed_chunks import REFERENCE, settings_of, table


def line(controller: str, delay_ms: float, seed: int, steps: int, success: bool = True) -> dict[str, Any]:
    motion = {"seam_jump": 2.0, "action_rate": 0.5, "jerk": None}
    return {"controller": controller, "delay_ms": delay_ms, "task": "open", "seed": seed, "success": success,
            "steps": steps, **motion}  # fmt: skip


def test_episodes_that_all_have_played_are_compared_and_late_successes_do_not_count():
    lines = [line(*REFERENCE, seed, 80) for seed in range(5)]
    lines += [line("rtc", 100.0, seed, 150 if seed else 300) for seed in range(4)]
    assert "4 paired episodes" in table(lines)
    assert "| `rtc` | 100 | 100.0% (51.0%-100.0%) | 0.0 +- 0.0 | 188 | 2.00 | 0.5 |" in table(lines)
    assert "| `rtc` | 100 | 75.0% (30.1%-95.4%) | 25.0 +- 42.4 | 188 |" in table(lines, within=200)


def test_names_are_completed_with_the_length_of_a_chunk():
    assert settings_of(["late:execute={chunk}"], [50.0], 8) == [REFERENCE, ("late:execute=8", 50.0)]
