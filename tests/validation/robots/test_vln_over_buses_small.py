"""The small form of ``vln_over_buses.py``: three short episodes over a bus, and how records and outcomes are read."""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict, replace
from pathlib import Path

import pytest
from _shared import once
from _vln_episodes import SAMPLE, EpisodeEnd, continuous_episode
from vln_over_buses import Timing, actions_of, compared, has_ended, in_real_time, play_bus

from vlatool import load
from vlatool.export.onnx import ExportOnnx
from vlatool.nodes.step_record import StepRecord
from vlatool.sources.torch_module import TorchModule
from vlatool.stage.base import Context
from vlatool.stage.run import run_transform
from vlatool.user_code import trust

SHORT = [5_000_013, 5_000_014, 5_000_000]
"""Seeds of levels whose target is one or two actions away."""
END = EpisodeEnd(7, True, True, ("left", "forward"), seconds=8.0)


def export(folder: Path) -> None:
    """Export the sample policy, in float32."""
    trust.allow(SAMPLE)
    source = run_transform(TorchModule(policy=SAMPLE), None, folder / "source", Context()).bundle
    run_transform(ExportOnnx(), source, folder / "bundle", Context())


@pytest.mark.soak("records and outcomes below; frames and arrival in controllers/test_vln.py")
@pytest.mark.parametrize(("bus", "library"), [("zenoh", "zenoh"), ("dds", "cyclonedds")])
def test_the_same_episodes_over_a_bus_and_in_one_process(bus: str, library: str, tmp_path: Path):
    pytest.importorskip(library)
    pytest.importorskip("minigrid")
    bundle = once("vln-babyai", export) / "bundle"
    options = argparse.Namespace(bundle=bundle, task="GoToLocalS6N3", pairs=1, output=tmp_path)
    lines = play_bus(bus, SHORT, options)
    policy = load(bundle, threads=1)
    assert compared(bus, lines, [continuous_episode(options.task, seed, policy) for seed in sorted(SHORT)]) == 0
    assert [line["end"]["seed"] for line in lines] == sorted(SHORT)
    assert all(line["end"]["success"] and line["end"]["actions"] for line in lines)


def test_actions_are_read_from_the_steps_at_which_their_number_grows():
    statuses = [("running looking", 0), ("running left", 1), ("running left", 1), ("running blocked", 2),
                ("running looking", 2), ("running forward", 3), ("arrived", 3)]  # fmt: skip
    records = [StepRecord(step, step / 10, (0, 0), status=status, notes={"actions": float(count)})
               for step, (status, count) in enumerate(statuses)]  # fmt: skip
    assert actions_of(records) == ("left", "forward", "forward")
    assert has_ended(records)
    assert not has_ended(records[:-1])
    assert not has_ended([])


@pytest.mark.parametrize(
    ("other", "differing"),
    [(END, 0), (replace(END, success=False), 1), (replace(END, stopped=False), 1), (replace(END, actions=()), 0)],
)
def test_an_episode_that_ends_otherwise_is_counted_and_named(other: EpisodeEnd, differing: int, capsys):
    line = {"end": asdict(other), "timing": Timing(10)._asdict()}
    assert compared("dds", [line], [END]) == differing
    assert ("over dds" in capsys.readouterr().out.partition("behind real time")[2]) == (other != END)
    slow = {**line, "timing": Timing(10, behind_s=5.0)._asdict()}
    assert compared("dds", [slow], [END]) == 0


def test_episodes_that_kept_up_with_real_time_are_not_played_again(tmp_path: Path):
    lines = [{"end": asdict(replace(END, seed=seed)), "timing": Timing(10, behind_s=behind_s)._asdict()}
             for seed, behind_s in ((1, 0.1), (2, 9.0), (2, 0.2), (3, 9.0), (4, 0.1))]  # fmt: skip
    (tmp_path / "dds.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    assert sorted(in_real_time("dds", [1, 2, 3], argparse.Namespace(output=tmp_path))) == [1, 2]
