"""LeRobot's client as it is on the wire: its classes as pickle writes them, its messages as protobuf writes them."""

from __future__ import annotations

import pickle  # noqa: TID251 - what the client does
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from types import ModuleType
from typing import Any

HELPERS = "lerobot.async_inference.helpers"


@dataclass
class TimedAction:
    timestamp: float
    timestep: int
    action: Any


@dataclass
class TimedObservation:
    timestamp: float
    timestep: int
    observation: dict[str, Any]
    must_go: bool = False


@dataclass
class RemotePolicyConfig:
    policy_type: str
    pretrained_name_or_path: str
    lerobot_features: dict[str, Any]
    actions_per_chunk: int
    device: str = "cpu"
    rename_map: dict[str, str] = field(default_factory=dict)


def with_modules() -> Iterator[None]:
    """Let pickle find the classes where LeRobot has them, while a test runs."""
    helpers = ModuleType(HELPERS)
    parents = {name: ModuleType(name) for name in ("lerobot", "lerobot.async_inference")}
    for kind in (TimedAction, TimedObservation, RemotePolicyConfig):
        kind.__module__ = HELPERS
        setattr(helpers, kind.__name__, kind)
    before = {name: sys.modules.get(name) for name in (*parents, HELPERS)}
    sys.modules.update({**parents, HELPERS: helpers})
    yield
    for name, module in before.items():
        sys.modules.pop(name)
        if module is not None:
            sys.modules[name] = module


def pickled(value: Any, protocol: int = 4) -> bytes:
    return pickle.dumps(value, protocol)


def unpickled(data: bytes) -> Any:
    """As the client does, in its own process."""
    return pickle.loads(data)
