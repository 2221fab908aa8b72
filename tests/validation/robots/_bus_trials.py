"""Messages for trials of buses, their times, and a table with the processor."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from vlatool.buses import Bus, QoS
from vlatool.buses._interface import Reception
from vlatool.messages import Message
from vlatool.messages.cdr import encode
from vlatool.messages.geometry_msgs import Twist, Vector3
from vlatool.messages.sensor_msgs import Image

QUALITY = QoS(reliable=True, depth=10)
REPLY_S = 2.0
"""How long an answer may take before it counts as lost."""


class Row(NamedTuple):
    """A line of the table: what was tried, what came of it, and whether that is enough."""

    trial: str
    result: str
    passed: bool


def twists(count: int, seed: int = 0) -> list[Twist]:
    """Twists of random numbers, the extreme ones among them."""
    random = np.random.default_rng(seed)
    values = random.standard_normal((count, 6)) * 10.0 ** random.integers(-300, 300, (count, 1))
    values[:3] = [[0.0] * 6, [np.inf, -np.inf, np.nan, -0.0, 5e-324, 1.7976931348623157e308], [1.0] * 6]
    return [Twist(Vector3(*map(float, row[:3])), Vector3(*map(float, row[3:]))) for row in values]


def picture(seed: int = 0) -> Image:
    """A picture of 320 x 240 random colours: 230,400 bytes."""
    pixels = np.random.default_rng(seed).integers(0, 256, 230_400, np.uint8)
    return Image(height=240, width=320, encoding="rgb8", step=960, data=pixels)


class Answers:
    """What comes on a topic, one message after another."""

    def __init__(self, bus: Bus, topic: str) -> None:
        self._came = threading.Condition()
        self._messages: list[Message] = []
        bus.subscribe(topic, Twist, self._take, QUALITY)

    def _take(self, reception: Reception) -> None:
        with self._came:
            self._messages.append(reception.message)
            self._came.notify()

    def after(self, act: Callable[[], None]) -> tuple[Message | None, float]:
        """Act, and return the message that comes, None when none does, and the time that it takes in seconds."""
        with self._came:
            self._messages.clear()
            started = time.perf_counter()
            act()
            self._came.wait_for(lambda: bool(self._messages), REPLY_S)
            return (self._messages[0] if self._messages else None), time.perf_counter() - started


def there_and_back(name: str, bus: Bus, there: str, back: str, count: int) -> Row:
    """Send random Twists, one after another, to a peer that sends each back; compare them byte by byte."""
    answers, send = Answers(bus, back), bus.publisher(there, Twist, QUALITY)
    without = bus.wait_for_peers((there, back), 10.0)
    if without:
        return Row(name, f"no peer on {', '.join(without)}", False)
    time.sleep(1.0)  # the other end has discovered this one, too
    equal = 0
    for twist in twists(count):
        came, _ = answers.after(lambda twist=twist: send(twist))
        equal += came is not None and encode(came) == encode(twist)
    return Row(name, f"{equal} of {count} byte-equal", equal == count)


def picture_to_twist(name: str, bus: Bus, there: str, back: str, count: int, limit_ms: float) -> Row:
    """Send pictures, one after another, to a peer that answers each with a Twist; return the median of the time."""
    answers, send = Answers(bus, back), bus.publisher(there, Image, QUALITY)
    bus.wait_for_peers((there, back), 10.0)
    time.sleep(1.0)
    image, times = picture(), []
    for _ in range(count):
        came, took_s = answers.after(lambda: send(image))
        times.append(took_s * 1e3 if came is not None else np.inf)
    median, tail = np.percentile(times[count // 10 :], [50, 99])
    lost = int(np.isinf(times).sum())
    result = f"p50 {median:.2f} ms, p99 {tail:.2f} ms, limit {limit_ms:g} ms; {lost} of {count} lost"
    return Row(name, result, bool(median <= limit_ms) and not lost)


def processor() -> str:
    """Name of the processor and its number of cores."""
    lines = Path("/proc/cpuinfo").read_text().splitlines()
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return f"{models[0] if models else 'unknown processor'}, {len(lines and models) or 1} cores"


def finish(title: str, rows: list[Row]) -> int:
    """Print the table; return the exit code: 0 when every trial passed."""
    width = max(len(row.trial) for row in rows)
    print(f"{title}\n{processor()}")
    for row in rows:
        print(f"  {row.trial:<{width}}  {'pass' if row.passed else 'FAIL'}  {row.result}")
    return 0 if all(row.passed for row in rows) else 1
