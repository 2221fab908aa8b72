"""Controllers and wrappers, one file each, which turn the chunks of a policy into one action for each control step.

The name of an entry's first parameter says what it wraps, ``policy`` or ``controller``. An entry with ``infer`` is
itself a policy, one with ``act`` a controller. A controller that acts while its policy infers also takes ``delay``: the
number of control steps that an inference takes.
"""

from __future__ import annotations

import inspect
import itertools
from collections.abc import Sequence
from typing import Any

from vlatool import registry
from vlatool.errors import PluginError, UsageError
from vlatool.runtime.interface import Controller, Policy

KIND, DEFAULT_PLAYER, PLAYER_WITH_DELAY = "control", "chunked", "late"
RANKS = {"deadline": 1, "fallback": 3, "envelope": 5}
"""Entry -> its place between others: policy wrappers are 0, a player 2, controller wrappers 4."""
OUTSIDE = {
    1: "the deadline does not limit the time of what is outside of it",
    2: "a wrapper of a policy needs a policy, and a player is a controller",
    3: "a wrapper of a policy, a player and a deadline have to be inside of the fallback, which answers for them",
    4: "the actions of a fallback would pass by the wrapper inside of it",
    5: "it would change an action after the envelope has checked it",
}
"""Place of a layer -> why nothing that belongs further inside may be around it."""
SINGLE = {
    1: "there is one deadline for an action",
    2: "one player plays the chunks of the policy",
    3: "one fallback answers for the policy",
    5: "an action is checked once, by what moves the robot last",
}


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
    return check_order(sorted(entries.values(), key=_layer))


def check_order(entries: Sequence[type]) -> list[type]:
    """Return layers around a policy, the innermost first, if their order makes sense.

    Raises:
        UsageError: when one would not do what it is for: it says which, and why.
    """
    order = list(entries)
    for inner, outer in itertools.combinations(order, 2):
        ranks = _rank(inner), _rank(outer)
        if ranks[0] > ranks[1] or (ranks[0] == ranks[1] and ranks[0] in SINGLE):
            reason = SINGLE[ranks[1]] if ranks[0] == ranks[1] else OUTSIDE[ranks[0]]
            raise UsageError(f"{outer.__name__} cannot be around {inner.__name__}: {reason}.",
                             "name each once; from the inside: wrappers of the policy, deadline, the player, fallback, "
                             "wrappers of the controller, envelope")  # fmt: skip
    return order


def build_controller(policy: Policy, names: Sequence[str] = (), delay: int = 0) -> Controller:
    """Return a controller that acts with a policy: ``chunked``, ``late`` if there is a delay, or the named one.

    Args:
        names: Names of entries of the kind ``control``, inner ones first; policy wrappers are always innermost.
        delay: Number of control steps that an inference takes.

    Raises:
        UsageError: as ``layers`` does.
        PluginError: when an entry lacks a method of the protocols.
    """
    acting: Any = policy
    for entry in layers(names, delayed=delay > 0):
        acting = build_layer(entry, acting, delay)
    return acting  # type: ignore[no-any-return]


def build_layer(entry: type, inner: Any, delay: int = 0) -> Any:
    """Return a layer around another, with the delay if it takes one; raises PluginError as ``build_controller``."""
    layer = entry(inner, delay=delay) if delay and takes_delay(entry) else entry(inner)
    if not isinstance(layer, Controller if _layer(entry) else Policy):
        raise PluginError(f"{entry.__name__}, an entry of vlatool.{KIND}, lacks methods or properties.",
                          "give it those of a protocol in vlatool/runtime/interface.py")  # fmt: skip
    return layer


def takes_delay(entry: type) -> bool:
    """Return whether a controller acts while its policy infers."""
    return _takes(entry, "delay")


def _layer(entry: type) -> int:
    """Return 0 for a policy wrapper, 1 for a player of a policy, 2 for a controller wrapper."""
    return hasattr(entry, "act") * (1 + (not _takes(entry, "policy")))


def _rank(entry: type) -> int:
    return RANKS.get(registry.entry_of(entry).rpartition(".")[2], 2 * _layer(entry))


def _takes(entry: type, parameter: str) -> bool:
    return parameter in inspect.signature(entry).parameters
