"""What makes no sense as an argument is told in a sentence."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from _written import written

from vlatool.errors import DataError, UsageError
from vlatool.runtime import ChunkQueue, load

NEG = "g (float[1,2] x) => (float[1,2] y) { y = Neg(x) }"


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        ({"seed": -1}, "seed is -1; allowed: a whole number from 0, or None"),
        ({"seed": "many"}, "seed is 'many'"),
        ({"seed": 1.5}, "seed is 1.5"),
        ({"threads": 0}, "threads is 0; allowed: a whole number from 1 to 1024, or None"),
        ({"threads": 2.0}, "threads is 2.0"),
        ({"threads": 10**9}, "threads is 1000000000"),
        ({"threads": True}, "threads is True"),
        ({"warmup": -1}, "warmup is -1; allowed: a whole number from 0"),
        ({"warmup": None}, "warmup is None"),
        ({"golden_tolerance": "0.1"}, "golden_tolerance is '0.1'"),
        ({"golden_tolerance": float("nan")}, "golden_tolerance is nan"),
        ({"first_run_s": 0}, "first_run_s is 0; allowed: a number of seconds above 0"),
        ({"memory_mb": -5}, "memory_mb is -5"),
    ],
)
def test_load_tells_what_an_argument_may_be(tmp_path: Path, arguments: dict[str, Any], told: str):
    with pytest.raises(UsageError) as caught:
        load(written(tmp_path, NEG).path, **arguments)
    assert told in caught.value.message


@pytest.mark.parametrize("path", [None, 3, b"bundle"])
def test_what_is_no_path(path: Any):
    with pytest.raises(UsageError, match="path of the bundle is a"):
        load(path)


def test_whole_numbers_of_numpy_are_whole_numbers(tmp_path: Path):
    assert load(written(tmp_path, NEG).path, threads=np.int64(1), seed=np.uint8(3), warmup=np.int32(1))


@pytest.mark.parametrize("execute", [-1, 1.5, "2", None])
def test_a_queue_executes_a_whole_number_of_actions(tmp_path: Path, execute: Any):
    policy = load(written(tmp_path, NEG).path)
    with pytest.raises(UsageError, match="execute is"):
        ChunkQueue(policy, execute)


@pytest.mark.parametrize(
    ("observation", "kind"),
    [(np.zeros((1, 2), np.float32), "ndarray"), ([1.0, 2.0], "list"), ("x", "str"), (None, "NoneType")],
)
def test_an_observation_that_is_no_mapping_is_told(tmp_path: Path, observation: Any, kind: str):
    policy = load(written(tmp_path, NEG).path)
    with pytest.raises(DataError, match=f"is a {kind}; it must be a mapping of names to values") as caught:
        policy.infer(observation)
    assert caught.value.fix == 'the policy has one input: pass {"x": ...}'


class Tensor:
    """As torch's, which refuses numpy where it requires a gradient or lies on a GPU."""

    def __array__(self, *_: Any, **__: Any) -> Any:
        raise RuntimeError("can't convert cuda tensor")


def test_a_value_that_gives_no_array_is_told(tmp_path: Path):
    policy = load(written(tmp_path, NEG).path)
    with pytest.raises(DataError, match="is a Tensor, which cannot be converted to a numpy array"):
        policy.infer({"x": Tensor()})


@pytest.mark.parametrize("how", ["warn", "raise", "ignore"])
@pytest.mark.parametrize("value", [1e300, -1e300])
def test_a_number_beyond_float32_is_told_however_numpy_is_set(tmp_path: Path, how: Any, value: float):
    """A warning of numpy would be an error here."""
    policy = load(written(tmp_path, NEG).path)
    says = r"'x' has values that are too large for float32 \(beyond 3\.4e\+38\), .*: up to 1e\+300"
    with np.errstate(over=how), pytest.raises(DataError, match=says):
        policy.infer({"x": np.array([value, 0.0])})
