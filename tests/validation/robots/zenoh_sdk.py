"""The bus ``zenoh`` against zenoh-ros2-sdk 0.1.8, another implementation of rmw_zenoh's wire, and against itself.

    python tests/validation/robots/zenoh_sdk.py

The sdk is installed in out/robots/zenoh-sdk, in an environment of its own; its node gets the definition and the
hash of the type from rosbags. Exit code 1 when a trial fails, 2 when the sdk cannot be installed here.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import venv
from pathlib import Path
from typing import Any, cast

from _bus_trials import Row, finish, picture_to_twist, there_and_back

from vlatool.buses import open_bus
from vlatool.messages.geometry_msgs import Twist
from vlatool.messages.std_srvs import SetBoolRequest, SetBoolResponse
from vlatool.messages.type_hash import rihs01, service_rihs01

HERE = Path(__file__).parent
OUT = Path("out/robots/zenoh-sdk")
BESIDE = ["eclipse-zenoh==1.10.2", "json5", "GitPython", "tqdm", "rosbags", "numpy"]
PORT = 17447
LIMIT_MS = 1.0


def install() -> Path:
    """Install the sdk, once; return its Python."""
    python = OUT / "venv/bin/python"
    if (
        subprocess.run([str(python), "-c", "import zenoh_ros2_sdk"], capture_output=True).returncode
        if python.exists()
        else 1
    ):
        venv.create(OUT / "venv", with_pip=True, clear=True)
        pip = [str(python), "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
        subprocess.run([*pip, "--no-deps", "zenoh-ros2-sdk==0.1.8"], check=True)
        subprocess.run([*pip, *BESIDE], check=True)
    return python


def sdk_trials(python: Path, count: int) -> list[Row]:
    """Twists there and back, what each side lists of the other, and hashes."""
    bus = open_bus(f"zenoh:router/tcp/127.0.0.1:{PORT}", "trial")
    bus.serve(
        "/vlatool_set", SetBoolRequest, SetBoolResponse, lambda ask: SetBoolResponse(cast(Any, ask).data, "by vlatool")
    )
    peer = subprocess.Popen(
        [str(python), str(HERE / "zenoh_sdk_peer.py"), str(PORT), service_rihs01(SetBoolRequest, SetBoolResponse)],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert peer.stdin
    assert peer.stdout
    try:
        ready, _, its_hash = peer.stdout.readline().strip().partition(" ")
        assert ready == "ready"
        rows = [Row("RIHS01 hash of Twist is that of rosbags", its_hash[:23] + "...", its_hash == rihs01(Twist))]
        rows.append(there_and_back("Twist to zenoh-ros2-sdk and back", bus, "/to_peer", "/from_peer", count))
        for topic in ("/to_peer", "/from_peer"):
            peer.stdin.write(f"{topic}\n")
            peer.stdin.flush()
            seen = sorted(node for node, *_ in json.loads(peer.stdout.readline()))
            rows.append(Row(f"nodes that the sdk lists on {topic}", ", ".join(seen), seen == ["sdk_node", "trial"]))
        answers = [bus.call("/sdk_set", SetBoolRequest(bool(n % 2)), SetBoolResponse, 5.0) for n in range(100)]
        right = sum((one.success, one.message) == (bool(n % 2), "by the sdk") for n, one in enumerate(answers))
        rows.append(Row("SetBool of the sdk, called by vlatool", f"{right} of 100", right == 100))
        peer.stdin.write("call 100\n")
        peer.stdin.flush()
        right = int(peer.stdout.readline())
        rows.append(Row("SetBool of vlatool, called by the sdk", f"{right} of 100", right == 100))
        ours = {info.topic: info for info in bus.topics()}
        nodes = [*ours["/to_peer"].subscribers, *ours["/from_peer"].publishers]
        rows.append(Row("nodes that vlatool lists", ", ".join(nodes), nodes == ["sdk_node", "sdk_node"]))
        rows.append(Row("faults counted", str(len(bus.faults())), not bus.faults()))
    finally:
        peer.stdin.close()
        peer.terminate()
        peer.wait(10)
        bus.close()
    return rows


def own_trials(count: int) -> list[Row]:
    """A node of vlatool in another process: Twists there and back, and latency."""
    bus = open_bus(f"zenoh:router/tcp/127.0.0.1:{PORT}", "trial")
    command = [sys.executable, str(HERE / "answering_node.py"), f"zenoh:tcp/127.0.0.1:{PORT}"]
    peer = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    assert peer.stdin
    assert peer.stdout
    try:
        assert peer.stdout.readline() == b"ready\n"
        rows = [there_and_back("Twist to vlatool's zenoh and back", bus, "/to_node", "/from_node", count)]
        title = "Image of 230 kB to vlatool's zenoh, Twist back"
        rows.append(picture_to_twist(title, bus, "/image_to_node", "/from_node", max(200, count // 5), LIMIT_MS))
    finally:
        peer.stdin.close()
        peer.wait(10)
        bus.close()
    return rows


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=1000, help="Twists sent to each peer")
    count = parser.parse_args().count
    try:
        python = install()
    except (OSError, subprocess.CalledProcessError) as error:
        print(f"zenoh-ros2-sdk cannot be installed here: {error}", file=sys.stderr)
        return 2
    return finish("zenoh and its peers", [*sdk_trials(python, count), *own_trials(count)])


if __name__ == "__main__":
    sys.exit(main())
