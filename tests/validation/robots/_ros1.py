"""ROS 1 from Debian's packages, unpacked into a folder: nothing is installed into the system."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import sysconfig
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

DEBS = """
catkin rospy rosmaster rosbag roslaunch rosgraph rosgraph-msgs roslib roslz4 rosparam rosclean roscpp-msg genmsg genpy
std-msgs std-srvs geometry-msgs sensor-msgs nav-msgs actionlib actionlib-msgs rosservice rostopic rosnode rosmsg
diagnostic-msgs trajectory-msgs visualization-msgs tf2-msgs
""".split()  # noqa: SIM905
LIBRARIES = """
libament-index-cpp0d libapr1 libaprutil1 libb64-0d libboost-chrono1.74.0 libboost-filesystem1.74.0
libboost-program-options1.74.0 libboost-regex1.74.0 libboost-system1.74.0 libboost-thread1.74.0 libclass-loader3d
libconsole-bridge1.0 libcpp-common0d libgpgme11 liblog4cxx15 librcpputils1d librcutils1d librosbag-storage4d librosbag4d
librosconsole3d libroscpp-serialization0d libroscpp4d libroslib0d libroslz4-1d librospack0d librostime1d libtinyxml2-9
libtopic-tools2d libxmlrpcpp3d rosout
""".split()  # noqa: SIM905
"""What ``rosbag record``, ``rosbag play`` and ``rosout`` need, which are nodes of roscpp."""
PIP = ("pyyaml", "rospkg", "catkin_pkg", "netifaces", "defusedxml", "pycryptodomex", "python-gnupg")
MODULES = "usr/lib/python3/dist-packages"
HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[2]
Rows = list[tuple[str, str, bool]]
"""What was tried, what came of it, and whether that is right."""


def prepare(folder: Path) -> dict[str, str]:
    """Unpack ROS 1 into a folder unless it is there, and return the environment in which Python imports it."""
    root, site, debs = folder / "root", folder / "site", folder / "debs"
    for names, sign in (([f"python3-{name}" for name in DEBS], root / MODULES / "rospy"),
                        (LIBRARIES, root / "usr/lib/rosout/rosout")):  # fmt: skip
        if not sign.exists():
            debs.mkdir(parents=True, exist_ok=True)
            subprocess.run(["apt-get", "download", "-q", *names], cwd=debs, check=True, stdout=subprocess.DEVNULL)
            for package in sorted(debs.glob("*.deb")):
                subprocess.run(["dpkg", "-x", package, root], check=True)
    plugins = "librosbag_default_encryption_plugins.so"
    if not (root / "usr/lib" / plugins).exists():  # Debian's own place is searched in /usr alone
        (root / "usr/lib" / plugins).symlink_to(libraries(folder) / "ros" / plugins)
    (root / "usr/.catkin").touch()  # as Debian's package catkin has it: programs below usr/lib are found
    if not (site / "rospkg").is_dir():
        pip = [sys.executable, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--target", site, *PIP]
        subprocess.run(pip, check=True)
    return environment(folder)


def is_prepared(folder: Path) -> bool:
    """Return whether ROS 1 is in a folder."""
    return (folder / "root/usr/lib/rosout/rosout").exists() and (folder / "site/rospkg").is_dir()


def libraries(folder: Path) -> Path:
    """Return where the libraries of C++ are."""
    return folder / "root/usr/lib" / (sysconfig.get_config_var("MULTIARCH") or "")


def environment(folder: Path) -> dict[str, str]:
    """Return the environment in which Python imports what is unpacked in a folder, and its programs run."""
    root, site = folder / "root", folder / "site"
    paths = [str(path) for path in (ROOT, root / MODULES, site)]
    kept = {name: value for name, value in os.environ.items() if not name.startswith("ROS_")}
    return kept | {
        "PYTHONPATH": os.pathsep.join(paths), "ROS_LOG_DIR": str(folder / "logs"),
        "ROS_HOME": str(folder / "home"), "PYTHONWARNINGS": "ignore", "ROS_ROOT": str(root / "usr/share/ros"),
        "ROS_PYTHON_LOG_CONFIG_FILE": str(root / "etc/ros/python_logging.conf"),
        "PATH": os.pathsep.join([str(root / "usr/bin"), str(site / "bin"), kept.get("PATH", "")]),
        "LD_LIBRARY_PATH": str(libraries(folder)),
        "ROS_PACKAGE_PATH": str(root / "usr/share"), "CMAKE_PREFIX_PATH": str(root / "usr"),
    }  # fmt: skip


def free_port() -> int:
    """Return a port on which nobody listens."""
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        port: int = listener.getsockname()[1]
    return port


def hear_interrupts() -> None:
    """Let a child end at SIGINT, which a script in the background of a shell ignores, and its children with it."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


class Master:
    """A ROS 1 master in a process of its own."""

    def __init__(self, folder: Path, environment: dict[str, str], port: int = 0) -> None:
        self.port = port or free_port()
        self.uri = f"http://127.0.0.1:{self.port}"
        script = folder / "root/usr/bin/rosmaster"
        self._process = subprocess.Popen(
            [sys.executable, script, "--core", "-p", str(self.port)], env=environment, stdout=subprocess.DEVNULL
        )
        for _ in range(1200):
            with socket.socket() as attempt:
                if attempt.connect_ex(("127.0.0.1", self.port)) == 0:
                    return
            time.sleep(0.05)
        raise SystemExit("rosmaster did not start within 60 s")

    def kill(self) -> None:
        """End it as a crash does."""
        self._process.send_signal(signal.SIGKILL)
        self._process.wait()


class Peer:
    """A process with a node of rospy; a context."""

    def __init__(self, *arguments: object) -> None:
        command = [sys.executable, str(HERE / "_rospy_peer.py"), *map(str, arguments)]
        environment = {**os.environ, "ROS_IP": "127.0.0.1"}
        self._process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment)

    def read(self) -> Any:
        """Return the next line that it says."""
        assert self._process.stdout is not None
        for line in self._process.stdout:
            with contextlib.suppress(ValueError):
                return json.loads(line)
        raise SystemExit("a peer ended without a word")

    def __enter__(self) -> Peer:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.wait()


def refused(rows: Rows, what: str, kind: type[Exception], word: str, attempt: Callable[[], object]) -> None:
    """Add a line: whether an attempt ended in an error with a word within 4 s."""
    began = time.monotonic()
    try:
        attempt()
        said = "nothing was raised"
    except kind as error:
        said = str(error).partition("\n")[0]
    seconds = time.monotonic() - began
    rows.append((f"{what}: {kind.__name__} in {seconds:.1f} s", said, word in said and seconds < 4))
