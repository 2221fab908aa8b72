"""vlatool-runtime, the distribution for robots: built, installed into a fresh Python 3.10 and run there."""

from __future__ import annotations

import inspect
import json
import os
import re
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Iterator
from pathlib import Path

import pytest
import tomllib

from vlatool.episodes.play import EpisodesJob, Worker
from vlatool.errors import InstallationError, pip_install, refuse_two_distributions

ROOT = Path(__file__).parents[2]
SETTINGS = tomllib.loads((ROOT / "robot/pyproject.toml").read_text())
ONNXRUNTIME = "onnxruntime==1.23.2"
"""The newest for Python 3.10."""
SILENT = re.compile(r"NewConnectionError|ConnectTimeout|ReadTimeout|Temporary failure|Connection refused|ProxyError")
"""What pip says when the registry does not answer."""


def imported_by(path: Path) -> set[str]:
    """The modules of vlatool that a file names in its imports, those for types alone left out."""
    text = re.sub(r"^if TYPE_CHECKING:\n(?:    .*\n|\n)+", "", path.read_text(), flags=re.MULTILINE)
    lines = re.findall(r"^\s*(?:from (vlatool[\w.]*) import \(?([^()\n]*)|import (vlatool[\w.]+))", text, re.MULTILINE)
    names = {name for package, taken, module in lines for name in [package or module, *modules(package, taken)]}
    return {name for name in names if file_of(name)}


def modules(package: str, taken: str) -> Iterator[str]:
    return (f"{package}.{name.split()[0]}" for name in taken.split(",") if name.strip())


def file_of(name: str) -> Path | None:
    path = ROOT.joinpath(*name.split("."))
    return next((file for file in (path.with_suffix(".py"), path / "__init__.py") if file.is_file()), None)


def pip(*words: str, python: Path | str = sys.executable) -> None:
    command = [str(python), "-m", "pip", "--disable-pip-version-check", "--retries", "1", *words]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode and SILENT.search(done.stderr):
        pytest.skip("the package registry does not answer")
    assert done.returncode == 0, done.stderr


def python310() -> str:
    """The first Python 3.10 that starts; pyenv's commands do not where another version is chosen."""
    commands = ["python3.10"]
    if shutil.which("pyenv"):
        prefix = subprocess.run(["pyenv", "prefix", "3.10"], capture_output=True, text=True).stdout.strip()
        commands.append(f"{prefix}/bin/python3.10")
    for command in commands:
        if (found := shutil.which(command)) and not subprocess.run([found, "-c", ""], capture_output=True).returncode:
            return found
    return ""


@pytest.fixture(scope="module")
def wheels(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Distribution -> wheel."""
    folder = tmp_path_factory.mktemp("wheels")
    pip("wheel", "--no-deps", "-w", str(folder), str(ROOT), str(ROOT / "robot"))
    return {path.name.partition("-")[0]: path for path in folder.glob("*.whl")}


@pytest.fixture(scope="module")
def robot(wheels: dict[str, Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A fresh Python 3.10 with what the one line for robots installs."""
    if not (python := python310()):
        pytest.skip("there is no Python 3.10 here")
    place = tmp_path_factory.mktemp("robot") / "venv"
    subprocess.run([python, "-m", "venv", str(place)], check=True)
    pip("install", f"{wheels['vlatool_runtime']}[ort]", ONNXRUNTIME, python=place / "bin/python")
    return place / "bin/python"


def run(python: Path | str, *words: str, **variables: str) -> subprocess.CompletedProcess[str]:
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    place = {"cwd": Path(python).parent, "env": {**environment, **variables}}
    return subprocess.run([str(python), *words], capture_output=True, text=True, check=False, **place)


def test_it_holds_what_load_imports_and_nothing_else():
    listed = SETTINGS["tool"]["hatch"]["build"]["targets"]["wheel"]["force-include"]
    assert {source.removeprefix("../") for source in listed} == set(listed.values())
    files = {file for name in listed.values() for file in [ROOT / name, *(ROOT / name).rglob("*.py")] if file.is_file()}
    rooms = [ROOT / "vlatool" / name for name in ("runtime", "deployment", "messages", "buses", "controllers")]
    runs = ("session", "topic_survey", "bus_recorder", "replay", "recordings", "map_file")
    starts = {ROOT / "vlatool/__main__.py", *(ROOT / f"vlatool/nodes/{name}.py" for name in runs)}
    reached, left = set(), {file for room in rooms for file in room.rglob("*.py")} | starts
    while left:
        file = left.pop()
        names = imported_by(file) - {"vlatool.cli"}
        packages = {".".join(name.split(".")[:depth]) for name in names for depth in range(1, name.count(".") + 1)}
        reached.add(file)
        left |= {path for name in names | packages if (path := file_of(name))} - reached
    assert reached == files


def test_it_asks_for_numpy_alone_and_for_the_engines_that_vlatool_takes():
    whole = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    project = SETTINGS["project"]
    assert project["dependencies"] == [line for line in whole["dependencies"] if line.startswith("numpy")]
    assert project["optional-dependencies"].items() <= whole["optional-dependencies"].items()
    assert set(project["optional-dependencies"]) == {
        "ort",
        "cuda",
        "openvino",
        "text",
        "sign",
        "remote",
        "zenoh",
        "dds",
        "bags",
    }


def test_its_files_are_those_of_the_whole_wheel(wheels: dict[str, Path]):
    with zipfile.ZipFile(wheels["vlatool"]) as whole, zipfile.ZipFile(wheels["vlatool_runtime"]) as part:
        names = [name for name in part.namelist() if name.startswith("vlatool/")]
        assert [whole.read(name) for name in names] == [part.read(name) for name in names]
        assert not any("cli" in name for name in names)


def test_the_evaluation_plays_with_files_of_the_robots_wheel(wheels: dict[str, Path], float_bundle):
    worker = Worker(str(float_bundle.path), "")
    jobs = [EpisodesJob("", "", "", (), latency_ms=latency) for latency in (0.0, 1e3)]
    played = [inspect.getfile(type(worker.controller(job))) for job in jobs]
    with zipfile.ZipFile(wheels["vlatool_runtime"]) as wheel:
        shipped = [wheel.read(Path(file).relative_to(ROOT).as_posix()) for file in played]
    assert [Path(file).name for file in played] == ["chunked.py", "late.py"]
    assert shipped == [Path(file).read_bytes() for file in played]


@pytest.mark.soak("make robot, which .ci/run calls, does the same")
def test_a_fresh_python_310_loads_a_bundle_and_acts(robot: Path, int8_bundle):
    done = run(robot, str(ROOT / "tests/robot/controller.py"), str(int8_bundle.path))
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("python 3.10")
    assert f"{robot.parents[1]}/lib/python3.10/site-packages/vlatool/runtime/control/late.py" in done.stdout
    done = run(robot, "-W", "error", str(ROOT / "tests/robot/alone.py"), str(int8_bundle.path))
    assert done.returncode == 0, done.stderr
    assert str(robot.parents[1]) in done.stdout


def test_both_in_one_place_are_refused(wheels: dict[str, Path], int8_bundle, tmp_path: Path):
    pip("install", "--no-deps", "--no-index", "--target", str(tmp_path / "both"), *map(str, wheels.values()))
    code = f"import vlatool; vlatool.load({str(int8_bundle.path)!r})"
    done = run(sys.executable, "-c", code, PYTHONPATH=str(tmp_path / "both"))
    assert "InstallationError: Both vlatool and vlatool-runtime are installed in" in done.stderr
    done = run(sys.executable, "-m", "vlatool", "doctor", "--json", PYTHONPATH=str(tmp_path / "both"))
    assert (done.returncode, json.loads(done.stdout)["error"]["type"]) == (3, "InstallationError")


@pytest.mark.parametrize("name", ["vlatool-0.1.0", "vlatool_runtime-0.1.0"])
def test_one_of_them_is_accepted(tmp_path: Path, name: str):
    (tmp_path / f"{name}.dist-info").mkdir()
    refuse_two_distributions(tmp_path)


def test_the_fix_for_both_says_to_remove_both(tmp_path: Path):
    for name in ("vlatool-0.2.0", "vlatool_runtime-0.1.0"):
        (tmp_path / f"{name}.dist-info").mkdir()
    with pytest.raises(InstallationError) as caught:
        refuse_two_distributions(tmp_path)
    assert caught.value.fix.startswith("pip uninstall -y vlatool vlatool-runtime")


def test_an_extra_is_of_the_distribution_that_is_installed():
    assert pip_install("ort") == "pip install 'vlatool[ort]'"
    assert pip_install("ort", "vlatool-runtime") == "pip install 'vlatool-runtime[ort]'"
