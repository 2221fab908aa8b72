"""Types of the ROS package ``visualization_msgs``: shapes for RViz, in the form of Humble and Jazzy, or of Noetic."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from vlatool.messages.builtin_interfaces import Duration
from vlatool.messages.geometry_msgs import Point, Pose, Vector3
from vlatool.messages.schema import Message, Ros1Form, boolean, float32, int32, string, uint8_sequence, zeros
from vlatool.messages.sensor_msgs import CompressedImage
from vlatool.messages.std_msgs import ColorRGBA, Header


@dataclass(frozen=True, eq=False)
class MeshFile(Message, name="visualization_msgs/msg/MeshFile"):
    """A file that describes a mesh, sent along with a marker."""

    filename: string = ""
    data: uint8_sequence = zeros("uint8")


@dataclass(frozen=True, eq=False)
class UVCoordinate(Message, name="visualization_msgs/msg/UVCoordinate"):
    """A position in a texture, each coordinate from 0 to 1."""

    u: float32 = 0.0
    v: float32 = 0.0


@dataclass(frozen=True, eq=False)
class Marker(
    Message,
    name="visualization_msgs/msg/Marker",
    ros1=Ros1Form(
        absent=("ARROW_STRIP", "texture_resource", "texture", "uv_coordinates", "mesh_file"),
        constants="uint8",
    ),
):
    """A shape of a ``type`` below, in metres; ROS 1 has no textures and no mesh files: they are not sent there."""

    ARROW: ClassVar[int32] = 0
    CUBE: ClassVar[int32] = 1
    SPHERE: ClassVar[int32] = 2
    CYLINDER: ClassVar[int32] = 3
    LINE_STRIP: ClassVar[int32] = 4
    LINE_LIST: ClassVar[int32] = 5
    CUBE_LIST: ClassVar[int32] = 6
    SPHERE_LIST: ClassVar[int32] = 7
    POINTS: ClassVar[int32] = 8
    TEXT_VIEW_FACING: ClassVar[int32] = 9
    MESH_RESOURCE: ClassVar[int32] = 10
    TRIANGLE_LIST: ClassVar[int32] = 11
    ARROW_STRIP: ClassVar[int32] = 12
    ADD: ClassVar[int32] = 0
    MODIFY: ClassVar[int32] = 0
    DELETE: ClassVar[int32] = 2
    DELETEALL: ClassVar[int32] = 3

    header: Header = Header()
    ns: string = ""
    id: int32 = 0
    type: int32 = 0
    action: int32 = 0
    pose: Pose = Pose()
    scale: Vector3 = Vector3()
    color: ColorRGBA = ColorRGBA()
    lifetime: Duration = Duration()
    frame_locked: boolean = False
    points: tuple[Point, ...] = ()
    colors: tuple[ColorRGBA, ...] = ()
    texture_resource: string = ""
    texture: CompressedImage = CompressedImage()
    uv_coordinates: tuple[UVCoordinate, ...] = ()
    text: string = ""
    mesh_resource: string = ""
    mesh_file: MeshFile = MeshFile()
    mesh_use_embedded_materials: boolean = False


@dataclass(frozen=True, eq=False)
class MarkerArray(Message, name="visualization_msgs/msg/MarkerArray"):
    """Several markers."""

    markers: tuple[Marker, ...] = ()
