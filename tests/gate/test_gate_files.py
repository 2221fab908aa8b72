from __future__ import annotations

from pathlib import Path

import yaml

from vlatool.cli import app
from vlatool.gate.config import Gate, read_gate
from vlatool.gate.files import gate_files


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
    for lines in ([step.get("run", "") for step in steps], gitlab["script"]):
        assert any(text.startswith('pip install "vlatool[ort,build]>=') for text in lines), "an engine, and YAML"
    assert gitlab["allow_failure"] == {"exit_codes": 5}
    assert gitlab["artifacts"]["reports"]["junit"] == "gate.xml"


def test_the_jobs_use_flags_that_exist() -> None:
    import typer

    group = typer.main.get_command(app).get_command(None, "gate")  # type: ignore[attr-defined]
    flags = {flag for parameter in group.commands["run"].params for flag in parameter.opts}
    line = next(each for each in gate_files("b", "c")[".gitlab/policy-gate.yml"].splitlines() if "vlatool gate" in each)
    assert {word for word in line.split() if word.startswith("-") and word != "-"} <= flags


def test_paths_with_blanks_and_marks_stay_paths(tmp_path: Path) -> None:
    files = gate_files("my models/a: b # c", "my policy")
    (tmp_path / "gate.yaml").write_text(files["gate.yaml"])
    assert read_gate(tmp_path / "gate.yaml").baseline == tmp_path / "my models/a: b # c"
    gitlab = yaml.safe_load(files[".gitlab/policy-gate.yml"])["policy gate"]
    assert any("vlatool gate 'my policy' --config" in line for line in gitlab["script"])
    yaml.safe_load(files[".github/workflows/policy-gate.yml"])
