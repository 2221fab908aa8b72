"""``--json`` is one JSON document on standard output: every command, however it ends, whatever the policy prints."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jsonschema
import numpy as np
import pytest
import typer
from _acts import POLICY_YAML, policy
from _arithmetic import computes_bfloat16
from _flow import write_flow
from _full import small_or_full
from _slots import bundle_of, install
from safetensors.torch import load_file, save_file

from vlatool.cli import app, main
from vlatool.cli._document import document, json_text, output, report_document
from vlatool.deployment.signature import new_key, sign
from vlatool.deployment.store import Store
from vlatool.errors import OutputError
from vlatool.machine.host import isa
from vlatool.machine.instruction_sets import saturates
from vlatool.measurement.recorded_run import record_run
from vlatool.report import Report, Row, read_report

SCHEMA = json.loads((Path(__file__).parents[2] / "docs/reference/output.schema.json").read_text())
NOISE = """\
import atexit, ctypes, os, subprocess
print("print in WHERE")
os.write(1, b"descriptor in WHERE\\n")
ctypes.CDLL(None).puts(b"puts in WHERE")
subprocess.run(["echo", "child in WHERE"])
atexit.register(print, "at exit of WHERE")
"""
QUICK = "--iterations 20 --duration 0"
LINES = {
    "optimize": "{policy} -o {out} --episodes 0 --no-search --iterations 20",
    "export onnx": "{policy} -o {out}",
    "export opset": "{bundle} -o {out} --opset 20",
    "export openvino": "{bundle} -o {out}",
    "export tensorrt": "{bundle} -o {out}",
    "prune": "{policy} -o {out} --samples 2",
    "prune neurons": "{policy} -o {out}",
    "prune structured": "{policy} -o {out} --samples 2 --multiple 1",
    "prune depth": "{deep} -o {out} --samples 2",
    "prune gradual": "{policy} -o {out} --steps 2 --batch 2 --episodes 0 --student-episodes 0 --threads 1",
    "prune latency": "{deep} -o {out} --target-ms 1 --chosen {chosen}",
    "prune steps": "{flow} -o {out} --to 2",
    "distill policy": "{pruned} -o {out} --trust {policy} --steps 2 --batch 2 --episodes 1 --student-episodes 0",
    "distill weights": "{policy} --file {tuned} -o {out}",
    "quantize bfloat16": "{policy} -o {out}",
    "quantize float8": "{policy} -o {out}",
    "quantize qat": "{policy} -o {out} --steps 2 --batch 2 --episodes 0 --student-episodes 0 --threads 1",
    "quantize": "{policy} -o {out}",
    "benchmark latency": "{policy} --iterations 20 --duration 0",
    "benchmark overhead": "{policy} --iterations 100",
    "evaluate recorded": "{policy}",
    "evaluate closed-loop": "{policy} --policy {policy} --episodes 2 --workers 1",
    "compare": "{bundle} {bundle} --iterations 20",
    "explain": "{bundle} --baseline {bundle} --samples 1 --no-suggest",
    "gate run": "{policy} --baseline {bundle} --config {gate}",
    "gate init": "{out}",
    "hwselect select": "{policy}",
    "hwselect score": "{points}",
    "hwselect fit": "{points} -o {out} --seconds 0",
    "cache size": "",
    "cache list": "",
    "cache prune": "--all --dry-run",
    "data inspect": "{policy}/calibration.npz",
    "data sample": "{policy}/calibration.npz -o {out}.npz --samples 3",
    "verify": "{policy} --against {original}:act",
    "inspect": "{bundle} --probe",
    "rebuild": "{bundle} --check --source {policy}",
    "deploy": "{toy} --store {out} --runs 32",
    "status": "--store {store}",
    "rollback": "--store {store}",
    "sign": "{toy} --key {key} --force",
    "verify-signature": "{toy} --key {key}.pub",
    "doctor": "",
    "run bundle": "{bundle} --dry-run --steps 20",
    "run": "--bus sim --seconds 0.1 --wait 0",
    "sim": "--bus sim --seconds 0.1 --only odom",
    "topics": "--bus sim --seconds 0",
    "serve": "{bundle} --port 0 --seconds 0.1",
    "record": "{bundle} -o {out} --steps 2",
    "replay": "{recorded} {bundle}",
    "simulate": "{policy} --profile raspberry-pi-5",
    "telemetry": "--seconds 0.1",
    "profiles list": "",
    "profiles show": "raspberry-pi-5",
    "profiles diff": "raspberry-pi-5 jetson-orin-nano",
    "profiles validate": "raspberry-pi-5",
    "profiles new": "mine -o {out}.yaml",
    "profiles calibrate": "raspberry-pi-5 --from {report}",
    "new": "{out} --from {bundle}/graphs/main.onnx",
    "samples list": "",
    "samples make": "vit-s -o {out}",
}
"""Command, or group of commands -> a command line of it that ends well."""


def commands(words: tuple[str, ...] = (), current: Any = None) -> Iterator[str]:
    """Return every command that the program has."""
    current = current or typer.main.get_command(app)
    lister = getattr(current, "list_commands", None)
    if lister is None:
        yield " ".join(words)
        return
    for name in lister(None):
        yield from commands((*words, name), current.get_command(None, name))


ONE_OF_MANY = {"run": ("bundle", "roi-tracker"), "sim": ("turtlebot4",)}
"""Groups whose commands one function makes, from a class each -> those that stand for all."""
ALL = [
    command
    for command in commands()
    for group, _, name in [command.partition(" ")]
    if name in ONE_OF_MANY.get(group, (name,))
]
ALIKE = {"export opset", "prune sparsegpt", "prune structured", "prune wanda", "quantize dynamic-int8",
         "quantize float16", "quantize smooth-quant"}  # fmt: skip
"""Commands that write their bundle and its document as others of their group do."""


def of(table: dict[str, Any], command: str) -> Any:
    """Return the entry of a command, or of its group."""
    return table.get(command, table.get(command.partition(" ")[0]))


@pytest.fixture
def vlatool(capfd):
    """Run a command line in this process; return status, the document on descriptor 1, and descriptor 2."""

    def run(*line: Any) -> tuple[int, Any, str]:
        capfd.readouterr()
        with pytest.raises(SystemExit) as left:
            main([str(part) for part in line])
        told = capfd.readouterr()
        return left.value.code or 0, json.loads(told.out), told.err

    return run


@pytest.fixture(scope="session")
def places(policy_template, tmp_path_factory) -> SimpleNamespace:
    """A policy that prints wherever it can, a bundle of it, and what else commands read."""
    here = tmp_path_factory.mktemp("noisy")
    noisy = Path(shutil.copytree(policy_template, here / "noisy"))
    code = (noisy / "policy.py").read_text()
    code = code.replace("import torch\n", NOISE.replace("WHERE", "import") + "import torch\n", 1)
    inside = "".join(f"    {line}\n" for line in NOISE.replace("WHERE", "make").splitlines())
    code = code.replace("def make(layers=1):\n", f"def make(layers=1):\n{inside}")
    code = code.replace("        pixels =", "        print('print in forward')\n        pixels =")
    (noisy / "policy.py").write_text(code)
    (here / "gate.yaml").write_text("{latency: null, memory: null, accuracy: {}}")
    with pytest.raises(SystemExit) as left:
        main(["export", str(noisy), "-o", str(here / "bundle")])
    assert not left.value.code
    original = "import vlatool\npolicy = vlatool.load(BUNDLE)\ndef act(given):\n    return policy.infer(given).chunk\n"
    (here / "original.py").write_text(original.replace("BUNDLE", repr(str(here / "bundle"))))
    with pytest.raises(SystemExit) as left:
        main(["prune", "neurons", str(noisy), "-o", str(here / "pruned"), "--ratio", "0.01"])
    assert not left.value.code
    record_run(here / "bundle", here / "recorded", steps=3)
    made = {
        "deep": deeper(noisy, here / "deep"),
        "flow": write_flow(here / "flow"),
        "chosen": '[{"graph":"main","module":"blocks","axis":"blocks","keep":[0]}]',
        "bundle": here / "bundle",
        "pruned": here / "pruned",
        "tuned": here / "pruned/module/main.safetensors",
        "original": here / "original.py",
        "gate": here / "gate.yaml",
        "recorded": here / "recorded",
    }
    return SimpleNamespace(policy=noisy, **made, **deployed(here), here=here)


def deployed(here: Path) -> dict[str, Path]:
    """Make a bundle that is signed, the key, and a store with a bundle to go back to."""
    toys = [bundle_of(here / f"toy {value}", value) for value in (1, 2)]
    for toy in toys:
        install(Store(here / "store"), toy, trial=None)
    new_key(here / "key")
    sign(toys[0], here / "key", 1)
    return {"toy": toys[0].path.rename(here / "toy"), "key": here / "key", "store": here / "store"}


def deeper(policy: Path, folder: Path) -> Path:
    """Copy a policy with a second block like the first."""
    shutil.copytree(policy, folder)
    description = folder / "policy.yaml"
    description.write_text(description.read_text().replace("layers: 1", "layers: 2"))
    weights = load_file(folder / "weights.safetensors")
    second = {name.replace("blocks.0", "blocks.1"): value.clone() for name, value in weights.items()}
    save_file({**second, **weights}, folder / "weights.safetensors")
    return folder


def validate(value: Any, name: str) -> None:
    jsonschema.validate(value, {**SCHEMA, "anyOf": [{"$ref": f"#/$defs/{name}"}]})


def test_the_schema_is_one() -> None:
    jsonschema.Draft202012Validator.check_schema(SCHEMA)


@pytest.mark.parametrize("command", ALL)
def test_every_command_takes_json_and_its_document_has_a_schema(command: str) -> None:
    current = typer.main.get_command(app)
    for word in command.split():
        current = current.get_command(None, word)
    assert any("--json" in option.opts for option in current.params), f"vlatool {command} has no --json"
    assert of(SCHEMA["commands"], command), f"vlatool/cli/_schemas.py says nothing of vlatool {command}"
    assert of(LINES, command) is not None, f"LINES has no example of vlatool {command}"


@pytest.mark.parametrize("command", ALL)
def test_a_wrong_option_is_a_document(vlatool, command: str) -> None:
    status, told, err = vlatool(*command.split(), "--no-such-option", "--json")
    validate(told, "failed")
    assert (status, told["error"]["exit_code"], told["error"]["type"]) == (2, 2, "UsageError")
    assert "no-such-option" in told["error"]["message"]
    assert told["error"]["message"] in err


@pytest.mark.parametrize("command", small_or_full([command for command in ALL if command not in ALIKE], ALL))
def test_a_command_prints_its_document_alone(vlatool, places, points_file, tmp_path, command: str) -> None:
    report = places.here / "report"
    if command == "profiles calibrate" and not report.exists():
        vlatool("benchmark", places.bundle, *QUICK.split(), "-o", report, "--json")
    given = {**vars(places), "points": points_file, "out": tmp_path / "out", "report": report}
    line = [word.format(**given) for word in of(LINES, command).split()]
    status, told, err = vlatool(*command.split(), *line, "--json")
    if command == "quantize bfloat16" and not computes_bfloat16():
        validate(told, "failed")
        assert (status, told["error"]["type"]) == (3, "GraphError")
        assert "wanted bf16" in told["error"]["message"]
        return
    assert status == 0, err
    assert "error" not in told
    validate(told, of(SCHEMA["commands"], command)[0])


def test_what_the_policy_printed_is_on_stderr(vlatool, places, tmp_path) -> None:
    fresh = Path(shutil.copytree(places.policy, tmp_path / "fresh"))
    (fresh / "policy.py").write_text((places.policy / "policy.py").read_text() + "# another one\n")
    _, told, err = vlatool("export", fresh, "-o", tmp_path / "out", "--json")
    assert told["bundle"] == str(tmp_path / "out")
    said = {f"{kind} in {where}" for where in ("import", "make") for kind in ("print", "descriptor", "puts", "child")}
    assert {each for each in {*said, "print in forward"} if f"[policy.py] {each}" not in err} == set()


BAD = {
    "optimize": "{nothing} -o {out}",
    "export": "{nothing} -o {out}",
    "prune": "{nothing} -o {out}",
    "distill": "{nothing} --file {nothing} -o {out}",
    "quantize": "{nothing} -o {out}",
    "benchmark": "{nothing}",
    "evaluate": "{nothing}",
    "evaluate closed-loop": "{nothing} --policy {nothing}",
    "compare": "{nothing} {nothing}",
    "explain": "{nothing}",
    "gate run": "{nothing} --baseline {nothing}",
    "data inspect": "{nothing}",
    "data sample": "{nothing} -o {out}.npz",
    "gate init": "{file}",
    "hwselect select": "{nothing}",
    "hwselect score": "{nothing}",
    "hwselect fit": "{nothing} -o {out}",
    "cache": "--cache {nothing}",
    "cache prune": "--all --cache {nothing}",
    "verify": "{nothing} --against {nothing}:act",
    "inspect": "{nothing}",
    "rebuild": "{nothing} --check",
    "run bundle": "{nothing} --dry-run",
    "run": "--bus sim --settings {nothing}",
    "sim": "--bus sim --settings {nothing}",
    "topics": "--bus nothing",
    "record": "{nothing} -o {out}",
    "replay": "{nothing} {nothing}",
    "deploy": "{nothing} --store {out}",
    "status": "--store {nothing}",
    "rollback": "--store {nothing}",
    "sign": "{nothing} --key {nothing}",
    "verify-signature": "{nothing} --key {nothing}",
    "serve": "{nothing} --port 0",
    "simulate": "{nothing} --profile raspberry-pi-5",
    "telemetry": "--root {nothing}",
    "profiles show": "no-board",
    "profiles diff": "no-board raspberry-pi-5",
    "profiles validate": "{file}",
    "profiles new": "mine --from no-board -o {out}",
    "profiles calibrate": "raspberry-pi-5 --from {nothing}",
    "new": "{out} --from {nothing}",
    "samples make": "no-sample -o {out}",
}
"""Command -> a command line of it that names what is not there."""


@pytest.mark.parametrize("command", [command for command in ALL if of(BAD, command)])
def test_an_error_is_a_document_with_the_same_exit_code(vlatool, tmp_path, command: str) -> None:
    (tmp_path / "file").write_text("no yaml: [")
    given = {"nothing": tmp_path / "nothing", "out": tmp_path / "out", "file": tmp_path / "file"}
    status, told, err = vlatool(*command.split(), *of(BAD, command).format(**given).split(), "--json")
    assert status in (2, 3), err
    validate(told, "failed" if set(told) == {"error"} else of(SCHEMA["commands"], command)[0])
    assert told["error"]["exit_code"] == status
    assert told["error"]["message"].splitlines()[0] in err
    assert told["error"]["fix"] in err


def test_commands_that_cannot_fail_on_their_input_are_few() -> None:
    assert {command for command in ALL if not of(BAD, command)} == {"doctor", "profiles list", "samples list"}


@pytest.mark.parametrize("dry", [True, False])
def test_a_plan_is_a_document_and_writes_nothing(vlatool, places, tmp_path, dry: bool) -> None:
    source = places.policy if dry else tmp_path / "nothing"
    status, told, _ = vlatool("optimize", source, "-o", tmp_path / "out", "--dry-run", "--json")
    assert not (tmp_path / "out").exists()
    assert status == (0 if dry else 3)
    validate(told, "plan" if dry else "failed")
    if dry:
        options = {"reduce_range": True} if saturates(isa() or ()) else {}
        assert told["plan"]["candidates"]["static_int8"] == [{"stage": "quantize.static_int8", "options": options}]


def test_raw_samples_stay_in_the_report(vlatool, places, tmp_path) -> None:
    line = ["benchmark", places.bundle, "--iterations", 50, "--duration", 0, "--json"]
    _, short, _ = vlatool(*line, "-o", tmp_path / "out")
    kept = read_report(tmp_path / "out")
    assert short["rows"][0]["raw"] == {}
    assert short["raw_samples"]["omitted"] == sum(len(each) for row in kept.rows for each in row.raw.values())
    assert short["raw_samples"]["file"] == str(tmp_path / "out/report.json")
    assert len(kept.rows[0].raw["latency_ms"]) >= 50
    _, nowhere, _ = vlatool(*line)
    assert nowhere["raw_samples"]["file"] is None
    assert "-o DIRECTORY" in nowhere["raw_samples"]["fix"]
    _, whole, _ = vlatool(*line, "--raw")
    assert len(whole["rows"][0]["raw"]["latency_ms"]) >= 50
    assert "raw_samples" not in whole
    for each in (short, nowhere, whole):
        validate(each, "report")
    assert len(json.dumps(short)) < 40_000


@pytest.mark.parametrize("option", ["--help", "--version"])
def test_help_is_a_document_too(vlatool, option: str) -> None:
    status, told, _ = vlatool(*(["--version"] if option == "--version" else ["optimize", option]), "--json")
    assert status in (0, 2)
    assert told.keys() <= {"text", "error"}


def test_what_this_process_and_its_children_print_goes_to_stderr(capfd) -> None:
    with output(["--json"], for_good=False):
        document({"a": float("nan"), "b": (1, "\udcff")})
        print("printed")
        os.write(1, b"descriptor\n")
        import ctypes

        ctypes.CDLL(None).puts(b"puts")
        subprocess.run([sys.executable, "-c", "print('child')"], check=True)
    told = capfd.readouterr()
    assert json.loads(told.out) == {"a": None, "b": [1, "\udcff"]}
    assert sorted(told.err.split()) == ["child", "descriptor", "printed", "puts"]


def test_nothing_is_set_aside_where_no_json_is_asked_for(capfd) -> None:
    for words in (["inspect"], ["inspect", "--", "--json"]):
        with output(words, for_good=False) as told:
            print("printed")
        assert told is None
        assert capfd.readouterr().out == "printed\n"


def test_the_end_of_the_process_adds_nothing(places) -> None:
    """What is registered to run at exit, and what threads print then, comes after the document."""
    code = (
        "import atexit, os, sys; atexit.register(print, 'python at exit'); "
        "atexit.register(os.write, 1, b'descriptor at exit'); from vlatool.cli import main; "
        f"sys.argv = ['vlatool', 'inspect', {str(places.bundle)!r}, '--json']; main()"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0
    assert done.stdout == (places.bundle / "manifest.json").read_text()
    assert "python at exit" in done.stderr
    assert "descriptor at exit" in done.stderr


@pytest.mark.parametrize(
    ("number", "kind", "status"),
    [*small_or_full([], [(signal.SIGINT, "Interrupted", 130)]), (signal.SIGTERM, "Terminated", 143)],
)
def test_a_signal_is_a_document(tmp_path, number, kind: str, status: int) -> None:
    mark, mine = tmp_path / "hangs", tmp_path / "mine"
    mine.mkdir()
    (mine / "policy.yaml").write_text(POLICY_YAML.replace("environment:", "# environment:"))
    (mine / "policy.py").write_text(policy(in_make=f"open({str(mark)!r}, 'w').close(); import time; time.sleep(600)"))
    line = [sys.executable, "-m", "vlatool", "export", str(mine), "-o", str(tmp_path / "out"), "--json"]
    process = subprocess.Popen(line, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True)
    end = time.monotonic() + 120
    while not mark.exists():
        assert time.monotonic() < end
        time.sleep(0.05)
    os.killpg(process.pid, number)
    out, _ = process.communicate(timeout=120)
    assert process.returncode == status
    told = json.loads(out)
    validate(told, "failed")
    assert (told["error"]["type"], told["error"]["exit_code"]) == (kind, status)


def test_a_bug_is_a_document(vlatool, monkeypatch) -> None:
    def fault() -> None:
        raise KeyError("a key that nobody has")

    monkeypatch.setattr("vlatool.doctor.doctor.diagnose", fault)
    status, told, _ = vlatool("doctor", "--json")
    validate(told, "failed")
    assert (status, told["error"]["type"], told["error"]["exit_code"]) == (70, "InternalError", 70)
    assert "a key that nobody has" in told["error"]["message"]


@pytest.mark.parametrize("redirect", [">&-", "| head -c 0"])
def test_a_document_that_nobody_takes_changes_no_exit_code(redirect: str) -> None:
    shell = f'"{sys.executable}" -m vlatool samples list --json {redirect}'
    done = subprocess.run(["sh", "-c", shell], capture_output=True, text=True, check=False)
    assert done.returncode == 0
    assert "Traceback" not in done.stderr


def test_a_report_that_cannot_be_written_is_printed_with_the_error(vlatool, places, monkeypatch, tmp_path) -> None:
    def full(*_: Any) -> None:
        raise OutputError("The disk is full.", "make room")

    monkeypatch.setattr("vlatool.render.write_reports", full)
    status, told, _ = vlatool("evaluate", places.bundle, "-o", tmp_path / "out", "--json")
    assert status == 3
    validate(told, "report")
    assert told["rows"]
    assert told["error"] == {"type": "OutputError", "message": "The disk is full.", "fix": "make room", "exit_code": 3}


def test_rows_without_raw_samples_are_told_as_they_are() -> None:
    assert "raw_samples" not in report_document(Report("evaluate", "t", rows=(Row("a"),)), raw=False, file=None)


@pytest.mark.parametrize(
    ("value", "plain"),
    [
        (np.array([0.5, np.nan]), [0.5, None]),
        (np.arange(4, dtype=np.int16).reshape(2, 2), [[0, 1], [2, 3]]),
        (np.array([True, False]), [True, False]),
        ((np.float32(0.25), np.float64("inf"), np.int64(3), np.bool_(True)), [0.25, None, 3, True]),
        (np.zeros((0, 3)), []),
    ],
)
def test_arrays_and_their_numbers_are_numbers_of_json(value: Any, plain: Any) -> None:
    """Such as what a simulated robot says of itself."""
    assert json.loads(json_text({"truth": {"": value}})) == {"truth": {"": plain}}
