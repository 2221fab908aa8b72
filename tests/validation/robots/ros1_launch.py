"""Controllers started by the real ``roslaunch``: names, namespaces, remappings, parameters, and a rest at every end.

    python tests/validation/robots/ros1_launch.py -o out/ros1

Unpacks ROS 1 into the folder as ``ros1_bus.py`` does, writes the package and the launch file that the guide shows
(docs/guides/robots.md), and starts them: once for each way of ending them. Prints a table, and exits with 1 when a line
of it failed.
"""

from __future__ import annotations

import argparse
import re
import signal
import sys
import tempfile
import time
from pathlib import Path

from _ros1 import ROOT, Rows, prepare
from _ros1_processes import Program, Programs, await_true, read_json

from vlatool.buses._ros1_master import ask
from vlatool.buses.bag import Bag
from vlatool.messages.geometry_msgs import Twist, Vector3
from vlatool.messages.ros1 import encode
from vlatool.nodes.recordings import open_recording

GUIDE = ROOT / "docs/guides/robots.md"
KEEP = """import signal, subprocess, sys
for number in (signal.SIGINT, signal.SIGTERM):
    signal.signal(number, lambda *_: None)
child = subprocess.Popen(sys.argv[2:], preexec_fn=lambda: [signal.signal(n, signal.SIG_DFL) for n in (2, 15)])
open(sys.argv[1], "w").write(str(child.wait()))
"""
"""Writes the exit code of a program to a file; it gets the signals that its group gets."""
ENDS = {"Ctrl-C": signal.SIGINT, "SIGTERM": signal.SIGTERM}
CODES = {"Ctrl-C": "130", "SIGTERM": "130", "rosnode kill": "3"}
"""roslaunch sends SIGINT to its nodes first, however it is ended itself."""


OWN = """import json
from vlatool.nodes.session import RunPlan, run_on_bus
document = run_on_bus(RunPlan("roi-tracker", bus="ros1", seconds=0.3, settle_s=0.0), on_missing=lambda topics: None)
print(json.dumps({"node": document.about.node, **document.about.topics}))
"""
"""A program of a user, which reads no word of roslaunch itself."""


def write_package(folder: Path, codes: Path) -> Path:
    """Write the package of the guide, ``my_robot``; return its launch file, which keeps the follower's exit code."""
    manifest, script, launch = re.findall(
        r"```(?:xml|sh)\n(.*?)```", GUIDE.read_text().partition("## From a launch file")[2], re.DOTALL
    )[:3]
    package = folder / "my_robot"
    (package / "scripts").mkdir(parents=True)
    (package / "package.xml").write_text(manifest)
    (package / "scripts/vlatool").write_text(
        script.replace("/home/me/venv/bin/vlatool", f"{sys.executable} -m vlatool")
    )
    (package / "scripts/vlatool").chmod(0o755)
    (folder / "keep.py").write_text(KEEP)
    keep = f'launch-prefix="{sys.executable} {folder / "keep.py"} {codes}" '
    (package / "robot.launch").write_text(launch.replace('name="follower" ', f'name="follower" {keep}'))
    return package / "robot.launch"


def try_launch(programs: Programs, end: str, rows: Rows) -> None:
    """Launch robot and follower, record them, end them, and look at what was recorded."""
    with tempfile.TemporaryDirectory() as folder:
        code = Path(folder) / "code"
        launch = write_package(Path(folder), code)
        programs.environment["ROS_PACKAGE_PATH"] += f":{folder}"
        programs.environment["ROS_LOG_DIR"] = f"{folder}/logs"
        recorder = programs.ros("rosbag", "record", "-a", "-O", Path(folder) / "run.bag")
        time.sleep(1.0)
        started = programs.ros("roslaunch", launch)
        await_true(lambda: "/robot1/follower/steps" in topics(programs), 30, "the topics of the follower")
        time.sleep(5.0)
        if end == "Ctrl-C":
            names(programs, started, rows)
        if end == "rosnode kill":
            programs.ros("rosnode", "kill", "/robot1/follower").answer()
            await_true(code.exists, 10, "the end of the follower")
        ended = started.end(ENDS.get(end, signal.SIGINT), 30)
        await_true(code.exists, 10, "the end of the follower")
        time.sleep(0.5)
        recorder.end()
        await_true((Path(folder) / "run.bag").exists, 10, "the bag, which the recorder below rosbag renames at its end")
        rows.append((f"{end}: exit codes of roslaunch and of the run", f"{ended}, {code.read_text()}",
                     not ended and code.read_text() == CODES[end]))  # fmt: skip
        about = open_recording(Path(folder) / "run.bag", "roi-follower").about
        said = f"{about.node} at {about.settings['rate']:g} Hz"
        rows.append((f"{end}: the bag says what ran", said, said == "robot1/follower at 15 Hz"))
        bag = Bag(str(Path(folder) / "run.bag"), "reader")
        commands = [one.message for one in bag.messages(["/robot1/cmd_vel"])]
        bag.close()
        moving = sum(encode(each) != encode(Twist()) for each in commands)
        rest = bool(commands) and encode(commands[-1]) == encode(Twist(Vector3(), Vector3()))
        rows.append(
            (f"{end}: the last command is a rest", f"{len(commands)} commands, {moving} moving", rest and moving)
        )
        replayed, text = programs.vlatool("replay", Path(folder) / "run.bag", "roi-follower", "--json").answer()
        document = read_json(text)
        said = f"{document.get('steps')} steps, {document.get('messages')} messages {document.get('note')}"
        rows.append(
            (f"{end}: the bag of rosbag record -a, replayed bit-equal", said, not replayed and not document["note"])
        )


def own_program(programs: Programs, rows: Rows) -> None:
    """Run a program with the words of roslaunch, which swap two topics: alone, then beside another publisher."""
    words = ("__name:=own", "__ns:=/robot1", "/cmd_vel:=roi", "/roi:=/cmd_vel")
    _, text = programs.python(OWN, *words).answer()
    document = read_json(text)
    right = (document.get("node"), document.get("cmd_vel"), document.get("roi")) == (
        "robot1/own",
        "/robot1/roi",
        "/cmd_vel",
    )
    rows.append(("own program with remappings that swap", text.strip()[:110], right))
    other = programs.python(OWN.replace("0.3", "30"), "__name:=other", "/cmd_vel:=/robot1/roi")
    await_true(lambda: "/robot1/roi" in topics(programs), 10, "another publisher")
    second = programs.python(OWN, *words)
    code, _ = second.answer()
    said = next((line for line in second.errors().splitlines() if "publisher" in line), second.errors()[-200:])
    rows.append(
        (
            "a second publisher of a remapped topic is refused",
            said[:110],
            code != 0 and "has the publisher /other" in said,
        )
    )
    other.end()


def topics(programs: Programs) -> dict[str, list[str]]:
    """Return the topics that have publishers."""
    publishers, _, _ = ask(programs.master.uri, "getSystemState", "/looker")
    return dict(publishers)


def names(programs: Programs, started: Program, rows: Rows) -> None:
    """Look at the names of nodes and topics, at the parameter, and at the log."""
    present = topics(programs)
    rows.append(("node of the launch file on the remapped topic", str(present.get("/robot1/cmd_vel")),
                 present.get("/robot1/cmd_vel") == ["/robot1/follower"]))  # fmt: skip
    robot = present.get("/roi", [])
    rows.append(("simulated robot of the launch file", str(robot), robot == ["/robot1/base"]))
    rows.append(("/cmd_vel", str(present.get("/cmd_vel", "nobody publishes it")), "/cmd_vel" not in present))
    logs = {path.resolve() for path in Path(programs.environment["ROS_LOG_DIR"]).glob("*/robot1-follower-?.log")}
    rows.append(("log of __log:=", ", ".join(path.name for path in logs), len(logs) == 1))


def main() -> None:
    """Prepare the folder, launch for each way of ending, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, default=Path("out/ros1"), help="folder for ROS 1")
    parser.add_argument("--only", nargs="+", choices=CODES, default=list(CODES), help="ways of ending them")
    given = parser.parse_args()
    folder = given.output.resolve()
    environment, rows = prepare(folder), []
    for end in given.only:
        with Programs(folder, environment, folder / "printed" / end.replace(" ", "-")) as programs:
            if end == "Ctrl-C":
                own_program(programs, rows)
            try_launch(programs, end, rows)
    for what, said, right in rows:
        print(f"{'ok  ' if right else 'FAIL'} {what:62} {said}")
    sys.exit(int(not all(right for _, _, right in rows)))


if __name__ == "__main__":
    main()
