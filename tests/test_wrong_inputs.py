"""Everything that a person can get wrong: the sentence on stderr, the exit code, and nothing left behind.

One table (``_wrong_inputs``); the rows of boards and of trainings stand in files of their own.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import _wrong_boards
import _wrong_trainings
import numpy as np
import pytest
import yaml
from _edits import put, take
from _full import small_or_full
from _wrong_inputs import Line, Place, Row, check

from vlatool.bundle.bundle import DIGEST, MANIFEST, Bundle, digest_of, seal
from vlatool.bundle.manifest import SCHEMA
from vlatool.errors import VlatoolError
from vlatool.export.onnx import ExportOnnx
from vlatool.quantize.static_int8 import StaticInt8
from vlatool.runtime import load
from vlatool.sources.torch_module import TorchModule
from vlatool.stage.base import Context
from vlatool.stage.run import run_transform

BOARD = ["--profile", "raspberry-pi-5"]
PLAN = [*BOARD, "--dry-run"]


class Workshop(Place):
    """Makes wrong things in a temporary folder; ``out`` is where a command is told to write."""

    def __init__(self, root: Path, policy: Path, bundles: Mapping[str, Bundle]) -> None:
        super().__init__(root)
        self.template, self.bundles = policy, bundles
        self.to = ["-o", self.out]
        self.float, self.int8 = bundles["float"].path, bundles["int8"].path
        self.environment = dict(os.environ)

    def policy(self, *swap: str, drop: str = "", **files: str | bytes | dict[str, Any]) -> Path:
        """The tiny policy with a text swapped in policy.yaml, one file dropped, and others written."""
        folder = Path(shutil.copytree(self.template, self.root / "tiny"))
        text = (folder / "policy.yaml").read_text()
        for old, new in zip(swap[::2], swap[1::2], strict=True):
            assert old in text
            text = text.replace(old, new)
        (folder / "policy.yaml").write_text(text)
        if drop:
            (folder / drop).unlink()
        endings = {"statistics": "json", "vocabulary": "json", "weights": "safetensors"}
        for stem, content in files.items():
            data = json.dumps(content) if isinstance(content, dict) else content
            (folder / f"{stem}.{endings.get(stem, 'py')}").write_bytes(data.encode() if isinstance(data, str) else data)
        return folder

    def code(self, body: str) -> Path:
        """The tiny policy with other code."""
        return self.policy(policy=body)

    def onnx(self, *swap: str) -> Path:
        """An ONNX file beside its policy.yaml, which needs no torch."""
        folder = self.policy(*swap)
        return Path(shutil.copyfile(self.float / "graphs/main.onnx", folder / "tiny.onnx"))

    def checkpoint(self) -> Path:
        """What another library saves."""
        self.file("act/config.json", "{}")
        return self.file("act/model.safetensors", b"").parent

    def bundle(
        self, file: str = "", content: bytes | Callable[[bytes], bytes] = b"", *, sealed: bool = False, of: str = "int8"
    ) -> Path:
        """A copy of the int8 bundle (or another) with one file rewritten; ``sealed`` again, the hashes are right."""
        path = Path(shutil.copytree(self.bundles[of].path, self.root / "damaged"))
        if file:
            (path / file).write_bytes(content((path / file).read_bytes()) if callable(content) else content)
        if file == MANIFEST:
            (path / DIGEST).write_bytes(digest_of((path / file).read_bytes()))
        if sealed:
            seal(path, self.bundles[of].manifest)
        return path

    def manifest(self, change: Callable[[dict[str, Any]], Any]) -> Path:
        """A copy of the int8 bundle whose manifest was changed by hand."""

        def rewritten(data: bytes) -> bytes:
            manifest = json.loads(data)
            change(manifest)
            return json.dumps(manifest).encode()

        return self.bundle("manifest.json", rewritten)

    def without(self, name: str) -> Path:
        path = self.bundle()
        (path / name).unlink()
        return path

    def linked(self) -> Path:
        path = self.without("graphs/main.onnx")
        (path / "graphs/main.onnx").symlink_to(self.int8 / "graphs/main.onnx")
        return path

    def recording(self, **changes: Callable[[Any], Any] | None) -> Path:
        """The evaluation data with arrays changed, or left out (None)."""
        with np.load(self.template / "evaluation.npz") as stored:
            arrays = dict(stored)
        for name, change in changes.items():
            values = arrays.pop(name)
            if change is not None:
                arrays[name] = change(values)
        np.savez(self.root / "recording.npz", **arrays)
        return self.root / "recording.npz"

    def recipe(self, text: str) -> Line:
        """The plan of the tiny policy under a recipe."""
        return ["optimize", self.template, *self.to, *PLAN, "--recipe", self.file("recipe.yaml", text)]

    def candidate(self, stage: str, name: str = "mine") -> Line:
        return self.recipe(f"candidates: {{{name}: [{stage}]}}")

    def profile(self, change: Callable[[dict[str, Any]], Any]) -> Path:
        shipped = Path(__file__).parents[1] / "profiles/raspberry-pi-5.yaml"
        data = yaml.safe_load(shipped.read_text())
        change(data)
        return self.file("board.yaml", yaml.safe_dump(data))

    def report(self, change: Callable[[dict[str, Any]], Any]) -> Line:
        """Compare a good report with one that was changed by hand."""
        row = {"name": "a", "measurements": [{"name": "latency_p50", "value": 1.0, "unit": "ms"}]}
        data = {"schema": 1, "kind": "benchmark", "title": "t", "rows": [row]}
        good = self.file("good.json", json.dumps(data))
        change(data)
        return ["compare", good, self.file("bad.json", json.dumps(data))]

    def observation(self, **changes: Any) -> dict[str, Any]:
        found = {"image": np.zeros((8, 8, 3), np.uint8), "proprio": np.zeros(3, np.float32), "instruction": "go"}
        return {name: value for name, value in (found | changes).items() if value is not None}

    def infer(self, **changes: Any) -> None:
        load(self.int8, threads=1).infer(self.observation(**changes))

    def changed_after(self) -> None:
        """The weights change between the source bundle and the export."""
        policy = self.policy()
        source = run_transform(TorchModule(policy=policy), None, self.root / "source", Context()).bundle
        with (policy / "weights.safetensors").open("ab") as stream:
            stream.write(b"\0")
        run_transform(ExportOnnx(), source, self.out, Context())

    def child(self, code: str, line: Line, *prefix: str) -> list[str]:
        """The command that runs ``code`` and then the command line in a fresh process."""
        start = f"import sys\n{code}\nfrom vlatool.cli import main\nmain(sys.argv[1:])"
        return [*prefix, sys.executable, "-c", start, *map(str, line)]


# ---- ways of running a row: each returns the exit code and what stood on stderr


def called(at: Workshop, line: Callable[[], Any]) -> tuple[int, str]:
    """A call of the Python interface."""
    with pytest.raises(VlatoolError) as caught:
        line()
    return caught.value.exit_code, str(caught.value)


def finished(at: Workshop, command: list[str]) -> tuple[int, str]:
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=at.environment)
    return done.returncode, done.stderr


def without_package(name: str) -> Callable[[Workshop, Line], tuple[int, str]]:
    """In a fresh process in which a package cannot be imported, as if it were not installed, nor in its children."""
    absent = f"raise ModuleNotFoundError(\"No module named '{name}'\", name={name!r})\n"
    code = f"""
sys.path.insert(0, {{folder!r}})
class Blocked:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] == {name!r}:
            raise ModuleNotFoundError(f"No module named {{{{name!r}}}}", name=name)
sys.meta_path.insert(0, Blocked())"""

    def run(at: Workshop, line: Line) -> tuple[int, str]:
        folder = at.root / "absent"
        folder.mkdir()
        (folder / f"{name}.py").write_text(absent)
        return finished(at, at.child(code.format(folder=str(folder)), line))

    return run


def namespace() -> list[str]:
    """How this user gets a mount namespace; nothing where the machine forbids it."""
    trial = 'mount -t tmpfs -o size=4k none "$0"'
    for flags in (["-m"], ["-U", "-r", "-m"]):
        command = ["unshare", *flags, "sh", "-c", trial, "/mnt"]
        if shutil.which("unshare") and subprocess.run(command, capture_output=True, check=False).returncode == 0:
            return ["unshare", *flags]
    return []


def small_files(at: Workshop, line: Line) -> tuple[int, str]:
    """With a limit on the size of a file, which the kernel enforces; lifted at the exit, where coverage is written."""
    code = """
import atexit, resource, sys
sys.dont_write_bytecode = True  # Python would leave half of a module's
kept = resource.getrlimit(resource.RLIMIT_FSIZE)
resource.setrlimit(resource.RLIMIT_FSIZE, (3000, kept[1]))
atexit.register(resource.setrlimit, resource.RLIMIT_FSIZE, kept)"""
    return finished(at, at.child(code, line))


def mounted(mount: str) -> Callable[[Workshop, Line], tuple[int, str]]:
    """With the output's folder on another file system; what was left there is looked at before it is gone."""

    def run(at: Workshop, line: Line) -> tuple[int, str]:
        script = f'{mount} || exit 99\nplace="$1"; shift; "$@"; code=$?; ls -A "$place" >&2; exit $code'
        command = [*namespace(), "sh", "-c", script, "sh", str(at.place)]
        code, told = finished(at, at.child("", line, *command))
        assert ".tmp-" not in told.splitlines()[-1]
        assert told.splitlines()[-1].startswith("  fix:"), "the folder is empty, so the last line is the command's"
        return code, told

    return run


def full_disk(at: Workshop, line: Line) -> tuple[int, str]:
    """On a disk of 16 kB; where nobody may mount one, with the limit on file sizes."""
    return mounted('mount -t tmpfs -o size=16k none "$1"')(at, line) if namespace() else small_files(at, line)


def full_cache(at: Workshop, line: Line) -> tuple[int, str]:
    """The cache is on the full disk."""
    if not namespace():
        return small_files(at, line)
    at.environment["VLATOOL_CACHE"] = str(at.place / "cache")
    script = 'mount -t tmpfs -o size=16k none "$1" || exit 99; shift; exec "$@"'
    return finished(at, at.child("", line, *namespace(), "sh", "-c", script, "sh", str(at.place)))


def read_only(at: Workshop, line: Line) -> tuple[int, str]:
    """On a read-only file system; where nobody may mount one, in a folder without write permission."""
    if namespace():
        return mounted('mount --bind "$1" "$1" && mount -o remount,ro,bind "$1"')(at, line)
    bound = ["setpriv", "--bounding-set", "-all"] if os.geteuid() == 0 else []  # root obeys permissions then, too
    at.place.chmod(0o555)
    try:
        return finished(at, at.child("", line, *bound))
    finally:
        at.place.chmod(0o755)


def interrupted(at: Workshop, line: Line) -> tuple[int, str]:
    """Ctrl-C as soon as the torch exporter is at work."""
    code = "import signal\nsignal.signal(signal.SIGINT, signal.default_int_handler)"
    process = subprocess.Popen(at.child(code, line), stderr=subprocess.PIPE, text=True, env=at.environment)
    assert process.stderr is not None
    told = []
    for text in process.stderr:
        told.append(text)
        if "exporting" in text:
            assert list(at.place.iterdir()), "a draft is being written"
            process.send_signal(signal.SIGINT)
    process.stderr.close()
    return process.wait(), "".join(told)


def nan_at(index: int) -> Callable[[Any], Any]:
    def change(values: Any) -> Any:
        values = values.copy()
        values[index].flat[0] = np.nan
        return values

    return change


def unsupported_compression(data: bytes) -> bytes:
    """The archive says that its first array is compressed by method 99."""
    at = data.index(b"PK\x01\x02") + 10
    return data[:at] + b"\x63\x00" + data[at + 2 :]


WORDS = ("go", "to", "the", "red", "blue", "ball", "box")
MAKE = "import torch\ndef make(layers=1):\n    "
COMMANDS = [
    Row("an unknown command", "did you mean 'quantize'", 2, lambda at: ["quantise", at.float]),
    Row("an unknown method", "did you mean 'static-int8'", 2, lambda at: ["quantize", "static-in8", at.float, *at.to]),
    Row("an unknown option", "--percentile", 2, lambda at: ["quantize", at.float, *at.to, "--percentil", 99]),
    Row("no output", "Missing option '-o'", 2, lambda at: ["quantize", at.float]),
    Row("an unknown choice", "'foo' is not one of", 2, lambda at: ["quantize", at.float, *at.to, "--method", "foo"]),
    Row("text for a number", "valid number", 2, lambda at: ["quantize", at.float, *at.to, "--percentile", "abc"]),
    Row("an unknown engine", "'ort_gpu'; did you mean 'ort_cpu'", 2,
        lambda at: ["evaluate", at.float, "--engine", "ort_gpu"]),
    Row("an unknown engine to measure", "'ort_gpu'; did you mean 'ort_cpu'", 2,
        lambda at: ["benchmark", at.float, "--engine", "ort_gpu", "--no-cold"]),
    Row("an unknown sample", "did you mean 'vit-s'", 2, lambda at: ["samples", "make", "vit-x", *at.to]),
    Row("an unknown task", "There is no task 'raech'; did you mean 'reach'", 2,
        lambda at: ["evaluate", "closed-loop", at.float, "--policy", at.template, "--tasks", "raech"]),
    Row("no samples", "samples = 0: input should be greater than or equal to 1", 3,
        lambda at: ["quantize", at.float, *at.to, "--samples", 0]),
    Row("a percentile too low", "percentile = 50.0", 3, lambda at: ["quantize", at.float, *at.to, "--percentile", 50]),
    Row("a percentile too high", "percentile = 101.0", 3,
        lambda at: ["quantize", at.float, *at.to, "--percentile", 101]),
    Row("an opset too old", "opset = 3", 3, lambda at: ["export", at.template, *at.to, "--opset", 3]),
    Row("an opset too new", "opset = 99", 3, lambda at: ["export", at.template, *at.to, "--opset", 99]),
    Row("too few iterations", "iterations = 3", 3, lambda at: ["benchmark", at.float, "--iterations", 3]),
    Row("too few pairs", "iterations = 3", 3, lambda at: ["benchmark", "overhead", at.float, "--iterations", 3]),
    Row("no worker", "--workers", 2, lambda at: ["evaluate", at.float, "--workers", 0]),
    Row("a graph that matches nothing", "No graph matches 'mian'; did you mean 'main'", 3,
        lambda at: ["quantize", at.float, *at.to, "--graphs", "mian"]),
    Row("nodes that match nothing", "node matches 'hed*'", 3,
        lambda at: ["quantize", at.float, *at.to, "--include", "hed*"]),
    Row("left-out nodes that match nothing", "node matches 'hed*'", 3,
        lambda at: ["quantize", "dynamic-int8", at.float, *at.to, "--exclude", "hed*"]),
    Row("an operator that is not there", "'Foo'", 3, lambda at: ["quantize", at.float, *at.to, "--ops", "Foo"]),
    Row("a drop in words", "--max-drop is 'lots'", 2,
        lambda at: ["optimize", at.template, *at.to, *PLAN, "--max-drop", "lots"]),
    Row("a negative drop", "--max-drop is '-1%'", 2,
        lambda at: ["optimize", at.template, *at.to, *PLAN, "--max-drop", "-1%"]),
    Row("a drop of more than all", "allowed: a percentage", 2,
        lambda at: ["optimize", at.template, *at.to, *PLAN, "--max-drop", "150%"]),
    Row("a negative rate", "'--hz'", 2, lambda at: ["optimize", at.template, *at.to, *PLAN, "--hz", -1]),
    Row("an endless rate", "--hz is inf", 2, lambda at: ["optimize", at.template, *at.to, *PLAN, "--hz", "inf"]),
    Row("an endless latency", "--max-latency-ms is inf", 2,
        lambda at: ["optimize", at.template, *at.to, *PLAN, "--max-latency-ms", "inf"]),
    Row("an endless memory", "--max-memory-mb is inf", 2,
        lambda at: ["optimize", at.template, *at.to, *PLAN, "--max-memory-mb", "inf"]),
    Row("one thing to compare", "two or more", 2, lambda at: ["compare", at.float]),
    Row("a bundle and a report to compare", "bundles or reports, not both", 2,
        lambda at: ["compare", at.float, at.report(lambda data: None)[1]]),
    Row("a bundle and nothing to compare", "No report or bundle at", 3,
        lambda at: ["compare", at.float, at.root / "none"]),
]  # fmt: skip
BUNDLES = [
    Row("no bundle", "No bundle at", 3, lambda at: ["inspect", at.root / "none"]),
    Row("no bundle to measure against", "No bundle at", 3,
        lambda at: ["benchmark", at.float, "--against", at.root / "none"]),
    Row("a file for a bundle", "is not a bundle: it has no manifest.json", 3,
        lambda at: ["inspect", at.template / "policy.py"]),
    Row("a folder without a manifest", "is not a bundle", 3,
        lambda at: ["quantize", at.place, "-o", at.root / "elsewhere"]),
    Row("a name that is too long", "none", 3, lambda at: ["inspect", at.root / ("none" * 80)]),
    Row("a manifest that is not JSON", "is not valid JSON", 3,
        lambda at: ["inspect", at.bundle("manifest.json", b"{")]),
    Row("a manifest that is not text", "is not valid JSON", 3,
        lambda at: ["inspect", at.bundle("manifest.json", b"\xff\xfe\x00")]),
    Row("a manifest that is a list", "must be a mapping; got []", 3,
        lambda at: ["inspect", at.bundle("manifest.json", b"[]")]),
    Row("a newer manifest", "upgrade vlatool", 3, lambda at: ["inspect", at.manifest(put("schema", SCHEMA + 1))]),
    Row("a manifest without a spec", "The manifest has no 'spec'", 3,
        lambda at: ["inspect", at.manifest(take("spec"))]),
    Row("a manifest that leads out of the bundle", "'../../etc/passwd', which is not inside the bundle", 3,
        lambda at: ["inspect", at.manifest(put("files", "../../etc/passwd", {"sha256": "0" * 64, "bytes": 1}))]),
    Row("a manifest with an absolute path", "which is not inside the bundle", 3,
        lambda at: ["inspect", at.manifest(put("files", "/etc/passwd", {"sha256": "0" * 64, "bytes": 1}))]),
    Row("a graph's file that is a number", "graphs", 3,
        lambda at: ["inspect", at.manifest(put("graphs", "main", "file", 3))]),
    Row("feeds that are no mapping", "feeds", 3,
        lambda at: ["inspect", at.manifest(put("program", 0, "feeds", "image"))]),
    Row("a program without steps", "'action'", 3, lambda at: ["evaluate", at.manifest(put("program", []))]),
    Row("an accuracy in words", "accuracy", 3,
        lambda at: ["inspect", at.manifest(put("accuracy", {"success": "good"}))]),
    Row("a graph that is missing", "lacks the file graphs/main.onnx", 3,
        lambda at: ["inspect", at.without("graphs/main.onnx")]),
    Row("a graph that is a link", "missing, or a link", 3, lambda at: ["quantize", at.linked(), *at.to]),
    Row("a graph cut short", "bytes; the manifest says", 3,
        lambda at: ["inspect", at.bundle("graphs/main.onnx", lambda data: data[:-100])]),
    Row("a graph with one byte flipped", "its SHA-256 is not the manifest's", 3,
        lambda at: ["evaluate", at.bundle("graphs/main.onnx", lambda data: data[:-9] + b"\0" + data[-8:])]),
    Row("a graph cut short, sealed again", "ONNX Runtime", 3,
        lambda at: ["evaluate", at.bundle("graphs/main.onnx", lambda data: data[:-100], sealed=True)]),
    Row("a graph that is no ONNX, sealed again", "The graph 'main' cannot be quantized: DecodeError", 3,
        lambda at: ["quantize", at.bundle("graphs/main.onnx", b"no graph", sealed=True, of="float"), *at.to]),
    Row("a bundle that is int8 already", "is int8 already; quantize.static_int8 starts from float32", 3,
        lambda at: ["quantize", at.int8, *at.to]),
    Row("bfloat16 of an int8 bundle", "is int8 already; quantize.bfloat16 starts from float32", 3,
        lambda at: ["quantize", "bfloat16", at.int8, *at.to]),
    Row("golden values that are none", "golden", 3,
        lambda at: lambda: load(at.bundle("golden/golden.npz", b"PK", sealed=True)), called),
]  # fmt: skip
SOURCES = [
    Row("no source", "is neither a bundle nor a policy source", 3, lambda at: ["export", at.root / "none", *at.to]),
    Row("no ONNX file", "No such ONNX file", 3, lambda at: ["quantize", at.root / "none.onnx", *at.to]),
    Row("an ONNX file that is none", "is not a readable ONNX file", 3,
        lambda at: ["quantize", at.file("a.onnx", b"\x0a\xff" * 9), *at.to]),
    Row("an empty ONNX file", "its graph has no nodes", 3, lambda at: ["quantize", at.file("a.onnx", ""), *at.to]),
    Row("an ONNX file that lacks an input", "The ONNX file has no 'frames'", 3,
        lambda at: ["quantize", at.onnx("name: image", "name: frames"), *at.to]),
    Row("a source without a description", "is not a bundle ... no source of policies reads it (found: nothing)", 3,
        lambda at: ["optimize", at.place, *at.to, *PLAN]),
    Row("a bundle for a policy", "is a bundle; the policy that it was made from is needed", 3,
        lambda at: ["optimize", at.float, *at.to, *PLAN]),
    Row("a checkpoint of another library", "(found: config.json, model.safetensors); it looks like", 3,
        lambda at: ["quantize", at.checkpoint(), *at.to]),
    Row("a description that is not YAML", "is not valid YAML", 3,
        lambda at: ["export", at.policy("schema: 1", "schema: [1"), *at.to]),
    Row("an unknown key", "unknown key 'sorce'; did you mean 'source'", 3,
        lambda at: ["export", at.policy("source:", "sorce:"), *at.to]),
    Row("a description without a spec", "has no 'spec'", 3,
        lambda at: ["export", at.file("policy.yaml", "name: a"), *at.to]),
    Row("an unknown dtype", "did you mean 'uint8'", 3, lambda at: ["export", at.policy("uint8", "unit8"), *at.to]),
    Row("an unknown normalisation", "did you mean 'mean_std'", 3,
        lambda at: ["export", at.policy("mean_std", "mean_sdt"), *at.to]),
    Row("a shape with a zero", "an axis is a whole number", 3,
        lambda at: ["export", at.policy("[1, 8, 8, 3]", "[1, 0, 8, 3]"), *at.to]),
    Row("a rate in words", "control_hz", 3,
        lambda at: ["export", at.policy("control_hz: 10", "control_hz: fast"), *at.to]),
    Row("executed actions in words", "execute", 3,
        lambda at: ["export", at.policy("execute: 2", "execute: two"), *at.to]),
    Row("a number of tokens in words", "max_tokens", 3,
        lambda at: ["export", at.policy("max_tokens: 4", "max_tokens: four"), *at.to]),
    Row("arguments that are no mapping", "arguments", 3,
        lambda at: ["export", at.policy("{layers: 1}", "[1]"), *at.to]),
    Row("calibration data that is not there", "names the calibration data", 3,
        lambda at: ["export", at.policy("schema: 1", "calibration: none.npz"), *at.to]),
    Row("no factory", "names no factory", 3, lambda at: ["export", at.policy("source: policy.py:make\n", ""), *at.to]),
    Row("a factory without a function", "names a file but no function", 3,
        lambda at: ["export", at.policy("policy.py:make\n", "policy.py\n"), *at.to]),
    Row("no factory file", "No such file", 3, lambda at: ["export", at.policy(drop="policy.py"), *at.to]),
    Row("no factory function", "no function 'make'; did you mean 'male'", 3,
        lambda at: ["export", at.code("def male(layers): pass"), *at.to]),
    Row("code that does not parse", "failed: SyntaxError", 3, lambda at: ["export", at.code("def"), *at.to]),
    Row("a factory that raises", "failed: ZeroDivisionError", 3,
        lambda at: ["export", at.code(MAKE + "1 / 0"), *at.to]),
    Row("a factory that gives no module", "The factory gave a int", 3,
        lambda at: ["export", at.code(MAKE + "return 3"), *at.to]),
    Row("a factory that takes other arguments", "failed: TypeError", 3,
        lambda at: ["export", at.code("def make(): pass"), *at.to]),
    Row("a factory that needs a package", "needs the package 'no_such_package'", 4,
        lambda at: ["export", at.code("import no_such_package"), *at.to]),
    Row("a module that fails", "The policy fails on an observation that fits its spec", 3,
        lambda at: ["export", at.code(MAKE + "return torch.nn.Linear(7, 7)"), *at.to]),
    Row("weights that do not fit", "failed: ", 3, lambda at: ["export", at.policy(weights=b"no weights"), *at.to]),
    Row("weights that changed after the source bundle", "has changed since the source bundle was made", 3,
        lambda at: at.changed_after, called),
    Row("no statistics", "names statistics.json, which is not in", 3,
        lambda at: ["export", at.policy(drop="statistics.json"), *at.to]),
    Row("statistics that are not JSON", "is not valid JSON", 3,
        lambda at: ["export", at.policy(statistics="{"), *at.to]),
    Row("statistics of another name", "has no statistics 'proprio'", 3,
        lambda at: ["export", at.policy(statistics={"propio": {}}), *at.to]),
    Row("statistics of the wrong width", "has the shape [2]; 'proprio' has 3 elements", 3,
        lambda at: ["export", at.policy(statistics={"proprio": {"mean": [0, 0], "std": [1, 1]}}), *at.to]),
    Row("statistics without spread", "have no spread in the elements [1]", 3,
        lambda at: ["export", at.policy(statistics={"proprio": {"mean": [0] * 3, "std": [1, 0, 1]}}), *at.to]),
    Row("statistics that are not finite", "not finite", 3,
        lambda at: ["export", at.policy(statistics={"proprio": {"mean": [0, np.nan, 0], "std": [1] * 3}}), *at.to]),
    Row("no tokenizer", "names vocabulary.json, which is not in", 3,
        lambda at: ["export", at.policy(drop="vocabulary.json"), *at.to]),
    Row("a tokenizer that is none", "is not a tokenizer", 3, lambda at: ["export", at.policy(vocabulary={}), *at.to]),
    Row("a vocabulary whose ids are words", "vocabulary", 3,
        lambda at: ["export", at.policy(vocabulary={"kind": "words", "pad": 0, "unknown": 1,
                    "words": dict.fromkeys(WORDS, "two")}), *at.to]),
]  # fmt: skip
DATA = [
    Row("no data", "none.npz not found", 3, lambda at: ["evaluate", at.float, "--data", at.root / "none.npz"]),
    Row("data of an unknown format", "is of an unknown format; known: hdf5", 3,
        lambda at: ["evaluate", at.float, "--data", at.file("a.txt", "1,2")]),
    Row("corrupt data", "cannot be read", 3,
        lambda at: ["evaluate", at.float, "--data", at.file("a.npz", "no archive")]),
    Row("data cut short", "cannot be read", 3,
        lambda at: ["evaluate", at.float, "--data", at.file("a.npz", at.recording().read_bytes()[:-200])]),
    Row("data in an unknown compression", "packed in a way that numpy does not write", 3,
        lambda at: ["evaluate", at.float, "--data",
                    at.file("a.npz", unsupported_compression(at.recording().read_bytes()))]),
    Row("pickled data", "it holds pickled objects, which are refused", 3,
        lambda at: ["quantize", at.float, *at.to, "--calibration",
                    at.recording(image=lambda values: np.array([{"a": 1}] * len(values)))]),
    Row("data without arrays", "has no 'image'", 3,
        lambda at: ["evaluate", at.float, "--data", empty_archive(at.root / "a.npz")]),
    Row("data without samples", "holds no samples", 3,
        lambda at: ["evaluate", at.float, "--data", at.recording(
            **dict.fromkeys(("image", "proprio", "instruction", "action", "episode"), lambda values: values[:0]))]),
    Row("data that is one array", "is one array, not an archive", 3,
        lambda at: ["evaluate", at.float, "--data", single_array(at.root / "a.npz")]),
    Row("calibration data that is too wide", "has the shape [16, 4]; wanted [N, 3]", 3,
        lambda at: ["quantize", at.float, *at.to, "--calibration",
                    at.recording(proprio=lambda values: np.zeros((len(values), 4), np.float32))]),
    Row("images of floats", "is float32; the policy takes uint8", 3,
        lambda at: ["quantize", at.float, *at.to, "--calibration",
                    at.recording(image=lambda values: (values / 255).astype(np.float32))]),
    Row("calibration data that is not a number", "the first is sample 5", 3,
        lambda at: ["quantize", at.float, *at.to, "--calibration", at.recording(proprio=nan_at(5))]),
    Row("actions that are not a number", "the expert's action in", 3,
        lambda at: ["evaluate", at.float, "--data", at.recording(action=nan_at(2))]),
    Row("actions of the wrong width", "has 3 elements; the policy gives 2", 3,
        lambda at: ["evaluate", at.float, "--data", at.recording(action=lambda values: np.zeros((16, 4, 3)))]),
    Row("a single action", "action", 3,
        lambda at: ["evaluate", at.float, "--data", at.recording(action=lambda values: np.array(1.0))]),
    Row("episodes with names", "episode", 3,
        lambda at: ["evaluate", at.float, "--data", at.recording(episode=lambda values: np.array(["a"] * 16))]),
    Row("a missing input", "has no 'proprio'", 3,
        lambda at: ["evaluate", at.float, "--data", at.recording(proprio=None)]),
    Row("instructions that are numbers", "a text input needs unicode strings", 3,
        lambda at: ["evaluate", at.float, "--data", at.recording(instruction=lambda values: np.arange(16))]),
    Row("unequal numbers of samples", "different numbers of samples", 3,
        lambda at: ["evaluate", at.float, "--data", at.recording(image=lambda values: values[:3])]),
    Row("no calibration data", "carries no calibration data", 3,
        lambda at: lambda: run_transform(StaticInt8(), uncalibrated(at), at.out, Context()).bundle, called),
    Row("an observation that lacks an input", "The observation has no 'proprio'", 3,
        lambda at: lambda: at.infer(proprio=None), called),
    Row("an observation of the wrong shape", "has the shape [1, 4]; the policy takes [1, 3]", 3,
        lambda at: lambda: at.infer(proprio=np.zeros(4, np.float32)), called),
    Row("an image of floats", "is float32; the policy takes uint8", 3,
        lambda at: lambda: at.infer(image=np.zeros((8, 8, 3), np.float32)), called),
    Row("an observation that is not a number", "holds 1 NaN of 3 values", 3,
        lambda at: lambda: at.infer(proprio=np.array([0, np.nan, 0], np.float32)), called),
    Row("an instruction that is a number", "is text; got int", 3, lambda at: lambda: at.infer(instruction=7), called),
]  # fmt: skip
FILES = [
    Row("no recipe", "There is no recipe", 3,
        lambda at: ["optimize", at.template, *at.to, *PLAN, "--recipe", at.root / "none.yaml"]),
    Row("a recipe that is not YAML", "is not valid YAML", 3, lambda at: at.recipe("candidates: [")),
    Row("a recipe that is a list", "must be a mapping; got list", 3, lambda at: at.recipe("[]")),
    Row("a recipe without candidates", "candidates", 3, lambda at: at.recipe("candidates: {}")),
    Row("a newer recipe", "schema", 3, lambda at: at.recipe("schema: 2\ncandidates: {a: []}")),
    Row("an unknown stage", "did you mean 'quantize.static_int8'", 3,
        lambda at: at.candidate("quantize.static_in8: {}")),
    Row("an unknown option of a stage", "unknown option 'sampels'; did you mean 'samples'", 3,
        lambda at: at.candidate("quantize.static_int8: {sampels: 3}")),
    Row("an option of the wrong type", "samples = 'many'", 3,
        lambda at: at.candidate("quantize.static_int8: {samples: many}")),
    Row("a stage with two names", "A stage is one name", 3,
        lambda at: at.candidate("{quantize.static_int8: {}, quantize.dynamic_int8: {}}")),
    Row("a stage that measures", "a recipe lists stages that make a bundle", 3,
        lambda at: at.candidate("benchmark.overhead: {}")),
    Row("a candidate by the baseline's name", "cannot be called 'float32'", 3,
        lambda at: at.candidate("quantize.dynamic_int8: {}", "float32")),
    Row("a recipe of which nothing can be made", "No candidate could be made: mine:", 3,
        lambda at: ["optimize", at.onnx(), *at.to, *BOARD, "--recipe",
                    at.file("r.yaml", "candidates: {mine: [quantize.static_int8: {calibration: none.npz}]}")]),
    Row("an unknown board", "did you mean 'raspberry-pi-5'", 3,
        lambda at: ["optimize", at.template, *at.to, "--profile", "rasberry-pi-5"]),
    Row("no profile", "cannot be read", 3, lambda at: ["profiles", "show", at.root / "none.yaml"]),
    Row("a profile that is not YAML", "is not valid YAML", 3,
        lambda at: ["profiles", "show", at.file("board.yaml", "name: [")]),
    Row("a profile that lacks a field", "bandwidth_gb_s: is missing", 3,
        lambda at: ["profiles", "show", at.profile(take("bandwidth_gb_s"))]),
    Row("a profile with a negative number", "memory_gb.value: must be above 0; got -8", 3,
        lambda at: ["profiles", "show", at.profile(put("memory_gb", "value", -8))]),
    Row("a profile with an unknown key", "colour: is not a known key", 3,
        lambda at: ["evaluate", at.float, "--profile", at.profile(put("colour", "red"))]),
    Row("no report", "No report or bundle at", 3, lambda at: ["compare", at.root / "none", at.root / "neither"]),
    Row("a report that is not JSON", "This is not a vlatool report", 3,
        lambda at: ["compare", at.file("a.json", "{"), at.file("b.json", "{")]),
    Row("a newer report", "upgrade vlatool", 3, lambda at: at.report(put("schema", 2))),
    Row("a report of an unknown verdict", "verdict", 3, lambda at: at.report(put("verdict", "maybe"))),
    Row("a report with a word for a number", "This is not a vlatool report", 3,
        lambda at: at.report(put("rows", 0, "measurements", 0, "value", "fast"))),
    Row("a report with a word for a table", "This is not a vlatool report", 3,
        lambda at: at.report(put("rows", 0, "details", "none"))),
]  # fmt: skip
OUTPUTS = [
    Row("a bundle that exists already", "exists already", 3, lambda at: ["quantize", at.float, *at.taken()]),
    Row("an optimized bundle that exists already", "exists already", 3,
        lambda at: ["optimize", at.onnx(), *at.taken(), *BOARD]),
    Row("a sample that exists already", "exists already", 3,
        lambda at: ["samples", "make", "action-expert", *at.taken()]),
    Row("a report that exists already", "exists already", 3, lambda at: ["evaluate", at.float, *at.taken()]),
    Row("an output below a file", "a part of the path is a file", 3,
        lambda at: ["quantize", at.float, "-o", at.file("place/file", "") / "out"]),
    Row("an output far below a file", "a part of the path is a file", 3,
        lambda at: ["quantize", at.float, "-o", at.file("place/file", "") / "a/out"]),
    Row("an output whose name is too long", "Cannot write", 3,
        lambda at: ["quantize", at.float, "-o", at.place / ("out" * 99)]),
    Row("a full disk", "Cannot write", 3, lambda at: ["quantize", at.float, *at.to], full_disk),
    Row("a full disk under the cache", "Cannot write", 3,
        lambda at: ["optimize", at.onnx(), "-o", at.root / "out", *BOARD, "--episodes", 0], full_cache),
    Row("a read-only disk", "Cannot write", 3, lambda at: ["quantize", at.float, *at.to], read_only),
    *small_or_full([], [
        Row("a full disk under a sample", "Cannot write", 3,
            lambda at: ["samples", "make", "action-expert", *at.to], full_disk),
        Row("a limit on the size of files", "Cannot write", 3, lambda at: ["quantize", at.float, *at.to], small_files),
    ]),
]  # fmt: skip
MACHINE = [
    Row("no torch", "pip install 'vlatool[build]'", 4, lambda at: ["export", at.template, *at.to],
        without_package("torch")),
    Row("no onnx", "pip install 'vlatool[build]'", 4, lambda at: ["quantize", at.float, *at.to],
        without_package("onnx")),
    Row("no onnxruntime", "pip install 'vlatool[ort]'", 4, lambda at: ["evaluate", at.float],
        without_package("onnxruntime")),
    Row("Ctrl-C in the middle of an export", "interrupted; finished stages are kept", 130,
        lambda at: ["export", at.template, *at.to], interrupted),
]  # fmt: skip
ROWS = [*COMMANDS, *BUNDLES, *SOURCES, *DATA, *FILES, *OUTPUTS, *MACHINE]
TABLE = {"": ROWS, "boards": _wrong_boards.ROWS, "trainings": _wrong_trainings.ROWS}


def empty_archive(path: Path) -> Path:
    zipfile.ZipFile(path, "w").close()
    return path


def single_array(path: Path) -> Path:
    with path.open("wb") as stream:
        np.save(stream, np.zeros(3))
    return path


def uncalibrated(at: Workshop) -> Bundle:
    path = Path(shutil.copytree(at.float, at.root / "bare"))
    shutil.rmtree(path / "data")
    return seal(path, at.bundles["float"].manifest)


@pytest.fixture
def at(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Place:
    """Where the mistakes of a subject are made."""
    subject, given = request.param, request.getfixturevalue
    if subject:
        return {"boards": _wrong_boards, "trainings": _wrong_trainings}[subject].place(tmp_path, monkeypatch, given)
    bundles = {"float": given("float_bundle"), "int8": given("int8_bundle")}
    return Workshop(tmp_path, given("policy_template"), bundles)


@pytest.mark.parametrize(
    ("at", "row"),
    [(subject, row) for subject, rows in TABLE.items() for row in rows],
    ids=lambda value: value if isinstance(value, str) else value.name.replace(" ", "-"),
    indirect=["at"],
)
def test_what_is_wrong_is_said_and_nothing_is_left(row: Row, at: Place, capfd: pytest.CaptureFixture[str]):
    check(row, at, lambda: capfd.readouterr().err)


def test_the_table_names_each_case_once():
    for subject, rows in TABLE.items():
        assert len({row.name for row in rows}) == len(rows) >= {"": 45, "boards": 100, "trainings": 40}[subject]
