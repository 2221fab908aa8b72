"""The drawing of one episode: paths, actions, seams, whatever the environment told."""

from __future__ import annotations

import math
import re

import pytest

from vlatool.render.charts.episode import Played, episode
from vlatool.render.sections.motion import Motion
from vlatool.report import Report, Row


def played(steps: int = 12, axes: str = "xyz", chunk: int = 4, **more: list[float]) -> dict[str, list[float]]:
    series = {
        f"position.{axis}": [math.sin(t / 3 + place) for t in range(steps + 1)] for place, axis in enumerate(axes)
    }
    return {**series, "fresh": [float(t % chunk == 0) for t in range(steps)],
            "action.dx": [0.1 * t for t in range(steps)], "action.dy": [0.0] * steps, **more}  # fmt: skip


def drawn(*series: dict[str, list[float]], width: int = 800) -> str:
    names = ("base", "s-base"), ("int8", "s-chosen")
    variants = [Played(name, css, one) for (name, css), one in zip(names, series, strict=True)]
    return episode(variants, "One episode", width).svg()


def paths(svg: str) -> int:
    return len(re.findall(r'<path[^>]*class="line', svg))


@pytest.mark.parametrize("width", [800, 360])
def test_paths_from_above_and_the_side_and_every_action(width: int):
    svg = drawn(played(), played(20), width=width)
    assert paths(svg) == 2 * (2 + 2)
    assert "path from above (x, y)" in svg
    assert "path from the side (x, z)" in svg
    assert "base: 12 steps; int8: 20 steps" in svg
    assert len(re.findall('class="mark', svg)) == 2 * (2 + 4), "seams of both, in both rows"
    assert "nan" not in svg.lower().replace("instance", "")


def test_what_is_not_known_is_not_drawn():
    assert paths(drawn(played(axes="xy"), played(axes="xyz"))) == 2 * (1 + 2)
    assert paths(drawn(played(axes=""), played(axes=""))) == 2 * 2
    assert 'class="mark' not in drawn(played(chunk=1), played(chunk=1)), "where each step is a seam, none is marked"


def test_a_long_episode_is_thinned_and_one_step_is_drawn():
    assert len(drawn(played(5000), played(5000))) < 120_000
    assert paths(drawn(played(1), played(1))) == 2 * (2 + 2)


def row(name: str, role: str, series: dict[str, list[float]]) -> Row:
    raw = {f"episode.{key}": values for key, values in series.items()}
    return Row(name, role, raw=raw, details={"the episode that differs most": [{"task": "a", "seed": 3}]})


@pytest.mark.parametrize(("own", "shown"), [
    (played(), True), (played(**{"action.dx": [math.nan] * 12}), False), (played(**{"position.x": [1.0]}), False),
    ({}, False), ({"fresh": []}, False),
])  # fmt: skip
def test_an_episode_that_cannot_be_drawn_is_left_out(own: dict[str, list[float]], shown: bool):
    report = Report("evaluate", "t", rows=(row("float32", "baseline", played()), row("int8", "subject", own)))
    assert bool(list(Motion().build(report))) == shown


def test_a_discrete_action_is_drawn_as_steps_between_its_indices():
    series = {"fresh": [1.0] * 6, "action": [0.0, 0.0, 2.0, 1.0, 1.0, 2.0]}
    svg = drawn(series, series)
    assert len(re.findall(r'd="M[\d.]+ [\d.]+(?:H[\d.]+V[\d.]+)+"', svg)) == 2
    assert all(f">{index}</text>" in svg for index in (0, 1, 2))


def test_an_action_that_hardly_changes_has_two_ticks():
    series = {"fresh": [1.0] * 4, "action.grip": [0.97, 1.0, 1.02, 1.01]}
    svg = drawn(series, series)
    ticks = re.findall(r'class="tick" text-anchor="end">([^<]+)<|text-anchor="end"[^>]*class="tick">([^<]+)<', svg)
    assert len(ticks) > 1, svg
