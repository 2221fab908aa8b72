from types import SimpleNamespace

import numpy as np
import pytest
import torch

from vlatool.verify._causes import _of_lines, _of_rounding


def told(mine, theirs):
    policy = SimpleNamespace(spec=SimpleNamespace(action=SimpleNamespace(labels=("dx", "gripper"))))
    return list(_of_lines(policy, [SimpleNamespace(chunk=mine, expected=theirs)], 1e-3))


def rounded(mine, theirs):
    policy = SimpleNamespace(spec=SimpleNamespace(action=SimpleNamespace(kind="continuous")))
    return list(_of_rounding(policy, [SimpleNamespace(chunk=mine, expected=theirs)]))


def chunk(count=48):
    """Millimetres beside a gripper near 0.6, as float64."""
    random = np.random.default_rng(0)
    return np.stack([random.normal(0, 0.01, count), random.normal(0.6, 0.03, count)], axis=1)


@pytest.mark.parametrize("seed", range(5))
def test_rounding_is_no_straight_line(seed):
    mine = chunk() + 1e-7 * np.random.default_rng(seed).standard_normal((48, 2))
    assert told(mine, chunk().astype(np.float16).astype(np.float64)) == []


def test_a_constant_original_is_no_straight_line():
    mine = chunk()
    assert told(mine, np.stack([mine[:, 0], np.full(48, 0.6)], axis=1)) == []


def test_a_small_offset_that_explains_the_difference_is_a_line():
    assert "plus 0.0003" in " ".join(told(chunk(), chunk() + np.array([0, 0.0003])))


def test_few_values_are_no_line():
    assert told(chunk(12), chunk(12) * [1000, 1]) == []


def test_a_narrower_action_is_told_by_its_dtype():
    mine = chunk()
    half = mine.astype(np.float16).astype(np.float64)
    coarse = torch.from_numpy(mine).bfloat16().double().numpy()
    assert "is in float16" in " ".join(rounded(mine, half))
    assert "is in bfloat16" in " ".join(rounded(mine, coarse))
    assert rounded(mine, half * 1.01) == rounded(mine, mine + 1e-3) == rounded(mine, mine * 1.0001) == []


def test_an_element_that_never_varies_hides_no_other_unit():
    mine = np.stack([np.arange(16.0), np.ones(16)], axis=1)
    assert "the original's dx is 1000 times" in " ".join(told(mine, mine * [1000, 1]))


def test_an_element_that_never_varies_and_differs_is_no_line():
    mine = np.stack([np.arange(16.0), np.ones(16)], axis=1)
    assert told(mine, mine * [1000, 2]) == []
