"""A video of the episode that differs most, decoded again and held against what the environment showed."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from tests._reach import GOOD, TREMBLES, bundle_of, folder_of
from vlatool.bundle.bundle import Bundle
from vlatool.cli import main
from vlatool.errors import DataError, OutputError, SourceError
from vlatool.evaluate import _replay
from vlatool.evaluate.closed_loop import ClosedLoop
from vlatool.render.filmstrip import BAR, EDGE, GAP, LINE
from vlatool.report import Report
from vlatool.stage.base import Context

SIDE = 192
"""Pixels that the 8 of the tiny policy's image are shown with."""
TOP = EDGE + 2 * LINE
DRAWS = """
    render_mode = "rgb_array"

    def render(self):
        picture = np.full((24, 32, 3), 40, np.uint8)
        for place, colour in ((self.goal, (220, 40, 40)), (self.at, (40, 90, 220))):
            column, row = (np.clip(np.asarray(place) * 4, (-15, -11), (15, 11)) + (16, 12)).astype(int)
            picture[row - 1 : row + 1, column - 1 : column + 1] = colour
        return picture

    def __init__(self, task):"""


def evaluated(bundle: Bundle, policy: Path, video: Path | str, **options: Any) -> Report:
    stage = ClosedLoop(policy=policy, **{"episodes": 10, "first_seed": 0, **options})
    stage.check(bundle, None)
    return stage.run(bundle, Context(video=str(video)))


def decoded(path: Path) -> list[np.ndarray]:
    with Image.open(path) as image:
        pictures = []
        for frame in range(image.n_frames):
            image.seek(frame)
            pictures.append(np.asarray(image.convert("RGB")).astype(int))
    return pictures


def seen(policy: Path, task: str, seed: int, image: Callable[[Any], Any], steps: int = 5) -> list[np.ndarray]:
    """What the environment shows at the reset and after each step, whoever acts."""
    from vlatool.module.factory import call_factory

    environment = call_factory("environment.py:make", policy, {"task": task})
    shown = [image(environment.reset(seed=seed)[0])]
    return [*shown, *(image(environment.step(np.zeros(2))[0]) for _ in range(steps))]


@pytest.fixture(scope="module")
def paired(tmp_path_factory: pytest.TempPathFactory, float_bundle: Bundle, int8_bundle: Bundle, policy_template: Path):
    """The tiny policy in float32 and int8: the report, and the video."""
    path = tmp_path_factory.mktemp("video") / "worst.gif"
    return evaluated(int8_bundle, policy_template, path, baseline=float_bundle.path), path


def test_both_variants_are_shown_beside_each_other_step_by_step(paired: tuple[Report, Path], policy_template: Path):
    report, path = paired
    (record,) = report.rows[-1].details["the episode that differs most"]
    task, seed = record["task"], record["seed"]
    expected = f"worst.gif shows the episode in which the variants differ most: task '{task}', seed {seed}."
    assert expected in report.summary
    assert report.warnings == ()
    pictures = decoded(path)
    assert pictures[0].shape == (TOP + SIDE + BAR + EDGE, 2 * SIDE + GAP + 2 * EDGE, 3)
    images = seen(policy_template, task, seed, lambda observation: observation["image"])
    assert len(pictures) == len(images) == 6
    for shown, image in zip(pictures, images, strict=True):
        for left in (EDGE, EDGE + SIDE + GAP):
            panel = shown[TOP : TOP + SIDE : 24, left : left + SIDE : 24]
            assert np.abs(panel - image).mean() < 12, "the tiny images are noise, in 240 colours"


def test_the_caption_changes_and_tells_the_end(paired: tuple[Report, Path]):
    pictures = decoded(paired[1])
    captions = [picture[EDGE + LINE : TOP, EDGE : EDGE + SIDE] for picture in pictures]
    assert all((one != two).any() for one, two in pairwise(captions))
    green = np.abs(captions[-1] - (111, 211, 155)).max(axis=-1) < 9
    red = np.abs(captions[-1] - (255, 139, 152)).max(axis=-1) < 9
    assert green.any() != red.any(), "it succeeds, or it fails"


def test_a_report_with_a_video_is_the_report_without(paired: tuple[Report, Path], float_bundle: Bundle,
                                                     int8_bundle: Bundle, policy_template: Path):  # fmt: skip
    plain = evaluated(int8_bundle, policy_template, "", baseline=float_bundle.path)
    assert plain.rows == paired[0].rows
    assert plain.summary == paired[0].summary[:-1]


def test_without_a_baseline_the_first_failed_episode_is_shown(int8_bundle: Bundle, policy_template: Path, tmp_path):
    report = evaluated(int8_bundle, policy_template, tmp_path / "a.gif")
    assert report.summary[-1] == "a.gif shows the first episode that fails: task 'reach', seed 0."
    assert decoded(tmp_path / "a.gif")[0].shape[1] == SIDE + 2 * EDGE
    report = evaluated(int8_bundle, policy_template, tmp_path / "b.gif", first_seed=1, episodes=4)
    assert report.summary[-1] == "b.gif shows the longest episode: task 'reach', seed 1."


@pytest.fixture(scope="module")
def reach(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Bundle]:
    """Bundles of a policy that takes no image."""
    folder = tmp_path_factory.mktemp("reach")
    return {name: bundle_of(folder / name, kind) for name, kind in {"good": GOOD, "trembles": TREMBLES}.items()}


def world(folder: Path, *edits: tuple[str, str]) -> Path:
    """A policy's folder whose environment is another."""
    file = folder_of(folder) / "environment.py"
    text = file.read_text()
    for before, after in edits:
        assert before in text
        text = text.replace(before, after)
    file.write_text(text)
    return folder


DRAWN = ("\n    def __init__(self, task):", DRAWS)


def test_what_the_environment_renders_is_shown_of_each_variant(reach: dict[str, Bundle], tmp_path: Path):
    policy = world(tmp_path / "policy", DRAWN)
    report = evaluated(reach["trembles"], policy, tmp_path / "a.gif", baseline=reach["good"].path, episodes=4)
    assert report.warnings == ()
    pictures = decoded(tmp_path / "a.gif")
    height, width = 24 * 8, 32 * 8
    assert pictures[0].shape == (TOP + height + BAR + EDGE, 2 * width + GAP + 2 * EDGE, 3)
    row = report.rows[-1]
    xs, ys = row.raw["episode.position.x"], row.raw["episode.position.y"]
    for picture, x, y in list(zip(pictures, xs, ys, strict=False))[1:4]:
        panel = picture[TOP : TOP + height : 8, EDGE + width + GAP : EDGE + 2 * width + GAP : 8]
        column, line = int(np.clip(x * 4, -15, 15) + 16), int(np.clip(y * 4, -11, 11) + 12)
        assert np.abs(panel[line - 1, column - 1] - (40, 90, 220)).max() <= 8, "the point is where the report says"


def test_without_any_picture_it_is_said_before_episodes_are_played(reach: dict[str, Bundle], tmp_path: Path):
    policy = world(tmp_path / "policy", ("def step(self, action):", "def step(self, action):\n        1 / 0"))
    with pytest.raises(DataError, match="has no picture to film: its render_mode is None") as caught:
        evaluated(reach["good"], policy, tmp_path / "a.gif")
    assert "render_mode='rgb_array'" in caught.value.fix
    assert not (tmp_path / "a.gif").exists()


def test_an_environment_that_dies_when_it_is_asked_is_said(reach: dict[str, Bundle], tmp_path: Path):
    policy = world(
        tmp_path / "policy",
        ("def reset(", "def reset(self, *, seed=None):\n        import os; os._exit(3)\n\n    def other("),
    )
    with pytest.raises(SourceError, match="ended its process with exit code 3"):
        evaluated(reach["good"], policy, tmp_path / "a.gif")


FAILS = {
    "render raises": ("return picture", "return picture if self.steps < 3 else 1 / 0", "ZeroDivisionError"),
    "render ends": ("return picture", "import os; os._exit(self.steps)\n        return picture", "ended its process"),
    "sizes change": ("return picture", "return picture[: 24 - self.steps]", "shape"),
}


@pytest.mark.parametrize("case", [name for name in FAILS if name != "render ends"])
def test_a_video_that_fails_costs_the_video_alone(reach: dict[str, Bundle], tmp_path: Path, case: str):
    before, after, says = FAILS[case]
    policy = world(tmp_path / "policy", DRAWN, (before, after))
    (tmp_path / "out").mkdir()
    path = tmp_path / "out/a.gif"
    report = evaluated(reach["trembles"], policy, path, baseline=reach["good"].path, episodes=4)
    assert report.rows[-1].value("success") == 1.0
    assert "episode.fresh" in report.rows[-1].raw, "the drawing of the report is there"
    (warning,) = report.warnings
    assert warning.startswith("a.gif was not written: ")
    assert says in warning
    assert list(path.parent.iterdir()) == []


def test_a_disk_that_fills_up_costs_the_video_alone(reach: dict[str, Bundle], tmp_path: Path,
                                                    monkeypatch: pytest.MonkeyPatch):  # fmt: skip
    def full(*_: Any, **__: Any) -> str:
        raise OutputError("Cannot write a.gif: the disk is full.", "free some space")

    monkeypatch.setattr(_replay, "write_video", full)
    policy = world(tmp_path / "policy", DRAWN)
    report = evaluated(reach["trembles"], policy, tmp_path / "a.gif", baseline=reach["good"].path, episodes=2)
    assert report.warnings == ("a.gif was not written: Cannot write a.gif: the disk is full. (free some space)",)
    monkeypatch.setattr(_replay, "SCRATCH", 1 << 62)
    with pytest.raises(OutputError, match=r"A video needs some room in .*, and the disk is full"):
        evaluated(reach["trembles"], policy, tmp_path / "a.gif", baseline=reach["good"].path, episodes=2)


def test_a_replay_that_goes_another_way_is_said(int8_bundle: Bundle, policy_template: Path, tmp_path: Path,
                                                monkeypatch: pytest.MonkeyPatch):  # fmt: skip
    real = _replay.stands_out

    def other(outcomes: list[Any]) -> int:
        place = real(outcomes)
        outcomes[place] = replace(outcomes[place], success=True, steps=9)
        return place

    monkeypatch.setattr(_replay, "stands_out", other)
    report = evaluated(int8_bundle, policy_template, tmp_path / "a.gif")
    assert "played again, tiny went another way than when it was measured (success at step 9)" in report.summary[-1]


def test_a_long_episode_is_shown_in_part_and_it_is_said(reach: dict[str, Bundle], tmp_path: Path):
    large = ("picture = np.full((24, 32, 3), 40, np.uint8)", "return np.zeros((480, 480, 3), np.uint8)")
    policy = world(tmp_path / "policy", DRAWN, large, ("self.steps >= 40", "self.steps >= 400"))
    report = evaluated(reach["good"], policy, tmp_path / "a.gif", episodes=2)
    assert report.summary[-1].endswith("; of reach the first 388 of 400 steps.")


def run(*words: Any) -> int:
    with pytest.raises(SystemExit) as ended:
        main([str(word) for word in words])
    return int(ended.value.code or 0)


def test_the_command_writes_it_and_replaces_it_with_force(int8_bundle: Bundle, policy_template: Path, tmp_path: Path,
                                                          capsys: pytest.CaptureFixture[str]):  # fmt: skip
    path = tmp_path / "worst.gif"
    line = ("evaluate", "closed-loop", int8_bundle.path, "--policy", policy_template, "--episodes", 2, "--video", path)
    assert run(*line, "--json") == 0
    told = json.loads(capsys.readouterr().out)
    assert "worst.gif shows the" in told["summary"][-1]
    assert str(tmp_path) not in told["command"].partition("--video")[2], "folders are not recorded"
    first = path.read_bytes()
    assert run(*line) == 3
    assert "exists already" in capsys.readouterr().err
    assert run(*line, "--force") == 0
    assert path.read_bytes() == first, "the same episode gives the same bytes"
    path.write_bytes(b"GIF89a, mine")
    assert run(*line, "--force") == 3
    assert "was not written by vlatool" in capsys.readouterr().err
    assert path.read_bytes() == b"GIF89a, mine"


@pytest.mark.parametrize(("options", "code", "says"), [
    (["--video", "worst.avi"], 2, "'avi' is none; known: gif, mp4"),
    (["--video", "worst"], 2, "the suffix says what kind of video"),
    (["--video", "none/worst.gif"], 3, "there is no folder"),
    (["-o", "out", "--video", "out/worst.gif"], 2, "is in the output out, which appears whole or not at all"),
    (["--video", "{bundle}/worst.gif"], 3, "lies in"),
])  # fmt: skip
def test_what_is_named_wrongly_is_said_before_episodes(int8_bundle: Bundle, policy_template: Path, tmp_path: Path,
                                                       monkeypatch: pytest.MonkeyPatch, options: list[str], code: int,
                                                       says: str, capsys: pytest.CaptureFixture[str]):  # fmt: skip
    monkeypatch.chdir(tmp_path)
    words = [word.format(bundle=int8_bundle.path) for word in options]
    assert run("evaluate", "closed-loop", int8_bundle.path, "--policy", policy_template, *words) == code
    captured = capsys.readouterr()
    assert says in " ".join(captured.err.split())
    assert "episodes" not in captured.err
    assert list(tmp_path.iterdir()) == []
