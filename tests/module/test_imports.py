"""What of a policy's folder counts as its code."""

from __future__ import annotations

from pathlib import Path

import pytest

from vlatool.bundle.bundle import Bundle
from vlatool.errors import SourceError
from vlatool.module.imports import imported_files
from vlatool.module.torch_policy import load_modules
from vlatool.sources.torch_module import TorchModule
from vlatool.stage.base import Context

FILES = {
    "policy.py": "import torch\nfrom helper import build\nimport nets.body\n",
    "helper.py": "def build():\n    from deep import constant\n    return constant\n",
    "deep.py": "constant = 3\n",
    "nets/__init__.py": "",
    "nets/body.py": "from . import head\nfrom .head import Head\nimport importlib\nimportlib.import_module('late')\n",
    "nets/head.py": "from ..outside import x\nHead = 1\n",
    "outside.py": "x = 1\n",
    "late.py": "",
    "nets/unused.py": "",
    "notes.py": "print('an experiment')\n",
}
IMPORTED = {
    "policy.py",
    "helper.py",
    "deep.py",
    "nets/__init__.py",
    "nets/body.py",
    "nets/head.py",
    "outside.py",
    "late.py",
}


def found(folder: Path, files: dict[str, str]) -> set[str]:
    for name, text in files.items():
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text(text)
    return {file.relative_to(folder).as_posix() for file in imported_files([folder / "policy.py"], folder)}


def test_imports_are_followed_and_nothing_else_counts(tmp_path: Path) -> None:
    assert found(tmp_path, FILES) == IMPORTED


def test_a_new_file_that_shadows_a_package_counts(tmp_path: Path) -> None:
    assert found(tmp_path, {**FILES, "torch.py": ""}) == {*IMPORTED, "torch.py"}


@pytest.mark.parametrize(
    "code",
    ["import importlib\nimportlib.import_module(name)\n", "__import__('notes')\n", "exec(open('notes.py').read())\n",
     "import sys\nsys.path.append('nets')\n", "import runpy\nrunpy.run_path(name)\n", "def broken(:\n"],
)  # fmt: skip
def test_where_no_statement_says_what_is_imported_every_file_counts(tmp_path: Path, code: str) -> None:
    assert "notes.py" in found(tmp_path, {"policy.py": code, "notes.py": ""})


@pytest.mark.parametrize("code", ["runpy.run_path('notes.py')", "spec_from_file_location('x', HERE / 'notes.py')"])
def test_a_file_that_is_imported_by_its_name_counts_and_no_other(tmp_path: Path, code: str) -> None:
    files = {"policy.py": f"def make():\n    {code}\n", "notes.py": "", "other.py": ""}
    assert found(tmp_path, files) == {"policy.py", "notes.py"}


def remade(policy: Path, out: Path) -> Bundle:
    out.mkdir()
    return TorchModule(policy=policy).run(None, out, Context()).bundle


def test_the_environment_and_what_it_imports_are_code_too(policy_dir: Path, tmp_path: Path) -> None:
    (policy_dir / "world.py").write_text("")
    text = (policy_dir / "environment.py").read_text()
    (policy_dir / "environment.py").write_text(f"{text}\nimport world\n")
    code = remade(policy_dir, tmp_path / "source").manifest.source["code"]
    assert {"policy.py", "environment.py", "world.py", "weights.safetensors"} <= set(code)


def test_an_import_that_no_statement_names_is_refused(policy_dir: Path, tmp_path: Path) -> None:
    text = (policy_dir / "policy.py").read_text()
    (policy_dir / "policy.py").write_text(
        f"{text}\nimport builtins\ngetattr(builtins, '__imp' + 'ort__')('concealed')\n"
    )
    (policy_dir / "environment.py").unlink()
    description = (policy_dir / "policy.yaml").read_text()
    (policy_dir / "policy.yaml").write_text(
        description.replace("environment:\n  make: environment.py:make\n  tasks: [reach, push]\n", "")
    )
    (policy_dir / "concealed.py").write_text("")
    with pytest.raises(SourceError, match=r"imports concealed\.py, which no import statement") as caught:
        load_modules(remade(policy_dir, tmp_path / "source"))
    assert "files: [concealed.py]" in caught.value.fix
    with (policy_dir / "policy.yaml").open("a") as file:
        file.write("files: [concealed.py, '*.safetensors']\n")
    load_modules(remade(policy_dir, tmp_path / "named"))


def test_files_say_which_data_counts(policy_dir: Path, tmp_path: Path) -> None:
    (policy_dir / "older.safetensors").write_bytes(b"another checkpoint")
    assert "older.safetensors" in remade(policy_dir, tmp_path / "all").manifest.source["code"]
    description = (policy_dir / "policy.yaml").read_text()
    (policy_dir / "policy.yaml").write_text(f"{description}files: weights.safetensors\n")
    code = remade(policy_dir, tmp_path / "named").manifest.source["code"]
    assert "weights.safetensors" in code
    assert "older.safetensors" not in code


@pytest.mark.parametrize("files", ["3", "[../other.pt]", "['/etc/passwd']", "[[]]", "[absent.pt]"])
def test_files_that_are_none_of_the_folder_are_refused(policy_dir: Path, tmp_path: Path, files: str) -> None:
    description = (policy_dir / "policy.yaml").read_text()
    (policy_dir / "policy.yaml").write_text(f"{description}files: {files}\n")
    with pytest.raises(SourceError, match=r"files"):
        remade(policy_dir, tmp_path / "source")
