"""What roslaunch and ros2 launch add to the command line of a node."""

from __future__ import annotations

import pytest

from vlatool.buses import RosWords, launch_parameters, open_bus, refuse_words_of_another, split_ros_words
from vlatool.errors import DataError, UsageError

ROSLAUNCH = ["/cmd_vel:=cmd_vel", "scan:=/front/scan", "_rate:=5", "__name:=left", "__log:=/tmp/left-1.log"]


def words_of(*words: str) -> RosWords:
    _, found = split_ros_words(words)
    assert found is not None
    return found


def test_words_of_roslaunch_are_taken_out_wherever_they_stand() -> None:
    ours = ["run", "vln", "--bus", "ros1", "--instruction", "go: left = no", "--map", "scan=/a"]
    others, words = split_ros_words([*ours[:2], *ROSLAUNCH, *ours[2:]])
    assert others == ours
    assert words is not None
    assert (words.dialect, words.typed) == ("ros1", tuple(ROSLAUNCH))
    assert words.topics() == [("/cmd_vel", "cmd_vel"), ("scan", "/front/scan")]
    assert (words.name_for("vlatool_vln"), words.special("log")) == ("left", "/tmp/left-1.log")
    assert words.parameters_for("vlatool_vln") == {"rate": 5}
    assert words.for_library() == [word for word in ROSLAUNCH if not word.startswith("_rate")]
    assert words.without_topics().for_library() == ROSLAUNCH[-2:]
    assert split_ros_words(ours) == (ours, None)


@pytest.mark.parametrize(
    ("text", "value"), [("0.5", 0.5), ("true", True), ("[1, 2]", [1, 2]), ("far", "far"), ("", None), ("'7'", "7")]
)
def test_values_of_parameters_are_yaml(text: str, value: object) -> None:
    assert words_of(f"_x:={text}").parameters_for("n") == {"x": value}
    assert words_of("--ros-args", "-p", f"x:={text}").parameters_for("n") == {"x": value}


def test_the_namespace_is_that_of_the_word_or_of_the_launch_file(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("ROS_NAMESPACE", raising=False)
    assert words_of("__name:=a").full_name_for("n") == "/a"
    assert words_of("__ns:=robot1/").full_name_for("n") == "/robot1/n"
    monkeypatch.setenv("ROS_NAMESPACE", "/robot2")
    assert words_of("__name:=a").full_name_for("n") == "/robot2/a"
    assert words_of("__ns:=/robot1", "__name:=a").full_name_for("n") == "/robot1/a"
    assert words_of("--ros-args", "-r", "__node:=a").full_name_for("n") == "/a"


def test_words_behind_ros_args_are_those_of_ros_2() -> None:
    arguments = ["run", "--ros-args", "-r", "__node:=left", "--remap", "scan:=/a", "-p", "rate:=5", "--", "--bus", "b",
                 "--ros-args", "--remap=__ns:=/robot1", "-p", "n:turn:=0.5", "-p", "other:x:=1", "--log-level", "debug",
                 "-p", "use_sim_time:=true", "--disable-stdout-logs", "-r", "rostopic://depth:=d"]  # fmt: skip
    others, words = split_ros_words(arguments)
    assert others == ["run", "--bus", "b"]
    assert words is not None
    assert words.topics() == [("scan", "/a"), ("depth", "d")]
    assert words.full_name_for("n") == "/robot1/left"
    assert words.parameters_for("n") == {"rate": 5, "turn": 0.5}
    assert words.for_library() == [word for word in arguments if word not in ("run", "--bus", "b")]
    assert words.without_topics().for_library() == ["--ros-args", "-r", "__node:=left", "-r", "__ns:=/robot1"]


def test_files_of_parameters_as_ros2_launch_writes_them(tmp_path) -> None:
    (tmp_path / "a.yaml").write_text(
        "/**: {ros__parameters: {rate: 5, use_sim_time: true, qos_overrides./tf.depth: 3}}\n"
        "robot1: {left: {ros__parameters: {turn: 1}}, right: {ros__parameters: {turn: 2}}}\n"
    )
    (tmp_path / "b.yaml").write_text("/*/left: {ros__parameters: {turn: 4}}\n/left: {ros__parameters: {rate: 9}}\n")
    words = words_of("--ros-args", "-r", "__ns:=/robot1", "-r", "__node:=left", "--params-file",
                     str(tmp_path / "a.yaml"), "--params-file", str(tmp_path / "b.yaml"))  # fmt: skip
    assert words.parameters_for("n") == {"rate": 5, "turn": 4}


@pytest.mark.parametrize("content", ["a: [", "rate: 5", "- 1", "a: {ros__parameters: 3}", "a: {}"])
def test_files_of_parameters_that_are_none(tmp_path, content: str) -> None:
    (tmp_path / "a.yaml").write_text(content)
    with pytest.raises(
        DataError, match=r"The file of parameters .*a\.yaml (is not valid YAML|has no 'ros__parameters')"
    ):
        words_of("--ros-args", "--params-file", str(tmp_path / "a.yaml")).parameters_for("n")
    with pytest.raises(DataError, match="cannot be read"):
        words_of("--ros-args", "--params-file", str(tmp_path / "absent")).parameters_for("n")


@pytest.mark.parametrize(
    ("typed", "words"),
    [
        (["__nmae:=a"], "ROS 1 has no argument '__nmae'; did you mean '__name'"),
        (["__name:="], "says nothing behind"),
        (["__ns:=/a b"], "cannot be a namespace"),
        (["__name:=a", "--ros-args", "-r", "a:=b"], "is a word of ROS 1, and --ros-args one of ROS 2"),
        (["--ros-args", "-x", "a:=b"], "ROS 2 has no argument '-x'"),
        (["--ros-args", "-r"], "'--remap' behind --ros-args has no value"),
        (["--ros-args", "-r", "--", "a"], "'--remap' behind --ros-args has no value"),
        (["--ros-args", "-r", "a=b"], "'a=b' behind --remap is not of the form"),
        (["--ros-args", "-r", "a:="], "is not of the form"),
        (["--ros-args", "-p", "a b:=1"], "is not of the form"),
        (["--ros-args", "-r", "__ns:=a/../b"], "cannot be a namespace"),
    ],
)
def test_words_that_ros_does_not_take(typed: list[str], words: str) -> None:
    with pytest.raises(UsageError, match=words):
        split_ros_words(typed)


def test_a_value_that_is_no_yaml_is_named() -> None:
    with pytest.raises(DataError, match=r"The value of '_x:=\[1' is not YAML"):
        words_of("_x:=[1").parameters_for("n")


def test_other_buses_refuse_them() -> None:
    with pytest.raises(UsageError, match=r"'__name:=a' is for a node of ROS 1, and the bus is 'sim'(?s:.*)--bus ros1"):
        open_bus("sim:x", "n", words_of("__name:=a"))
    with pytest.raises(UsageError, match="is for a node of ROS 2, and the bus is 'ros1'"):
        refuse_words_of_another("ros1", words_of("--ros-args", "-r", "a:=b"))
    with pytest.raises(UsageError, match="is for a node of ROS 1, and the bus is 'sim'"):
        launch_parameters("sim:x", "n", words_of("_x:=1"))
