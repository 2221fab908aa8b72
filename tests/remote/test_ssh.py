"""A benchmark on another machine: what comes back, what each fault says, and that nothing is left there.

Every test runs against a real server on loopback, and ends with a look at the target: no process of the run lives, and
the directories that the run made are gone.
"""

from __future__ import annotations

import contextlib
import fcntl
import io
import os
import platform
import shutil
import signal
import socket
import subprocess
import sys
import tarfile
import textwrap
import time
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import psutil
import pytest
from _full import small_or_full
from _ssh_server import BACK_END, Server, exports, processes_with, serving, target, until

from vlatool.bundle.bundle import Bundle, seal
from vlatool.bundle.manifest import Manifest
from vlatool.bundle.spec import PolicySpec
from vlatool.errors import (
    BundleError,
    GraphError,
    MissingExtra,
    OutputError,
    TargetError,
    UsageError,
)
from vlatool.remote import _bootstrap, _connection, _push, _run_directory, ssh
from vlatool.remote._validate_replies import Python

pytestmark = pytest.mark.skipif(shutil.which("ssh") is None, reason="there is no ssh")
SPEC = {
    "inputs": [{"name": "proprio", "shape": [1, 2], "unit": ["m", "m"]}],
    "outputs": [{"name": "action", "shape": [1, 1, 2], "unit": ["m", "m"], "labels": ["x", "y"]}],
    "control_hz": 10,
}
AGENT = '''\
"""Stands in for the agent: what it does is named in the job."""

import json, os, signal, subprocess, sys, time


def say(**line):
    print(json.dumps(line), flush=True)


job = json.loads(sys.stdin.readline())
assert sys.stdin.read() == ""
say(progress={"what": "begun", "share": 0.25})
if job["do"] == "answer":
    from vlatool.bundle.bundle import Bundle
    found = [Bundle.open(path) for path in job["bundles"]]
    files = [sorted(str(each.relative_to(bundle.path)) for each in bundle.path.rglob("*") if each.is_file())
             for bundle in found]
    print("an engine greets on standard output")
    print("not a {line")
    print("{neither this")
    print("and one on standard error", file=sys.stderr)
    open(os.path.join(os.environ["TMPDIR"], "left behind"), "w").close()
    say(progress={"what": "half", "share": None})
    value = {"hashes": [each.hash for each in found], "files": files, "names": [each.path.name for each in found],
             "engine": job.get("engine"), "private": oct(os.stat("..").st_mode & 0o777)}
    say(result={"value": value})
elif job["do"] == "wait":
    subprocess.Popen(["sleep", "600"])
    say(progress={"what": "waiting", "share": None})
    time.sleep(600)
elif job["do"] == "chat":
    for _ in range(25):
        time.sleep(0.1)
        say(progress={"what": "still at it", "share": None})
    say(result={"value": {"all": "said"}})
elif job["do"] == "raise":
    say(raised={"kind": job["kind"], "message": job["bundles"][0] + " is refused.", "fix": "export it again"})
elif job["do"] == "die":
    print("the last words", file=sys.stderr, flush=True)
    os.kill(os.getpid(), job["signal"])
elif job["do"] == "leave":
    print("Traceback\\nValueError: it broke", file=sys.stderr)
    sys.exit(job["code"])
'''


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    with serving(tmp_path_factory.mktemp("server")) as found:
        yield found


class Target:
    """The machine as a test sees it: where it writes, what its sessions do first, and how to measure on it."""

    def __init__(self, server: Server, folder: Path) -> None:
        self.server = server
        self.cache = folder / "a cache" / "deeper"
        self.temporary = folder / "temporary"
        self.temporary.mkdir()
        self.site = folder / "site"
        self.site.mkdir()
        (self.site / "onnxruntime.py").write_text("__version__ = '1.23.9'\n")
        self.name = f"VLATOOL_TEST_RUN={uuid.uuid4().hex}"
        self.environment: dict[str, Any] = {}
        self.told: list[tuple[str, float | None]] = []
        self.allowed: set[Path] = set()
        self.prepare()

    def prepare(self, more: str = "", **environment: Any) -> None:
        """Set what each session starts with."""
        name, _, value = self.name.partition("=")
        places = {"XDG_CACHE_HOME": self.cache, "TMPDIR": self.temporary, "PYTHONPATH": self.site, name: value}
        self.server.session(exports(**{**places, **environment}) + "\n" + more)

    def tell(self, what: str, share: float | None) -> None:
        self.told.append((what, share))

    def measure(self, *bundles: Bundle, on: str = "", options: list[str] | None = None, **job: Any) -> dict[str, Any]:
        tell = job.pop("tell", self.tell)
        python = job.pop("python", sys.executable)
        timeout = job.pop("connect_timeout_s", 15)
        return ssh.measure_on(
            on or target(), {"do": "answer", "engine": "", **job}, [each.path for each in bundles], tell, python=python,
            ssh_options=self.server.options() if options is None else options, connect_timeout_s=timeout,
        )  # fmt: skip

    def processes(self, text: str = "") -> list[int]:
        """Processes of the run whose command line holds the text."""
        found = []
        for number in processes_with(self.name):
            with contextlib.suppress(psutil.Error):
                if text in " ".join(psutil.Process(number).cmdline()):
                    found.append(number)
        return found

    def runs(self) -> list[Path]:
        return [*self.cache.glob("vlatool/remote/*"), *self.temporary.glob("vlatool*")]

    def check(self) -> None:
        """Nothing of any run is left."""
        until(lambda: not self.processes(), f"the end of {self.processes()}")
        until(lambda: not self.runs(), f"the removal of {self.runs()}")
        for place in (self.cache, *self.cache.parents[:1]):
            until(lambda place=place: place in self.allowed or not place.exists(), f"the removal of {place}")


@pytest.fixture
def there(server: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Target]:
    agent = tmp_path / "stand_in_agent.py"
    agent.write_text(AGENT)
    monkeypatch.setattr(ssh, "AGENT", "stand_in_agent")
    monkeypatch.setattr(ssh, "FURTHER_MODULES", (agent,))
    found = Target(server, tmp_path)
    yield found
    found.check()
    assert list(found.temporary.iterdir()) == []


def bundle_of(folder: Path, size: int = 300) -> Bundle:
    (folder / "graphs").mkdir(parents=True)
    (folder / "graphs/main.onnx").write_bytes(os.urandom(size))
    (folder / "empty").touch()
    (folder / "reports").mkdir()
    (folder / "reports/report.md").write_text("private")
    return seal(folder, Manifest(folder.name, "1.0.0", PolicySpec.from_dict(SPEC)))


@pytest.fixture
def bundle(tmp_path: Path) -> Bundle:
    return bundle_of(tmp_path / "my bundle")


@pytest.fixture
def large(tmp_path: Path) -> Bundle:
    """Several pieces, and more than all buffers of a connection hold."""
    return bundle_of(tmp_path / "large", 30_000_000)


# what comes back


def test_the_result_comes_back_with_what_the_target_is_and_not_who(there, bundle, large):
    found = there.measure(bundle, large, bundle)
    assert found["hashes"] == [bundle.hash, large.hash, bundle.hash]
    assert found["files"][1] == ["empty", "graphs/main.onnx", "manifest.json", "manifest.sha256"]
    assert found["names"] == ["my_bundle", "large", "my_bundle"]
    assert found["private"] == "0o700"
    assert "and one on standard error" in found["log"]
    assert found["target"] == {
        "python": platform.python_version(),
        "architecture": platform.machine(),
        "kernel": platform.release(),
        "packages": {"numpy": __import__("numpy").__version__, "onnxruntime": "1.23.9"},
    }
    assert not any(name in str(found) for name in (target(), socket.gethostname(), "127.0.0.1"))
    assert ("begun", 0.25) in there.told
    assert ("half", None) in there.told
    shares = [share for what, share in there.told if what.startswith(("sending", "sent"))]
    assert len(shares) >= 5
    assert (shares == sorted(shares), shares[-1]) == (True, 1.0)


def test_directories_that_were_there_stay(there, bundle):
    there.allowed = {there.cache, there.cache.parent}
    (there.cache / "other").mkdir(parents=True)
    there.measure(bundle)
    assert [path.name for path in there.cache.iterdir()] == ["other"]


def test_what_start_up_files_print_does_not_matter(there, bundle):
    there.prepare("echo welcome; echo '{\"result\": {}}'; echo oops >&2; printf 'no end of line'")
    assert there.measure(bundle)["hashes"] == [bundle.hash]


def test_the_cache_directory_may_be_unwritable_when_there_is_another(there, bundle, tmp_path):
    (tmp_path / "a file").touch()
    there.prepare(XDG_CACHE_HOME=tmp_path / "a file")
    assert there.measure(bundle)["hashes"] == [bundle.hash]


def test_the_first_python_that_can_measure_is_taken(there, bundle, tmp_path, bare_python):
    for name, python in (
        ("python3", bare_python),
        ("python3.13", old_python(tmp_path)),
        ("python3.12", sys.executable),
    ):
        script(tmp_path / "bin" / name, f'exec {python} "$@"')
    there.prepare(PATH=f"{tmp_path / 'bin'}:{system_tools(tmp_path)}")
    assert there.measure(bundle, python="")["hashes"] == [bundle.hash]


def test_a_python_in_the_home_directory_of_the_target(there, bundle, tmp_path):
    script(tmp_path / "home" / "its python", f'exec {sys.executable} "$@"')
    there.prepare(HOME=tmp_path / "home")
    assert there.measure(bundle, python="~/its python")["hashes"] == [bundle.hash]
    assert [path.name for path in (tmp_path / "home").iterdir()] == ["its python"]


def test_runs_at_the_same_time_do_not_meet(there, bundle):
    inner: list[dict[str, Any]] = []

    def tell(what: str, _share: float | None) -> None:
        if what == "half" and not inner:
            inner.append(there.measure(bundle))

    assert there.measure(bundle, tell=tell)["hashes"] == inner[0]["hashes"]


# what the target lacks


def script(path: Path, text: str) -> Path:
    path.parent.mkdir(exist_ok=True)
    path.write_text(f"#!/bin/sh\n{text}\n")
    path.chmod(0o755)
    return path


def old_python(folder: Path) -> Path:
    """A Python that says it is 3.8."""
    lie = "import sys; sys.version_info = (3, 8, 10); code = sys.argv.pop(1); exec(code)"
    return script(folder / "old" / "python", f"shift 2\nexec {sys.executable} -c '{lie}' \"$@\"")


def system_tools(folder: Path) -> Path:
    """A directory with what a session needs beside Python."""
    (folder / "tools").mkdir()
    for name in ("sh", "sleep"):
        (folder / "tools" / name).symlink_to(str(shutil.which(name)))
    return folder / "tools"


@pytest.fixture(scope="module")
def bare_python(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A Python with nothing but the standard library."""
    folder = tmp_path_factory.mktemp("bare")
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", folder], check=True)
    return folder / "bin/python"


def test_a_python_that_is_too_old(there, bundle, tmp_path):
    python = old_python(tmp_path)
    with pytest.raises(TargetError, match=r"is too old: .*/python is 3\.8\.10; 3\.10 or later") as caught:
        there.measure(bundle, python=str(python))
    assert "--remote-python" in caught.value.fix


def test_no_python_at_all(there, bundle, tmp_path):
    there.prepare(PATH=system_tools(tmp_path))
    with pytest.raises(TargetError, match=r"has no Python to measure with \(none of python3, python3\.13"):
        there.measure(bundle, python="")


def test_a_python_that_is_not_there(there, bundle):
    with pytest.raises(TargetError, match=r"has no Python .*\(/nowhere/python: no such program\)"):
        there.measure(bundle, python="/nowhere/python")


def test_a_python_that_crashes_when_it_imports_the_engine(there, bundle):
    (there.site / "onnxruntime.py").write_text("import os, signal\nos.kill(os.getpid(), signal.SIGILL)\n")
    with pytest.raises(TargetError, match="ended with code 132 when it was to import numpy and onnxruntime") as caught:
        there.measure(bundle)
    assert "-c 'import numpy, onnxruntime'" in caught.value.fix


def test_a_python_without_numpy(there, bundle, bare_python):
    with pytest.raises(MissingExtra, match=r"cannot import numpy: numpy: No module named 'numpy'\.") as caught:
        there.measure(bundle, python=str(bare_python))
    assert caught.value.fix.startswith(f"ssh {target()} {bare_python} -m pip install numpy;")
    assert caught.value.exit_code == 4


@pytest.mark.parametrize(("engine", "package"), [("", "onnxruntime"), ("openvino", "openvino")])
def test_a_python_without_the_engine(there, bundle, engine, package):
    (there.site / f"{package}.py").write_text(f"raise ImportError('No module named {package}')\n")
    with pytest.raises(MissingExtra, match=f"cannot import {package}") as caught:
        there.measure(bundle, engine=engine)
    assert f"-m pip install {package}" in caught.value.fix


def test_a_python_that_the_system_manages_needs_an_environment(there):
    python = Python("python3", (3, 11, 2), {}, {"numpy": "none"}, "x86_64", "6", None, managed=True)
    error = ssh._probe.refusal("board", "", [python], [], ("numpy",))
    assert error.fix == (
        "ssh board 'python3 -m venv --system-site-packages vlatool-venv && "
        "vlatool-venv/bin/python -m pip install numpy', then --remote-python '~/vlatool-venv/bin/python'"
    )


def test_an_engine_without_a_package(there, bundle):
    with pytest.raises(UsageError, match="Unknown engine 'openvina'; did you mean 'openvino'"):
        there.measure(bundle, engine="openvina")


# disks


@pytest.fixture
def mounted(tmp_path: Path) -> Iterator[Callable[[str], Path]]:
    """A function that mounts a small file system in memory."""
    places: list[Path] = []

    def mount(options: str) -> Path:
        place = tmp_path / f"mounted{len(places)}"
        place.mkdir()
        done = subprocess.run(["mount", "-t", "tmpfs", "-o", options, "tmpfs", place], capture_output=True, check=False)
        if done.returncode:
            pytest.skip("mounting is not allowed here")
        places.append(place)
        return place

    yield mount
    for place in places:
        subprocess.run(["umount", place], check=True)


def test_a_disk_that_is_too_full_is_refused_before_anything_is_sent(there, bundle, mounted):
    there.cache = mounted("size=1m") / "cache"
    there.allowed = {there.cache.parent}
    there.prepare()
    with pytest.raises(OutputError, match=r"too full: \d+\.\d MB are needed, 1\.0 MB are free below"):
        there.measure(bundle)
    assert not any(what.startswith("sending") for what, _ in there.told)
    there.check()


def test_a_disk_that_becomes_full_while_files_are_sent(there, large, mounted):
    there.cache = mounted("size=60m") / "cache"
    there.allowed = {there.cache.parent}
    there.prepare()
    filler = there.cache.parent / "filler"

    def tell(_what: str, share: float | None) -> None:
        if share and not filler.exists():
            with contextlib.suppress(OSError), filler.open("wb", buffering=0) as stream:
                while stream.write(bytes(1 << 16)):
                    pass

    with pytest.raises(OutputError, match=r"became full: .*No space left on device"):
        there.measure(large, tell=tell)
    there.check()


def test_a_target_that_cannot_be_written_to(there, bundle, tmp_path, request):
    if os.geteuid() == 0:
        place = request.getfixturevalue("mounted")("ro")
    else:
        place = tmp_path / "locked"
        place.mkdir(mode=0o500)
    there.prepare(XDG_CACHE_HOME=place, TMPDIR=place)
    with pytest.raises(OutputError, match=r"has no directory to write to: .*(Read-only file system|Permission denied)"):
        there.measure(bundle)


# the way there


def test_a_bundle_that_has_changed_is_not_sent_on(there, large):
    with (large.path / "graphs/main.onnx").open("r+b") as stream:
        stream.seek(20_000_000)
        stream.write(b"changed")
    with pytest.raises(BundleError, match=r"main.onnx has changed: its SHA-256 is not the manifest's"):
        there.measure(large)


@pytest.mark.parametrize("damage", ["missing", "shorter"])
def test_a_bundle_that_is_not_whole_is_not_sent(there, bundle, damage):
    path = bundle.path / "graphs/main.onnx"
    path.unlink() if damage == "missing" else path.write_bytes(b"short")
    with pytest.raises(BundleError, match=r"lacks the file graphs/main.onnx|has 5 bytes"):
        there.measure(bundle)
    assert there.told == []


def test_a_transfer_that_is_corrupted(there, large, tmp_path, monkeypatch):
    real = shutil.which("ssh")
    code = f"""
    import subprocess, sys
    ssh = subprocess.Popen([{real!r}, *sys.argv[1:]], stdin=subprocess.PIPE)
    at = 0
    while block := sys.stdin.buffer.raw.read(1 << 16):
        block = bytearray(block)
        if at <= 400_000 < at + len(block):
            block[400_000 - at] ^= 1
        at += len(block)
        try:
            ssh.stdin.write(block)
            ssh.stdin.flush()
        except BrokenPipeError:
            break
    with __import__("contextlib").suppress(BrokenPipeError):
        ssh.stdin.close()
    sys.exit(ssh.wait())
    """
    wrapper = tmp_path / "wrapper"
    wrapper.mkdir()
    (wrapper / "wrapper.py").write_text(textwrap.dedent(code))
    script(wrapper / "ssh", f'exec {sys.executable} {wrapper}/wrapper.py "$@"')
    monkeypatch.setenv("PATH", f"{wrapper}:{os.environ['PATH']}")
    with pytest.raises(TargetError, match="did not arrive whole: the SHA-256 of a piece differs"):
        there.measure(large)


def kill_client() -> None:
    """Kill the ssh that this process started."""
    for child in psutil.Process().children(recursive=True):
        with contextlib.suppress(psutil.Error):
            if child.name() == "ssh":
                child.kill()


@pytest.mark.parametrize("how", ["server", *small_or_full([], ["client"])])
def test_the_connection_ends_while_files_are_sent(there, large, server, how):
    def tell(what: str, share: float | None) -> None:
        if what.startswith("sending") and share:
            until(there.runs, "a directory on the target")
            server.drop() if how == "server" else kill_client()

    with pytest.raises(TargetError, match=r"The connection to .* ended while files were sent \(.* of 3\d\.\d MB\): .+"):
        there.measure(large, tell=tell)


@pytest.mark.parametrize("how", ["client", *small_or_full([], ["server"])])
def test_the_connection_ends_while_it_measures(there, bundle, server, how):
    def tell(what: str, _share: float | None) -> None:
        if what == "waiting":
            until(lambda: there.processes("sleep 600"), "the process of the agent")
            server.drop() if how == "server" else kill_client()

    with pytest.raises(TargetError, match=r"The connection to .* ended while it measured: .+") as caught:
        there.measure(bundle, do="wait", tell=tell)
    assert "run it again" in caught.value.fix


@pytest.fixture
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    """The target gives up after two seconds without a sign of life."""
    text = ssh._probe.program()
    assert "\nQUIET_S = 60\n" in text
    monkeypatch.setattr(ssh._probe, "program", lambda: text.replace("\nQUIET_S = 60\n", "\nQUIET_S = 2\n"))
    monkeypatch.setattr(_connection, "ALIVE_S", 0.2)


def test_a_connection_that_falls_silent_ends_the_run_there(there, bundle, impatient):
    def tell(what: str, _share: float | None) -> None:
        if what == "waiting":
            (client,) = [child for child in psutil.Process().children() if child.name() == "ssh"]
            client.suspend()
            until(lambda: not there.runs() and not there.processes("stand_in"), "the end of the run")
            client.resume()

    with pytest.raises(TargetError, match="ended while it measured"):
        there.measure(bundle, do="wait", tell=tell)


def test_signs_of_life_are_sent_while_the_agent_talks(there, bundle, impatient):
    assert there.measure(bundle, do="chat")["all"] == "said"


def test_a_target_that_takes_nothing(there, large, monkeypatch):
    monkeypatch.setattr(_connection, "STALLED_S", 0.5)
    monkeypatch.setattr(_connection, "CLEANING_S", 0.5)

    def tell(what: str, share: float | None) -> None:
        if what.startswith("sending") and share == 0:
            os.kill(bootstraps(there)[0], signal.SIGSTOP)

    with pytest.raises(TargetError, match=r"took nothing for 0\.5 s while files were sent") as caught:
        there.measure(large, tell=tell)
    assert "run it again" in caught.value.fix
    os.kill(bootstraps(there)[0], signal.SIGCONT)


@pytest.mark.parametrize("number", small_or_full([signal.SIGINT], [signal.SIGINT, signal.SIGKILL]))
def test_a_command_that_is_ended_ends_the_run_there(there, bundle, tmp_path, number):
    code = f"""
    import sys
    from pathlib import Path
    from vlatool.remote import ssh
    ssh.AGENT, ssh.FURTHER_MODULES = "stand_in_agent", (Path({str(tmp_path / "stand_in_agent.py")!r}),)
    tell = lambda what, share: print(what, flush=True)
    ssh.measure_on({target()!r}, {{"do": "wait"}}, [Path({str(bundle.path)!r})], tell, python={sys.executable!r},
                   ssh_options={there.server.options()!r})
    """
    command = [sys.executable, "-c", textwrap.dedent(code)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as local:
        assert local.stdout is not None
        assert "waiting\n" in iter(local.stdout.readline, "")
        until(lambda: there.processes("sleep 600"), "the process of the agent")
        local.send_signal(number)
        error = local.communicate(timeout=30)[1]
    assert ("KeyboardInterrupt" in error) == (number == signal.SIGINT)
    there.check()


# what is sent


def test_the_same_files_give_the_same_bytes_and_no_owner_or_time(large, tmp_path):
    one, other = (list(_push.payload_of([large], ssh.PACKAGE).archives()) for _ in range(2))
    assert one == other
    assert sum(size for _, size in one) == _push.payload_of([large], ssh.PACKAGE).size
    with tarfile.open(fileobj=io.BytesIO(one[0][0])) as pack:
        members = pack.getmembers()
    assert {(each.uid, each.gid, each.uname, each.mtime, each.mode) for each in members} == {(0, 0, "", 0, 0o600)}
    names = [each.name for each in members]
    assert "package/vlatool/remote/ssh.py" in names
    assert not any("__pycache__" in name or name.endswith(".pyc") for name in names)
    for packed, _ in one:
        _bootstrap.unpack(packed, tmp_path / "out")
    assert Bundle.open(next((tmp_path / "out/bundles").glob("*/*"))).hash == large.hash


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("/etc/over", tarfile.REGTYPE),
        ("a/../../over", tarfile.REGTYPE),
        ("link", tarfile.SYMTYPE),
        ("hard", tarfile.LNKTYPE),
        ("pipe", tarfile.FIFOTYPE),
        ("folder", tarfile.DIRTYPE),
    ],
)
def test_only_files_below_the_directory_are_unpacked(tmp_path, name, kind):
    packed = io.BytesIO()
    with tarfile.open(fileobj=packed, mode="w") as pack:
        member = tarfile.TarInfo(name)
        member.type, member.linkname = kind, "/etc/passwd"
        pack.addfile(member)
    with pytest.raises(_run_directory.Refused, match="is not a file below the directory"):
        _bootstrap.unpack(packed.getvalue(), tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_only_directories_of_dead_runs_are_removed(tmp_path):
    for name in ("vlatool-run-dead", "vlatool-run-without-lock", "vlatool-run-alive", "another"):
        (tmp_path / name).mkdir()
    (tmp_path / "vlatool-run-link").symlink_to(tmp_path / "another")
    (tmp_path / "vlatool-run-dead" / _run_directory.LOCK).touch()
    with (tmp_path / "vlatool-run-alive" / _run_directory.LOCK).open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        _run_directory.sweep(tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["another", "vlatool-run-alive", "vlatool-run-link"]


# what runs there


def bootstraps(there: Target) -> list[int]:
    """The process that serves the run, then its guard."""
    found = [number for number in there.processes("vlatool-run-") if "-I" in psutil.Process(number).cmdline()]
    return sorted(found, key=lambda number: psutil.Process(number).create_time())


def ended_by(there: Target, bundle: Bundle, kill: Callable[[], None]) -> None:
    def tell(what: str, _share: float | None) -> None:
        if what == "waiting":
            kill()

    with pytest.raises(TargetError, match="ended while it measured"):
        there.measure(bundle, do="wait", tell=tell)


@pytest.mark.parametrize("number", [signal.SIGKILL, *small_or_full([], [signal.SIGTERM, signal.SIGHUP, signal.SIGINT])])
def test_a_signal_to_what_serves_the_run(there, bundle, number):
    ended_by(there, bundle, lambda: os.kill(bootstraps(there)[0], number))


def test_what_a_run_left_that_was_killed_with_its_guard_is_removed_by_the_next(there, bundle):
    def kill() -> None:
        assert len(bootstraps(there)) == 2
        for number in [*reversed(bootstraps(there)), *there.processes("stand_in"), *there.processes("sleep 600")]:
            os.kill(number, signal.SIGKILL)

    ended_by(there, bundle, kill)
    assert len([path for path in there.runs() if path.is_dir()]) == 1
    there.measure(bundle)


@pytest.mark.parametrize(
    ("number", "said"),
    [
        (signal.SIGKILL, r"was killed \(SIGKILL\), as it is when memory runs out"),
        *small_or_full([], [(signal.SIGSEGV, "was ended by SIGSEGV")]),
    ],
)
def test_an_agent_that_is_killed(there, bundle, number, said):
    with pytest.raises(TargetError, match=f"{said}; its last line: the last words"):
        there.measure(bundle, do="die", signal=int(number))


@pytest.mark.parametrize("code", small_or_full([0], [0, 1]))
def test_an_agent_that_ends_without_a_result(there, bundle, code):
    with pytest.raises(TargetError, match=f"ended with code {code} and without a result; .*ValueError: it broke"):
        there.measure(bundle, do="leave", code=code)


@pytest.mark.parametrize(("kind", "raised"), [("GraphError", GraphError), ("os", TargetError)])
def test_what_the_agent_raises_is_raised_here(there, bundle, kind, raised):
    with pytest.raises(raised) as caught:
        there.measure(bundle, do="raise", kind=kind)
    assert caught.value.message == f"{bundle.path} is refused."
    assert caught.value.fix == "export it again"


# getting in


def test_a_name_that_does_not_resolve(there, bundle):
    with pytest.raises(
        TargetError, match=r"its name does not resolve: ssh: Could not resolve hostname nowhere\.invalid"
    ):
        there.measure(bundle, on="nowhere.invalid")


def test_nothing_listens(there, bundle):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))  # bound, and not listening
        options = there.server.options(Port=str(taken.getsockname()[1]))
        with pytest.raises(TargetError, match=r"nothing answers at that address and port: .*Connection refused"):
            there.measure(bundle, options=options)


def test_a_machine_that_does_not_answer(there, bundle):
    with socket.create_server(("127.0.0.1", 0)) as mute:
        options = there.server.options(Port=str(mute.getsockname()[1]))
        with pytest.raises(TargetError, match=r"does not answer in time: .*timed out"):
            there.measure(bundle, options=options, connect_timeout_s=1)


def test_a_key_that_is_not_allowed(there, bundle):
    options = there.server.options(IdentityFile=str(there.server.folder / "other_key"))
    with pytest.raises(
        TargetError, match=r"does not let this user in without a password: .*Permission denied"
    ) as caught:
        there.measure(bundle, options=options)
    assert caught.value.fix == f"copy your key there: ssh-copy-id {target()}"


def test_a_host_key_that_is_not_known(there, bundle):
    with pytest.raises(TargetError, match="its host key is not known here: Host key verification failed"):
        there.measure(bundle, options=there.server.options(UserKnownHostsFile="/dev/null"))


def test_a_host_key_that_has_changed(there, bundle, tmp_path):
    other = " ".join((there.server.folder / "other_key.pub").read_text().split()[:2])
    (tmp_path / "known").write_text(f"[127.0.0.1]:{there.server.port} {other}\n")
    with pytest.raises(TargetError, match="its host key is not the one that is known: Host key verification failed"):
        there.measure(bundle, options=there.server.options(UserKnownHostsFile=str(tmp_path / "known")))


def test_a_login_that_runs_no_shell(there, bundle):
    there.prepare("echo 'This account is not available.' >&2; exit 1")
    with pytest.raises(TargetError, match=r"did not start a shell there: This account is not available\."):
        there.measure(bundle)


def test_a_login_that_hangs(there, bundle, monkeypatch):
    monkeypatch.setattr(ssh, "SHELL_S", 0.5)
    monkeypatch.setattr(_connection, "CLEANING_S", 0.5)
    there.prepare("exec sleep 600")
    with pytest.raises(TargetError, match=r"said nothing for 1\.5 s before anything ran there"):
        there.measure(bundle, connect_timeout_s=1)
    for number in there.processes("sleep 600"):
        os.kill(number, signal.SIGKILL)


def test_no_ssh_here(there, bundle, monkeypatch, tmp_path):
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(MissingExtra, match="needs the program ssh"):
        there.measure(bundle)


@pytest.mark.parametrize("name", ["", "-oProxyCommand=touch here", "a b", "host\n", "host\x00"])
def test_a_target_that_is_no_machine(there, bundle, name):
    with pytest.raises(UsageError, match="is not a machine that ssh can reach"):
        ssh.measure_on(name, {}, [bundle.path], there.tell)
    with pytest.raises(UsageError, match="is not the path of a program"):
        there.measure(bundle, python="-c")


def test_the_back_end_is_the_one_that_is_there():
    assert BACK_END in ("sshd", "asyncssh")


EVIL = """
import json, os, re, sys, time
seen = b""
while not (found := re.search(rb"vlatool-[0-9a-f]{16}:", seen)):
    seen += os.read(0, 1 << 16)
marker = found[0].decode()


def say(text):
    sys.stdout.write("\\n" + marker + text + "\\n")
    sys.stdout.flush()


def python(**changed):
    facts = {"command": "python3", "version": [3, 11, 0], "packages": {"numpy": "2", "onnxruntime": "1"}, "errors": {},
             "architecture": "x86_64", "kernel": "6", "free": 10**12}
    say(json.dumps({"python": {**facts, **changed}}))


def until_measuring():
    say('{"shell": true}')
    python()
    say('{"ready": "/tmp/there"}')
    os.set_blocking(0, False)
    quiet = time.monotonic()
    while time.monotonic() - quiet < 1:
        try:
            quiet = time.monotonic() if os.read(0, 1 << 16) else quiet
        except BlockingIOError:
            time.sleep(0.05)
    say('{"received": true}')


"""


@pytest.fixture
def instead_of_ssh(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], None]:
    """What the target sends, without a server between: a shell command runs as ``ssh``."""

    def put(command: str) -> None:
        (tmp_path / "programs").mkdir()
        script(tmp_path / "programs/ssh", f"#!/bin/sh\nexec {command}\n")
        monkeypatch.setenv("PATH", str(tmp_path / "programs"), prepend=os.pathsep)

    return put


@pytest.fixture
def evil(tmp_path: Path, instead_of_ssh: Callable[[str], None]) -> Callable[[str], None]:
    """A target on which a program of somebody else's answers."""

    def put(program: str) -> None:
        (tmp_path / "evil.py").write_text(EVIL + textwrap.dedent(program))
        instead_of_ssh(f"{sys.executable} {tmp_path / 'evil.py'}")

    return put


@pytest.mark.parametrize("flood", [
    "timeout 30 cat /dev/zero", "sh -c 'timeout 30 yes >&2'",
    *small_or_full([], ["timeout 30 yes", "sh -c 'timeout 30 cat /dev/zero >&2'"]),
])  # fmt: skip
def test_a_target_that_floods_is_cut_off(there, bundle, instead_of_ssh, monkeypatch, flood):
    monkeypatch.setenv("VLATOOL_LIMITS", "target_bytes=2e7")
    instead_of_ssh(flood)
    before = psutil.Process().memory_info().rss
    with pytest.raises(TargetError, match="the limit 'target_bytes' allows 20000000") as caught:
        there.measure(bundle)
    assert psutil.Process().memory_info().rss - before < 60e6
    assert "VLATOOL_LIMITS=target_bytes=" in caught.value.fix


NONSENSE = [
    ("say('x' * 3_000_000)", "target_message_bytes"),
    ("sys.stdout.write(marker + 'x' * 3_000_000); sys.stdout.flush(); time.sleep(2)", "target_message_bytes"),
    ("say('[]')", "a message is a list"),
    ("say('{')", "Invalid reply from"),
    ("say('[' * 100_000)", "Invalid reply from"),
    ("""say('{"a": ' * 40 + '1' + '}' * 40)""", "more than 32 levels"),
    ("""say('{"python": {"version": [3, 11, NaN]}}')""", "NaN is not a number"),
    ("""say('{"python": {"version": [3, 11, 1e999]}}')""", "a number is too large"),
    ("say('{\"python\": ' + '9' * 5000 + '}')", "Invalid reply from"),
    ("say('{}'); say('{\"python\": {}}')", "'python' lacks 'command'"),
    ("say('{}'); python(version='3')", "'python.version' is '3', not a list"),
    ("say('{}'); python(version=[3, 11])", "'python.version' has 2 values, not 3"),
    ("say('{}'); python(free='much')", "'python.free' is 'much', not"),
    ("say('{}'); python(packages={'numpy': 1})", "'python.packages.numpy' is 1, not text"),
    ("[python(packages={}) for _ in range(70)]; time.sleep(2)", "more than 64 Pythons"),
    ("say('{}'); python(); say('{\"ready\": 1}'); time.sleep(2)", "'ready' is 1, not text"),
    ("say('{}'); python(); say('{\"refused\": \"no room\", \"text\": \"x\"}'); time.sleep(2)", "Invalid reply from"),
    ("say('{}'); python(); say('{\"refused\": \"no room\", \"text\": \"{}\"}'); time.sleep(2)", "lacks 'free'"),
    ("until_measuring(); say('{\"ended\": 1}')", "'ended' is 1, not a mapping"),
    ("until_measuring(); say('{\"ended\": {\"code\": \"0\", \"log\": \"\"}}')", "'ended.code' is '0'"),
    ("until_measuring(); say('{\"ended\": {\"code\": 0, \"log\": 3}}')", "'ended.log' is 3, not text"),
    ("until_measuring(); say('{\"agent\": 3}'); time.sleep(2)", "'agent' is 3, not text"),
    ("""until_measuring(); say(json.dumps({"agent": '{"result": {"p50": 1e999}}'})); time.sleep(2)""",
     "a number is too large"),
]  # fmt: skip


@pytest.mark.parametrize(("program", "message"), small_or_full(NONSENSE[::3], NONSENSE))
def test_a_target_that_answers_nonsense(there, bundle, evil, monkeypatch, program, message):
    monkeypatch.setenv("VLATOOL_LIMITS", "target_message_bytes=1e6")
    evil(program)
    with pytest.raises(TargetError, match=message):
        there.measure(bundle)


def test_a_target_that_never_ends_is_cut_off(there, bundle, evil, monkeypatch):
    monkeypatch.setenv("VLATOOL_LIMITS", "target_seconds=1000")
    evil("""
    until_measuring()
    for _ in range(30):
        say(json.dumps({"agent": json.dumps({"progress": {"what": "run", "share": 0.5}})}))
        time.sleep(0.1)
    """)
    later = 0.0

    def half_an_hour_later(what: str, _share: float | None) -> None:
        nonlocal later
        later = 1800.0 if what == "run" else 0.0

    now = time.monotonic
    monkeypatch.setattr(_connection, "time", SimpleNamespace(monotonic=lambda: now() + later))
    with pytest.raises(TargetError, match="is not done after 1000 s, while it measured"):
        there.measure(bundle, tell=half_an_hour_later)


def test_nothing_of_a_target_reaches_the_terminal_raw(there, bundle, evil):
    evil(r"""
    until_measuring()
    say(json.dumps({"agent": json.dumps({"progress": {"what": "\x1b]0;owned\x07 half\nway", "share": 0.5}})}))
    raised = {"raised": {"kind": "GraphError", "message": "\x1b[2Jgone", "fix": "\u202etxt"}}
    say(json.dumps({"agent": json.dumps(raised)}))
    say(json.dumps({"ended": {"code": 0, "log": ""}}))
    """)
    with pytest.raises(GraphError) as caught:
        there.measure(bundle)
    assert str(caught.value) == "\\x1b[2Jgone\n  fix: \\u202etxt"
    assert r"\x1b]0;owned\x07 half way" in [what for what, _ in there.told]
