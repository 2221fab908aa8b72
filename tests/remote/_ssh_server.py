"""An ssh server on loopback for tests: OpenSSH's sshd where there is one, else asyncssh."""

from __future__ import annotations

import contextlib
import getpass
import os
import shlex
import shutil
import socket
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest

SSHD = shutil.which("sshd", path=os.pathsep.join([os.environ.get("PATH", ""), "/usr/sbin", "/usr/local/sbin"]))
BACK_END = os.environ.get("VLATOOL_TEST_SSH", "sshd" if SSHD else "asyncssh")
DEADLINE_S = 20
CONFIG = """\
HostKey {folder}/host_key
AuthorizedKeysFile {folder}/user_key.pub
PidFile none
ListenAddress 127.0.0.1
UsePAM no
StrictModes no
PasswordAuthentication no
PermitRootLogin yes
MaxStartups 50
ForceCommand /bin/sh {folder}/session.sh
"""


def until(condition: Callable[[], Any], what: str) -> Any:
    """Wait for a condition and return its value; fails after a while."""
    end = time.monotonic() + DEADLINE_S
    while time.monotonic() < end:
        if found := condition():
            return found
        time.sleep(0.02)
    pytest.fail(f"not within {DEADLINE_S} s: {what}")


def processes_with(variable: str) -> list[int]:
    """Processes whose environment holds the text, apart from zombies."""
    found = []
    for process in psutil.process_iter(["pid", "status"]):
        with contextlib.suppress(psutil.Error, OSError):
            content = Path(f"/proc/{process.pid}/environ").read_bytes()
            if variable.encode() in content and process.info["status"] != psutil.STATUS_ZOMBIE:
                found.append(process.pid)
    return found


class Server:
    """A running server; ``session.sh`` in its folder is what every session runs."""

    def __init__(self, folder: Path, port: int, drop: Callable[[], None]) -> None:
        self.folder = folder
        self.port = port
        self.drop = drop

    def options(self, **changed: str) -> list[str]:
        """Options of ssh for this server alone: nothing of the user's own settings is read."""
        settings = {
            "Port": str(self.port),
            "IdentityFile": str(self.folder / "user_key"),
            "IdentitiesOnly": "yes",
            "IdentityAgent": "none",
            "UserKnownHostsFile": str(self.folder / "known_hosts"),
            "GlobalKnownHostsFile": "/dev/null",
            "StrictHostKeyChecking": "yes",
            **changed,
        }
        return ["-F", "/dev/null", *(part for name, value in settings.items() for part in ("-o", f"{name}={value}"))]

    def session(self, prelude: str) -> None:
        """Say what each session does before its command."""
        (self.folder / "session.sh").write_text(prelude + '\nexec /bin/sh -c "$SSH_ORIGINAL_COMMAND"\n')


def target() -> str:
    return f"{getpass.getuser()}@127.0.0.1"


@contextlib.contextmanager
def serving(folder: Path) -> Iterator[Server]:
    """Run a server with keys of its own."""
    for name in ("host_key", "user_key", "other_key"):
        subprocess.run(["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", folder / name], check=True)
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    key = " ".join((folder / "host_key.pub").read_text().split()[:2])
    (folder / "known_hosts").write_text(f"[127.0.0.1]:{port} {key}\n")
    back_end = _sshd if BACK_END == "sshd" else _asyncssh
    with back_end(folder, port) as drop:
        yield Server(folder, port, drop)


@contextlib.contextmanager
def _sshd(folder: Path, port: int) -> Iterator[Callable[[], None]]:
    (folder / "sshd_config").write_text(CONFIG.format(folder=folder))
    if os.geteuid() == 0:
        Path("/run/sshd").mkdir(mode=0o755, exist_ok=True)  # sshd wants it; the service makes it when it starts
    assert SSHD is not None
    command = [SSHD, "-D", "-e", "-f", str(folder / "sshd_config"), "-p", str(port)]
    with (folder / "sshd.log").open("wb") as log:
        server = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=log, stderr=log)
    try:
        until(lambda: server.poll() is not None or _listens(port), "sshd listens")
        assert server.poll() is None, (folder / "sshd.log").read_text()

        def drop() -> None:
            for child in psutil.Process(server.pid).children():
                child.kill()

        yield drop
    finally:
        server.terminate()
        server.wait()


def _listens(port: int) -> bool:
    try:
        socket.create_connection(("127.0.0.1", port), timeout=1).close()
    except OSError:
        return False
    return True


@contextlib.contextmanager
def _asyncssh(folder: Path, port: int) -> Iterator[Callable[[], None]]:
    asyncssh = pytest.importorskip("asyncssh")
    import asyncio

    connections: set[Any] = set()
    loop = asyncio.new_event_loop()

    class Listening(asyncssh.SSHServer):  # type: ignore[misc, name-defined]
        def connection_made(self, connection: Any) -> None:
            self.connection = connection
            connections.add(connection)

        def connection_lost(self, _error: Exception | None) -> None:
            connections.discard(self.connection)

    async def copy(source: Any, sink: Any, close: Callable[[], None]) -> None:
        with contextlib.suppress(asyncssh.Error, OSError):
            while data := await source.read(1 << 16):
                sink.write(data)
                await sink.drain()
        with contextlib.suppress(asyncssh.Error, OSError):
            close()

    async def session(process: Any) -> None:
        pipe = asyncio.subprocess.PIPE
        child = await asyncio.create_subprocess_exec(
            "/bin/sh", folder / "session.sh", stdin=pipe, stdout=pipe, stderr=pipe,
            env={**os.environ, "SSH_ORIGINAL_COMMAND": process.command},
        )  # fmt: skip
        assert child.stdin is not None
        into = asyncio.ensure_future(copy(process.stdin, child.stdin, child.stdin.close))
        out = [copy(child.stdout, process.stdout, int), copy(child.stderr, process.stderr, int)]
        await asyncio.gather(*out)
        code = await child.wait()
        with contextlib.suppress(asyncssh.Error, OSError):
            process.exit(code if code >= 0 else 255)
        into.cancel()

    async def start() -> Any:
        return await asyncssh.listen(
            "127.0.0.1", port, server_factory=Listening, server_host_keys=[str(folder / "host_key")],
            authorized_client_keys=str(folder / "user_key.pub"), process_factory=session, encoding=None,
        )  # fmt: skip

    server = loop.run_until_complete(start())
    thread = threading.Thread(target=loop.run_forever)
    thread.start()

    def drop() -> None:
        loop.call_soon_threadsafe(lambda: [each.abort() for each in list(connections)])

    async def stop() -> None:
        server.close()
        for each in list(connections):
            each.abort()
        await server.wait_closed()
        others = [task for task in asyncio.all_tasks() if task is not asyncio.current_task()]
        await asyncio.wait(others, timeout=5) if others else None

    try:
        yield drop
    finally:
        asyncio.run_coroutine_threadsafe(stop(), loop).result(DEADLINE_S)
        loop.call_soon_threadsafe(loop.stop)
        thread.join()
        loop.close()


def exports(**values: object) -> str:
    """Lines of sh that export variables; an empty value unsets."""
    lines = (f"export {name}={shlex.quote(str(value))}" if value else f"unset {name}" for name, value in values.items())
    return "\n".join(lines)
