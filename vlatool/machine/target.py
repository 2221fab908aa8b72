"""What a policy is to run on, as engines are asked about it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from vlatool.machine.host import gpus, isa


@dataclass(frozen=True)
class Target:
    """A board, or this host.

    Args:
        profile: ``vlatool.hardware.profile.Profile`` of the board, which a robot has not got; None for this host.
        devices: Names of what computes there beside the processor.
        features: Features of its processor, as ``/proc/cpuinfo`` names them.
    """

    profile: Any = None
    devices: tuple[str, ...] = ()
    features: frozenset[str] = frozenset()

    def has(self, *features: str) -> bool:
        """Return whether the processor has one of these features."""
        return not self.features.isdisjoint(features)


def target_of(profile: Any) -> Target:
    """Return the board of a profile as a target; this host for None."""
    if profile is None:
        return Target(None, gpus(), frozenset(isa() or ()))
    devices = tuple(unit.title for name, unit in profile.units.items() if name != "cpu")
    return Target(profile, devices, frozenset(name for unit in profile.units.values() for name in unit.isa))
