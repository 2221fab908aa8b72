"""The text format of Prometheus, in a file and over HTTP on this machine."""

from __future__ import annotations

import socket
import urllib.error
import urllib.request
from pathlib import Path

import pytest
from _records import record

from vlatool.errors import UsageError
from vlatool.runtime.telemetry.health import Health, Timeout
from vlatool.runtime.telemetry.prometheus import Prometheus


def samples(text: str) -> dict[str, float]:
    """Read the text as Prometheus does: comments apart, one sample in a line, each name described before."""
    found, described = {}, set()
    for line in text.splitlines():
        if line.startswith("# TYPE "):
            described.add(line.split()[2])
        if not line.startswith("#"):
            name, _, value = line.rpartition(" ")
            family = name.partition("{")[0]
            assert family in described or family.rsplit("_", 1)[0] in described
            assert name not in found
            found[name] = float(value)
    assert text.endswith("\n")
    return found


def test_numbers_are_in_the_file(tmp_path: Path):
    now = [0.0]
    health = Health({"camera": Timeout(0.2, 1.0)}, clock=lambda: now[0])
    sink = Prometheus(tmp_path / "run.prom", health=health, clock=lambda: now[0], every_s=5)
    sink(record(0, error='Odd"\\\nError: x', missed=True))
    sink.flush()
    found = samples((tmp_path / "run.prom").read_text())
    assert (found["vlatool_steps_total"], found["vlatool_misses_total"]) == (1, 1)
    assert found['vlatool_source_total{source="policy"}'] == 1
    assert found['vlatool_error_total{error="Odd\\"\\\\\\nError"}'] == 1
    assert found['vlatool_health{component="camera"}'] == 0
    assert found['vlatool_seconds_count{part="answer"}'] == 1
    assert found['vlatool_seconds_sum{part="answer"}'] == pytest.approx(0.002)
    buckets = [value for name, value in found.items() if name.startswith('vlatool_seconds_bucket{part="answer"')]
    assert buckets == sorted(buckets)
    assert buckets[-1] == 1
    sink(record(1))
    now[0] = 3.0
    sink.flush()
    assert samples((tmp_path / "run.prom").read_text())["vlatool_steps_total"] == 1, "it is not time yet"
    sink.close()
    found = samples((tmp_path / "run.prom").read_text())
    assert (found["vlatool_steps_total"], found['vlatool_health{component="camera"}']) == (2, 2)
    assert [file.name for file in tmp_path.iterdir()] == ["run.prom"]


def test_numbers_are_served_on_this_machine_alone():
    sink = Prometheus(port=0)
    sink(record(0))
    address = f"http://127.0.0.1:{sink.port}"
    with urllib.request.urlopen(f"{address}/metrics", timeout=10) as answer:
        assert answer.headers["Content-Type"].startswith("text/plain; version=0.0.4")
        assert samples(answer.read().decode())["vlatool_steps_total"] == 1
    with pytest.raises(urllib.error.HTTPError, match="404"):
        urllib.request.urlopen(f"{address}/secret", timeout=10)
    with socket.create_connection(("127.0.0.1", sink.port), 10) as rude:
        rude.sendall(b"\x00\xff" * 100 + b"\r\n\r\n")
        assert b"400" in rude.recv(4096)
    with urllib.request.urlopen(f"{address}/metrics", timeout=10) as answer:
        assert answer.status == 200
    sink.close()
    with pytest.raises(OSError, match="refused"):
        socket.create_connection(("127.0.0.1", sink.port), 10)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [({}, "neither a file nor a port"), ({"port": -1}, "port is -1"), ({"port": 70000}, "port is 70000"),
     ({"path": "x", "every_s": 0}, "every_s is 0")],
)  # fmt: skip
def test_a_sink_without_an_outlet_is_refused(wrong: dict[str, object], message: str):
    with pytest.raises(UsageError, match=message):
        Prometheus(**wrong)  # type: ignore[arg-type]
