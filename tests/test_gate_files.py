from __future__ import annotations

from pathlib import Path

import yaml

from vlatool.cli import app
from vlatool.gate import Gate, read_gate
from vlatool.gate_files import gate_files


def test_the_written_gate_is_one_and_says_the_defaults(tmp_path: Path) -> None:
    path = tmp_path / "gate.yaml"
    path.write_text(gate_files("models/base", "policy")["gate.yaml"])
    gate = read_gate(path)
    assert gate.baseline == tmp_path / "models/base"
    assert gate.model_copy(update={"baseline": None}) == Gate()


def test_the_jobs_are_yaml_and_run_the_gate() -> None:
    files = gate_files("models/base", "my/policy")
    github = yaml.safe_load(files[".github/workflows/policy-gate.yml"])
    steps = github["jobs"]["gate"]["steps"]
    (line,) = [step["run"] for step in steps if "vlatool gate" in step.get("run", "")]
    assert line.startswith("vlatool gate my/policy --config gate.yaml ")
    gitlab = yaml.safe_load(files[".gitlab/policy-gate.yml"])["policy gate"]
    assert line in gitlab["script"]
    assert gitlab["allow_failure"] == {"exit_codes": 5}
    assert gitlab["artifacts"]["reports"]["junit"] == "gate.xml"


def test_the_jobs_use_flags_that_exist() -> None:
    import typer

    group = typer.main.get_command(app).commands["gate"]  # type: ignore[attr-defined]
    flags = {flag for parameter in group.commands["run"].params for flag in parameter.opts}
    line = next(each for each in gate_files("b", "c")[".gitlab/policy-gate.yml"].splitlines() if "vlatool gate" in each)
    assert {word for word in line.split() if word.startswith("-") and word != "-"} <= flags
