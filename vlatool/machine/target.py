"""What a policy is to run on, as engines are asked about it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from vlatool.machine.host import gpus, isa

if TYPE_CHECKING:
    from vlatool.hardware.profile import Profile


@dataclass(frozen=True)
class Target:
    """A board, or this host.

    Args:
        profile: Profile of the board; None for this host.
        devices: Names of what computes there beside the processor.
        features: Features of its processor, as ``/proc/cpuinfo`` names them.
    """

    profile: Profile | None = None
    devices: tuple[str, ...] = ()
    features: frozenset[str] = frozenset()

    def has(self, *features: str) -> bool:
        """Return whether the processor has one of these features."""
        return not self.features.isdisjoint(features)


def target_of(profile: Profile | None) -> Target:
    """Return the board of a profile as a target; this host for None."""
    if profile is None:
        return Target(None, gpus(), frozenset(isa() or ()))
    devices = tuple(unit.title for name, unit in profile.units.items() if name != "cpu")
    return Target(profile, devices, frozenset(name for unit in profile.units.values() for name in unit.isa))
