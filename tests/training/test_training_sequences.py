"""Windows of episodes: within one, each row as likely, led to by what comes before; labels are of whole episodes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

from vlatool.bundle.program import ProgramStep
from vlatool.data import BEGINS, Recording
from vlatool.episodes.frames import file_of
from vlatool.errors import DataError
from vlatool.module.batched_program import BatchedProgram
from vlatool.stage.base import Context
from vlatool.training.frames import Frames
from vlatool.training.lanes import Lanes
from vlatool.training.rounds import LABEL, write_labels
from vlatool.training.sequences import Sequences, Unroll, episode_begins, outputs_and_labels, select_episodes

LENGTHS = (1, 7, 3, 12, 2, 5)


def rounds(place: Path, *lengths: tuple[int, ...]) -> None:
    """Write rounds of episodes, each row the place that it has over all of them."""
    row = 0
    for number, sizes in enumerate(lengths):
        folder = place / f"round-{number:03d}"
        folder.mkdir(parents=True)
        begins = np.concatenate([np.arange(size) == 0 for size in sizes])
        np.save(folder / f"{BEGINS}.npy", begins)
        np.save(file_of(folder, "x"), np.arange(row, row + len(begins), dtype=np.float32)[:, None])
        row += len(begins)


def sequences(place: Path, window: int, burn_in: int | None = None) -> Sequences:
    rounds(place, LENGTHS[:3], LENGTHS[3:])
    frames = Sequences(place, Unroll(window, burn_in))
    frames.read(0)
    frames.read(1)
    return frames


@pytest.mark.parametrize("window", [1, 4, 20])
@pytest.mark.parametrize("burn_in", [None, 0, 2])
def test_windows_stay_in_an_episode_and_each_row_is_as_likely(tmp_path: Path, window: int, burn_in: int | None):
    frames = sequences(tmp_path, window, burn_in)
    places = frames.draw(np.random.default_rng(0), 40_000 * window)
    assert len(places) == 40_000
    begins = np.repeat(np.cumsum([0, *LENGTHS[:-1]]), LENGTHS)
    firsts, starts, ends = places.T
    assert (begins[starts] == begins[ends - 1]).all(), "no window crosses a border"
    assert (ends - starts <= window).all()
    lead = starts - begins[starts] if burn_in is None else np.minimum(burn_in, starts - begins[starts])
    assert (starts - firsts == lead).all()
    seen = sum(np.bincount(np.arange(first, end), minlength=30) for _, first, end in places[:20_000])
    assert seen.sum() == frames.row_count(places[:20_000])
    assert seen.max() / seen.min() < 1.2


def test_rows_do_not_hold_what_says_where_episodes_begin(tmp_path: Path):
    frames = sequences(tmp_path, 4)
    assert list(frames.rows(np.array([3]))) == ["x"]
    plain = Frames(tmp_path)
    plain.read(0)
    assert plain.begins(0).tolist() == [0, 1, 8]


def test_whole_episodes_are_spread_over_the_rounds_that_are_asked_for(tmp_path: Path):
    frames = sequences(tmp_path, 4)
    assert frames.sample((0, 1), 1000)[:, 1:].tolist() == [[0, 1], [1, 8], [8, 11], [11, 23], [23, 25], [25, 30]]
    assert frames.sample((1,), 10)[:, 0].tolist() == [11, 25]
    kept = frames.sample_rows(15)
    assert len(kept["x"]) <= 15
    assert kept[BEGINS][0]
    assert np.flatnonzero(np.diff(kept["x"][:, 0]) != 1).tolist() == (np.flatnonzero(kept[BEGINS])[1:] - 1).tolist()


def test_lanes_are_reset_where_they_begin_and_count_where_they_are_asked_for():
    lanes = Lanes(np.array([2, 10]), np.array([4, 10]), np.array([6, 13]))
    rows, begins, counts = zip(*lanes.steps(), strict=True)
    assert np.stack(rows).T.tolist() == [[2, 3, 4, 5, 5], [10, 10, 10, 11, 12]]
    assert np.stack(begins).T.tolist() == [[True, *[False] * 4], [*[True] * 3, *[False] * 2]]
    assert np.stack(counts).T.tolist() == [[False, False, True, True, False], [False, False, True, True, True]]


class Noisy(nn.Module):
    """Adds up noise and what it is given."""

    def __init__(self, alone: bool) -> None:
        super().__init__()
        self.map, self.alone = nn.Linear(1, 1), alone

    def forward(self, x: torch.Tensor, noise: torch.Tensor, total: torch.Tensor, count: torch.Tensor):
        total = 0.9 * total + self.map(torch.sin(x)) + 0.1 * noise
        return total.reshape(1, 1) if self.alone else total, total, count + 1


STEPS = (
    ProgramStep(
        "main",
        {"x": "x", "noise": "noise", "total": "total", "count": "count"},
        {"y": "y", "t": "total", "c": "count"},
        noise={"noise": {"shape": [1, 1]}},
        keep={"total": {"shape": [1, 1]}, "count": {"shape": [1], "dtype": "int64"}},
    ),
)


@pytest.mark.parametrize("alone", [False, True])
def test_a_student_that_is_its_teacher_answers_in_windows_what_the_labels_say(tmp_path: Path, alone: bool):
    """With noise, more episodes than run side by side, and of different lengths."""
    sizes = tuple(1 + number % 5 for number in range(40))
    rounds(tmp_path, sizes)
    program = BatchedProgram(STEPS, {"main": Noisy(alone)})
    assert write_labels(tmp_path / "round-000", ["x"], ["y"], program, (0,), Context()) == ["y"]
    frames = Sequences(tmp_path, Unroll(3))
    frames.read(0)
    for places in (frames.draw(np.random.default_rng(0), 90), frames.sample((0,), 1000)):
        given, wanted = outputs_and_labels(program, frames.batch(places), "y", LABEL)
        assert given.requires_grad
        assert len(given) == frames.row_count(places)
        assert torch.allclose(given, wanted, atol=1e-5)
    apart = Sequences(tmp_path, Unroll(3, 0))
    apart.read(0)
    given, wanted = outputs_and_labels(program, apart.batch(apart.draw(np.random.default_rng(0), 90)), "y", LABEL)
    assert not torch.allclose(given, wanted, atol=1e-5), "without a burn-in, windows begin at zero"


def test_gradients_pass_through_a_window_and_not_through_what_leads_to_it(tmp_path: Path):
    rounds(tmp_path, (20,))
    module = Noisy(False)
    with torch.no_grad():
        module.map.weight.fill_(0.0)
    program = BatchedProgram(STEPS, {"main": module})
    write_labels(tmp_path / "round-000", ["x"], ["y"], program, (0,), Context())
    frames = Sequences(tmp_path, Unroll(3))
    frames.read(0)
    given, _ = outputs_and_labels(program, frames.batch(np.array([[0, 10, 13]])), "y", LABEL)
    (slope,) = torch.autograd.grad(given[-1].sum(), [module.map.bias])
    assert float(slope) == pytest.approx(1 + 0.9 + 0.81)


def test_episodes_of_a_recording(tmp_path: Path):
    rows = {"x": np.zeros((9, 1))}
    numbers = np.array([4, 4, 4, 1, 1, 1, 4, 4, 4])
    whole = Recording(tmp_path / "r.npz", rows, None, numbers)
    assert np.flatnonzero(episode_begins(whole)).tolist() == [0, 3, 6]
    chosen = whole.subset(numbers == 4)
    assert np.flatnonzero(episode_begins(chosen)).tolist() == [0, 3], "two of the same number that do not touch"
    assert len(episode_begins(whole.subset(np.arange(9) < 5))) == 5, "the end of one may be missing"
    with pytest.raises(DataError, match=r"too few episodes to hold whole ones out \(3\)"):
        episode_begins(whole.subset(np.arange(9) > 4))
    with pytest.raises(DataError, match="does not say where episodes begin"):
        episode_begins(Recording(tmp_path / "r.npz", rows, None, None))


@pytest.mark.parametrize(("share", "used"), [(1.0, 9), (0.5, 6), (0.01, 3), (0.34, 6)])
def test_a_share_of_the_episodes(share: float, used: int):
    begins = np.arange(9) % 3 == 0
    chosen = select_episodes(begins, share, np.random.default_rng(0).permutation)
    assert chosen.sum() == used
    assert (chosen.reshape(3, 3).sum(1) % 3 == 0).all()
