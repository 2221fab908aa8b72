"""The command that exports a bundle of modules, wherever its lack of graphs is noticed."""

from __future__ import annotations

import json
import shlex
import shutil
from pathlib import Path

import pytest

from vlatool.bundle.bundle import LOCATION, Bundle
from vlatool.bundle.module_bundle import export_command
from vlatool.errors import BundleError
from vlatool.quantize.static_int8 import StaticInt8
from vlatool.quantize.weight_only import WeightOnly
from vlatool.runtime import load


@pytest.fixture
def pruned(source_bundle: Bundle, tmp_path: Path) -> Path:
    """A bundle without graphs, under a name that a shell would take for two."""
    return Path(shutil.copytree(source_bundle.path, tmp_path / "pruned one"))


@pytest.mark.parametrize("use", ["load", "quantize", "stream"])
def test_the_command_names_the_bundle_and_the_code_that_it_trusts(pruned: Path, use: str):
    folder = json.loads((pruned / LOCATION).read_text())["folder"]
    uses = {"load": load, "quantize": lambda path: StaticInt8().check(Bundle.open(path), None),
            "stream": lambda path: WeightOnly().check(Bundle.open(path), None)}  # fmt: skip
    with pytest.raises(BundleError, match="no graph to") as caught:
        uses[use](pruned)
    command = caught.value.fix.partition("export it first: ")[2].partition(";")[0]
    assert shlex.split(command) == ["vlatool", "export", str(pruned), "-o", "BUNDLE", "--trust", folder]


@pytest.mark.parametrize("note", [
    "", "{", "[]", '{"folder": 7}', '{"folder": "relative"}', '{"folder": "/not/there"}',
    '{"folder": "/tmp\\u001b[2J"}', "[" * 100_000,
])  # fmt: skip
def test_a_note_that_names_no_folder_gives_a_placeholder(tmp_path: Path, note: str):
    (tmp_path / LOCATION).write_text(note)
    assert export_command(tmp_path).endswith(" -o BUNDLE --trust POLICY")
