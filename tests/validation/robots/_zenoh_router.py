"""The router of a Zenoh bus in a process of its own, without a robot: python _zenoh_router.py zenoh:router/ENDPOINT."""

from __future__ import annotations

import sys

from vlatool.buses import open_bus


def main() -> None:
    bus = open_bus(sys.argv[1], "vlatool_router")
    print("ready", flush=True)
    sys.stdin.read()
    bus.close()


if __name__ == "__main__":
    main()
