"""A policy on another machine behind a bad network: each step in time, and never an action for another observation.

    python tests/validation/serving/network_faults.py --steps 10000

Between a ``RemotePolicy`` with a deadline and the openpi server of ``vlatool serve``, a proxy delays bytes by 0 to 4
times the deadline, holds them back for longer than the client waits, cuts connections in the middle of a frame, and
refuses new ones. Each action says which observation it answers.
"""

from __future__ import annotations

import argparse
import contextlib
import random
import socket
import sys
import threading
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[2]))
from _episodes_policy import CountingPolicy

from vlatool.errors import DeadlineMissed
from vlatool.runtime.control.deadline import Deadline
from vlatool.runtime.remote_policy import RemotePolicy
from vlatool.serving import Access, Service
from vlatool.serving.openpi import OpenpiServer

DEADLINE_MS, ANSWER_S = 40.0, 0.25


class Proxy:
    """Passes bytes on between a client and a server, badly once ``faults`` is true."""

    def __init__(self, port: int, seed: int) -> None:
        self._target, self._draw, self.faults = port, random.Random(seed), False
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = self._listener.getsockname()[1]
        self.events: Counter[str] = Counter()
        threading.Thread(target=self._accept, daemon=True).start()

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                client, _ = self._listener.accept()
                if self.faults and self._draw.random() < 0.2:
                    self.events["refused"] += 1
                    client.close()
                    continue
                try:
                    server = socket.create_connection(("127.0.0.1", self._target))
                except OSError:
                    client.close()
                    raise
                threading.Thread(target=self._carry, args=(client, server), daemon=True).start()

    def _carry(self, client: socket.socket, server: socket.socket) -> None:
        """Pass bytes in both directions until both have ended, then close both ends."""
        with client, server:
            back = threading.Thread(target=self._pass, args=(server, client), daemon=True)
            back.start()
            self._pass(client, server)
            back.join()

    def _pass(self, source: socket.socket, target: socket.socket) -> None:
        with contextlib.suppress(OSError):
            while content := source.recv(65536):
                event = (
                    self._draw.choices(("passed", "delayed", "held", "cut"), (70, 24, 3, 3))[0] if self.faults else ""
                )
                self.events[event] += 1
                if event == "delayed":
                    time.sleep(self._draw.uniform(0, 4) * DEADLINE_MS / 1e3)
                elif event == "held":
                    time.sleep(2 * ANSWER_S)
                target.sendall(content[: len(content) // 2] if event == "cut" else content)
                if event == "cut":
                    break
        for end in (source, target):
            with contextlib.suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        """Take no more connections."""
        self._listener.close()


def trial(steps: int, seed: int = 0) -> dict[str, Any]:
    """Ask for an action at each step; returns what came of them."""
    server = OpenpiServer(Service(CountingPolicy(), clients=64), Access(), 0)
    server.start()
    proxy = Proxy(server.port, seed)
    remote = RemotePolicy(f"ws://127.0.0.1:{proxy.port}", connect_s=0.2, answer_s=ANSWER_S)
    limited = Deadline(remote, DEADLINE_MS)
    outcomes: Counter[str] = Counter()
    times = []
    proxy.faults = True
    for step in range(steps):
        began = time.monotonic()
        try:
            chunk = limited.infer({"t": step % 1000}).chunk
            outcomes["right" if int(chunk[0, 0]) // 100 == step % 1000 else "of another observation"] += 1
        except DeadlineMissed:
            outcomes["not in time"] += 1
        except Exception as error:
            outcomes[type(error).__name__] += 1
        times.append((time.monotonic() - began) * 1e3)
        time.sleep(0.01)  # a robot has a rate, too
    limited.close()
    remote.close()
    proxy.close()
    server.close()
    times.sort()
    times_ms = {"p50": round(times[len(times) // 2], 3), "longest": round(times[-1], 1)}
    wrong = {"of another observation": outcomes["of another observation"]}
    return {"steps": steps, **outcomes, **wrong, "network": dict(proxy.events), "ms": times_ms}


def main(words: Sequence[str] | None = None) -> None:
    """Run a trial."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args(words)
    print(trial(given.steps, given.seed))


if __name__ == "__main__":
    main()
