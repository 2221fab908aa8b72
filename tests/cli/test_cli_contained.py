"""A policy or an environment that ends its process, prints, or changes what it finds: through every command."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from _acts import DISTURBS, ENDS, FORGES, POLICY_YAML, environment, policy
from _full import small_or_full

from vlatool.cli import main


@pytest.fixture
def folder(tmp_path: Path):
    """A function that writes a policy with an environment and returns its folder."""

    def write(world: dict[str, str] | None = None, **acts: str) -> Path:
        place = tmp_path / "mine"
        place.mkdir()
        (place / "policy.yaml").write_text(POLICY_YAML)
        (place / "policy.py").write_text(policy(**acts))
        (place / "environment.py").write_text(environment(**(world or {})))
        return place

    return write


@pytest.fixture
def vlatool(capfd):
    """Run a command line in this process; return status and what reached descriptors 1 and 2."""

    def run(*line: Any) -> tuple[int, str, str]:
        capfd.readouterr()
        with pytest.raises(SystemExit) as left:
            main([str(part) for part in line])
        told = capfd.readouterr()
        return left.value.code or 0, told.out, told.err

    return run


def error_in(out: str) -> int:
    """Return the exit code that a document tells that holds an error alone."""
    (error,) = json.loads(out).values()
    return int(error["exit_code"])


@pytest.fixture(scope="module")
def plain(tmp_path_factory) -> Path:
    """A bundle of the policy that does nothing wrong."""
    place = tmp_path_factory.mktemp("plain")
    (place / "policy.yaml").write_text(POLICY_YAML)
    (place / "policy.py").write_text(policy())
    (place / "environment.py").write_text(environment())
    with pytest.raises(SystemExit) as left:
        main(["export", str(place), "-o", str(place / "bundle")])
    assert not left.value.code
    return place / "bundle"


@pytest.mark.parametrize("where", ["at_import", "in_make", "in_forward"])
@pytest.mark.parametrize("act", ENDS)
def test_a_policy_that_ends_its_process_is_no_success(vlatool, folder, tmp_path: Path, where: str, act: str) -> None:
    code, says = ENDS[act]
    status, out, err = vlatool("export", folder(**{where: code}), "-o", tmp_path / "out", "--json")
    assert (status, error_in(out)) == (3, 3)
    assert "policy" in err
    assert re.search(says, err), err
    assert not (tmp_path / "out").exists()
    assert not list(tmp_path.glob(".out*"))


@pytest.mark.parametrize("act", ["sys.exit", "os._exit"])
@pytest.mark.parametrize("command", ["optimize", "gate", "hwselect", "quantize", "benchmark"])
def test_no_command_takes_it_for_its_own_end(vlatool, folder, plain, tmp_path: Path, command: str, act: str) -> None:
    code, says = ENDS[act]
    mine = folder(in_make=code)
    line = {
        "optimize": ["optimize", mine, "-o", tmp_path / "out", "--episodes", 0, "--no-search", "--json"],
        "gate": ["gate", mine, "--baseline", plain, "--json"],
        "hwselect": ["hwselect", mine, "--json"],
        "quantize": ["quantize", "dynamic-int8", mine, "-o", tmp_path / "out", "--json"],
        "benchmark": ["benchmark", mine, "--json"],
    }[command]
    status, out, err = vlatool(*line)
    assert (status, error_in(out)) == (3, 3)
    assert "policy.py" in err
    assert re.search(says, err), err


@pytest.mark.parametrize("act", FORGES)
def test_what_a_policy_raises_or_forges_does_not_decide_the_exit_code(
    vlatool, folder, tmp_path: Path, act: str
) -> None:
    code, says = FORGES[act]
    status, out, err = vlatool("export", folder(in_make=code), "-o", tmp_path / "out", "--json")
    assert (status, error_in(out)) == (3, 3), err
    assert re.search(says, err), err
    assert "internal error" not in err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("where", ["in_make", "in_reset", "in_step"])
@pytest.mark.parametrize("act", ["mute", "verdict", "ours"])
def test_what_an_environment_raises_or_forges_does_not_either(vlatool, folder, plain, where: str, act: str) -> None:
    line = ["evaluate", "closed-loop", plain, "--policy", folder({where: FORGES[act][0]}), "--episodes", 2]
    status, out, err = vlatool(*line, "--workers", 1, "--json")
    assert (status, error_in(out)) == (3, 3), err
    assert "internal error" not in err


@pytest.mark.parametrize("where", ["at_import", "in_make", "in_reset", "in_step"])
@pytest.mark.parametrize("act", ENDS)
def test_an_environment_that_ends_its_process_is_no_success(vlatool, folder, plain, where: str, act: str) -> None:
    code, says = ENDS[act]
    line = ["evaluate", "closed-loop", plain, "--policy", folder({where: code}), "--episodes", 2, "--workers", 1]
    status, out, err = vlatool(*line, "--json")
    assert (status, error_in(out)) == (3, 3)
    assert "environment" in err
    assert re.search(says, err), err


@pytest.mark.parametrize("where", ["at_import", "in_make", "in_forward"])
def test_what_a_policy_prints_and_changes_stays_with_it(vlatool, folder, tmp_path: Path, where: str) -> None:
    before = (os.getcwd(), dict(os.environ), signal.getsignal(signal.SIGINT))
    status, out, err = vlatool("export", folder(**{where: DISTURBS}), "-o", tmp_path / "out", "--json")
    if where == "in_forward":  # torch cannot trace threads
        assert status in (0, 3)
    else:
        assert status == 0, err
        assert json.loads(out)["bundle"] == str(tmp_path / "out")
    for line in ("printed by the policy", '{"written": "to descriptor 1"}', "written to descriptor 2"):
        assert f"[policy.py] {line}" in err
        assert line not in out
    assert (os.getcwd(), dict(os.environ), signal.getsignal(signal.SIGINT)) == before


@pytest.mark.parametrize("where", ["at_import", "in_make", "in_reset", "in_step"])
def test_what_an_environment_prints_and_changes_stays_with_it(vlatool, folder, plain, where: str) -> None:
    before = (os.getcwd(), dict(os.environ), signal.getsignal(signal.SIGINT))
    line = ["evaluate", "closed-loop", plain, "--policy", folder({where: DISTURBS}), "--episodes", 2, "--workers", 1]
    status, out, err = vlatool(*line, "--json")
    assert status == 0, err
    assert json.loads(out)["kind"] == "evaluate"
    assert "[environment.py] printed by the policy" in err
    assert (os.getcwd(), dict(os.environ), signal.getsignal(signal.SIGINT)) == before


def test_eager_torch_may_print(vlatool, folder, tmp_path: Path) -> None:
    mine = folder(in_make=DISTURBS, in_forward="import os; os.write(1, b'forward\\n'); print('forward')")
    with pytest.raises(SystemExit):
        main(["hwselect", str(mine), "--boards", "raspberry-pi-5"])
    (bundle,) = [path for path in (Path(os.environ["VLATOOL_CACHE"]) / "stages").glob("sources.torch_module-*")
                 if str(mine) in (path / "location.json").read_text()]  # fmt: skip
    line = ["--trust", mine, "benchmark", bundle, "--iterations", 20, "--duration", 0, "--no-phase", "--json"]
    status, out, err = vlatool(*line)
    assert status == 0, err
    assert json.loads(out)["rows"][0]["name"] == "torch eager"


def hanging(tmp_path: Path, folder) -> tuple[subprocess.Popen[str], Path]:
    """Start an export that hangs in make(), and wait until it does."""
    mark = tmp_path / "hangs"
    act = (
        "import os, signal, time; signal.signal(signal.SIGINT, signal.SIG_IGN); "
        f"open({str(mark)!r}, 'w').write(str(os.getpid())); time.sleep(600)"
    )
    line = [sys.executable, "-m", "vlatool", "export", str(folder(in_make=act)), "-o", str(tmp_path / "out")]
    process = subprocess.Popen(line, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True, start_new_session=True)
    end = time.monotonic() + 120
    while not (mark.exists() and mark.read_text()):
        assert time.monotonic() < end
        assert process.poll() is None, process.communicate()
        time.sleep(0.05)
    return process, mark


def gone(pid: int) -> bool:
    """Wait for a process to end."""
    end = time.monotonic() + 60
    while Path(f"/proc/{pid}").exists():
        if time.monotonic() > end:
            return False
        time.sleep(0.05)
    return True


@pytest.mark.parametrize("group", small_or_full([True], [True, False]))
@pytest.mark.parametrize(
    ("number", "status", "says"),
    [
        (signal.SIGINT, 130, "interrupted; finished stages are kept\n"),
        *small_or_full([], [(signal.SIGTERM, 143, ""), (signal.SIGKILL, -9, "")]),
    ],
)
def test_a_policy_that_hangs_can_be_ended(tmp_path, folder, number, status, says, group) -> None:
    process, mark = hanging(tmp_path, folder)
    (os.killpg if group else os.kill)(process.pid, number)
    _, err = process.communicate(timeout=120)
    assert process.returncode == status
    assert err.endswith(says)
    assert "fix:" not in err
    assert gone(int(mark.read_text())), "the policy's process is still there"
    assert not (tmp_path / "out").exists()


@pytest.mark.soak("Ctrl-C in an export: tests/test_wrong_inputs.py")
def test_ctrl_c_while_torch_exports_is_no_advice(tmp_path: Path, folder) -> None:
    act = f"open({str(tmp_path / 'runs')!r}, 'w').close(); import time; time.sleep(600)"
    line = [sys.executable, "-m", "vlatool", "export", str(folder(in_forward=act)), "-o", str(tmp_path / "out")]
    with subprocess.Popen(line, stderr=subprocess.PIPE, text=True, start_new_session=True) as process:
        end = time.monotonic() + 120
        while not (tmp_path / "runs").exists():
            assert time.monotonic() < end
            time.sleep(0.05)
        os.killpg(process.pid, signal.SIGINT)
        _, err = process.communicate(timeout=120)
    assert process.returncode == 130
    assert err.endswith("interrupted; finished stages are kept\n")


@pytest.mark.parametrize(
    "redirect", small_or_full(["<&- >&- 2>&-", "2>/dev/full"], ["2>&-", ">&-", "<&-", ">&- 2>&-", "2>/dev/full"])
)
def test_closed_and_full_streams_do_not_change_the_exit_code(float_bundle, redirect: str) -> None:
    shell = f'"{sys.executable}" -m vlatool inspect "{float_bundle.path}" {redirect}'
    assert subprocess.run(["sh", "-c", shell], check=False).returncode == 0


@pytest.mark.parametrize(
    "redirect", small_or_full([">/dev/full"], [">/dev/full", ">/dev/full 2>&-", "--json >/dev/full"])
)
def test_a_result_that_cannot_be_printed_is_an_error(int8_bundle, redirect: str) -> None:
    shell = f'"{sys.executable}" -m vlatool evaluate recorded "{int8_bundle.path}" --samples 2 {redirect}'
    done = subprocess.run(["sh", "-c", shell], check=False, stderr=subprocess.PIPE, text=True)
    assert done.returncode == 3
    assert ("error: the result cannot be printed: No space left" in done.stderr) == ("2>" not in redirect)


def test_lines_that_cannot_be_printed_name_standard_output(float_bundle) -> None:
    shell = f'"{sys.executable}" -m vlatool inspect "{float_bundle.path}" >/dev/full'
    done = subprocess.run(["sh", "-c", shell], check=False, stderr=subprocess.PIPE, text=True)
    assert (done.returncode, done.stderr) == (3, "error: standard output: No space left on device.\n")


def test_another_error_keeps_its_code_when_it_cannot_be_printed() -> None:
    shell = f'"{sys.executable}" -m vlatool nothing --json >/dev/full'
    assert subprocess.run(["sh", "-c", shell], check=False, stderr=subprocess.PIPE).returncode == 2


def test_an_error_keeps_its_code_with_stderr_closed(tmp_path: Path, folder) -> None:
    mine = folder(in_make="import sys; sys.exit(0)")
    for redirect in small_or_full(["2>&-"], ["2>&-", "2>/dev/full"]):
        shell = f'"{sys.executable}" -m vlatool export "{mine}" -o "{tmp_path / "out"}" {redirect}'
        assert subprocess.run(["sh", "-c", shell], check=False).returncode == 3


@pytest.mark.parametrize("module", ["vlatool", *small_or_full([], ["vlatool.cli"])])
def test_a_distribution_in_the_current_directory_adds_nothing(tmp_path, module):
    """``python -m`` puts the current directory on the search path, and names of methods are looked up along it."""
    info = tmp_path / "acme-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: acme\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[vlatool.quantize]\nacme-int3 = acme:Int3\n")
    (tmp_path / "acme.py").write_text("raise SystemExit('imported')\n")
    words = [sys.executable, "-m", module, "quantize", "--help"]
    done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert "static-int8" in done.stdout, done.stderr
    assert "acme" not in done.stdout + done.stderr
