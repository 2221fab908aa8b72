"""What a person can get wrong with boards: rows of the table of wrong inputs."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml
from _edits import put, take
from _wrong_inputs import Line, Place, Row

from vlatool.report import Measurement, Report
from vlatool.report import Row as Variant

PROFILES = Path(__file__).parents[1] / "profiles"
ONE = ["--boards", "raspberry-pi-5"]
WORK = {"macs": 1e9, "weights": 1e7, "activations": 5e6, "layers": 50, "traits": []}
KEPT = {
    "profile": "raspberry-pi-5",
    "mode": "default",
    "engine": "ort_cpu",
    "precision": "int8",
    "work": WORK,
    "ms": 9.5,
}
SHEET = {"name": "mine", "title": "t", "control_hz": 10, "compute_watts": 20, "sensors": ["camera"], "kind": "estimate",
         "source": "s"}  # fmt: skip


class Workshop(Place):
    """Makes wrong boards, figures and measurements."""

    def __init__(self, root: Path, policy: Path, bundle: Path, points: Path) -> None:
        super().__init__(root)
        self.template, self.float, self.points = policy, bundle, points
        self.measured = root / "kept"
        self.kept.append(self.measured)

    def choose(self, *more: Any) -> Line:
        """Choose a board for the tiny policy."""
        return ["hwselect", self.float, *ONE, *more]

    def board(self, change: Callable[[dict[str, Any]], Any], name: str = "board.yaml") -> Path:
        """A profile that was changed by hand."""
        data = yaml.safe_load((PROFILES / "raspberry-pi-5.yaml").read_text())
        change(data)
        return self.file(name, yaml.safe_dump(data))

    def sheet(self, **changes: Any) -> Path:
        """A platform that was changed by hand."""
        return self.file("mine.yaml", yaml.safe_dump({k: v for k, v in (SHEET | changes).items() if v is not None}))

    def published(self, *swap: str) -> Path:
        """Published latencies with texts swapped."""
        text = self.points.read_text()
        for old, new in zip(swap[::2], swap[1::2], strict=True):
            assert old in text
            text = text.replace(old, new, 1)
        return self.file("points.csv", text)

    def calibrated(self, content: Any) -> Line:
        """Choose a board with measurements that somebody wrote."""
        text = content if isinstance(content, str | bytes) else json.dumps({"schema": 1, "measured": [content]})
        self.file("kept/raspberry-pi-5.json", text)
        return self.choose()

    def report(self, *measurements: Measurement, **details: Any) -> Path:
        """A report with one row."""
        rows = (Variant("int8", measurements=measurements, details=details),)
        self.file("report/report.json", Report("benchmark", "t", rows=rows).to_json())
        return self.root / "report"

    def calibrate(self, report: Path | str, *more: Any, board: str = "raspberry-pi-5") -> Line:
        return ["profiles", "calibrate", board, "--from", report, *more]


def latency(ms: float = 9.5, origin: str = "measured") -> Measurement:
    return Measurement("latency_p50", ms, "ms", origin, samples=20)


def number(flag: str, *values: str) -> list[Row]:
    """A row for each value that a number above zero may not have."""
    return [
        Row(f"{flag} of {value}", f"{flag} is {value}; allowed: a number above 0", 2,
            lambda at, value=value: at.choose(f"{flag}={value}"))
        for value in values
    ]  # fmt: skip


NUMBERS = [
    *number("--hz", "0", "-1", "nan", "inf"),
    *number("--latency-ms", "0", "-3", "nan", "inf"),
    *number("--max-watts", "0", "-5", "nan", "inf"),
    *number("--max-price", "0", "-1", "nan", "inf"),
    *number("--memory", "0", "-2", "nan", "inf"),
    *number("--battery-wh", "0", "-9", "nan", "inf"),
    *number("--years", "0", "-1", "nan", "inf"),
    *number("--hours", "0", "-8", "nan"),
    *number("--kwh-price", "0", "-1", "nan", "inf"),
    Row("endless hours a day", "--hours is inf", 2, lambda at: at.choose("--hours", "inf")),
    Row("more hours than a day has", "--hours is 25; a day has 24", 2, lambda at: at.choose("--hours", 25)),
    Row("a network that is back before", "--network-ms is -1; allowed: 0 or more", 2,
        lambda at: at.choose("--network-ms=-1")),
    Row("a network that never answers", "--network-ms is inf", 2, lambda at: at.choose("--network-ms", "inf")),
    Row("no robot", "--robots", 2, lambda at: at.choose("--robots", 0)),
    Row("an inference for each chunk of no rate", "--per-chunk asks how often the loop ticks", 2,
        lambda at: at.choose("--latency-ms", 5, "--per-chunk")),
    Row("a bundle that shall carry a count", "is counted without torch", 2, lambda at: at.choose("--carry-count")),
    Row("half a robot", "--robots", 2, lambda at: at.choose("--robots", 0.5)),
    Row("a rate in words", "Invalid value for '--hz'", 2, lambda at: at.choose("--hz", "often")),
]  # fmt: skip
NAMES = [
    Row("no source", "Missing argument", 2, lambda at: ["hwselect", "select"]),
    Row("a source that is not there", "is neither a bundle nor a policy source", 3,
        lambda at: ["hwselect", at.root / "none"]),
    Row("an ONNX file that is not there", "No such ONNX file", 3, lambda at: ["hwselect", at.root / "none.onnx"]),
    Row("a misspelt subcommand", "is neither a bundle nor a policy source", 3, lambda at: ["hwselect", "scroe"]),
    Row("an unknown profile", "Unknown profile 'rasberry-pi-5'; did you mean 'raspberry-pi-5'", 3,
        lambda at: ["hwselect", at.float, "--boards", "rasberry-pi-5"]),
    Row("a profile that is not there", "cannot be read: No such file", 3,
        lambda at: ["hwselect", at.float, "--boards", at.root / "none.yaml"]),
    Row("an unknown precision", "--precision is 'int9'; did you mean 'int8'", 2,
        lambda at: at.choose("--precision", "int9")),
    Row("a type that nothing computes in", "--precision is 'int4'", 2, lambda at: at.choose("--precision", "int4")),
    Row("an unknown platform", "Unknown platform 'quadcoptre'; did you mean 'quadcopter'", 3,
        lambda at: at.choose("--platform", "quadcoptre")),
    Row("a platform that is not there", "cannot be read: No such file", 3,
        lambda at: at.choose("--platform", at.root / "none.yaml")),
    Row("a platform without a rate", "control_hz: Field required", 3,
        lambda at: at.choose("--platform", at.sheet(control_hz=None))),
    Row("a platform with negative power", "compute_watts: Input should be greater than 0", 3,
        lambda at: at.choose("--platform", at.sheet(compute_watts=-1))),
    Row("a platform that is not YAML", "is not valid YAML", 3,
        lambda at: at.choose("--platform", at.file("mine.yaml", "name: ["))),
    Row("a platform that is a profile", "is malformed", 3,
        lambda at: at.choose("--platform", PROFILES / "raspberry-pi-5.yaml")),
    Row("a report that exists already", "exists already", 3, lambda at: at.choose("-o", at.place)),
    Row("an output below a file", "a part of the path is a file", 3,
        lambda at: at.choose("-o", at.file("place/file", "") / "out")),
]  # fmt: skip
CONSTRAINTS = [
    Row("a board for one dollar", "No board is certain to run", 1, lambda at: at.choose("--max-price", 1)),
    Row("a board for one watt", "No board is certain to run", 1, lambda at: at.choose("--max-watts", 1)),
    Row("a board with no memory", "No board is certain to run", 1, lambda at: at.choose("--memory", 0.001)),
    Row("a million inferences in a second", "No board is certain to run", 1, lambda at: at.choose("--hz", 1e6)),
    Row("a precision that the board lacks", "No board is certain to run", 1,
        lambda at: at.choose("--precision", "float8")),
    Row("an old board alone", "No board is certain to run", 1,
        lambda at: ["hwselect", at.float, "--boards", "jetson-nano"]),
]  # fmt: skip
PROFILE_FILES = [
    Row("a profile that lacks a field", "bandwidth_gb_s: is missing", 3,
        lambda at: ["hwselect", at.float, "--boards", at.board(take("bandwidth_gb_s"))]),
    Row("a profile whose engine has no peak", "engines.ort_cpu.dtypes: cpu has no peak_tops.int8", 3,
        lambda at: ["hwselect", at.float, "--boards", at.board(take("units", "cpu", "peak_tops", "int8"))]),
    Row("a profile whose engine computes in nothing", "engines.ort_cpu.dtypes: needs at least one entry", 3,
        lambda at: ["hwselect", at.float, "--boards", at.board(put("engines", "ort_cpu", "dtypes", []))]),
    Row("a profile with an unknown dtype", "did you mean 'int8'", 3,
        lambda at: ["hwselect", at.float, "--boards", at.board(put("engines", "ort_cpu", "dtypes", ["itn8"]))]),
    Row("a profile that is not YAML", "is not valid YAML", 3,
        lambda at: ["hwselect", at.float, "--boards", at.file("board.yaml", "name: [")]),
    Row("a profile that is a list", "must be a mapping; got list", 3,
        lambda at: ["hwselect", at.float, "--boards", at.file("board.yaml", "- a")]),
    Row("a profile with a unit of another name", "dsp", 3,
        lambda at: ["hwselect", at.float, "--boards", at.board(lambda data: data.update(
            name="bard", units={"dsp": data["units"]["cpu"]},
            engines={"ort_cpu": data["engines"]["ort_cpu"] | {"unit": "dsp"}},
            modes={"default": data["modes"]["default"] | {"cores": {"dsp": 4}, "clock_mhz": {"dsp": 2400}}}))]),
    Row("a profile without a float32 peak", "float32", 3,
        lambda at: ["hwselect", at.float, "--boards", at.board(lambda data: (
            data["units"]["cpu"]["peak_tops"].pop("float32"), data["units"]["cpu"]["peak_tops"].pop("float16"),
            data["engines"]["ort_cpu"].update(dtypes=["w8", "int8"])))]),
]  # fmt: skip
SIMULATE = [
    Row("simulate without a board", "Missing option '--profile'", 2, lambda at: ["simulate", at.float]),
    Row("simulate on an unknown board", "did you mean 'raspberry-pi-5'", 3,
        lambda at: ["simulate", at.float, "--profile", "raspberry-pi-55"]),
    Row("simulate in an unknown mode", "no power mode '20W'", 3,
        lambda at: ["simulate", at.float, "--profile", "jetson-orin-nano", "--mode", "20W"]),
    Row("simulate with an unknown engine", "has no engine 'tensorrt'; did you mean 'ort_tensorrt'", 3,
        lambda at: ["simulate", at.float, "--profile", "jetson-orin-nano", "--engine", "tensorrt"]),
    Row("simulate in an unknown precision", "--precision is 'itn8'; did you mean 'int8'", 2,
        lambda at: ["simulate", at.float, "--profile", "raspberry-pi-5", "--precision", "itn8"]),
    Row("simulate in a precision that the engine lacks", "--precision is 'float8'", 2,
        lambda at: ["simulate", at.float, "--profile", "raspberry-pi-5", "--precision", "float8"]),
    Row("simulate a transformer on Hailo", "a transformer's latency there is unknown", 3,
        lambda at: ["simulate", at.float, "--profile", "raspberry-pi-5-hailo8", "--engine", "hailort", "--precision",
                    "int8"]),
    Row("simulate float32 on an NPU", "raspberry-pi-5-hailo8", 3,
        lambda at: ["simulate", at.float, "--profile", "raspberry-pi-5-hailo8", "--engine", "hailort"]),
    Row("simulate a policy that is not there", "is neither a bundle nor a policy source", 3,
        lambda at: ["simulate", at.root / "none", "--profile", "raspberry-pi-5"]),
]  # fmt: skip
POINTS = [
    Row("no points", "cannot be read: No such file", 3, lambda at: ["hwselect", "score", at.root / "none.csv"]),
    Row("points in a folder", "cannot be read", 3, lambda at: ["hwselect", "score", at.place]),
    Row("empty points", "has no column 'device'", 3, lambda at: ["hwselect", "score", at.file("p.csv", "")]),
    Row("points that are not text", "cannot be read: 'utf-8' codec", 3,
        lambda at: ["hwselect", "score", at.file("p.csv", b"\xff\xfe\x00\x01")]),
    Row("points without a column", "has no column 'metric'", 3,
        lambda at: ["hwselect", "score", at.published("metric", "what")]),
    Row("points without a row", "holds no row", 3,
        lambda at: ["hwselect", "score", at.file("p.csv", at.points.read_text().splitlines()[0] + "\n")]),
    Row("points in another unit", "line 2: the metric 'joules' is unknown", 3,
        lambda at: ["hwselect", "score", at.published("latency_ms", "joules")]),
    Row("points with a word for a number", "line 2: 'many' in the column", 3,
        lambda at: ["hwselect", "score", at.published("resnet18,11.7,", "resnet18,many,")]),
    Row("points of another class", "line 2: the device class 'tpu' is unknown", 3,
        lambda at: ["hwselect", "score", at.published(",cpu", ",tpu")]),
    Row("an unknown split", "--held-out is 'rows'; allowed: models, devices, calibrated", 2,
        lambda at: ["hwselect", "score", at.points, "--held-out", "rows"]),
    Row("a negative seed of a split", "--seed", 2,
        lambda at: ["hwselect", "score", at.points, "--held-out", "models", "--seed=-1"]),
    Row("a refit of nothing left out", "--held-out is not given; with --refit, allowed: models, devices", 2,
        lambda at: ["hwselect", "score", at.points, "--refit", 0]),
    Row("a refit in no number of seconds", "--refit", 2,
        lambda at: ["hwselect", "score", at.points, "--held-out", "models", "--refit", "nan"]),
    Row("a refit for ever", "--refit is inf; allowed", 2,
        lambda at: ["hwselect", "score", at.points, "--held-out", "models", "--refit", "inf"]),
    Row("a fit for ever", "--seconds is inf; allowed", 2,
        lambda at: ["hwselect", "fit", at.points, "-o", at.out, "--seconds", "inf"]),
    Row("a refit in less than no time", "--refit", 2,
        lambda at: ["hwselect", "score", at.points, "--held-out", "models", "--refit=-1"]),
    Row("a seed in words", "valid integer", 2, lambda at: ["hwselect", "score", at.points, "--seed", "one"]),
    Row("a fit without an output", "Missing option '-o'", 2, lambda at: ["hwselect", "fit", at.points]),
    Row("a fit of nothing", "cannot be read: No such file", 3,
        lambda at: ["hwselect", "fit", at.root / "none.csv", "-o", at.out]),
    Row("a fit for less than no time", "--seconds", 2,
        lambda at: ["hwselect", "fit", at.points, "-o", at.out, "--seconds=-1"]),
    Row("a fit into a file", "File exists", 3,
        lambda at: ["hwselect", "fit", at.points, "-o", at.file("place/file", ""), "--seconds", 0]),
    Row("a negative seed of a fit", "--seed", 2,
        lambda at: ["hwselect", "fit", at.points, "-o", at.out, "--seconds", 0, "--seed=-1"]),
    Row("a fit of figures without ground", "p.csv", 3,
        lambda at: ["hwselect", "fit", at.file("p.csv", at.points.read_text().replace("ncnn", "abacus").replace(
            "openvino", "abacus").replace("tensorrt", "abacus").replace("onnxruntime", "abacus").replace(
            "hailort", "abacus")), "-o", at.out, "--seconds", 0]),
]  # fmt: skip
PROFILES_COMMANDS = [
    Row("a new profile with a bad name", "'My Board' is not a valid profile name", 3,
        lambda at: ["profiles", "new", "My Board", "-o", at.out]),
    Row("a new profile over a file", "exists", 3,
        lambda at: ["profiles", "new", "mine", "-o", at.file("place/mine.yaml", "precious")]),
    Row("a new profile like an unknown one", "did you mean 'raspberry-pi-5'", 3,
        lambda at: ["profiles", "new", "mine", "--from", "raspberrypi-5", "-o", at.out]),
    Row("a new profile below a file", "cannot be written: File exists", 3,
        lambda at: ["profiles", "new", "mine", "-o", at.template / "policy.py/mine.yaml"]),
    Row("validate an empty folder", "No profiles in", 3, lambda at: ["profiles", "validate", at.place]),
    Row("validate nothing", "Missing argument", 2, lambda at: ["profiles", "validate"]),
    Row("validate what is not there", "cannot be read: No such file", 3,
        lambda at: ["profiles", "validate", at.root / "none.yaml"]),
    Row("validate a wrong profile", "memory_gb.value: must be above 0; got -8", 3,
        lambda at: ["profiles", "validate", at.board(put("memory_gb", "value", -8))]),
    Row("diff with an unknown profile", "did you mean 'raspberry-pi-5'", 3,
        lambda at: ["profiles", "diff", "raspberry-pi-5", "raspberry-pi-55"]),
    Row("diff with nothing", "Missing argument", 2, lambda at: ["profiles", "diff", "raspberry-pi-5"]),
]  # fmt: skip
CALIBRATE = [
    Row("calibrate without a report", "No report at", 3, lambda at: at.calibrate(at.place)),
    Row("calibrate an unknown board", "did you mean 'raspberry-pi-5'", 3,
        lambda at: at.calibrate(at.report(latency()), board="rasberry-pi-5")),
    Row("calibrate an unknown mode", "no power mode '9W'", 3,
        lambda at: at.calibrate(at.report(latency()), "--mode", "9W")),
    Row("calibrate by a report that is none", "This is not a vlatool report", 3,
        lambda at: at.calibrate(at.file("report.json", "{"))),
    Row("calibrate by a report without latencies", "it has no latency of an engine of this board", 3,
        lambda at: at.calibrate(at.report())),
    Row("calibrate by a prediction", "it has no latency of an engine of this board", 3,
        lambda at: at.calibrate(at.report(latency(origin="predicted")))),
    Row("calibrate by a report that does not say the work", "its rows have no workload", 3,
        lambda at: at.calibrate(at.report(latency()))),
    Row("calibrate by an engine of another board", "it has no latency of an engine of this board", 3,
        lambda at: at.calibrate(at.report(
            latency(), workload=[WORK | {"engine": "ort_tensorrt", "precision": "int8"}]))),
    Row("calibrate by half a table", "report", 3,
        lambda at: at.calibrate(at.report(latency(), workload=[{"macs": 1.0, "precision": "int8"}]))),
    Row("calibrate by a latency of zero", "report", 3,
        lambda at: at.calibrate(at.report(latency(0.0), workload=[WORK | {"precision": "int8"}]))),
    Row("calibrate by work without shapes", "report", 3,
        lambda at: at.calibrate(at.report(latency(), workload=[WORK | {"macs": 0.0, "precision": "float32"}]))),
    Row("calibrate with a bundle that is not there", "No bundle at", 3,
        lambda at: at.calibrate(at.report(latency()), "--bundle", at.root / "none")),
    Row("measurements that are not JSON", "is malformed: JSONDecodeError", 3, lambda at: at.calibrated("{")),
    Row("measurements that are not text", "is malformed: UnicodeDecodeError", 3,
        lambda at: at.calibrated(b"\xff\xfe\x00")),
    Row("a measurement below zero", "is malformed", 3, lambda at: at.calibrated(KEPT | {"ms": -1})),
    Row("a measurement with a word for its work", "is malformed", 3, lambda at: at.calibrated(KEPT | {"work": "much"})),
    Row("a measurement of an unknown trait", "is malformed", 3,
        lambda at: at.calibrated(KEPT | {"work": WORK | {"traits": ["magic"]}})),
    Row("a measurement on an engine that is gone", "has no engine 'ort_gpu'", 3,
        lambda at: at.calibrated(KEPT | {"engine": "ort_gpu"})),
    Row("a calibration that is not there", "cannot be read: No such file", 3,
        lambda at: at.choose("--calibration", at.root / "none.json")),
]  # fmt: skip
ROWS = [*NUMBERS, *NAMES, *CONSTRAINTS, *PROFILE_FILES, *SIMULATE, *POINTS, *PROFILES_COMMANDS, *CALIBRATE]


def place(root: Path, monkeypatch: pytest.MonkeyPatch, fixture: Callable[[str], Any]) -> Workshop:
    """Return where they are made."""
    made = Workshop(root, fixture("policy_template"), fixture("float_bundle").path, fixture("points_template"))
    monkeypatch.setenv("VLATOOL_CALIBRATIONS", str(made.measured))
    return made
