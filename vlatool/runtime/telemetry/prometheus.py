"""The numbers of a run in the text format of Prometheus: in a file for node_exporter, or over HTTP on this machine.

Format: https://prometheus.io/docs/instrumenting/exposition_formats/ (text, version 0.0.4).
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from vlatool.errors import UsageError
from vlatool.runtime.arguments import check_positive, check_whole
from vlatool.runtime.telemetry.health import Health
from vlatool.runtime.telemetry.metrics import Metrics

CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"
LOOPBACK = "127.0.0.1"
LINES_AT_ONCE = 16
"""Lines of text after which a control step may have Python's lock."""
QUIET_S = 5.0
"""Seconds after which a client that says nothing is dropped."""


class Prometheus:
    """A sink that exposes the numbers of a run.

    Args:
        path: File that is replaced as a whole, in the directory of node_exporter's textfile collector (``.prom``).
        port: Port of an HTTP server on the loopback address, 0 for any free one; no server when None.
        every_s: Shortest time between two files, in seconds.
        health: Whose levels are told, too.
        clock: Returns seconds.

    Raises:
        UsageError: when neither a file nor a port is given, or a number is out of its range.
        OSError: when the port is taken.
    """

    def __init__(
        self,
        path: str | os.PathLike[str] | None = None,
        *,
        port: int | None = None,
        every_s: float = 1.0,
        health: Health | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        check_whole("port", port, 0, 65535, optional=True)
        check_positive("every_s", every_s, "a number of seconds")
        if path is None and port is None:
            raise UsageError("Prometheus gets neither a file nor a port.", 'pass Prometheus("run.prom") or port=9464')
        self.metrics, self._health, self._clock, self._every_s = Metrics(), health, clock, every_s
        self.path = None if path is None else Path(path)
        self._due = clock()
        self._server = None if port is None else _serve(self.text, port)
        self.port = None if self._server is None else self._server.server_address[1]
        """Port of the server."""

    def __call__(self, record: Any) -> None:
        """Count a record."""
        self.metrics(record)

    def text(self) -> str:
        """Return all numbers as text."""
        lines: list[str] = []
        with self.metrics.lock:
            for line in exposition(self.metrics, self._health):
                lines.append(line)
                if not len(lines) % LINES_AT_ONCE:
                    time.sleep(0)  # lets a control step have Python's lock
        return "\n".join([*lines, ""])

    def flush(self) -> None:
        """Replace the file, if it is time; raises OSError where that is not possible."""
        if self.path is not None and self._clock() >= self._due:
            self._due = self._clock() + self._every_s
            self._replace()

    def _replace(self) -> None:
        draft = self.path.with_name(f".{self.path.name}.part")  # type: ignore[union-attr]
        draft.write_text(self.text())
        os.replace(draft, self.path)  # type: ignore[arg-type]

    def close(self) -> None:
        """Write the file a last time, and end the server."""
        if self._server is not None:
            self._server.shutdown()
            self._server.server_close()
        if self.path is not None:
            self._replace()


def exposition(metrics: Metrics, health: Health | None = None) -> Iterator[str]:
    """Return the lines of the text format: counters, histograms in seconds, gauges."""
    yield from _single("vlatool_steps_total", "counter", "Control steps.", metrics.steps)
    yield from _single("vlatool_misses_total", "counter", "Control steps without an action of the policy.",
                       metrics.misses)  # fmt: skip
    yield from _single("vlatool_fallback_level", "gauge", "Rung that the fallback stands on; 0 is the policy.",
                       metrics.level)  # fmt: skip
    yield from _single("vlatool_time_drift", "gauge", "Median answer time now by that at first.", metrics.time_drift)
    yield from _single("vlatool_action_drift", "gauge", "Shift of the actions in standard deviations of the run.",
                       metrics.action_drift)  # fmt: skip
    for kind, what in (("source", "where the action came from"), ("check", "check that altered the action"),
                       ("error", "why the policy had no action"), ("alarm", "anomaly monitor")):  # fmt: skip
        name = f"vlatool_{kind}_total"
        yield from _head(name, "counter", f"Control steps by {what}.")
        for reason, count in sorted(metrics.counts[kind].items()):
            yield f'{name}{{{kind}="{_escaped(reason)}"}} {count}'
    yield from _times(metrics)
    if health is not None:
        yield from _head("vlatool_health", "gauge", "0 works, 1 is degraded, 2 has failed.")
        for component, (level, _) in sorted(health.levels().items()):
            yield f'vlatool_health{{component="{_escaped(component)}"}} {int(level)}'


def _times(metrics: Metrics) -> Iterator[str]:
    name = "vlatool_seconds"
    yield from _head(name, "histogram", "Time of a part of a control step.")
    for part, times in metrics.times.items():
        if not times.count:
            continue
        label = f'part="{_escaped(part)}"'
        for edge, count in times.cumulative():
            yield f'{name}_bucket{{{label},le="{edge / 1e3:.6g}"}} {count}'
        yield f'{name}_bucket{{{label},le="+Inf"}} {times.count}'
        yield f"{name}_sum{{{label}}} {times.sum_ms / 1e3!r}"
        yield f"{name}_count{{{label}}} {times.count}"


def _single(name: str, kind: str, what: str, value: float) -> Iterator[str]:
    yield from _head(name, kind, what)
    yield f"{name} {value!r}"


def _head(name: str, kind: str, what: str) -> Iterator[str]:
    yield f"# HELP {name} {what}"
    yield f"# TYPE {name} {kind}"


def _escaped(text: str) -> str:
    return text.replace("\\", r"\\").replace('"', r"\"").replace("\n", r"\n")


def _serve(text: Callable[[], str], port: int) -> Any:
    """Return a server on the loopback address that answers ``GET /metrics``, in a thread."""
    from http.server import BaseHTTPRequestHandler, HTTPServer  # 20 ms, for who wants it

    class Handler(BaseHTTPRequestHandler):
        timeout = QUIET_S

        def do_GET(self) -> None:
            known = self.path.partition("?")[0] == "/metrics"
            content = text().encode() if known else b"see /metrics\n"
            self.send_response(200 if known else 404)
            self.send_header("Content-Type", CONTENT_TYPE)
            self.send_header("Content-Length", str(len(content)))
            self.end_headers()
            self.wfile.write(content)

        def log_message(self, format: str, *values: Any) -> None:
            """Say nothing."""

    server = HTTPServer((LOOPBACK, port), Handler)
    threading.Thread(target=server.serve_forever, args=(0.2,), name="vlatool-prometheus", daemon=True).start()
    return server
