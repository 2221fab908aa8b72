"""Types of the ROS package ``sensor_msgs``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from vlatool.messages.geometry_msgs import Quaternion, Vector3
from vlatool.messages.schema import (
    Message,
    Ros1Form,
    boolean,
    float32,
    float32_sequence,
    float64_9,
    float64_12,
    float64_sequence,
    string,
    string_sequence,
    uint8,
    uint8_sequence,
    uint32,
    zeros,
)
from vlatool.messages.std_msgs import Header


@dataclass(frozen=True, eq=False)
class Image(Message, name="sensor_msgs/msg/Image"):
    """An image of ``height`` rows of ``step`` bytes, in one of ROS's encodings (``rgb8``, ``bgr8``, ``16UC1``, ...)."""

    header: Header = Header()
    height: uint32 = 0
    width: uint32 = 0
    encoding: string = ""
    is_bigendian: uint8 = 0
    step: uint32 = 0
    data: uint8_sequence = zeros("uint8")


@dataclass(frozen=True, eq=False)
class CompressedImage(Message, name="sensor_msgs/msg/CompressedImage"):
    """An image file: ``jpeg`` or ``png``, possibly with what ``image_transport`` writes behind it."""

    header: Header = Header()
    format: string = ""
    data: uint8_sequence = zeros("uint8")


@dataclass(frozen=True, eq=False)
class RegionOfInterest(Message, name="sensor_msgs/msg/RegionOfInterest"):
    """A rectangle of an image, in pixels; 0 x 0 at 0, 0 is the full image."""

    x_offset: uint32 = 0
    y_offset: uint32 = 0
    height: uint32 = 0
    width: uint32 = 0
    do_rectify: boolean = False


@dataclass(frozen=True, eq=False)
class CameraInfo(
    Message,
    name="sensor_msgs/msg/CameraInfo",
    ros1=Ros1Form(names=(("d", "D"), ("k", "K"), ("r", "R"), ("p", "P"))),
):
    """Calibration of a camera: distortion ``d``, intrinsic matrix ``k``, rectification ``r``, projection ``p``."""

    header: Header = Header()
    height: uint32 = 0
    width: uint32 = 0
    distortion_model: string = ""
    d: float64_sequence = zeros("float64")
    k: float64_9 = zeros("float64", 9)
    r: float64_9 = zeros("float64", 9)
    p: float64_12 = zeros("float64", 12)
    binning_x: uint32 = 0
    binning_y: uint32 = 0
    roi: RegionOfInterest = RegionOfInterest()


@dataclass(frozen=True, eq=False)
class PointField(Message, name="sensor_msgs/msg/PointField"):
    """One field of the points of a cloud, of a ``datatype`` below."""

    INT8: ClassVar[uint8] = 1
    UINT8: ClassVar[uint8] = 2
    INT16: ClassVar[uint8] = 3
    UINT16: ClassVar[uint8] = 4
    INT32: ClassVar[uint8] = 5
    UINT32: ClassVar[uint8] = 6
    FLOAT32: ClassVar[uint8] = 7
    FLOAT64: ClassVar[uint8] = 8

    name: string = ""
    offset: uint32 = 0
    datatype: uint8 = 0
    count: uint32 = 0


@dataclass(frozen=True, eq=False)
class PointCloud2(Message, name="sensor_msgs/msg/PointCloud2"):
    """A cloud of ``height`` x ``width`` points of ``point_step`` bytes."""

    header: Header = Header()
    height: uint32 = 0
    width: uint32 = 0
    fields: tuple[PointField, ...] = ()
    is_bigendian: boolean = False
    point_step: uint32 = 0
    row_step: uint32 = 0
    data: uint8_sequence = zeros("uint8")
    is_dense: boolean = False


@dataclass(frozen=True, eq=False)
class LaserScan(Message, name="sensor_msgs/msg/LaserScan"):
    """Ranges in metres, at angles in radians from ``angle_min`` on, in steps of ``angle_increment``."""

    header: Header = Header()
    angle_min: float32 = 0.0
    angle_max: float32 = 0.0
    angle_increment: float32 = 0.0
    time_increment: float32 = 0.0
    scan_time: float32 = 0.0
    range_min: float32 = 0.0
    range_max: float32 = 0.0
    ranges: float32_sequence = zeros("float32")
    intensities: float32_sequence = zeros("float32")


@dataclass(frozen=True, eq=False)
class Imu(Message, name="sensor_msgs/msg/Imu"):
    """Orientation, angular velocity in rad/s, linear acceleration in m/s^2, with covariances."""

    header: Header = Header()
    orientation: Quaternion = Quaternion()
    orientation_covariance: float64_9 = zeros("float64", 9)
    angular_velocity: Vector3 = Vector3()
    angular_velocity_covariance: float64_9 = zeros("float64", 9)
    linear_acceleration: Vector3 = Vector3()
    linear_acceleration_covariance: float64_9 = zeros("float64", 9)


@dataclass(frozen=True, eq=False)
class JointState(Message, name="sensor_msgs/msg/JointState"):
    """Positions (rad or m), velocities and efforts of named joints; each array is empty or as long as ``name``."""

    header: Header = Header()
    name: string_sequence = ()
    position: float64_sequence = zeros("float64")
    velocity: float64_sequence = zeros("float64")
    effort: float64_sequence = zeros("float64")


@dataclass(frozen=True, eq=False)
class BatteryState(
    Message,
    name="sensor_msgs/msg/BatteryState",
    ros1=Ros1Form(absent=("POWER_SUPPLY_TECHNOLOGY_TERNARY", "POWER_SUPPLY_TECHNOLOGY_VRLA")),
):
    """A battery: volts, degrees Celsius, amperes, ampere hours, and ``percentage`` from 0 to 1; NaN is unmeasured."""

    POWER_SUPPLY_STATUS_UNKNOWN: ClassVar[uint8] = 0
    POWER_SUPPLY_STATUS_CHARGING: ClassVar[uint8] = 1
    POWER_SUPPLY_STATUS_DISCHARGING: ClassVar[uint8] = 2
    POWER_SUPPLY_STATUS_NOT_CHARGING: ClassVar[uint8] = 3
    POWER_SUPPLY_STATUS_FULL: ClassVar[uint8] = 4
    POWER_SUPPLY_HEALTH_UNKNOWN: ClassVar[uint8] = 0
    POWER_SUPPLY_HEALTH_GOOD: ClassVar[uint8] = 1
    POWER_SUPPLY_HEALTH_OVERHEAT: ClassVar[uint8] = 2
    POWER_SUPPLY_HEALTH_DEAD: ClassVar[uint8] = 3
    POWER_SUPPLY_HEALTH_OVERVOLTAGE: ClassVar[uint8] = 4
    POWER_SUPPLY_HEALTH_UNSPEC_FAILURE: ClassVar[uint8] = 5
    POWER_SUPPLY_HEALTH_COLD: ClassVar[uint8] = 6
    POWER_SUPPLY_HEALTH_WATCHDOG_TIMER_EXPIRE: ClassVar[uint8] = 7
    POWER_SUPPLY_HEALTH_SAFETY_TIMER_EXPIRE: ClassVar[uint8] = 8
    POWER_SUPPLY_TECHNOLOGY_UNKNOWN: ClassVar[uint8] = 0
    POWER_SUPPLY_TECHNOLOGY_NIMH: ClassVar[uint8] = 1
    POWER_SUPPLY_TECHNOLOGY_LION: ClassVar[uint8] = 2
    POWER_SUPPLY_TECHNOLOGY_LIPO: ClassVar[uint8] = 3
    POWER_SUPPLY_TECHNOLOGY_LIFE: ClassVar[uint8] = 4
    POWER_SUPPLY_TECHNOLOGY_NICD: ClassVar[uint8] = 5
    POWER_SUPPLY_TECHNOLOGY_LIMN: ClassVar[uint8] = 6
    POWER_SUPPLY_TECHNOLOGY_TERNARY: ClassVar[uint8] = 7
    POWER_SUPPLY_TECHNOLOGY_VRLA: ClassVar[uint8] = 8

    header: Header = Header()
    voltage: float32 = 0.0
    temperature: float32 = 0.0
    current: float32 = 0.0
    charge: float32 = 0.0
    capacity: float32 = 0.0
    design_capacity: float32 = 0.0
    percentage: float32 = 0.0
    power_supply_status: uint8 = 0
    power_supply_health: uint8 = 0
    power_supply_technology: uint8 = 0
    present: boolean = False
    cell_voltage: float32_sequence = zeros("float32")
    cell_temperature: float32_sequence = zeros("float32")
    location: string = ""
    serial_number: string = ""
