from __future__ import annotations

import json
import math
import shutil
from pathlib import Path

import pytest

from vlatool.bundle.bundle import DIGEST, Bundle, digest_of
from vlatool.errors import BundleError, DataError, GraphError
from vlatool.gate import run as run_gate_module
from vlatool.gate import timing_processes
from vlatool.gate.claims.deadline import Deadline
from vlatool.gate.claims.latency import Latency
from vlatool.gate.claims.memory import Memory
from vlatool.gate.claims.size import Size
from vlatool.gate.config import Gate
from vlatool.gate.run import run_gate
from vlatool.measurement.agreement import run_agreement
from vlatool.measurement.pairs import PairJob, Pairs
from vlatool.measures import tables
from vlatool.report import Report
from vlatool.runtime.identity import policy_identity
from vlatool.stage.base import Context
from vlatool.telemetry._reading import THROTTLE, Reader, gauge

QUICK = Gate(memory=None, latency=Latency(interim_analyses=(10,)))


@pytest.fixture
def as_fast(monkeypatch: pytest.MonkeyPatch):
    """A function that sets how much slower the candidate seems to be; no process is started."""

    def make(slowdown: float) -> list[PairJob]:
        jobs: list[PairJob] = []

        def measured(job: PairJob, timeout: float | None) -> Pairs:
            jobs.append(job)
            shift = math.exp(0.001 * (job.seed % 5 - 2))
            return Pairs((2.0,) * 80, (2.0 * (1 + slowdown) * shift,) * 80)

        monkeypatch.setattr(timing_processes, "measure_pairs", measured)
        monkeypatch.setattr(run_gate_module, "measure_agreement", lambda job, timeout: run_agreement(job))
        return jobs

    return make


@pytest.mark.parametrize(("slowdown", "verdict"), [(0.0, "pass"), (0.2, "fail"), (0.05, "inconclusive")])
def test_the_worst_claim_decides(float_bundle: Bundle, as_fast, slowdown: float, verdict: str) -> None:
    as_fast(slowdown)
    report = run_gate(float_bundle, float_bundle, QUICK, Context(command="vlatool gate x"))
    assert (report.kind, report.verdict) == ("gate", verdict)
    claims = {each["claim"]: each["verdict"] for each in report.rows[1].details["claims"]}
    assert claims == {"size": "pass", "accuracy": "pass", "answers": "pass", "latency": verdict}
    assert [row.name for row in report.rows] == ["baseline", "candidate"]
    assert len(report.rows[1].raw["log_ratio"]) == 10
    assert len(report.rows[0].raw["latency_ms"]) == 800
    assert report.command == "vlatool gate x"
    identities = [row.details[tables.IDENTITY][0]["identity"] for row in report.rows]
    assert identities == [policy_identity(float_bundle)] * 2
    assert Report.from_json(report.to_json()) == report


def test_the_summary_begins_with_what_failed(float_bundle: Bundle, int8_bundle: Bundle, as_fast) -> None:
    as_fast(0.5)
    gate = QUICK.model_copy(update={"size": Size(margin=0), "accuracy": None, "memory": Memory(margin=9)})
    report = run_gate(float_bundle, int8_bundle, gate, Context())
    assert report.summary[0] == "tiny does not keep to: size, latency."
    assert [line.split(":")[:2] for line in report.summary[1:-1]] == [
        ["size", " fail"], ["latency", " fail"], ["memory", " pass"], ["answers", " pass"],
    ]  # fmt: skip
    assert report.summary[-1].startswith(
        "observations are drawn from 40 recorded ones and the vocabulary with the seed "
    )


def test_every_process_has_its_own_seed_and_both_bundles(float_bundle: Bundle, int8_bundle: Bundle, as_fast) -> None:
    jobs = as_fast(0.0)
    claim = Latency(interim_analyses=(10,), pairs=33, threads=2, warmup=3, seconds=4)
    run_gate(int8_bundle, float_bundle, QUICK.model_copy(update={"latency": claim}), Context(), seed=7)
    assert [job.seed for job in jobs] == list(range(7, 17))
    job = jobs[0]
    assert (job.baseline, job.candidate) == (str(float_bundle.path), str(int8_bundle.path))
    assert (job.pairs, job.threads, job.warmup, job.seconds) == (33, 2, 3, 4)


def test_a_deadline_needs_no_claim_about_the_median(float_bundle: Bundle, as_fast) -> None:
    as_fast(0.0)
    gate = Gate(latency=None, accuracy=None, memory=None, size=None, deadline=Deadline(ms=3, percent=50))
    report = run_gate(float_bundle, float_bundle, gate, Context())
    assert report.verdict == "pass"
    assert len(report.rows[1].raw["latency_ms"]) >= 10 * 80, "ten processes at least"


def test_one_real_gate_from_end_to_end(float_bundle: Bundle) -> None:
    """Ten processes, each with the same bundle twice; no verdict is asked for, for this machine may be busy."""
    gate = Gate(latency=Latency(interim_analyses=(10,), pairs=30, margin=1.0), memory=Memory(margin=1.0))
    report = run_gate(float_bundle, float_bundle, gate, Context())
    measured = {each.name: each for each in report.rows[1].measurements}
    assert {each.name for each in report.rows[0].measurements} == {
        "latency_p50", "peak_rss", "size", "skill_expert", "variation",
    }  # fmt: skip
    assert set(measured) == {
        "latency_p50", "peak_rss", "size", "recorded_drop", "latency_ratio", "latency_mean_ratio", "follows"
    }  # fmt: skip
    assert measured["latency_ratio"].low <= measured["latency_ratio"].value <= measured["latency_ratio"].high
    assert report.verdict in ("pass", "inconclusive", "fail")
    json.loads(report.to_json())


@pytest.mark.parametrize("claim", ["memory", "latency"])
def test_a_process_that_hangs_ends_the_gate(float_bundle: Bundle, claim: str) -> None:
    gate = Gate(
        memory=Memory() if claim == "memory" else None,
        accuracy=None,
        size=None,
        latency=Latency(timeout=0.05),
    )
    with pytest.raises(GraphError, match=r"no result after 0\.05 s, so the process was ended") as caught:
        run_gate(float_bundle, float_bundle, gate, Context())
    assert "latency: {timeout: SECONDS}" in caught.value.fix


@pytest.mark.parametrize(
    ("side", "field", "value", "says"),
    [
        ("inputs", "shape", [1, 9, 8, 3], r"input image: shape \[1, 9, 8, 3\] in the candidate, \[1, 8, 8, 3\] in"),
        ("inputs", "unit", "bgr", r"input image: unit 'bgr' in the candidate, 'rgb' in the baseline"),
        (
            "outputs",
            "labels",
            ["dy", "dx"],
            r"output action: labels \['dy', 'dx'\] in the candidate, \['dx', 'dy'\] in",
        ),
        ("outputs", "mode", "absolute", "output action: mode 'absolute' in the candidate, 'delta' in the baseline"),
    ],
)
def test_bundles_that_mean_something_else_are_refused(
    float_bundle: Bundle, tmp_path: Path, side: str, field: str, value: object, says: str
) -> None:
    other = Path(shutil.copytree(float_bundle.path, tmp_path / "other"))
    manifest = json.loads((other / "manifest.json").read_text())
    manifest["spec"][side][0][field] = value
    (other / "manifest.json").write_text(json.dumps(manifest))
    (other / DIGEST).write_bytes(digest_of((other / "manifest.json").read_bytes()))
    with pytest.raises(BundleError, match=says):
        run_gate(Bundle.open(other, verify=False), float_bundle, QUICK, Context())


def test_a_source_without_graphs_is_refused(source_bundle: Bundle, float_bundle: Bundle) -> None:
    with pytest.raises(BundleError, match="has no graph to run"):
        run_gate(source_bundle, float_bundle, QUICK, Context())


def test_what_cannot_be_examined_is_said_before_anything_is_measured(
    float_bundle: Bundle, tmp_path: Path, resealed, as_fast
) -> None:
    jobs = as_fast(0.0)
    bare = Bundle.open(shutil.copytree(float_bundle.path, tmp_path / "bare"))
    shutil.rmtree(bare.path / "data")
    with pytest.raises(DataError, match="Accuracy is claimed"):
        run_gate(float_bundle, resealed(bare), QUICK, Context())
    assert jobs == []


def test_a_board_that_throttled_makes_the_measurement_suspect(float_bundle: Bundle, as_fast, monkeypatch) -> None:
    class Hot(Reader):
        name = "pi"

        @classmethod
        def open(cls, root=None, run=None):
            return cls()

        def read(self):
            return gauge("pi.throttled", 1.0, THROTTLE, "soft temperature limit")

    as_fast(0.0)
    gate = QUICK.model_copy(update={"accuracy": None, "size": None})
    assert run_gate(float_bundle, float_bundle, gate, Context()).validity == "valid"
    monkeypatch.setattr(run_gate_module, "open_all", lambda: [Hot()])
    report = run_gate(float_bundle, float_bundle, gate, Context())
    assert (report.verdict, report.validity) == ("pass", "suspect")
    assert "soft temperature limit" in report.findings[0].reason


def test_other_work_before_the_gate_is_noted(float_bundle: Bundle, as_fast, monkeypatch) -> None:
    as_fast(0.0)
    machine = {"cores_online": 2, "processors_busy": 1.2}
    monkeypatch.setattr(run_gate_module, "before_run", lambda: machine)
    report = run_gate(float_bundle, float_bundle, QUICK.model_copy(update={"accuracy": None}), Context())
    assert [(each.effect, "1.2 of 2 processors" in each.reason) for each in report.findings] == [("note", True)]
    assert report.validity == "valid"
    assert report.environment == machine
    untimed = run_gate(
        float_bundle, float_bundle, QUICK.model_copy(update={"accuracy": None, "latency": None}), Context()
    )
    assert not untimed.findings, "no time is claimed"
