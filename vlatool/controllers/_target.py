"""The region of interest that a controller follows: from a topic, or by a correlation filter from a first one on."""

from __future__ import annotations

from dataclasses import dataclass

from vlatool.controllers._correlation_filter import Box, CorrelationFilter, begin, follow
from vlatool.controllers._interface import Input, Snapshot
from vlatool.controllers._sensor_arrays import colours_of
from vlatool.errors import UsageError
from vlatool.messages.sensor_msgs import CameraInfo, Image, RegionOfInterest

CAMERA_INFO = Input("camera_info", "/camera/color/camera_info", CameraInfo)
ROI = Input("roi", "/roi", RegionOfInterest)
IMAGE = Input("image", "/camera/color/image_raw", Image)


@dataclass(frozen=True)
class Target:
    """Where the region of interest comes from.

    Args:
        filter: Filter of the target; None before its first frame, or without one.
        first: How many regions had come on the topic when the filter began; -1 where a setting gave the first one.
    """

    filter: CorrelationFilter | None = None
    first: int = -1


def target_inputs(roi: str, track: bool) -> tuple[Input, ...]:
    """Return the inputs that settings of a target ask for."""
    if roi:
        return (CAMERA_INFO, IMAGE)
    return (CAMERA_INFO, ROI, IMAGE) if track else (CAMERA_INFO, ROI)


def read_roi(text: str) -> RegionOfInterest | None:
    """Return the region of a setting ``X,Y,WIDTH,HEIGHT`` in pixels; None for an empty one.

    Raises:
        UsageError: for anything else.
    """
    if not text:
        return None
    parts = [part.strip() for part in text.split(",")]
    plain = len(parts) == 4 and all(part.isascii() and part.isdigit() and len(part) < 10 for part in parts)
    if not plain or 0 in map(int, parts[2:]):
        raise UsageError(
            f"The region of interest is '{text}'; allowed: X,Y,WIDTH,HEIGHT in pixels, with a size above 0.",
            "write for example roi='140,100,40,60', or leave it out to take it from the topic /roi",
        )
    x, y, width, height = (int(part) for part in parts)
    return RegionOfInterest(x_offset=x, y_offset=y, width=width, height=height)


def find_target(
    snapshot: Snapshot, roi: RegionOfInterest | None, track: bool, state: Target
) -> tuple[RegionOfInterest | None, Target, str]:
    """Return the region of interest at this step, the state after it, and why there is none.

    Args:
        snapshot: Inputs ``camera_info``, ``roi`` and ``image``.
        roi: First region, from a setting.
        track: Whether a region of the topic is the first of a filter, and not the target of this step alone.
        state: What the last step returned.
    """
    if roi is None and not track:
        if not snapshot.readings.get("roi"):
            return None, state, "no new region"
        found = snapshot.message("roi", RegionOfInterest)
        return _inside(found, snapshot.message("camera_info", CameraInfo), state)
    if not snapshot.readings.get("image"):
        return None, state, "no new image"
    image, problem = colours_of(snapshot.message("image", Image))
    if image is None:
        return None, state, problem
    count = snapshot.newest["roi"].sequence if "roi" in snapshot.newest and roi is None else -1
    if state.filter is None or count != state.first:
        first = roi or snapshot.message("roi", RegionOfInterest)
        if first is None or not (first.width and first.height):
            return None, state, "no first region"
        region, state, problem = _inside(first, snapshot.message("camera_info", CameraInfo), state)
        if region is None:
            return None, state, problem
        x, y = region.x_offset + region.width / 2, region.y_offset + region.height / 2
        return region, Target(begin(image, Box(x, y, region.width, region.height)), count), ""
    known, visible = follow(image, state.filter)
    state = Target(known, state.first)
    return (_region(known.box), state, "") if visible else (None, state, "target lost")


def _region(box: Box) -> RegionOfInterest:
    left, top = max(round(box.x - box.width / 2), 0), max(round(box.y - box.height / 2), 0)
    return RegionOfInterest(x_offset=left, y_offset=top, width=round(box.width), height=round(box.height))


def _inside(
    region: RegionOfInterest | None, camera: CameraInfo | None, state: Target
) -> tuple[RegionOfInterest | None, Target, str]:
    """Return a region if it has a size and lies in the image of the camera."""
    if region is None or not (region.width and region.height):
        return None, state, "no target"
    if camera is None or not (camera.width and camera.height):
        return None, state, "size of the image unknown"
    if region.x_offset + region.width > camera.width or region.y_offset + region.height > camera.height:
        size = f"{region.width} x {region.height} at {region.x_offset}, {region.y_offset}"
        return None, state, f"region {size} outside of the image of {camera.width} x {camera.height}"
    return region, state, ""
