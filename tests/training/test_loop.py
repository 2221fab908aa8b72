"""The training loop: what it minimises, its schedule, and that a run that is killed goes on as if it were not."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

from vlatool.errors import DataError
from vlatool.training.loop import CHECKPOINT, Settings, Trainer, seconds_of


def net() -> nn.Module:
    torch.manual_seed(0)
    return nn.Sequential(nn.Linear(3, 8), nn.LayerNorm(8), nn.GELU(), nn.Linear(8, 1)).eval()


def draw_for(module: nn.Module, times: float = 1.0):
    def loss(rows: torch.Tensor) -> torch.Tensor:
        return ((module(rows)[:, 0] - rows.sum(1)) ** 2).mean() * times

    def draw(random: np.random.Generator):
        rows = torch.from_numpy(random.standard_normal((32, 3)).astype(np.float32))
        yield 1.0, lambda: loss(rows)

    return draw


def silent(_step: int, _loss: float) -> None:
    """Tell nobody."""


def trained(folder: Path, stops: tuple[int, ...]) -> tuple[dict[str, torch.Tensor], list[float]]:
    """Train for 40 steps; at each stop the trainer is thrown away, and another goes on from its checkpoint."""
    folder.mkdir()
    settings = Settings(40, learning_rate=0.03, average=0.9)
    for until in (*stops, 40):
        module = net()
        trainer = Trainer({"main": module}, settings, folder)
        trainer.train(until, draw_for(module), silent)
        trainer.save()
    trainer.finish()
    return module.state_dict(), trainer.losses


def test_it_learns_and_goes_on_to_the_bit(tmp_path: Path):
    whole, losses = trained(tmp_path / "whole", ())
    pieces, same = trained(tmp_path / "pieces", (1, 7, 8, 33))
    assert losses == same
    assert np.mean(losses[-5:]) < 0.2 * np.mean(losses[:5])
    for name, value in whole.items():
        assert torch.equal(value, pieces[name]), name


def test_steps_after_the_last_checkpoint_are_taken_again(tmp_path: Path):
    whole, _ = trained(tmp_path / "whole", ())
    (tmp_path / "killed").mkdir()
    module, settings = net(), Settings(40, learning_rate=0.03, average=0.9)
    trainer = Trainer({"main": module}, settings, tmp_path / "killed")
    trainer.train(11, draw_for(module), silent)
    trainer.save()
    trainer.train(19, draw_for(module), silent)  # killed here
    again = net()
    other = Trainer({"main": again}, settings, tmp_path / "killed")
    assert other.step == 11
    other.train(40, draw_for(again), silent)
    other.finish()
    assert all(torch.equal(value, again.state_dict()[name]) for name, value in whole.items())


def test_the_result_is_the_average_of_the_weights(tmp_path: Path):
    module = net()
    trainer = Trainer({"main": module}, Settings(20, learning_rate=0.03, average=0.9), tmp_path)
    trainer.train(20, draw_for(module), silent)
    last = {name: value.clone() for name, value in module.state_dict().items()}
    trainer.swap()
    average = {name: value.clone() for name, value in module.state_dict().items()}
    trainer.swap()
    assert all(torch.equal(value, last[name]) for name, value in module.state_dict().items())
    trainer.finish()
    assert all(torch.equal(value, average[name]) for name, value in module.state_dict().items())
    assert any(not torch.equal(value, last[name]) for name, value in average.items())
    assert not any(value.requires_grad for value in module.parameters())


def test_the_rate_warms_up_and_falls_to_zero():
    rates = [Settings(100, learning_rate=1.0).rate(step) for step in range(101)]
    assert rates[0] == pytest.approx(0.2)
    assert max(rates) == rates[4] == 1.0
    assert rates[5:] == sorted(rates[5:], reverse=True)
    assert rates[100] == pytest.approx(0.0, abs=1e-12)


def test_a_loss_that_is_not_finite_is_refused_and_the_checkpoint_stays(tmp_path: Path):
    module = net()
    trainer = Trainer({"main": module}, Settings(10), tmp_path)
    trainer.train(3, draw_for(module), silent)
    trainer.save()
    before = (tmp_path / CHECKPOINT).read_bytes()
    with pytest.raises(DataError, match="The loss is nan in step 4 of 10"):
        trainer.train(10, draw_for(module, float("nan")), silent)
    assert (tmp_path / CHECKPOINT).read_bytes() == before


def test_weights_without_a_gradient_stay(tmp_path: Path):
    module = nn.ModuleDict({"used": nn.Linear(3, 1), "unused": nn.Linear(3, 1)})
    before = module["unused"].weight.detach().clone()
    trainer = Trainer({"main": module}, Settings(5), tmp_path)
    trainer.train(5, lambda _random: [(1.0, lambda: module["used"](torch.ones(1, 3)).sum())], silent)
    trainer.save()
    trainer = Trainer({"main": module}, Settings(5), tmp_path)
    assert torch.equal(module["unused"].weight, before)


@pytest.mark.parametrize("damage", [lambda data: data[:100], lambda data: data[: len(data) // 2], lambda data: b""])
def test_a_damaged_checkpoint_is_told(tmp_path: Path, damage):
    module = net()
    trainer = Trainer({"main": module}, Settings(5), tmp_path)
    trainer.train(2, draw_for(module), silent)
    trainer.save()
    (tmp_path / CHECKPOINT).write_bytes(damage((tmp_path / CHECKPOINT).read_bytes()))
    with pytest.raises(DataError, match=r"checkpoint.safetensors is damaged"):
        Trainer({"main": net()}, Settings(5), tmp_path)


def test_a_checkpoint_of_other_weights_is_told(tmp_path: Path):
    Trainer({"main": net()}, Settings(5), tmp_path).save()
    with pytest.raises(DataError, match=r"checkpoint.safetensors is damaged"):
        Trainer({"main": nn.Linear(2, 2)}, Settings(5), tmp_path)


def test_the_time_of_earlier_runs_counts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    clock = iter([10.0, 17.0, 100.0, 103.0])
    monkeypatch.setattr("vlatool.training.loop.time.monotonic", lambda: next(clock))
    Trainer({"main": net()}, Settings(5), tmp_path).save()
    assert seconds_of(tmp_path) == 7.0
    assert Trainer({"main": net()}, Settings(5), tmp_path).seconds == 10.0
