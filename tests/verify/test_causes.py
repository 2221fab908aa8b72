from types import SimpleNamespace

import numpy as np

from vlatool.verify._causes import _of_lines


def told(mine, theirs):
    policy = SimpleNamespace(spec=SimpleNamespace(action=SimpleNamespace(labels=("dx", "gripper"))))
    return list(_of_lines(policy, [SimpleNamespace(chunk=mine, wanted=theirs)], 1e-3))


def test_an_element_that_never_varies_hides_no_other_unit():
    mine = np.stack([np.arange(16.0), np.ones(16)], axis=1)
    assert "the original's dx is 1000 times" in " ".join(told(mine, mine * [1000, 1]))


def test_an_element_that_never_varies_and_differs_is_no_line():
    mine = np.stack([np.arange(16.0), np.ones(16)], axis=1)
    assert told(mine, mine * [1000, 2]) == []
