"""Malformed bytes as messages of every type: each gives a message or BusError, in memory that the bytes bound.

    python tests/validation/soak/messages_fuzz.py --mutants 1000000
    python tests/validation/soak/messages_fuzz.py --mutants 0 --times

Random messages of every type, in CDR of both byte orders and in ROS 1's encoding, are cut, extended and changed in
bits, bytes and lengths (2^31 and others) as in ``tests/_malformed.py``. What is accepted is encoded and decoded again,
and must be the same message. The process may take 512 MB more than at its start; more is a MemoryError, which counts as
a crash. Prints how many were accepted and refused, and the memory; with ``--times``, the processor time of messages
that are encoded and decoded, the least of 15 rounds. Exit code 1 after a crash.
"""

from __future__ import annotations

import argparse
import resource
import sys
import time
import timeit
import traceback
import zlib
from collections import Counter
from functools import partial
from pathlib import Path
from types import ModuleType

sys.path.insert(0, str(Path(__file__).parents[2]))

import numpy as np
from _malformed import malformed
from _messages import Drawer, as_rosbags, in_ros1, ros2_store

from vlatool.errors import BusError
from vlatool.messages import Message, all_types, cdr, ros1, same
from vlatool.messages.geometry_msgs import Twist, Vector3
from vlatool.messages.sensor_msgs import Image

ALLOWANCE = 512 << 20
"""Bytes of address space beyond those at the start."""
SEEDS = 12
"""Messages of each type that are damaged."""


def trial(codec: ModuleType, cls: type[Message], encoded: bytes) -> str:
    """Return what became of malformed bytes; raises what the codec must not."""
    try:
        message = codec.decode(cls, encoded)
    except BusError as error:
        if cls.TYPE not in error.message and "malformed" not in error.message:
            raise AssertionError(f"an error that does not name the type: {error}") from error
        return "refused"
    if not same(codec.decode(cls, codec.encode(message)), message):
        raise AssertionError("a message that differs after it was encoded")
    return "accepted"


def run(mutants: int, seed: int) -> Counter[str]:
    """Damage messages of all types, and return how often each outcome came."""
    kinds = [(codec, cls) for cls in all_types() for codec in (cdr, ros1) if codec is cdr or in_ros1(cls)]
    store, outcomes = ros2_store(), Counter[str]()
    for number, (codec, cls) in enumerate(kinds):
        drawer = Drawer(seed)
        messages = [drawer.message(cls) for _ in range(SEEDS)]
        frames = [codec.encode(message) for message in messages]
        if codec is cdr:
            frames += [
                bytes(store.serialize_cdr(as_rosbags(m, store), cls.TYPE, little_endian=False)) for m in messages
            ]
        count = mutants * (number + 1) // len(kinds) - mutants * number // len(kinds)
        for encoded in malformed(frames, count, zlib.crc32(f"{seed} {codec.__name__} {cls.TYPE}".encode())):
            try:
                outcomes[trial(codec, cls, encoded)] += 1
            except Exception:
                outcomes["crashed"] += 1
                print(f"{codec.__name__} {cls.TYPE} {encoded.hex()}\n{traceback.format_exc()}", flush=True)
    return outcomes


def times() -> None:
    """Print the processor time of a Twist and of an Image of 320 x 240, in microseconds."""
    pixels = np.zeros(240 * 320 * 3, np.uint8)
    image = Image(height=240, width=320, encoding="rgb8", step=960, data=pixels)
    for message in (Twist(linear=Vector3(1.0, 2.0, 3.0)), image):
        for codec in (cdr, ros1):
            calls = {
                "encode": partial(codec.encode, message),
                "encode_parts": partial(codec.encode_parts, message),
                "decode": partial(codec.decode, type(message), codec.encode(message)),
            }
            least = {key: min(timeit.repeat(call, number=1000, repeat=15, timer=time.process_time))
                     for key, call in calls.items()}  # fmt: skip
            measured = ", ".join(f"{key} {1000 * seconds:.1f} us" for key, seconds in least.items())
            print(f"{message.TYPE} {codec.__name__.rpartition('.')[2]}: {measured}")


def main(arguments: list[str] | None = None) -> int:
    """Run the trials."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--mutants", type=int, default=1_000_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--times", action="store_true")
    chosen = parser.parse_args(arguments)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + ALLOWANCE, resource.getrlimit(resource.RLIMIT_AS)[1]))
    before, start = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.process_time()
    outcomes = run(chosen.mutants, chosen.seed)
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    print(f"{sum(outcomes.values()):,} mutants of {len(all_types())} types: {dict(sorted(outcomes.items()))}; "
          f"{grown / 1024:.1f} MB more memory; {time.process_time() - start:.0f} s of processor time")  # fmt: skip
    if chosen.times:
        times()
    return int(outcomes["crashed"] > 0)


if __name__ == "__main__":
    sys.exit(main())
