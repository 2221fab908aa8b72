"""What policies keep from step to step is there when it is ranked what they need."""

from __future__ import annotations

from itertools import product
from pathlib import Path

import numpy as np
import pytest
import torch
from _full import small_or_full
from _recurrent import recorded, recurrent_bundle

from vlatool.bundle.bundle import Bundle
from vlatool.module.torch_policy import load_modules, torch_policy
from vlatool.prune._block_ranking import BlockRanking
from vlatool.prune.structured import Structured
from vlatool.prune.wanda import Wanda
from vlatool.stage.base import Context
from vlatool.stage.run import run_transform


def actions(bundle: Bundle) -> np.ndarray:
    """What a policy does in episodes that nobody ranked on, (N, 2)."""
    policy, rows = torch_policy(bundle, 0), recorded(4, seed=9)
    chunks = []
    for target, begins in zip(rows["target"], np.diff(rows["episode"], prepend=-1), strict=True):
        if begins:
            policy.reset()
        chunks.append(policy.infer({"target": target}).chunk[0])
    return np.stack(chunks)


@pytest.mark.parametrize(("kind", "options"), small_or_full(
    [("hidden", {"count": 0}), ("writers", {}), ("writers", {"episodes": False})],
    list(product(("hidden", "writers"), ({}, {"count": 0}, {"episodes": False}))),
))  # fmt: skip
def test_units_that_read_or_write_what_is_kept_are_not_taken_for_useless(tmp_path: Path, kind: str, options):
    source = recurrent_bundle(tmp_path / kind, kind, **options)
    made = run_transform(Structured(ratio=0.4, multiple=1), source, tmp_path / "out", Context()).bundle
    whole, pruned = actions(source), actions(made)
    assert np.linalg.norm(pruned - whole) / np.linalg.norm(whole) < 0.2


def test_zeros_are_chosen_by_what_layers_are_given_with_it(tmp_path: Path):
    """With memory 0 all weights that read it would matter as little as any could."""
    source = recurrent_bundle(tmp_path / "hidden", "hidden")
    made = run_transform(Wanda(ratio=0.5, include=("i",)), source, tmp_path / "out", Context()).bundle
    weight = load_modules(made)["main"].i.weight.detach()
    assert int((weight[32:, 2:] != 0).sum()) > 100


class Blocks(torch.nn.Module):
    """Two blocks: one changes what it is given by what is kept, one hardly at all."""

    def __init__(self, keeps: int) -> None:
        super().__init__()
        self.blocks = torch.nn.ModuleList(Block() for _ in range(2))
        self.keeps = keeps
        with torch.no_grad():
            for number, block in enumerate(self.blocks):
                block.map.weight.copy_(torch.eye(4) * 0.01)
                block.map.weight[:, 2:] += float(number == keeps)

    def forward(self, target: torch.Tensor, memory: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        stream = torch.cat([target, memory], 1)
        for block in self.blocks:
            stream = block(stream)
        return stream[:, None, :2], 0.5 * memory + target


class Block(torch.nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.map = torch.nn.Linear(4, 4, bias=False)

    def forward(self, stream: torch.Tensor) -> torch.Tensor:
        return stream + self.map(stream)


@pytest.mark.parametrize("keeps", [0, 1])
@pytest.mark.parametrize("rank", ["errors", "gate", "cosine"])
def test_blocks_that_read_it_matter(tmp_path: Path, rank: str, keeps: int):
    source = recurrent_bundle(tmp_path / "sum", "sum")
    ranking = BlockRanking({"main": Blocks(keeps).eval()}, source, 16)
    places = [("main", "blocks", number) for number in range(2)]
    scores = getattr(ranking, rank)(places, set())
    assert scores[places[keeps]] > 3 * scores[places[1 - keeps]]
