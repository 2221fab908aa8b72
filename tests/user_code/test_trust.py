"""A bundle is data: its files make no code run that the user neither named nor trusted."""

from __future__ import annotations

import importlib.util
import json
import os
import py_compile
import shutil
import stat
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from vlatool.bundle.bundle import LOCATION, Bundle, seal, write_manifest
from vlatool.cli import main
from vlatool.errors import SourceError, UsageError
from vlatool.module.torch_policy import load_modules
from vlatool.sources.torch_module import TorchModule
from vlatool.stage.base import Context
from vlatool.user_code import trust

MARKED = """\
import pathlib
pathlib.Path(__file__).with_name("ran").touch()
"""


@pytest.fixture(autouse=True)
def nothing_trusted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Each test begins with a user who trusts nothing."""
    monkeypatch.setenv("VLATOOL_TRUST", str(tmp_path / "settings" / "trusted.json"))
    with trust.forget_named():
        yield


@pytest.fixture
def mine(policy_dir: Path) -> Path:
    """A policy whose code leaves a mark when it runs."""
    for name in ("policy.py", "environment.py"):
        (policy_dir / name).write_text(MARKED + (policy_dir / name).read_text())
    return policy_dir


@pytest.fixture
def bundle(mine: Path, tmp_path: Path) -> Bundle:
    """The source bundle of that policy, as somebody else may have sent it."""
    (tmp_path / "bundle").mkdir()
    with trust.forget_named():
        return TorchModule(policy=mine).run(None, tmp_path / "bundle", Context()).bundle


@pytest.fixture
def vlatool(capsys):
    def run(*line: Any) -> tuple[int, str, str]:
        capsys.readouterr()
        with pytest.raises(SystemExit) as left:
            main([str(part) for part in line])
        told = capsys.readouterr()
        return left.value.code or 0, told.out, told.err

    return run


def ran(mine: Path) -> bool:
    return (mine / "ran").exists()


COMMANDS = {
    "export": ["export", "BUNDLE", "-o", "OUT"],
    "quantize": ["quantize", "weight-only", "BUNDLE", "-o", "OUT"],
    "hwselect": ["hwselect", "BUNDLE", "--boards", "raspberry-pi-5"],
    "carry": ["hwselect", "BUNDLE", "--boards", "raspberry-pi-5", "--carry-count"],
    "simulate": ["simulate", "BUNDLE", "--profile", "raspberry-pi-5"],
    "benchmark": ["benchmark", "BUNDLE", "--iterations", "20", "--duration", "0"],
    "rebuild": ["rebuild", "BUNDLE", "--check"],
}


@pytest.mark.parametrize("command", COMMANDS)
def test_a_bundle_alone_runs_no_code(vlatool, mine, bundle, tmp_path: Path, command: str) -> None:
    with (mine / "policy.yaml").open("a") as stream:
        stream.write('weights: "*.safetensors"\n' if command == "quantize" else "")
    names = {"BUNDLE": bundle.path, "OUT": tmp_path / "out"}
    status, out, err = vlatool(*[names.get(word, word) for word in COMMANDS[command]])
    assert status == 3, err
    assert not ran(mine)
    assert out == ""
    assert str(mine) in err
    assert "which you did not name" in err
    assert f"--trust {mine}" in err
    assert not (mine / "workload.json").exists()


def test_a_bundle_alone_plays_no_episodes(vlatool, float_bundle, mine, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(mine)
    status, _, err = vlatool("evaluate", "closed-loop", float_bundle.path, "--episodes", 2)
    assert status == 3
    assert "This would run make() of environment.py in" in err
    assert not ran(mine)
    status, _, err = vlatool("evaluate", "closed-loop", float_bundle.path, "--episodes", 2, "--policy", mine)
    assert status == 0, err
    assert ran(mine)


def test_an_environment_of_a_package_is_named_by_the_user_alone(vlatool, float_bundle, copied) -> None:
    made = copied(float_bundle)
    other = replace(made.manifest, environment={"make": "http.server:test", "tasks": ["reach"]})
    seal(made.path, other)
    status, _, err = vlatool("evaluate", "closed-loop", made.path, "--episodes", 2)
    assert status == 3
    assert "test() of the package http.server, which the bundle names and you did not" in err


def test_what_is_trusted_runs_until_it_changes(vlatool, mine, bundle, tmp_path: Path) -> None:
    status, _, err = vlatool("export", bundle.path, "-o", tmp_path / "one", "--trust", mine)
    assert status == 0, err
    assert ran(mine)
    assert stat.S_IMODE(trust.trust_file().stat().st_mode) == 0o600
    (mine / "ran").unlink()
    status, _, err = vlatool("export", bundle.path, "-o", tmp_path / "two")
    assert status == 0, err
    (mine / "ran").unlink()
    (mine / "helper.py").write_text("x = 1\n")
    status, _, err = vlatool("export", bundle.path, "-o", tmp_path / "three")
    assert status == 3
    assert "which has changed since you trusted it" in err
    assert not ran(mine)


def test_a_policy_that_is_named_needs_no_trust(vlatool, mine, tmp_path: Path) -> None:
    assert vlatool("export", mine, "-o", tmp_path / "out")[0] == 0
    assert ran(mine)
    assert not trust.trust_file().exists()


def test_rebuild_takes_the_source_from_the_command_line(vlatool, mine, tmp_path: Path) -> None:
    assert vlatool("export", mine, "-o", tmp_path / "out")[0] == 0
    (mine / "ran").unlink()
    status, _, err = vlatool("rebuild", tmp_path / "out", "--check")
    assert status == 3
    assert "name the policy: --source DIR" in err
    assert not ran(mine)
    assert vlatool("rebuild", tmp_path / "out", "--check", "--source", mine)[0] == 0
    assert vlatool("rebuild", tmp_path / "out", "--check", "--trust", mine)[0] == 0


def forged(bundle: Bundle, **source: Any) -> Bundle:
    """Change what a source bundle says of its source, with good hashes."""
    manifest = replace(bundle.manifest, source={**bundle.manifest.source, **source})
    write_manifest(bundle.path, manifest)
    return Bundle(bundle.path, manifest)


@pytest.mark.parametrize(
    ("source", "says"),
    [
        ({"factory": "subprocess:check_output"}, "names the factory subprocess:check_output, which the description"),
        ({"factory": "vlatool.stats.intervals:wilson"}, "which the description in .* does not name"),
        ({"factory": "../evil.py:make"}, "which the description in .* does not name"),
        ({"factory": "/evil.py:make"}, "which the description in .* does not name"),
        ({"factory": 3}, "was not made from a torch policy"),
        ({"factory": "x"}, "names no factory"),
        ({"arguments": {"layers": 1, "path": "evil.pt"}}, "says arguments: .*evil.pt"),
        ({"weights": "*.bin"}, r"says weights: '\*.bin'"),
        ({"code": {"../policy.py": "0"}}, "which is not beside the factory"),
        ({"code": ["policy.py"]}, "an invalid record"),
    ],
)
def test_the_policys_own_description_says_what_runs(mine, bundle, source, says: str) -> None:
    trust.allow(mine)
    with pytest.raises(SourceError, match=says):
        load_modules(forged(bundle, **source))
    assert not ran(mine)


def test_a_package_that_a_trusted_description_names_may_run(
    policy_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    package = tmp_path / "site" / "installed_policy"
    shutil.copytree(policy_dir, package)
    (package / "policy.py").rename(package / "__init__.py")
    monkeypatch.syspath_prepend(package.parent)
    described = (policy_dir / "policy.yaml").read_text()
    (policy_dir / "policy.yaml").write_text(described.replace("policy.py:make", "installed_policy:make"))
    (tmp_path / "bundle").mkdir()
    with trust.forget_named():
        bundle = TorchModule(policy=policy_dir).run(None, tmp_path / "bundle", Context()).bundle
    with pytest.raises(SourceError, match="you did not"):
        load_modules(bundle)
    trust.trust(policy_dir)
    assert "main" in load_modules(bundle)
    with pytest.raises(SourceError, match=r"the description in .* does not name"):
        load_modules(forged(bundle, factory="installed_policy:other"))


@pytest.mark.parametrize("folder", ["mine/../other", "relative", "/a/../b", "", "/a\0b", 3, ["/a"]])
def test_a_place_that_is_no_absolute_path_is_refused(bundle, folder) -> None:
    (bundle.path / LOCATION).write_text(json.dumps({"folder": folder}))
    with pytest.raises(SourceError):
        load_modules(bundle)


def test_another_function_of_the_policys_own_files_may_be_named(vlatool, mine, tmp_path: Path) -> None:
    (mine / "other.py").write_text("from policy import make as build\n")
    assert vlatool("export", f"{mine / 'other.py'}:build", "-o", tmp_path / "out")[0] == 0


def test_a_recipe_names_no_policy(vlatool, mine, policy_template, tmp_path: Path) -> None:
    recipe = tmp_path / "recipe.yaml"
    recipe.write_text(
        f"candidates:\n  evil:\n    - sources.torch_module: {{policy: {mine}}}\n    - export.onnx: {{}}\n"
    )
    status, _, err = vlatool("optimize", policy_template, "--recipe", recipe, "-o", tmp_path / "out")
    assert status == 3
    assert "the policy is named on the command line" in err
    assert not ran(mine)


@pytest.mark.parametrize(
    ("text", "mode", "says"),
    [
        ("{}", 0o600, "is malformed"),
        ("[", 0o600, "cannot be read"),
        ('{"schema": 1, "trusted": {"/a": 3}}', 0o600, "is malformed"),
        ('{"schema": 1, "trusted": {}}', 0o622, "can be written by others"),
    ],
)
def test_a_file_of_trust_that_is_not_the_users_is_not_believed(tmp_path: Path, text: str, mode: int, says: str) -> None:
    trust.trust_file().parent.mkdir()
    trust.trust_file().write_text(text)
    trust.trust_file().chmod(mode)
    with pytest.raises(SourceError, match=says):
        trust.require(tmp_path, "something")


def test_the_hash_is_of_all_that_may_hold_code(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("a.py", "b/c.so", "weights.pt"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("1")
    hashes = {trust.content_hash(tmp_path)}
    for name in ("a.py", "b/c.so", "weights.pt", "new.yaml"):
        (tmp_path / name).write_text("2")
        hashes.add(trust.content_hash(tmp_path))
    assert len(hashes) == 5
    (tmp_path / "data.npz").write_text("any")
    (tmp_path / "__pycache__").mkdir()
    (tmp_path / "__pycache__/a.cpython-311.pyc").write_text("any")
    assert trust.content_hash(tmp_path) in hashes
    os.rename(tmp_path / "a.py", tmp_path / "z.py")
    assert trust.content_hash(tmp_path) not in hashes
    monkeypatch.setattr(trust, "MAX_FILES", 2)
    with pytest.raises(UsageError, match="more than 2 files"):
        trust.trust(tmp_path)


def test_only_a_directory_is_trusted(vlatool, tmp_path: Path) -> None:
    assert vlatool("profiles", "list", "--trust", tmp_path / "none")[0] == 2
    assert vlatool("profiles", "list", "--trust")[0] == 2


def test_trust_of_a_copy_is_asked_again(vlatool, mine, bundle, tmp_path: Path) -> None:
    moved = Path(shutil.copytree(mine, tmp_path / "moved"))
    trust.trust(mine)
    (bundle.path / LOCATION).write_text(json.dumps({"folder": str(moved)}))
    assert vlatool("export", bundle.path, "-o", tmp_path / "out")[0] == 3
    assert not ran(moved)


ENVIRONMENT_THAT_IMPORTS = """\
import importlib.util, os, subprocess, sys
here = os.path.dirname(__file__)
sys.path[:0] = [os.path.join(here, "lib"), os.path.realpath(os.path.join(here, "away"))]
import helper, linked, distant
spec = importlib.util.spec_from_file_location("loaded", os.path.join(here, "loaded.py"))
spec.loader.exec_module(importlib.util.module_from_spec(spec))
subprocess.run([sys.executable, "-c", "import child"], cwd=here, check=True)
"""
MODULES = {"helper": "", "loaded": "", "child": "", "linked": "lib", "distant": "away"}


@pytest.fixture
def linking(mine: Path, tmp_path: Path) -> Path:
    """A policy whose environment imports its neighbours in every way, two of them behind links to directories."""
    for name, place in MODULES.items():
        folder = tmp_path / f"beside-{place}" if place else mine
        folder.mkdir(exist_ok=True)
        (folder / f"{name}.py").write_text("X = 1\n")
        if place:
            (mine / place).symlink_to(folder)
    file = mine / "environment.py"
    file.write_text(file.read_text().replace("import numpy", ENVIRONMENT_THAT_IMPORTS + "import numpy", 1))
    assert "import helper" in file.read_text()
    return mine


def test_bytecode_beside_a_trusted_policy_is_not_run(
    vlatool, linking: Path, float_bundle, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(linking)
    episodes = ("evaluate", "closed-loop", float_bundle.path, "--episodes", 2)
    status, _, err = vlatool(*episodes, "--trust", linking)
    assert status == 0, err
    evil, mark = tmp_path / "evil.py", tmp_path / "ran"
    for name, place in MODULES.items():
        evil.write_text(f"open({str(mark)!r}, 'a').write({name!r} + ' ')\nX = 1\n")
        cache = importlib.util.cache_from_source(str((linking / place).resolve() / f"{name}.py"))
        for target in {cache, importlib.util.cache_from_source(str(linking / place / f"{name}.py"))}:
            Path(target).parent.mkdir(exist_ok=True)
            py_compile.compile(
                str(evil), cfile=target, doraise=True, invalidation_mode=py_compile.PycInvalidationMode.UNCHECKED_HASH
            )
    (linking / "ran").unlink()
    status, _, err = vlatool(*episodes)
    assert status == 0, err
    assert ran(linking)
    assert not mark.exists(), mark.read_text()
    status, _, err = vlatool(*episodes, "--policy", linking)
    assert status == 0, err
    assert not {"helper", "loaded", "linked"} & set(mark.read_text().split() if mark.exists() else ())


@pytest.mark.parametrize(
    "name",
    ["lib/linked.py", "sourceless.pyc", "__pycache__/sourceless.pyc", "__pycache__/new.py", ".venv/lib/a.py",
     "node_modules/a.js", "lib/new.so"],
)  # fmt: skip
def test_all_that_can_be_imported_is_in_the_hash(linking: Path, name: str) -> None:
    before = trust.content_hash(linking)
    (linking / name).parent.mkdir(parents=True, exist_ok=True)
    (linking / name).write_bytes(b"X = 2")
    assert trust.content_hash(linking) != before


def test_what_python_caches_is_not_in_the_hash(linking: Path) -> None:
    before = trust.content_hash(linking)
    (linking / "__pycache__").mkdir(exist_ok=True)
    (linking / "__pycache__/helper.cpython-399.opt-1.pyc").write_bytes(b"X = 2")
    (linking / ".git").mkdir()
    (linking / ".git/index").write_bytes(b"X = 2")
    assert trust.content_hash(linking) == before


def test_links_in_a_circle_end_and_where_they_lead_is_in_the_hash(linking: Path, tmp_path: Path) -> None:
    (linking / "a").mkdir()
    (linking / "b").mkdir()
    (linking / "circle").symlink_to(linking)
    (linking / "turn").symlink_to("a")
    before = trust.content_hash(linking)
    (linking / "turn").unlink()
    (linking / "turn").symlink_to("b")
    assert trust.content_hash(linking) != before


def test_a_folder_of_too_many_files_is_not_trusted(linking: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(trust, "MAX_FILES", 20)
    (linking / ".venv").mkdir()
    for number in range(20):
        (linking / f".venv/{number}.py").touch()
    with pytest.raises(UsageError, match="more than 20 files, too many to trust") as caught:
        trust.trust(linking)
    assert "name a smaller directory" in caught.value.fix


def test_a_folder_that_cannot_be_read_is_not_trusted(linking: Path) -> None:
    (linking / "unreadable").symlink_to("unreadable")
    trust.content_hash(linking)  # a link to nowhere is no file
    (linking / "closed.py").write_text("")
    (linking / "closed.py").chmod(0)
    if os.access(linking / "closed.py", os.R_OK):
        pytest.skip("this user may read everything")
    with pytest.raises(UsageError, match=r"closed.py cannot be read"):
        trust.content_hash(linking)
