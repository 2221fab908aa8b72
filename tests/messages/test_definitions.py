"""Hashes, MD5 sums and texts of definitions are those of rosbags, of Debian's packages and of ROS 2 itself."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import pytest
from _messages import in_ros1, ros1_store, ros2_store

from vlatool.messages import Message, all_types, find_type, ros1
from vlatool.messages.definition import text
from vlatool.messages.diagnostic_msgs import DiagnosticStatus
from vlatool.messages.schema import int64
from vlatool.messages.sensor_msgs import BatteryState
from vlatool.messages.std_msgs import String
from vlatool.messages.std_srvs import SetBoolRequest, SetBoolResponse, TriggerRequest, TriggerResponse
from vlatool.messages.type_hash import rihs01, service_rihs01
from vlatool.messages.visualization_msgs import Marker
from vlatool.messages.vlatool_msgs import ACTION, RunInstructionSendGoalRequest

JAZZY, NOETIC = ros2_store(), ros1_store()
PLAIN = [cls for cls in all_types() if "/msg/" in cls.TYPE]
DEBIAN = {
    "std_srvs/SetBoolRequest": "8b94c1b53db61fb6aed406028ad6332a",
    "std_srvs/SetBoolResponse": "937c9679a518e3a18d831e57125ea522",
    "std_srvs/TriggerRequest": "d41d8cd98f00b204e9800998ecf8427e",
    "tf2_msgs/TFMessage": "94810edda583a504dfda3829e70d7eec",
    "sensor_msgs/Image": "060021388200f6f0f447d0fcd9c64743",
    "visualization_msgs/Marker": "4048c9de2a16f4ae8e0538085ebf1b97",
}


@dataclass(frozen=True, eq=False)
class AddTwoIntsRequest(Message):
    """Of example_interfaces; without ``name``, so that it is not among the types."""

    TYPE: ClassVar[str] = "example_interfaces/srv/AddTwoInts_Request"

    a: int64 = 0
    b: int64 = 0


@dataclass(frozen=True, eq=False)
class AddTwoIntsResponse(Message):
    """See above."""

    TYPE: ClassVar[str] = "example_interfaces/srv/AddTwoInts_Response"

    sum: int64 = 0


@pytest.mark.parametrize("cls", all_types(), ids=lambda cls: cls.TYPE)
def test_hash_is_that_of_rosbags(cls: type[Message]) -> None:
    assert rihs01(cls) == JAZZY.hash_rihs01(cls.TYPE)


@pytest.mark.parametrize("cls", PLAIN, ids=lambda cls: cls.TYPE)
def test_text_is_that_of_rosbags(cls: type[Message]) -> None:
    assert text(cls) == JAZZY.generate_msgdef(cls.TYPE, ros_version=2)[0]


@pytest.mark.parametrize("cls", [cls for cls in PLAIN if in_ros1(cls)], ids=lambda cls: cls.TYPE)
def test_ros1_text_and_sum_are_those_of_rosbags(cls: type[Message]) -> None:
    assert (ros1.definition(cls), ros1.md5sum(cls)) == NOETIC.generate_msgdef(cls.TYPE, ros_version=1)


def test_hashes_that_rmw_zenoh_documents() -> None:
    """From the design page of rmw_zenoh: the topic and the service of ROS 2's tutorials."""
    assert rihs01(String) == "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
    added = service_rihs01(AddTwoIntsRequest, AddTwoIntsResponse)
    assert added == "RIHS01_e118de6bf5eeb66a2491b5bda11202e7b68f198d6f67922cf30364858239c81a"


@pytest.mark.parametrize("service", ["std_srvs/srv/SetBool", "action_msgs/srv/CancelGoal", f"{ACTION}_SendGoal"])
def test_hash_of_a_service_is_that_of_rosbags(service: str) -> None:
    """A service is a message with its request, its response and its event; rosbags hashes it as such.

    ``char`` of a ``.msg`` file is ``uint8`` in IDL, of which ROS 2 makes the hash; rosbags takes it for another type.
    """
    event = [("info", (2, "service_msgs/msg/ServiceEventInfo")), ("request", (4, ((2, f"{service}_Request"), 1))),
             ("response", (4, ((2, f"{service}_Response"), 1)))]  # fmt: skip
    whole = [(f"{part}_message", (2, f"{service}_{part.title()}")) for part in ("request", "response", "event")]
    store = ros2_store()
    info = store.fielddefs["service_msgs/msg/ServiceEventInfo"][1]
    gid = [(name, (3, ((1, ("uint8", 0)), 16)) if name == "client_gid" else kind) for name, kind in info]
    store.fielddefs["service_msgs/msg/ServiceEventInfo"] = ([], gid)
    store.register({f"{service}_Event": ([], event), service: ([], whole)})
    hashed = service_rihs01(find_type(f"{service}_Request"), find_type(f"{service}_Response"))
    assert hashed == store.hash_rihs01(service)


@pytest.mark.parametrize(("name", "md5"), DEBIAN.items())
def test_sum_is_that_of_debians_package(name: str, md5: str) -> None:
    """Of the classes in Debian's python3-*-msgs and python3-std-srvs (ROS 1 Noetic)."""
    assert ros1.md5sum(find_type(name)) == md5
    assert ros1.type_name(find_type(name)) == name


def test_services_in_ros1() -> None:
    assert ros1.service_md5sum(SetBoolRequest, SetBoolResponse) == "09fb03525b03e7ea1fd3992bafd87e16"
    assert ros1.service_md5sum(TriggerRequest, TriggerResponse) == "937c9679a518e3a18d831e57125ea522"
    assert ros1.service_name(SetBoolRequest) == "std_srvs/SetBool" == ros1.service_name(SetBoolResponse)


def test_constants_are_attributes() -> None:
    assert (Marker.CYLINDER, BatteryState.POWER_SUPPLY_TECHNOLOGY_VRLA, DiagnosticStatus.STALE) == (3, 8, 3)
    assert "uint8 CYLINDER=3\n" in ros1.definition(Marker)
    assert "int32 CYLINDER=3\n" in text(Marker)
    assert "VRLA" not in ros1.definition(BatteryState)


def test_parts_of_actions_are_named_in_full() -> None:
    assert text(RunInstructionSendGoalRequest) == (
        "unique_identifier_msgs/UUID goal_id\nvlatool_msgs/action/RunInstruction_Goal goal\n"
        f"{'=' * 80}\nMSG: unique_identifier_msgs/UUID\nuint8[16] uuid\n"
        f"{'=' * 80}\nMSG: vlatool_msgs/action/RunInstruction_Goal\nstring instruction\nfloat64 timeout_s\n"
    )
