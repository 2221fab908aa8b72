"""A child process ``ssh`` as a pair of message streams, and what its end means."""

from __future__ import annotations

import contextlib
import json
import math
import os
import re
import secrets
import select
import subprocess
import time
from collections import deque
from collections.abc import Sequence
from typing import IO, Any, cast

from vlatool.errors import MissingExtra, TargetError
from vlatool.files.limits import check_limit, limit
from vlatool.files.printable import one_line, printable
from vlatool.remote._validate_replies import parse

ALIVE_S = 5
"""Seconds between signs of life to the target."""
STALLED_S = 60
"""Seconds without progress of a transfer after which it is given up."""
CLEANING_S = 20
"""Seconds that the target has to clean up before ssh is ended here; it goes on there."""
BLOCK = 1 << 16
MAX_NOISE_BYTES = 1 << 20
MAX_STDERR_BYTES = 1 << 16
"""Bytes of ssh's standard error that are kept, the last ones."""

RUN_AGAIN = "run it again; the target removes what was sent when the connection ends"
REFUSALS = (
    (r"Could not resolve hostname", "its name does not resolve",
     "check the name, or give it a Host entry in ~/.ssh/config"),
    (r"REMOTE HOST IDENTIFICATION HAS CHANGED", "its host key is not the one that is known",
     "if the machine was set up anew, remove the old key with ssh-keygen -R HOST, and log in once by hand"),
    (r"Host key verification failed|host key is known", "its host key is not known here",
     "log in once by hand and compare the fingerprint: ssh {target}"),
    (r"Permission denied|Too many authentication failures", "it does not let this user in without a password",
     "copy your key there: ssh-copy-id {target}"),
    (r"Connection refused", "nothing answers at that address and port",
     "check that sshd runs there, and on which port (Port in ~/.ssh/config)"),
    (r"timed out|Timeout", "it does not answer in time",
     "check that it is on and in this network: ssh {target} true"),
    (r"No route to host|Network is unreachable", "there is no way to its network",
     "check the network: ssh {target} true"),
)  # fmt: skip
"""What ssh says, what it means, and what to do; the first that matches."""


class Connection:
    """One ``ssh TARGET sh``: messages there as lines of JSON and bytes, messages back as marked lines of JSON.

    Args:
        target: target, as ``ssh`` takes it.
        options: options of ssh, before vlatool's own.
    """

    def __init__(self, target: str, options: Sequence[str], connect_timeout_s: float) -> None:
        self.marker = f"vlatool-{secrets.token_hex(8)}:"
        self.doing = "before anything ran there"
        self._target = target
        self._answered = False
        self._closing = self._flooded = False
        self._due = 0.0
        self._buffer = b""
        self._messages: deque[dict[str, Any]] = deque()
        self._said = b""
        self._came = 0
        self._until = time.monotonic() + limit("target_seconds")
        own = {
            "BatchMode": "yes",
            "ConnectTimeout": str(max(1, round(connect_timeout_s))),
            "ServerAliveInterval": "5",
            "ServerAliveCountMax": "3",
            "ClearAllForwardings": "yes",
            "RemoteCommand": "none",
        }
        settings = [part for name, value in own.items() for part in ("-o", f"{name}={value}")]
        try:
            self._ssh = subprocess.Popen(
                ["ssh", "-T", *options, *settings, "--", target, "sh"],
                stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, bufsize=0,
                start_new_session=True,
            )  # fmt: skip
        except FileNotFoundError as error:
            raise MissingExtra(
                "A benchmark on another machine needs the program ssh, which is not on this one.",
                "install the OpenSSH client, for example: apt install openssh-client",
            ) from error
        self._in, self._out = cast(IO[bytes], self._ssh.stdin), cast(IO[bytes], self._ssh.stdout)
        self._err = cast(IO[bytes], self._ssh.stderr)
        for stream in (self._in, self._err):
            os.set_blocking(stream.fileno(), False)

    def allow(self, seconds: float) -> None:
        """Let the run take so many seconds more than the limit ``target_seconds``."""
        self._until += seconds

    def send(self, data: bytes) -> bool:
        """Write bytes; False when the target had something to say before they were through."""
        rest, moved = memoryview(data), time.monotonic()
        while rest:
            ready = self._ready(STALLED_S * 1000, self._in)
            if self._out in ready and not self._take():
                raise self.end_error()
            if self._messages:
                return False
            if self._in in ready:
                try:
                    rest = rest[os.write(self._in.fileno(), rest[:BLOCK]) :]
                    moved = time.monotonic()
                except BlockingIOError:
                    continue
                except BrokenPipeError:
                    return self._last_words()
            if time.monotonic() - moved > STALLED_S:
                raise TargetError(f"{self._target} took nothing for {STALLED_S} s {self.doing}.", RUN_AGAIN)
        return True

    def tell(self, message: dict[str, Any]) -> bool:
        """Send one line of JSON; see ``send``."""
        return self.send(json.dumps(message).encode() + b"\n")

    def receive(self, timeout_s: float | None = None, *, alive: bool = False) -> dict[str, Any]:
        """Return the next message, and send signs of life meanwhile when ``alive``."""
        start = time.monotonic()
        while True:
            if alive and time.monotonic() >= self._due:
                self._due = time.monotonic() + ALIVE_S
                with contextlib.suppress(BlockingIOError, BrokenPipeError):
                    os.write(self._in.fileno(), b"\n")
            if self._messages:
                return self._messages.popleft()
            if self._out in self._ready(500) and not self._take():
                raise self.end_error()
            if timeout_s is not None and time.monotonic() - start > timeout_s and not self._messages:
                raise TargetError(f"{self._target} said nothing for {timeout_s:g} s {self.doing}.", self._try())

    def end_error(self) -> TargetError:
        """Return the error of a connection that has ended: what ssh reported, and what that means."""
        code = self.close()
        text = printable(self._said.decode("utf-8", "replace"))
        last = one_line(next((line for line in reversed(text.splitlines()) if line.strip()), f"exit code {code}"))
        if self._answered:
            return TargetError(f"The connection to {self._target} ended {self.doing}: {last}", RUN_AGAIN)
        for pattern, meaning, fix in REFUSALS:
            if code == 255 and re.search(pattern, text):
                return TargetError(f"Cannot reach {self._target}, {meaning}: {last}", fix.format(target=self._target))
        return TargetError(f"ssh {self._target} did not start a shell there: {last}", self._try())

    def close(self) -> int:
        """End it: the target sees the end of its input and cleans up; return ssh's exit code."""
        self._closing = True
        with contextlib.suppress(OSError):
            self._in.close()
        until = time.monotonic() + (0 if self._flooded else CLEANING_S)
        try:
            while self._ssh.poll() is None and time.monotonic() < until and not self._flooded:
                if self._out in self._ready(50) and not os.read(self._out.fileno(), BLOCK):
                    self._ssh.wait(max(0.1, until - time.monotonic()))
        except subprocess.TimeoutExpired:
            pass
        finally:
            if self._ssh.poll() is None:
                self._ssh.kill()
            self._read_errors()
        return self._ssh.wait()

    def dispose(self) -> None:
        """Close it and what it holds here."""
        try:
            self.close()
        finally:
            self._out.close()
            self._err.close()

    def _ready(self, milliseconds: float, *more: IO[bytes]) -> list[IO[bytes]]:
        """Wait until something can be read, or written to one of ``more``; what ssh says is taken in at once."""
        poll = select.poll()
        for stream in (self._out, *(() if self._err.closed else (self._err,))):
            poll.register(stream, select.POLLIN)
        for stream in more:
            poll.register(stream, select.POLLOUT)
        ready = {handle for handle, _ in poll.poll(milliseconds)}
        if not self._err.closed and self._err.fileno() in ready:
            self._read_errors()
        if time.monotonic() > self._until:
            self._until = math.inf
            raise TargetError(
                f"{self._target} is not done after {limit('target_seconds')} s, {self.doing}.",
                "if it is right, raise the limit: VLATOOL_LIMITS=target_seconds=SECONDS",
            )
        return [stream for stream in (self._out, *more) if stream.fileno() in ready]

    def _read_errors(self) -> None:
        """Take what ssh and the target's standard error say; its end is kept."""
        with contextlib.suppress(BlockingIOError, ValueError):
            received = os.read(self._err.fileno(), BLOCK)
            self._said = (self._said + received)[-MAX_STDERR_BYTES:]
            self._count(len(received))
            if not received:
                self._err.close()

    def _count(self, count: int) -> None:
        """Refuse a target that never stops talking."""
        self._came += count
        self._flooded = self._came > limit("target_bytes")
        if not self._closing:
            check_limit("target_bytes", self._came, f"What {self._target} sends", TargetError)

    def _try(self) -> str:
        return f"see what happens with: ssh {self._target} sh -c true"

    def _last_words(self) -> bool:
        """Read to the end what the target said before it hung up."""
        while not self._messages:
            if not self._take():
                raise self.end_error()
        return False

    def _take(self) -> bool:
        """Take what has come; False at the end."""
        received = os.read(self._out.fileno(), BLOCK)
        self._count(len(received))
        self._buffer += received
        mark = self.marker.encode()
        if b"\n" in received:
            *lines, self._buffer = self._buffer.split(b"\n")
            for line in lines:
                _, marked, rest = line.partition(mark)
                if marked:
                    self._answered = True
                    check_limit("target_message_bytes", len(rest), f"A message of {self._target}", TargetError)
                    self._messages.append(parse(rest, self._target))
        elif mark in self._buffer:
            check_limit("target_message_bytes", len(self._buffer), f"A message of {self._target}", TargetError)
        elif len(self._buffer) > MAX_NOISE_BYTES:
            self._buffer = self._buffer[-len(mark) :]
        return bool(received)
