"""What a person may name as a policy and is none, or a broken one: what is said, the exit code, and nothing left.

Malicious pickles write a file when they are opened: it must not be there.
"""

from __future__ import annotations

import io
import json
import pickle  # noqa: TID251 (what must not be opened is written here)
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
import torch
from _foreign_onnx import F, N, V, model, weight
from _torch_files import Branching, Camera, quiet, saved
from _wrong_inputs import Line, Place, Row, check
from onnx import TensorProto, helper
from torch import Tensor, nn

from vlatool.user_code import trust

SHAPES = ["--shape", "state=1,16", "--shape", "goal=1,3"]


class Evil:
    """Runs a command when it is unpickled."""

    def __init__(self, mark: Path) -> None:
        self.mark = mark

    def __reduce__(self) -> Any:
        import os

        return os.system, (f"touch {self.mark}",)


class Workshop(Place):
    """Makes wrong sources."""

    def __init__(self, root: Path) -> None:
        super().__init__(root)
        self.to = ["-o", self.out]
        self.mark = root / "pwned"

    def export(self, path: Path, *more: Any) -> Line:
        """Export a path."""
        return ["export", path, *self.to, *more]

    def trusted(self, path: Path, *more: Any) -> Line:
        """Export a file that is trusted."""
        return self.export(path, "--trust", path, *more)

    def script(self, name: str = "walker.pt") -> Path:
        """A good TorchScript file."""
        return saved(Branching(), self.root / name)

    def program(self, name: str = "cam.pt2") -> Path:
        """A good program of torch.export."""
        return saved(Camera(), self.root / name, torch.rand(1, 3, 8, 8), torch.zeros(1, 1, 5))

    def cut(self, path: Path, share: float) -> Path:
        """Leave the first part of a file."""
        content = path.read_bytes()
        path.write_bytes(content[: int(len(content) * share)])
        return path

    def pickled(self, name: str, save: Callable[[Any, Path], object]) -> Path:
        """A file that would run a command."""
        path = self.root / name
        save(Evil(self.mark), path)
        return path

    def zipped(self, name: str, compressed: bool = False, **files: bytes) -> Path:
        """A zip file."""
        path = self.root / name
        how = zipfile.ZIP_DEFLATED if compressed else zipfile.ZIP_STORED
        with zipfile.ZipFile(path, "w", how) as archive:
            for key, content in files.items():
                archive.writestr(key.replace("__", "/").replace("_dot_", "."), content)
        return path

    def onnx(self, made: Any, name: str = "net.onnx") -> Path:
        """An ONNX file."""
        path = self.root / name
        onnx.save(made, path)
        return path

    def folder(self, **files: str | bytes) -> Path:
        """A directory with files."""
        for name, content in files.items():
            self.file(f"folder/{name.replace('_dot_', '.')}", content)
        (self.root / "folder").mkdir(exist_ok=True)
        return self.root / "folder"


def of_torch(module: nn.Module, name: str = "net.pt", *example: Any) -> Callable[[Workshop], Path]:
    return lambda at: saved(module, at.root / name, *example)


class Growing(nn.Module):
    """A loop whose length depends on the values, and a list that grows in it."""

    def forward(self, state: Tensor) -> Tensor:
        parts = [state]
        while bool(parts[-1].sum() < 10):
            parts.append(parts[-1] * 2 + 1)
        return torch.cat(parts, 1)


class Selected(nn.Module):
    """The shape of what it returns depends on the values."""

    def forward(self, state: Tensor) -> Tensor:
        return state[state > 0]


class Noisy(nn.Module):
    """Draws noise of its own."""

    def forward(self, state: Tensor) -> Tensor:
        return state + torch.randn_like(state)


class Strings(nn.Module):
    """Returns what is no tensor."""

    def forward(self, state: Tensor) -> tuple[Tensor, str]:
        return state, "ok"


class Empty(nn.Module):
    """Takes nothing."""

    def forward(self) -> Tensor:
        return torch.ones(1, 3)


class Unused(nn.Module):
    """Takes what it does not use."""

    def forward(self, state: Tensor, extra: Tensor) -> Tensor:
        return state * 2


class Five(nn.Module):
    """Pictures of several cameras and steps, as 2-D convolutions do not take them."""

    def __init__(self) -> None:
        super().__init__()
        self.conv = nn.Conv2d(3, 4, 3)

    def forward(self, images: Tensor) -> Tensor:
        return self.conv(images).mean((2, 3))


class Eigen(nn.Module):
    """An operator that ONNX lacks."""

    def forward(self, state: Tensor) -> Tensor:
        return torch.linalg.eigvalsh(state)


def linear(**more: Any) -> Any:
    nodes = [N("MatMul", ["state", "W"], ["action"])]
    return model(nodes, [weight("W", 16, 6)], **more)


def custom(domain: str, kind: str = "DeformableAttention") -> Any:
    nodes = [
        N("MatMul", ["state", "W"], ["hidden"], "layer1/MatMul"),
        N(kind, ["hidden"], ["action"], "layer2/attention", domain=domain),
    ]
    return model(nodes, [weight("W", 16, 6)], domains=(domain,))


def texts() -> Any:
    nodes = [N("StringNormalizer", ["state"], ["action"], case_change_action="LOWER")]
    kind = TensorProto.STRING
    return model(nodes, (), (V("state", kind, [1]),), (V("action", kind, [1]),))


def newer(made: Any, opset: int = 99, ir: int = 8) -> Any:
    made.opset_import[0].version = opset
    made.ir_version = ir
    return made


def safetensors(*content: bytes) -> bytes:
    header = json.dumps({"w": {"dtype": "F32", "shape": [4], "data_offsets": [0, 16]}}).encode()
    return struct.pack("<Q", len(header)) + header + b"".join(content)


ARCHIVES = [
    Row("a file that is not there", "there is no such file", 3, lambda at: at.export(at.root / "gone.bin")),
    Row("a TorchScript file that is not there", "No such file: ... gone.pt", 3,
        lambda at: at.export(at.root / "gone.pt")),
    Row("an ONNX file that is not there", "No such ONNX file: ... gone.onnx", 3,
        lambda at: at.export(at.root / "gone.onnx")),
    Row("0 bytes as .pt", "net.pt is empty. fix: copy or save it again", 3,
        lambda at: at.export(at.file("net.pt", b""))),
    Row("0 bytes as .pt2", "net.pt2 is empty", 3, lambda at: at.export(at.file("net.pt2", b""))),
    Row("0 bytes as .onnx", "net.onnx", 3, lambda at: at.export(at.file("net.onnx", b""))),
    Row("text as .pt", "is not a file that torch wrote: it begins with b'vers'", 3,
        lambda at: at.export(at.file("net.pt", "version https://git-lfs.github.com/spec/v1\n"))),
    Row("text as .onnx", "net.onnx is not a readable ONNX file", 3,
        lambda at: at.export(at.file("net.onnx", "<html>404</html>" * 9))),
    Row("half of a .pt", "walker.pt is damaged", 3, lambda at: at.export(at.cut(at.script(), 0.5))),
    Row("half of a .pt2", "cam.pt2 is damaged", 3, lambda at: at.export(at.cut(at.program(), 0.5))),
    Row("half of a .onnx", "net.onnx", 3, lambda at: at.export(at.cut(at.onnx(linear()), 0.5))),
    Row("a zip file of something else", "is a zip file that torch did not write: it holds a.txt", 3,
        lambda at: at.export(at.zipped("net.pt", a_dot_txt=b"hello"))),
    Row("a zip bomb as .pt", "would unpack to 1 files of 20,000,000 bytes", 3,
        lambda at: at.export(at.zipped("net.pt", True, net__data__0=bytes(20_000_000)))),
    Row("a zip bomb as .pt2", "would unpack to", 3,
        lambda at: at.export(at.zipped("net.pt2", True, net__data__weights__0=bytes(20_000_000)))),
    Row("a compiled program", "is a program that AOTInductor compiled for one machine", 3,
        lambda at: at.export(at.zipped("net.pt2", net__data__aotinductor__model__a_dot_so=b"\x7fELF"))),
    Row("TorchScript named .pt2", "is TorchScript, and not a program of torch.export", 3,
        lambda at: at.trusted(at.script("net.pt2x").rename(at.root / "net.pt2"))),
    Row("a program named .pt", "is a program of torch.export, and not TorchScript ... name it FILE.pt2", 3,
        lambda at: at.trusted(at.program().rename(at.root / "net.pt"))),
    Row("a state_dict", "holds weights alone (a state_dict, say), and no network to run", 3,
        lambda at: (torch.save(Branching().state_dict(), at.root / "net.pt"), at.export(at.root / "net.pt"))[1]),
    Row("a state_dict of old torch", "holds weights alone", 3, lambda at: (
        torch.save(Branching().state_dict(), at.root / "net.pth", _use_new_zipfile_serialization=False),
        at.export(at.root / "net.pth"))[1]),
    Row("a pickled module", "is a pickle of Python objects (_torch_files.Branching", 3,
        lambda at: (torch.save(Branching(), at.root / "net.pt"), at.trusted(at.root / "net.pt"))[1]),
]  # fmt: skip
PICKLES = [
    Row("a malicious .pt", "is a pickle of Python objects (posix.system), which may run any code", 3,
        lambda at: at.export(at.pickled("net.pt", torch.save))),
    Row("a malicious .pt that is trusted", "(posix.system), which may run any code when it is opened; it was not", 3,
        lambda at: at.trusted(at.pickled("net.pt", torch.save))),
    Row("a malicious .ckpt", "(posix.system), which may run any code", 3,
        lambda at: at.export(at.pickled("net.ckpt", torch.save))),
    Row("a malicious .pth without a zip", "(posix.system), which may run any code", 3,
        lambda at: at.trusted(at.pickled("net.pth", lambda value, path: path.write_bytes(pickle.dumps(value))))),
    Row("a malicious .pkl", "is a pickle, which may run any code when it is opened; it was not", 3,
        lambda at: at.export(at.pickled("net.pkl", lambda value, path: path.write_bytes(pickle.dumps(value))))),
    Row("TorchScript with a malicious constant", "which you did not trust", 3, lambda at: at.export(at.zipped(
        "net.pt", net__code____torch___dot_py=b"", net__constants_dot_pkl=pickle.dumps(Evil(at.mark)),
        net__data_dot_pkl=pickle.dumps(Evil(at.mark))))),
    Row("TorchScript with a malicious pickle that is trusted", "torch cannot open", 3, lambda at: at.trusted(at.zipped(
        "net.pt", net__code____torch___dot_py=b"", net__constants_dot_pkl=pickle.dumps(Evil(at.mark)),
        net__data_dot_pkl=pickle.dumps(Evil(at.mark)), net__version=b"3\n"))),
    Row("a pickle that is cut off", "is damaged", 3,
        lambda at: at.export(at.cut(at.pickled("net.pth", lambda v, path: path.write_bytes(pickle.dumps(v))), 0.5))),
    Row("a module by name in a policy.yaml that is no function", "names no factory", 3, lambda at: at.export(at.folder(
        policy_dot_yaml="name: a\nsource: os\nspec: {inputs: [{name: a, shape: [1, 2]}], "
        "outputs: [{name: b, shape: [1, 2]}], control_hz: unknown}\n"))),
]  # fmt: skip
SCRIPTS = [
    Row("a file that is not trusted", "Opening ... walker.pt may run code that is in it ... --trust", 3,
        lambda at: (trust.trust_file().unlink(missing_ok=True), at.export(at.script_untrusted()))[1]),
    Row("no shapes", "is scripted and does not say the shape of 'state', 'goal' ... vlatool new POLICY --from", 3,
        lambda at: at.trusted(at.script())),
    Row("a shape that is none", "--shape 'state=1,x y' is not a shape of an input", 3,
        lambda at: at.trusted(at.script(), "--shape", "state=1,x y")),
    Row("a dtype that is none", "has the dtype 'int65'; ... int64", 3,
        lambda at: at.trusted(at.script(), "--shape", "state=1,16:int65")),
    Row("a shape on which it fails", "cannot run on state [1, 15] float32, goal [1, 3] float32", 3,
        lambda at: at.trusted(at.script(), "--shape", "state=1,15", "--shape", "goal=1,3")),
    Row("a shape of an input that it lacks", "--shape names 'robot', which is not an input", 3,
        lambda at: at.trusted(at.script(), *SHAPES, "--shape", "robot=1,3")),
    Row("a growing list", "export the Python module that was saved", 3,
        lambda at: at.trusted(of_torch(Growing())(at), "--shape", "state=1,3")),
    Row("a shape that depends on values", "gives 'action' as float32 [2]; the spec declares float32 [1]", 3,
        lambda at: at.trusted(of_torch(Selected())(at), "--shape", "state=1,3")),
    Row("noise of its own", "draws random numbers", 3,
        lambda at: at.trusted(of_torch(Noisy())(at), "--shape", "state=1,3")),
    Row("texts among what it returns", "returns a value of type str", 3,
        lambda at: at.trusted(of_torch(Strings())(at), "--shape", "state=1,3")),
    Row("no inputs", "takes no inputs", 3, lambda at: at.trusted(of_torch(Empty())(at))),
    Row("an input that is not used", "takes extra, on which nothing that it returns depends", 3,
        lambda at: at.trusted(of_torch(Unused())(at), "--shape", "state=1,3", "--shape", "extra=1,2")),
    Row("pictures of five axes", "cannot run on images [1, 2, 3, 8, 8] float32", 3,
        lambda at: at.trusted(of_torch(Five())(at), "--shape", "images=1,2,3,8,8")),
    Row("an operator that ONNX lacks", "torch cannot export ... eig", 3,
        lambda at: at.trusted(of_torch(Eigen())(at), "--shape", "state=1,3,3")),
    Row("an operator that ONNX lacks, in a program", "eig", 3,
        lambda at: at.trusted(of_torch(Eigen(), "net.pt2", torch.eye(3)[None])(at))),
]  # fmt: skip
GRAPHS = [
    Row("an opset that is too new", "opset 99", 3, lambda at: at.export(at.onnx(newer(linear())))),
    Row("a format that is too new", "(ir_version) 99", 3, lambda at: at.export(at.onnx(newer(linear(), 17, 99)))),
    Row("an opset that is refused", "opset = 99", 3, lambda at: at.export(at.onnx(linear()), "--opset", 99)),
    Row("a custom operator", "DeformableAttention of the domain 'mmdeploy' at 'layer2/attention'", 3,
        lambda at: at.export(at.onnx(custom("mmdeploy")))),
    Row("an operator that does not exist", "has the operator Foo at 'layer2/attention'", 3,
        lambda at: at.export(at.onnx(custom("", "Foo")))),
    Row("texts as inputs", "The input 'state' has the type string", 3, lambda at: at.export(at.onnx(texts()))),
    Row("no nodes", "its graph has no nodes", 3, lambda at: at.export(at.onnx(helper.make_model(
        helper.make_graph([], "g", [V("state", F, [1, 2])], [V("state", F, [1, 2])]))))),
    Row("weights beside it that are gone", "net.onnx", 3, lambda at: at.export(at.beside())),
    Row("an empty axis", "has the shape [1, 0]", 3, lambda at: at.export(at.onnx(model(
        [N("Identity", ["state"], ["action"])], (), (V("state", F, [1, 0]),), (V("action", F, [1, 0]),))))),
    Row("free axes", "has the free axes width in its shape ... --shape state=1,width", 3, lambda at: at.export(at.onnx(
        model([N("Relu", ["state"], ["action"])], (), (V("state", F, [1, "width"]),), (V("action", F, None),))))),
    Row("weights that are NaN", "'action' of net.onnx holds NaN or infinity", 3,
        lambda at: at.export(at.onnx(model([N("MatMul", ["state", "W"], ["action"])], [
        onnx.numpy_helper.from_array(np.full((16, 6), np.nan, np.float32), "W")])))),
]  # fmt: skip
OTHERS = [
    Row("weights alone", "is a file of weights alone, without a network", 3,
        lambda at: at.export(at.file("model.safetensors", safetensors(bytes(16))))),
    Row("weights that are cut off", "is cut off: it has ... 'w' ends at", 3,
        lambda at: at.export(at.file("model.safetensors", safetensors(bytes(6))))),
    Row("a header of exabytes", "cannot hold a header of", 3,
        lambda at: at.export(at.file("model.safetensors", struct.pack("<Q", 1 << 60) + b"{}"))),
    Row("llama.cpp", "is a model of llama.cpp", 3, lambda at: at.export(at.file("net.gguf", b"GGUF"))),
    Row("TensorRT", "an engine that TensorRT compiled for one card", 3,
        lambda at: at.export(at.file("net.engine", b"x"))),
    Row("TensorFlow Lite", "TensorFlow Lite ... python -m tf2onnx.convert --tflite", 3,
        lambda at: at.export(at.file("net.tflite", b"x"))),
    Row("Keras", "a Keras model ... tf2onnx", 3, lambda at: at.export(at.file("net.keras", b"x"))),
    Row("Paddle", "a Paddle model ... paddle2onnx", 3, lambda at: at.export(at.file("net.pdmodel", b"x"))),
    Row("OpenVINO", "an OpenVINO IR", 3, lambda at: at.export(at.file("net.xml", "<net/>"))),
    Row("ExecuTorch", "a program that ExecuTorch compiled", 3, lambda at: at.export(at.file("net.pte", b"x"))),
    Row("a recording", "is a recording and no policy", 3, lambda at: at.export(at.file("log.npz", b"x"))),
    Row("a directory without anything", "is not a bundle ... (found: nothing)", 3, lambda at: at.export(at.folder())),
    Row("a directory of texts", "(found: README.md)", 3, lambda at: at.export(at.folder(README_dot_md="hi"))),
    Row("a SavedModel", "looks like a TensorFlow SavedModel ... --saved-model", 3,
        lambda at: at.export(at.folder(saved_model_dot_pb=b"x"))),
    Row("an adapter", "an adapter (LoRA) ... merge it", 3,
        lambda at: at.export(at.folder(adapter_config_dot_json="{}", adapter_model_dot_safetensors=b""))),
    Row("a LeRobot checkpoint", "a LeRobot checkpoint of the policy 'act'", 3, lambda at: at.export(at.folder(
        config_dot_json='{"type": "act", "n_action_steps": 100}', model_dot_safetensors=b""))),
    Row("a Hugging Face checkpoint", "a Hugging Face checkpoint of the model 'llama'", 3,
        lambda at: at.export(at.folder(config_dot_json='{"model_type": "llama"}', model_dot_safetensors=b""))),
    Row("a package of another format", "a package of another tool, of the format 'policy_bundle'", 3,
        lambda at: at.export(at.folder(manifest_dot_json='{"format": "policy_bundle"}'))),
    Row("a package that is no JSON", "has no manifest.sha256", 3,
        lambda at: at.export(at.folder(manifest_dot_json='{"format": '))),
    Row("a policy.yaml that names a file that is gone", "'net.onnx' is neither a Python function nor a file", 3,
        lambda at: at.export(at.folder(
        policy_dot_yaml="name: a\nsource: net.onnx\nspec: {inputs: [{name: a, shape: [1, 2]}], "
        "outputs: [{name: b, shape: [1, 2]}], control_hz: unknown}\n"))),
    Row("neither a target nor a policy", "Unknown export target 'nope', and no such file", 2,
        lambda at: ["export", "nope", "-o", at.out]),
    Row("a new policy where one is", "exists already. fix: name a directory that does not exist", 3,
        lambda at: ["new", at.folder(), "--from", at.onnx(linear())]),
    Row("a new policy of one that is described", "has a policy.yaml already", 2, lambda at: [
        "new", at.out, "--from", at.folder(policy_dot_yaml="name: a\nsource: a.py:make\nspec: {inputs: [{name: a, "
        "shape: [1, 2]}], outputs: [{name: b, shape: [1, 2]}], control_hz: 5}\n", a_dot_py="def make(): pass\n")]),
]  # fmt: skip
ROWS = [*ARCHIVES, *PICKLES, *SCRIPTS, *GRAPHS, *OTHERS]


class Maker(Workshop):
    """Makes what needs several steps."""

    def script_untrusted(self) -> Path:
        """A good TorchScript file that nobody trusted."""
        path = self.root / "walker.pt"
        stream = io.BytesIO()
        with quiet():
            torch.jit.save(torch.jit.script(Branching()), stream)
        path.write_bytes(stream.getvalue())
        return path

    def beside(self) -> Path:
        """An ONNX file whose weights are gone."""
        path = self.root / "net.onnx"
        onnx.save(linear(), path, save_as_external_data=True, location="net.data", size_threshold=0)
        (self.root / "net.data").unlink()
        return path


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.name)
def test_it_is_told_and_nothing_is_left(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], row: Row
) -> None:
    monkeypatch.setenv(trust.TRUST_VARIABLE, str(tmp_path / "trusted.json"))
    at = Maker(tmp_path)
    check(row, at, lambda: capfd.readouterr().err)
    assert not at.mark.exists()


def test_there_are_enough_of_them() -> None:
    assert len({row.name for row in ROWS}) == len(ROWS) >= 60
