"""Whatever a policy gives, only what its spec declares is passed on."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from _numbered import MOVES, NumberedPolicy, spec_of

from vlatool.bundle.spec import TensorSpec
from vlatool.errors import GraphError
from vlatool.runtime.control.action_check import CheckedPolicy

GOOD = np.zeros((3, 2), np.float32)
BUTTONS = TensorSpec("a", (1, 2, 3), kind="discrete", labels=("l", "r", "stop"))


class Given(NumberedPolicy):
    """Gives one chunk."""

    def __init__(self, chunk: Any, *spec: Any, **more: Any) -> None:
        super().__init__(spec_of(*spec, **more))
        self.chunk = chunk

    def infer(self, observation: Any, *, noise: Any = None) -> Any:
        return super().infer({"t": 0})._replace(chunk=self.chunk)


def wrong(value: float, place: tuple[int, int] = (0, 0)) -> Any:
    chunk = GOOD.copy()
    chunk[place] = value
    return chunk


def test_what_the_spec_declares_is_passed_on_unchanged():
    for chunk, spec in ((GOOD, spec_of(3)), (np.array([2, 0]), spec_of(2, action=BUTTONS))):
        policy = Given(chunk, spec.chunk, action=spec.action)
        assert CheckedPolicy(policy).infer({}).chunk is chunk
    free = TensorSpec("a", (1, "T", 2), labels=("x", "y"))
    assert len(CheckedPolicy(Given(GOOD[:1], 3, action=free)).infer({}).chunk) == 1


@pytest.mark.parametrize(
    ("chunk", "message"),
    [(wrong(np.nan), "is not finite"), (wrong(np.inf, (2, 1)), "is not finite"), (wrong(-np.inf), "is not finite"),
     (GOOD[:2], r"has the shape \[2, 2\]; the spec declares \[3, 2\]"), (GOOD.T, "has the shape"),
     (GOOD[None], "has the shape"), (GOOD[0], "has the shape"), (np.float32(0), "is a float32"),
     (np.zeros(()), "is float64"), (np.zeros((), np.float32), "has the shape"), (GOOD.astype(np.float64), "is float64"),
     (GOOD.astype(np.float16), "is float16"), (GOOD.astype(int), "is int64"), (GOOD.astype(object), "is object"),
     (GOOD.astype(complex), "is complex128"), (GOOD.tolist(), "is a list"), (None, "is a NoneType"),
     (np.ma.masked_array(GOOD), "is a MaskedArray"), (np.zeros((0, 2), np.float32), "has the shape")],
    ids=str,
)  # fmt: skip
def test_anything_else_is_refused(chunk: Any, message: str):
    with pytest.raises(GraphError, match=f"Given gives a chunk that {message}"):
        CheckedPolicy(Given(chunk, 3)).infer({})


@pytest.mark.parametrize("chunk", [np.array([0, 3]), np.array([-1, 0]), np.array([0.0, 1.0]), np.array([[0, 1]]),
                                   np.array([0]), np.array([0, 1], np.int32)], ids=str)  # fmt: skip
def test_indices_that_name_no_action_are_refused(chunk: Any):
    with pytest.raises(GraphError, match="gives a chunk that"):
        CheckedPolicy(Given(chunk, 2, action=BUTTONS)).infer({})


@pytest.mark.parametrize("shape", [(1, "T", 2), (1, 3, "A")])
def test_a_free_axis_may_not_be_empty(shape: Any):
    empty = np.zeros([0 if isinstance(axis, str) else axis for axis in shape[1:]], np.float32)
    action = TensorSpec("a", shape, mode=MOVES.mode)
    with pytest.raises(GraphError, match="has the shape"):
        CheckedPolicy(Given(empty, 3, action=action)).infer({})
