"""Whether a candidate follows the baseline where nothing is recorded."""

from __future__ import annotations

import numpy as np
import pytest

from vlatool.bundle.bundle import Bundle, seal
from vlatool.errors import BundleError, GraphError
from vlatool.measurement.agreement import OutputAgreement, correlation, measure_agreement, run_agreement
from vlatool.measurement.pairs import PairJob


@pytest.fixture
def job(float_bundle: Bundle, int8_bundle: Bundle) -> PairJob:
    return PairJob(str(float_bundle.path), str(int8_bundle.path), pairs=90, seed=5)


def random(*shape: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=shape)


def test_the_correlation_is_that_of_variation_alone() -> None:
    one = random(200, 4, 2)
    assert correlation(one, one) == pytest.approx(1)
    assert correlation(3 * one + 7, one) == pytest.approx(1), "another scale and offset follow, too"
    assert correlation(-one, one) == pytest.approx(-1)
    assert abs(correlation(random(200, 4, 2, seed=1), one)) < 0.1
    assert correlation(np.ones_like(one), one) == 0
    assert correlation(one[:, :2], one) == 0, "another shape follows nothing"


@pytest.mark.parametrize(
    ("scale", "offset", "wanted"),
    [(1, 0, 1), (0.1, 0, 0.198), (10, 0, 0.198), (1, 2, 1 / 3), (0.9, 0.1, 0.99), (-1, 0, -1)],
)
def test_where_scale_and_place_count_another_answer_does_not_follow(scale: float, offset: float, wanted: float):
    one = random(2000)[:, None]
    one = (one - one.mean()) / one.std()
    assert correlation(scale * one + offset, one, concordant=True) == pytest.approx(wanted, abs=0.001)
    assert correlation(np.zeros_like(one), one, concordant=True) == pytest.approx(0)


def test_every_element_counts_alike() -> None:
    one = random(300, 2) * [100.0, 0.1]
    assert correlation(one * [1, -1], one) == pytest.approx(0, abs=1e-9), "a small element that is wrong is half of two"


def test_elements_that_do_not_vary_do_not_count() -> None:
    one = np.column_stack([random(50), np.full(50, 5.0)])
    assert correlation(np.column_stack([one[:, 0], random(50)]), one) == pytest.approx(1)
    still = np.full((50, 2), 5.0)
    assert correlation(still * 1.1, still) == 1
    assert correlation(-still, still) == 0


def test_the_rounding_of_an_element_that_happens_to_stand_still_counts_little() -> None:
    """Otherwise it would outweigh seven that follow exactly."""
    one, usual = random(24, 4, 2), np.ones((4, 2))
    one[:, 3, 1] *= 1e-3
    mine = one + 0.02 * random(24, 4, 2, seed=2)
    assert correlation(mine, one) < 0.5
    assert correlation(mine, one, usual) > 0.99
    assert correlation(-mine, one, usual) < -0.99
    assert correlation(np.zeros_like(one), one, usual) == 0
    assert abs(correlation(random(24, 4, 2, seed=3), one, usual)) < 0.3


def test_a_fresh_process_says_how_int8_follows_float32(job: PairJob) -> None:
    found = measure_agreement(job)
    assert [(each.kind, each.output) for each in found.followed] == [("drawn", "action")]
    assert isinstance(found.followed[0], OutputAgreement)
    assert found.followed[0].correlation > 0.9
    assert (found.looked, found.strays, found.unsteady, found.skipped) == (30, 0, 0, 0)
    assert found.golden[0] == pytest.approx(0, abs=1e-5)
    assert found.engines == ("ort_cpu", "ort_cpu")
    assert [record.problems for record in found.records] == [(), ()]


def test_nothing_is_asked_of_a_gate_without_answers_but_the_golden_action(job: PairJob, copied) -> None:
    silent = PairJob(**{**vars(job), "pairs": 0})
    assert run_agreement(silent).followed == ()
    made = copied(Bundle.open(job.candidate))
    with np.load(made.path / "golden/golden.npz") as stored:
        np.savez(
            made.path / "golden/golden.npz",
            **{name: -stored[name] if name == "out.action" else stored[name] for name in stored.files},
        )
    seal(made.path, made.manifest)
    with pytest.raises(GraphError, match=r"copied: This machine computes a different golden action than recorded"):
        run_agreement(PairJob(**{**vars(silent), "candidate": str(made.path)}))


def test_a_file_that_was_changed_is_told(job: PairJob, copied) -> None:
    made = copied(Bundle.open(job.candidate))
    with (made.path / "graphs/main.onnx").open("ab") as stream:
        stream.write(b"x")
    with pytest.raises(BundleError, match=r"main\.onnx"):
        run_agreement(PairJob(**{**vars(job), "candidate": str(made.path)}))
