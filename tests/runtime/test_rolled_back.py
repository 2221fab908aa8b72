"""An inference that raised counts as if it had never been."""

from pathlib import Path

import numpy as np
import pytest
from _written import MEMORY, SUM, X, written

from vlatool.bundle.program import ProgramStep
from vlatool.errors import DataError, GraphError
from vlatool.runtime import ChunkQueue, Policy, load

GOOD, HUGE = {"x": [1.0, 2.0]}, {"x": [3e38, 1.0]}
ENGINES = pytest.mark.parametrize("engine", ["ort_cpu", "openvino"])


@ENGINES
def test_one_huge_number_does_not_poison_what_is_kept(tmp_path: Path, engine):
    path = written(tmp_path, SUM, program=MEMORY).path
    policy, other = load(path, engine=engine), load(path, engine=engine)
    policy.infer(GOOD)
    other.infer(GOOD)
    for _ in range(2):
        with pytest.raises(GraphError, match="'y' is not finite") as caught:
            policy.infer(HUGE)
    assert "as it was before this inference" in caught.value.message
    assert "reset()" in caught.value.fix
    again, wanted = policy.infer(GOOD), other.infer(GOOD)
    np.testing.assert_array_equal(again.chunk, wanted.chunk)
    assert again.sequence == wanted.sequence == 1


def test_a_kept_value_that_is_not_finite_is_refused_under_a_finite_action(tmp_path: Path):
    text = (
        "g (float[1,2] x, float[1,2] h) => (float[1,2] y, float[1,2] n) { s = Add(h, x)  n = Add(s, s)  y = Tanh(s) }"
    )
    policy = load(written(tmp_path, text, program=MEMORY).path)
    with pytest.raises(GraphError, match="kept value 'h' is not finite"):
        policy.infer(HUGE)
    np.testing.assert_allclose(policy.infer(GOOD).chunk, [np.tanh([1, 2])], rtol=1e-6)


def test_a_kept_value_that_comes_out_in_another_shape_is_refused(tmp_path: Path):
    text = "g (float[1,2] x, float[1,N] h) => (float[1,2] y, float[1,M] n) { y = Neg(x)  n = Concat<axis = 1>(h, x) }"
    policy = load(written(tmp_path, text, program=MEMORY).path)
    with pytest.raises(GraphError, match=r"kept value 'h' is float32 \[1, 4\]; the program declares float32 \[1, 2\]"):
        policy.infer(GOOD)


def noisy(folder: Path) -> Policy:
    text = "g (float[1,2] x, float[1,2] z) => (float[1,2] y) { s = Add(x, z)  y = Add(s, s) }"
    noise = {"z": {"shape": [1, 2]}}
    program = (ProgramStep("main", {"x": "x", "z": "z"}, {"y": "y"}, noise=noise),)
    return load(written(folder, text, program=program).path, seed=5)


def test_the_noise_after_a_refused_action_is_what_it_would_have_been(tmp_path: Path):
    policy, other = noisy(tmp_path / "a"), noisy(tmp_path / "b")
    with pytest.raises(GraphError, match="not finite"):
        policy.infer(HUGE)
    for _ in range(3):
        np.testing.assert_array_equal(policy.infer(GOOD).chunk, other.infer(GOOD).chunk)


@pytest.mark.parametrize(
    ("noise", "told"),
    [
        ({"z": np.zeros((1, 2), np.int64)}, "is int64; wanted float32"),
        ({"z": np.zeros((1, 3), np.float32)}, r"shape \[1, 3\]"),
        ({"z": "loud"}, "is <U4; wanted float32"),
        ({"q": np.zeros((1, 2), np.float32)}, "draws no noise 'q'"),
        (np.zeros((1, 2), np.float32), "is a ndarray; it must be a mapping"),
    ],
)
def test_noise_that_does_not_fit_is_told(tmp_path: Path, noise, told):
    policy = noisy(tmp_path)
    with pytest.raises(DataError, match=told):
        policy.infer(GOOD, noise=noise)


def test_an_error_of_the_engine_leaves_what_is_kept(tmp_path: Path):
    text = """g (float[1,N] x, float[1,2] h) => (float[1,2] y, float[1,2] n) <int64[2] s = {1, 2}> {
        r = Reshape(x, s)  n = Add(h, r)  y = Identity(n) }"""
    free = type(X)("x", (1, "n"))
    policy = load(written(tmp_path, text, (free,), program=MEMORY).path)
    policy.infer(GOOD)
    with pytest.raises(GraphError, match="ONNX Runtime failed") as caught:
        policy.infer({"x": [1.0, 2.0, 3.0]})
    assert "reset()" in caught.value.fix
    np.testing.assert_array_equal(policy.infer(GOOD).chunk, [[2, 4]])


def test_a_policy_without_state_does_not_talk_of_it(tmp_path: Path):
    policy = load(written(tmp_path, "g (float[1,2] x) => (float[1,2] y) { y = Add(x, x) }").path)
    with pytest.raises(GraphError) as caught:
        policy.infer(HUGE)
    assert "state" not in str(caught.value)


def test_an_action_that_overflows_in_physical_units_is_refused(tmp_path: Path):
    from _written import Y

    (tmp_path / "assets").mkdir()
    (tmp_path / "assets/s.json").write_text('{"y": {"mean": [0, 0], "std": [100, 100]}}')
    output = type(Y)("y", (1, 2), normalisation="mean_std", statistics="s.json#y")
    policy = load(written(tmp_path, "g (float[1,2] x) => (float[1,2] y) { y = Neg(x) }", outputs=(output,)).path)
    with pytest.raises(GraphError, match="'y' is not finite"):
        policy.infer(HUGE)


def test_a_queue_asks_again_after_a_refused_action(tmp_path: Path):
    queue = ChunkQueue(load(written(tmp_path, SUM, program=MEMORY).path))
    with pytest.raises(GraphError):
        queue.act(HUGE)
    np.testing.assert_array_equal(queue.act(GOOD), [2, 4])
