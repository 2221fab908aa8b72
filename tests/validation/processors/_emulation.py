"""Other processors on this host: user-mode QEMU, and what a 64-bit ARM board has, fetched once into a cache.

Nothing is installed and root is not needed: Debian's packages are unpacked into a folder, through an apt configuration
of its own. What is fetched is checked (apt and pip check hashes and sizes; here: the architecture, and that it runs)
and moved into place when it is whole.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tarfile
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib import metadata
from itertools import chain
from pathlib import Path

KEYRING = Path("/usr/share/keyrings/debian-archive-keyring.gpg")
ROBOT = Path(__file__).parents[3] / "robot"
"""What describes vlatool-runtime."""
RUNTIME = "runtime"
"""Folder of the cache that it is installed in."""
SOURCES = Path("/etc/apt")
ELSE = "http://deb.debian.org/debian"
NEEDS = ("apt-get", "dpkg-deb")
QEMU = ("trixie", 10)
"""Release of Debian, and the least major version: 7.2 crashes when it imports onnxruntime 1.31."""
BOARD = ("bookworm", ("python3.11", "libstdc++6"))
TAGS = tuple(f"manylinux_2_{minor}_aarch64" for minor in (17, 27, 28, 31, 34, 35))
MACHINES = {"aarch64": 183, "x86_64": 62}
"""``e_machine`` of an ELF file."""
SILENT = re.compile(
    r"could not resolve|temporary failure|could not connect|unable to connect|failed to establish|connection "
    r"(?:refused|reset|timed out|failed|broken)|timed out|network is unreachable|no route to host|\b50[234] ",
    re.IGNORECASE,
)
"""What apt and pip say when a registry does not answer, and not when it answers that it has no such thing."""
ANSWERED = re.compile(r"hash sum mismatch|hashes|no space left|permission denied|size mismatch", re.IGNORECASE)
"""What they say when it did answer, whatever else they had to try again before."""
LIBRARIES = ("onnxruntime/capi/onnxruntime_pybind11_state*.so", "numpy/_core/_multiarray_umath*.so")
"""What is in the wheels and has to be of the board's architecture."""
LEAST_BYTES = 1_000_000
"""Of a file that an emulator or a library is: less is no whole one."""

APT = """\
APT::Architecture "{arch}"; APT::Architectures {{ "{arch}"; }}; APT::Install-Recommends "false";
APT::Sandbox::User "root"; APT::Update::Error-Mode "any"; Acquire::Languages "none"; Acquire::Retries "2";
Debug::NoLocking "true";
Dir::State "{at}"; Dir::State::status "{at}/status"; Dir::State::lists "{at}/lists"; Dir::Cache "{at}/cache";
Dir::Etc::sourcelist "{at}/sources.list"; Dir::Etc::sourceparts "{at}/parts"; Dir::Etc::parts "{at}/parts";
"""


class EmulationError(Exception):
    """What the user is told instead of a traceback."""


class Unreachable(EmulationError):
    """A registry does not answer, so that nothing can be said."""


@dataclass(frozen=True)
class Emulators:
    """What is in the cache.

    Args:
        folder: Its directory.
    """

    folder: Path

    def qemu(self, arch: str) -> Path:
        """Return the static emulator of an architecture, fetched where it is not there.

        Raises:
            Unreachable: when Debian's mirror does not answer.
            EmulationError: when something else fails.
        """
        target = self.folder / f"qemu-{arch}"
        if not target.exists():
            whole(target, lambda draft: self._fetch_qemu(arch, draft))
        return target

    def _fetch_qemu(self, arch: str, draft: Path) -> None:
        with tempfile.TemporaryDirectory(dir=self.folder) as scratch:
            packages = fetched(Path(scratch), host_architecture(), QEMU[0], ("qemu-user",))
            unpack(packages, Path(scratch) / "root", only=f"./usr/bin/qemu-{arch}")
            shutil.copyfile(Path(scratch) / f"root/usr/bin/qemu-{arch}", draft)
        draft.chmod(0o755)
        check_elf(draft)
        check_version(said([str(draft), "--version"]), QEMU[1])

    def board(self) -> Path:
        """Return the root of an ARM board's system: the C and C++ libraries and Python 3.11, fetched where absent.

        Raises:
            Unreachable: when Debian's mirror does not answer.
            EmulationError: when something else fails.
        """
        target = self.folder / "board"
        if not target.exists():
            whole(target, self._fetch_board)
        return target

    def _fetch_board(self, draft: Path) -> None:
        with tempfile.TemporaryDirectory(dir=self.folder) as scratch:
            unpack(fetched(Path(scratch), "arm64", *BOARD), draft)
        python = draft / "usr/bin/python3.11"
        check_elf(python, "aarch64")
        words = [
            *self.emulated("aarch64", "max", draft),
            str(python),
            "-c",
            "import platform; print(platform.machine())",
        ]
        if (got := said(words)) != "aarch64":
            raise EmulationError(f"The emulated Python says that it runs on {got}; wanted aarch64.")

    def wheels(self, onnxruntime: str) -> Path:
        """Return a folder with an ONNX Runtime and numpy for the board's Python, fetched where it is not there.

        Raises:
            Unreachable: when the package registry does not answer.
            EmulationError: when something else fails.
        """
        target = self.folder / f"onnxruntime-{onnxruntime}"
        if not target.exists():
            whole(target, lambda draft: self._fetch_wheels(onnxruntime, draft))
        return target

    def serving(self) -> Path:
        """Return a folder with all that ``vlatool serve`` needs beside an ONNX Runtime, fetched where it is not there.

        Raises:
            Unreachable: when the package registry does not answer.
            EmulationError: when something else fails.
        """
        target = self.folder / "serving"
        if not target.exists():
            whole(target, self._fetch_serving)
        return target

    def _fetch_serving(self, draft: Path) -> None:
        lines = [line.partition(";") for line in metadata.requires("vlatool") or ()]
        wanted = [name for name, _, marker in lines if "extra ==" not in marker or "serve" in marker]
        install_for_board(draft, wanted)
        code = "import grpc, msgpack, pydantic, websockets, zmq; print(zmq.__version__)"
        said([*self.emulated("aarch64", "max"), str(self.python()), "-c", code], {"PYTHONPATH": str(draft)})

    def _fetch_wheels(self, onnxruntime: str, draft: Path) -> None:
        install_for_board(draft, ["--no-deps", f"onnxruntime=={onnxruntime}", "numpy"])
        for library in chain.from_iterable(map(draft.glob, LIBRARIES)):
            check_elf(library, "aarch64")
        code = "import numpy, onnxruntime; print(onnxruntime.__version__)"
        words = [*self.emulated("aarch64", "max"), str(self.python()), "-c", code]
        if (got := said(words, {"PYTHONPATH": str(draft)})) != onnxruntime:
            raise EmulationError(f"The emulated Python imports onnxruntime {got}; wanted {onnxruntime}.")

    def runtime(self) -> Path:
        """Return a folder with vlatool-runtime, built anew and installed: what a robot has of vlatool.

        Raises:
            Unreachable: when the package registry, which the build backend comes from, does not answer.
            EmulationError: when something else fails.
        """
        target = self.folder / RUNTIME
        shutil.rmtree(target, ignore_errors=True)
        words = [sys.executable, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--no-deps"]
        told([*words, "--target", str(target), str(ROBOT)], "The package registry")
        return target

    def python(self) -> Path:
        """Return the board's Python."""
        return self.board() / "usr/bin/python3.11"

    def emulated(self, arch: str, cpu: str, root: Path | None = None) -> list[str]:
        """Return the words before a command that let it run on a core of another kind."""
        place = root or (self.board() if arch == "aarch64" else Path("/"))
        return [str(self.qemu(arch)), "-cpu", cpu, *(["-L", str(place)] if arch == "aarch64" else [])]


def install_for_board(folder: Path, wanted: Sequence[str]) -> None:
    """Install wheels for the board's Python.

    Args:
        folder: Where to.
        wanted: Requirements, and further options of pip.

    Raises:
        Unreachable: when the package registry does not answer.
        EmulationError: when something else fails.
    """
    tags = [word for tag in (*TAGS, "manylinux2014_aarch64") for word in ("--platform", tag)]
    kind = ["--python-version", "3.11", "--implementation", "cp", "--abi", "cp311", "--only-binary", ":all:"]
    options = ["--quiet", "--disable-pip-version-check", "--target", str(folder)]
    told([sys.executable, "-m", "pip", "install", *options, *kind, *tags, *wanted], "The package registry")


def whole(target: Path, make: Callable[[Path], None]) -> None:
    """Make a file or folder beside its place and move it there when it is whole."""
    target.parent.mkdir(parents=True, exist_ok=True)
    draft = target.with_name(f".{target.name}.part-{os.getpid()}")
    try:
        make(draft)
        if not target.exists():  # another run may have been first
            os.replace(draft, target)
    finally:
        shutil.rmtree(draft) if draft.is_dir() else draft.unlink(missing_ok=True)


def mirror(folder: Path = SOURCES) -> str:
    """Return the mirror of Debian that this host uses; Debian's own where its sources name none."""
    files = [folder / "sources.list", *sorted((folder / "sources.list.d").glob("*"))]
    lines = [line for file in files if file.is_file() for line in file.read_text(errors="replace").splitlines()]
    for line in lines:
        found = re.match(r"(?:URIs:|deb\s+(?:\[[^]]*\])?)\s*(https?://\S+/debian)/?(?:\s|$)", line)
        if found:
            return found[1]
    return ELSE


def host_architecture() -> str:
    """Return what Debian calls this host's architecture."""
    return {"x86_64": "amd64", "aarch64": "arm64"}.get(os.uname().machine, os.uname().machine)


def fetched(scratch: Path, arch: str, release: str, packages: Sequence[str]) -> list[Path]:
    """Fetch packages of an architecture with what they need, through an apt configuration of its own.

    Raises:
        Unreachable: when the mirror does not answer.
        EmulationError: when this host has no apt, or it fails.
    """
    for name in NEEDS:
        if shutil.which(name) is None:
            raise EmulationError(f"{name} is not installed: Debian's packages cannot be fetched and unpacked here.")
    if not KEYRING.is_file():
        raise EmulationError(f"There is no {KEYRING}; install the package debian-archive-keyring.")
    for name in ("lists/partial", "cache/archives/partial", "parts"):
        (scratch / name).mkdir(parents=True)
    (scratch / "status").touch()
    (scratch / "sources.list").write_text(f"deb [signed-by={KEYRING}] {mirror()} {release} main\n")
    (scratch / "apt.conf").write_text(APT.format(arch=arch, at=scratch))
    place = {"APT_CONFIG": str(scratch / "apt.conf")}
    told(["apt-get", "-qq", "update"], "Debian's mirror", place)
    told(["apt-get", "-qq", "-y", "--download-only", "install", *packages], "Debian's mirror", place)
    return sorted((scratch / "cache/archives").glob("*.deb"))


def unpack(packages: Sequence[Path], root: Path, only: str = "") -> None:
    """Unpack Debian packages into a folder, or one file of them alone."""
    root.mkdir(parents=True)
    for package in packages:
        if not only:
            told(["dpkg-deb", "-x", str(package), str(root)], "")
        elif package.name.startswith("qemu-user_"):
            archive = root / "data.tar"
            with archive.open("wb") as stream:
                subprocess.run(["dpkg-deb", "--fsys-tarfile", str(package)], stdout=stream, check=True)
            with tarfile.open(archive) as members:
                members.extraction_filter = getattr(tarfile, "data_filter", None)  # Python 3.11.2 has none
                members.extract(only, root)


def told(words: Sequence[str], registry: str, variables: Mapping[str, str] | None = None) -> None:
    """Run a command that fetches something.

    Args:
        words: The command.
        registry: What it asks; empty when nothing.
        variables: Further variables of its environment.

    Raises:
        Unreachable: when it fails and says that the registry does not answer.
        EmulationError: when it fails otherwise.
    """
    done = subprocess.run(words, env={**os.environ, **(variables or {})}, capture_output=True, text=True, check=False)
    if not done.returncode:
        return
    if registry and (line := silent(done.stderr)):
        raise Unreachable(f"{registry} does not answer: {line}")
    lines = [line for line in done.stderr.splitlines() if line.strip()]
    raise EmulationError(f"{Path(words[0]).name} left with {done.returncode}: {' / '.join(lines[-2:])[-400:]}")


def silent(stderr: str) -> str:
    """Return the line that says that a registry does not answer; empty when there is none, or another says it did."""
    if ANSWERED.search(stderr):
        return ""
    return next((line.strip()[:200] for line in stderr.splitlines() if SILENT.search(line)), "")


def said(words: Sequence[str], variables: Mapping[str, str] | None = None) -> str:
    """Return what a command prints.

    Raises:
        EmulationError: when it fails.
    """
    done = subprocess.run(words, env={**os.environ, **(variables or {})}, capture_output=True, text=True, check=False)
    if done.returncode:
        raise EmulationError(f"{' '.join(words[:3])} ... left with {done.returncode}: {done.stderr.strip()[-300:]}")
    return done.stdout.strip()


def check_elf(path: Path, arch: str = "") -> None:
    """Refuse what is no whole program or library of an architecture.

    Args:
        path: The file.
        arch: A key of ``MACHINES``; this host's own when empty.

    Raises:
        EmulationError: when it is not.
    """
    wanted = arch or os.uname().machine
    head = path.read_bytes()[:20] if path.is_file() else b""
    if head[:4] != b"\x7fELF" or int.from_bytes(head[18:20], "little") != MACHINES.get(wanted):
        raise EmulationError(f"{path.name} is no program for {wanted}.")
    if path.stat().st_size < LEAST_BYTES:
        raise EmulationError(f"{path.name} has {path.stat().st_size} bytes; a whole one has at least {LEAST_BYTES}.")


def check_version(text: str, least: int) -> None:
    """Refuse a QEMU that is too old.

    Raises:
        EmulationError: when it is, or does not say.
    """
    found = re.search(r"version (\d+)\.", text)
    if found is None or int(found[1]) < least:
        raise EmulationError(f"This QEMU says '{text.splitlines()[0] if text else ''}'; version {least} is needed.")
