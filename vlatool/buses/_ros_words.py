"""What ROS's launchers add to a command line: name, namespace, remappings and parameters of a node.

ROS 1 (``roslaunch``, ``rosrun``): ``__name:=NAME``, ``__log:=FILE``, ``FROM:=TO``, ``_parameter:=VALUE``.
ROS 2 (``ros2 launch``, ``ros2 run``): all that stands behind ``--ros-args``, up to ``--``.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vlatool.errors import DataError, UsageError, require
from vlatool.files.yaml import read_yaml

SPECIAL = ("name", "ns", "log", "master", "ip", "hostname")
"""What ROS 1 takes with two underscores before it."""
MARK = "--ros-args"
WITH_VALUE = ("--remap", "--param", "--params-file", "--log-level", "--log-config-file", "--enclave")
SHORT_FLAGS = {"-r": "--remap", "-p": "--param", "-e": "--enclave"}
SWITCH = re.compile(r"--(?:en|dis)able-(?:rosout|stdout|external-lib)-logs")
OF_ROS = ("use_sim_time", "start_type_description_service")
"""Parameters that every node of ROS 2 has."""
WORD = re.compile(r"((?:__?|~/?|/)?[A-Za-z][A-Za-z0-9_]*(?:/[A-Za-z0-9_]+)*):=(.*)", re.ASCII | re.DOTALL)
"""A word of ROS 1, and behind ``-r`` or ``-p`` one of ROS 2."""
QUALIFIED_RULE = re.compile(r"(/?[A-Za-z]\w*(?:/\w+)*):(?!=)(.*)", re.ASCII | re.DOTALL)
"""A rule of ROS 2 for the node before the colon alone."""
NAMESPACE = re.compile(r"/?(?:[A-Za-z]\w*(?:/[A-Za-z]\w*)*)?/?", re.ASCII)


@dataclass(frozen=True)
class Rule:
    """``LEFT:=RIGHT``, for all nodes of the process or for one.

    Args:
        left: What stands before ``:=``.
        right: What stands behind it.
        node: The node; any when empty.
    """

    left: str
    right: str
    node: str = ""

    def holds_for(self, node: str) -> bool:
        """Return whether it is for a node of this name."""
        return not self.node or self.node.rpartition("/")[2] == node


@dataclass(frozen=True)
class RosWords:
    """What a launcher of ROS says of a node.

    Args:
        dialect: ``ros1`` or ``ros2``.
        typed: The words as they stand on the command line.
        remappings: Names and topics: ``__name``, ``__ns`` and such are among them.
        settings: Parameters, whose values are YAML.
        files: Files of parameters (ROS 2).
    """

    dialect: str
    typed: tuple[str, ...]
    remappings: tuple[Rule, ...] = ()
    settings: tuple[Rule, ...] = ()
    files: tuple[str, ...] = ()

    def special(self, name: str, node: str = "") -> str:
        """Return what ``__NAME`` is for a node; empty where it is not set."""
        values = [rule.right for rule in self.remappings if rule.left == f"__{name}" and rule.holds_for(node)]
        return values[-1] if values else ""

    def name_for(self, node: str) -> str:
        """Return the name of a node that is called so without them."""
        return self.special("node", node) or self.special("name", node) or node

    def namespace_for(self, node: str) -> str:
        """Return its namespace, with a slash before and behind it: ``/`` or ``/robot1/``; empty where none is set."""
        text = self.special("ns", node) or (os.environ.get("ROS_NAMESPACE", "") if self.dialect == "ros1" else "")
        return f"/{text.strip('/')}/".replace("//", "/") if text else ""

    def full_name_for(self, node: str) -> str:
        """Return its full name, such as ``/robot1/vlatool_vln``."""
        return f"{self.namespace_for(node) or '/'}{self.name_for(node)}"

    def for_library(self) -> list[str]:
        """Return the words for ROS's own library: without parameters in ROS 1, which would stay at the master."""
        if self.dialect == "ros2":
            return list(self.typed)
        return [f"{rule.left}:={rule.right}" for rule in self.remappings]

    def without_topics(self) -> RosWords:
        """Return them without the remappings of topics and services."""
        rules = tuple(rule for rule in self.remappings if rule.left.startswith("__"))
        typed = (f"{rule.node}:{rule.left}:={rule.right}".lstrip(":") for rule in rules)
        if self.dialect == "ros2":
            typed = (word for each in [MARK, *typed] for word in ([each] if each == MARK else ["-r", each]))
        return RosWords(self.dialect, tuple(typed), rules)

    def topics(self) -> list[tuple[str, str]]:
        """Return the remappings of topics and services."""
        return [(rule.left, rule.right) for rule in self.remappings if not rule.left.startswith("__")]

    def parameters_for(self, node: str) -> dict[str, Any]:
        """Return the parameters of a node that is called so without them.

        Raises:
            DataError: when a file or a value is not YAML.
            MissingExtra: when PyYAML is absent.
        """
        parameters: dict[str, Any] = {}
        full = self.full_name_for(node)
        for path in self.files:
            parameters |= _parameters_in(path, full)
        for rule in self.settings:
            if rule.holds_for(node) or rule.holds_for(self.name_for(node)):
                parameters[rule.left.lstrip("_")] = _value(rule)
        return {name: value for name, value in parameters.items() if name not in OF_ROS and "." not in name}


def split_ros_words(words: Sequence[str]) -> tuple[list[str], RosWords | None]:
    """Return the other words of a command line, and what a launcher of ROS added to it; None where it is nothing.

    Raises:
        UsageError: for a word that ROS does not take, and for words of ROS 1 and ROS 2 at once.
    """
    ours, behind = _split_ros2(words)
    first = [(word, match) for word in ours if (match := WORD.fullmatch(word))]
    if not behind:
        return [word for word in ours if not WORD.fullmatch(word)], _ros1(first) if first else None
    if first:
        raise UsageError(
            f"'{first[0][0]}' is a word of ROS 1, and {MARK} one of ROS 2.", f"write all behind {MARK}: -r FROM:=TO"
        )
    return ours, _ros2(behind)


def _split_ros2(words: Sequence[str]) -> tuple[list[str], list[str]]:
    """Return the words outside and inside of ``--ros-args ... --``."""
    outside: list[str] = []
    inside: list[str] = []
    ros = False
    for word in words:
        if word == MARK or (ros and word == "--"):
            ros = word == MARK
            inside += [MARK] if ros else ["--"]
        else:
            (inside if ros else outside).append(word)
    return outside, inside


def _ros1(matches: Sequence[tuple[str, re.Match[str]]]) -> RosWords:
    remappings: list[Rule] = []
    settings: list[Rule] = []
    for word, match in matches:
        left, right = match.groups()
        special = left.startswith("__")
        if special and left[2:] not in SPECIAL:
            raise UsageError.unknown(f"ROS 1 has no argument '{left}'", left, [f"__{name}" for name in SPECIAL])
        private = left.startswith("_") and not special
        if not right and not private:
            raise UsageError(f"'{word}' says nothing behind ':='.", f"write it such as {left}:=VALUE, or leave it out")
        _check_namespace(left, right)
        (settings if private else remappings).append(Rule(left, right))
    return RosWords("ros1", tuple(word for word, _ in matches), tuple(remappings), tuple(settings))


def _ros2(behind: Sequence[str]) -> RosWords:
    remappings: list[Rule] = []
    settings: list[Rule] = []
    files: list[str] = []
    for flag, value in _flags(behind):
        if flag in ("--remap", "--param"):
            (remappings if flag == "--remap" else settings).append(_rule(flag, value))
        elif flag == "--params-file":
            files.append(value)
    return RosWords("ros2", tuple(behind), tuple(remappings), tuple(settings), tuple(files))


def _flags(behind: Sequence[str]) -> Iterator[tuple[str, str]]:
    """Yield the flags behind ``--ros-args`` with their values."""
    words = iter(behind)
    for word in words:
        flag, sign, value = word.partition("=") if word.startswith("--") else (word, "", "")
        flag = SHORT_FLAGS.get(flag, flag)
        if word in (MARK, "--") or SWITCH.fullmatch(word):
            continue
        if flag not in WITH_VALUE:
            raise UsageError.unknown(f"ROS 2 has no argument '{word}' behind {MARK}", flag, [*WITH_VALUE, *SHORT_FLAGS])
        value = value if sign else next(words, "")
        if not value or value in (MARK, "--"):
            raise UsageError(f"'{flag}' behind {MARK} has no value.", f"write it such as {flag} VALUE")
        yield flag, value


def _rule(flag: str, text: str) -> Rule:
    """Return a rule of ROS 2: ``FROM:=TO``, ``NODE:FROM:=TO``, or with a dot in the name of a parameter."""
    plain = text.replace("rostopic://", "").replace("rosservice://", "")
    qualified = QUALIFIED_RULE.fullmatch(plain)
    node, rest = qualified.groups() if qualified else ("", plain)
    left, sign, right = rest.partition(":=")
    shape = re.compile(r"[A-Za-z_][\w.]*", re.ASCII) if flag == "--param" else re.compile(r"[~/\w]+", re.ASCII)
    if not sign or not shape.fullmatch(left) or (flag == "--remap" and not right):
        raise UsageError(f"'{text}' behind {flag} is not of the form NAME:=VALUE.", f"write it such as {flag} a:=b")
    _check_namespace(left, right)
    return Rule(left, right, node)


def _check_namespace(left: str, right: str) -> None:
    if left == "__ns" and not NAMESPACE.fullmatch(right):
        raise UsageError(
            f"'{right}' cannot be a namespace; allowed: letters, digits, '_' and '/', such as /robot1.", "correct it"
        )


def _value(rule: Rule) -> Any:
    yaml: Any = require("yaml", "build")
    try:
        return yaml.safe_load(rule.right)
    except yaml.YAMLError:
        raise DataError(f"The value of '{rule.left}:={rule.right:.60}' is not YAML.", "put it in quotes") from None


def _parameters_in(path: str, full: str) -> dict[str, Any]:
    """Return the parameters of a node in a file of ROS 2: those for all nodes, and those below its name."""
    values = read_yaml(Path(path), f"The file of parameters {path}", DataError)
    values_of_node: dict[str, Any] = {}
    for node, parameters in _nodes_in(values, path, "write it as NODE: {ros__parameters: {NAME: VALUE}}"):
        if _is_for(node, full):
            values_of_node |= parameters
    return values_of_node


def _nodes_in(values: Any, path: str, fix: str, above: str = "") -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield the nodes of a file of parameters, by their full names or patterns of these, with their parameters."""
    for name, entry in values.items() if isinstance(values, Mapping) else [("", values)]:
        node = f"{above}/{str(name).strip('/')}"
        parameters = entry.get("ros__parameters") if isinstance(entry, Mapping) else None
        if isinstance(parameters, Mapping):
            yield node, {str(key): value for key, value in parameters.items()}
        elif isinstance(entry, Mapping) and entry and parameters is None:
            yield from _nodes_in(entry, path, fix, node)
        else:
            raise DataError(f"The file of parameters {path} has no 'ros__parameters' below '{node}'.", fix)


def _is_for(pattern: str, full: str) -> bool:
    """Return whether the name above parameters is that of a node; ``*`` stands for one part, ``**`` for any number."""
    parts = [{"**": r".*", "*": r"[^/]+"}.get(part, re.escape(part)) for part in pattern.strip("/").split("/")]
    return re.fullmatch("/".join(parts).replace(".*/", "(?:.*/)?"), full.strip("/")) is not None
