"""The bus ``dds`` against Fast DDS 2.9.1, ROS 2's default middleware, and against itself.

    python tests/validation/robots/dds_fastdds.py

Fast DDS comes from Debian 12 (``libfastrtps-dev``), unpacked in out/robots/fastdds, without root; ``fastdds_peer.cpp``
is a node of it with type support by hand, built with g++. Exit code 1 when a trial fails, 2 when the peer cannot be
built here.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import time
from pathlib import Path

from _bus_trials import QUALITY, Row, finish, picture_to_twist, there_and_back, twists

from vlatool.buses import open_bus
from vlatool.messages.geometry_msgs import Twist

HERE = Path(__file__).parent
OUT = Path("out/robots/fastdds")
PACKAGES = [
    "libfastrtps-dev", "libfastrtps2.9", "libfastcdr-dev", "libfastcdr1", "libfoonathan-memory-dev",
    "libfoonathan-memory0.7.2", "libtinyxml2-9", "libasio-dev",
]  # fmt: skip
DOMAIN = 91
LIMIT_MS = 5.0


def libraries() -> Path:
    """Folder of the shared libraries of Debian's packages."""
    return (OUT / "root/usr/lib/x86_64-linux-gnu").absolute()


def build() -> Path:
    """Unpack Fast DDS and build the peer, once; return the program."""
    program, source = OUT / "peer", HERE / "fastdds_peer.cpp"
    if program.exists() and program.stat().st_mtime > source.stat().st_mtime:
        return program
    OUT.mkdir(parents=True, exist_ok=True)
    if not libraries().exists():
        subprocess.run(["apt-get", "download", "-qq", *PACKAGES], cwd=OUT, check=True)
        for package in OUT.glob("*.deb"):
            subprocess.run(["dpkg", "-x", package.name, "root"], cwd=OUT, check=True)
    headers = OUT / "root/usr/include"
    subprocess.run(
        ["g++", "-O1", "-std=c++17", f"-I{headers}", f"-I{headers}/x86_64-linux-gnu", str(source), "-o", str(program),
         f"-L{libraries()}", "-lfastrtps", "-lfastcdr", "-lpthread", "-Wl,--allow-shlib-undefined"],
        check=True,
    )  # fmt: skip
    return program


def trials(program: Path, count: int) -> list[Row]:
    """Run every trial and return its row."""
    rows = []
    address = f"dds:{DOMAIN}@127.0.0.1"
    environment = {**os.environ, "LD_LIBRARY_PATH": str(libraries())}
    own = [sys.executable, str(HERE / "answering_node.py"), address]
    peers = [
        ("Fast DDS 2.9.1", [str(program), str(DOMAIN)], "/to_peer", "/image", "/from_peer"),
        ("vlatool's dds", own, "/to_node", "/image_to_node", "/from_node"),
    ]  # fmt: skip
    for name, command, there, images, back in peers:
        peer = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environment)
        assert peer.stdin
        assert peer.stdout
        try:
            assert peer.stdout.readline() == b"ready\n"
            bus = open_bus(address, "trial")
            rows.append(there_and_back(f"Twist to {name} and back", bus, there, back, count))
            title = f"Image of 230 kB to {name}, Twist back"
            rows.append(picture_to_twist(title, bus, images, back, max(200, count // 5), LIMIT_MS))
            faults = [f"{fault.topic}: {fault.count} x {fault.error.message}" for fault in bus.faults()]
            rows.append(Row(f"faults counted with {name}", "; ".join(faults) or "none", not faults))
            bus.close()
        finally:
            peer.stdin.close()
            peer.wait(10)
    return rows


def malformed(program: Path, count: int) -> Row:
    """Let Fast DDS answer with Twists that end after three numbers: none may arrive, and each is a fault."""
    title = "malformed Twists from Fast DDS"
    environment = {**os.environ, "LD_LIBRARY_PATH": str(libraries())}
    peer = subprocess.Popen(
        [str(program), str(DOMAIN), "malformed"], stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environment
    )
    assert peer.stdin
    assert peer.stdout
    try:
        assert peer.stdout.readline() == b"ready\n"
        bus = open_bus(f"dds:{DOMAIN}@127.0.0.1", "trial")
        came: list[object] = []
        bus.subscribe("/from_peer", Twist, came.append, QUALITY)
        send = bus.publisher("/to_peer", Twist, QUALITY)
        bus.wait_for_peers(("/from_peer", "/to_peer"), 10.0)
        time.sleep(1.0)
        for twist in twists(count):
            send(twist)
            time.sleep(0.002)
        deadline = time.monotonic() + 5.0
        while sum(fault.count for fault in bus.faults()) < count and time.monotonic() < deadline:
            time.sleep(0.05)
        faults = {fault.topic: fault.count for fault in bus.faults()}
        bus.close()
    finally:
        peer.stdin.close()
        peer.wait(10)
    passed = faults == {"/from_peer": count} and not came
    return Row(title, f"{faults.get('/from_peer', 0)} of {count} counted as faults, {len(came)} handed on", passed)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=1000, help="Twists sent to each peer")
    count = parser.parse_args().count
    try:
        program = build()
    except (OSError, subprocess.CalledProcessError) as error:
        print(f"Fast DDS cannot be unpacked or built here: {error}", file=sys.stderr)
        return 2
    return finish("dds (cyclonedds) and its peers", [*trials(program, count), malformed(program, 200)])


if __name__ == "__main__":
    sys.exit(main())
