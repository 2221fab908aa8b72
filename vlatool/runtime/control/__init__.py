"""Controllers and wrappers, one file each, which turn the chunks of a policy into one action for each control step.

The name of an entry's first parameter says what it wraps, ``policy`` or ``controller``. An entry with ``infer`` is
itself a policy, one with ``act`` a controller. A controller that acts while its policy infers also takes ``delay``: the
number of control steps that an inference takes.
"""

from __future__ import annotations

import inspect
from collections.abc import Sequence
from typing import Any

from vlatool import registry
from vlatool.errors import PluginError, UsageError
from vlatool.runtime.interface import Controller, Policy

KIND, DEFAULT_PLAYER, PLAYER_WITH_DELAY = "control", "chunked", "late"


def layers(names: Sequence[str], *, delayed: bool = False) -> list[type]:
    """Return the classes around a policy, innermost first: policy wrappers, one player, controller wrappers.

    Args:
        names: Names of entries of the kind ``control``; ``chunked`` or ``late`` is added if none plays the policy.
        delayed: Whether the controller should act while the policy infers.

    Raises:
        UsageError: when a name is unknown, two entries play the policy, or the player does not support a delay.
    """
    entries = {name: registry.load(KIND, name) for name in names}
    players = [name for name, entry in entries.items() if _layer(entry) == 1]
    if len(players) > 1:
        raise UsageError(f"Both {players[0]} and {players[1]} play the chunks of the policy.", "name one of them")
    player = players[0] if players else PLAYER_WITH_DELAY if delayed else DEFAULT_PLAYER
    entries[player] = registry.load(KIND, player)
    if delayed and not _takes(entries[player], "delay"):
        raise UsageError(f"The controller {player} waits for each inference: its actions cannot come late.",
                         f"use {PLAYER_WITH_DELAY}, or leave the latency out")  # fmt: skip
    return sorted(entries.values(), key=_layer)


def build_controller(policy: Policy, names: Sequence[str] = (), delay: int = 0) -> Controller:
    """Return a controller that acts with a policy: ``chunked``, ``late`` if there is a delay, or the named one.

    Args:
        names: Names of entries of the kind ``control``, inner ones first; policy wrappers are always innermost.
        delay: Number of control steps that an inference takes.

    Raises:
        UsageError: as ``layers`` does.
        PluginError: when an entry lacks a method of the protocols.
    """
    made: Any = policy
    for entry in layers(names, delayed=delay > 0):
        made = entry(made, delay=delay) if delay and _takes(entry, "delay") else entry(made)
        if not isinstance(made, Controller if _layer(entry) else Policy):
            raise PluginError(f"{entry.__name__}, an entry of vlatool.{KIND}, lacks methods or properties.",
                              "give it those of a protocol in vlatool/runtime/interface.py")  # fmt: skip
    return made  # type: ignore[no-any-return]


def _layer(entry: type) -> int:
    """Return 0 for a policy wrapper, 1 for a player of a policy, 2 for a controller wrapper."""
    return hasattr(entry, "act") * (1 + (not _takes(entry, "policy")))


def _takes(entry: type, parameter: str) -> bool:
    return parameter in inspect.signature(entry).parameters
