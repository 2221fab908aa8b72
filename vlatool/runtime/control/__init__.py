"""Controllers and wrappers, one file each, which turn the chunks of a policy into one action for each control step.

The name of an entry's first parameter says what it wraps, ``policy`` or ``controller``. An entry with ``infer`` is
itself a policy, one with ``act`` a controller. A controller that acts while its policy infers also takes ``delay``: the
number of control steps that an inference takes. An entry that takes ``spec`` gets that of the policy. Its other
parameters with a default are options, which follow the name: ``rtc:delay=8:blend=4``.
"""

from __future__ import annotations

import inspect
import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from types import UnionType
from typing import Any, NamedTuple, Union, get_args, get_origin, get_type_hints

from vlatool import registry
from vlatool.bundle.spec import PolicySpec
from vlatool.errors import PluginError, UsageError
from vlatool.files.validate import short_repr
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


TRUTH = {"true": True, "false": False}
WRITABLE = (bool, int, float, str)


class _Layer(NamedTuple):
    """An entry, with the options that were given behind its name."""

    entry: type
    options: dict[str, Any]


def layers(names: Sequence[str], *, delayed: bool = False) -> list[type]:
    """Return the classes around a policy, innermost first: policy wrappers, one player, controller wrappers.

    Args:
        names: Names of entries of the kind ``control``, which options may follow (``rtc:delay=8``); ``chunked`` or
            ``late`` is added if none plays the policy.
        delayed: Whether the controller should act while the policy infers.

    Raises:
        UsageError: when a name, an option or a value is unknown, an entry is named twice, two entries play the policy,
            or the player does not support a delay.
    """
    return check_order([layer.entry for layer in _layers(names, delayed)])


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
        UsageError: as ``layers`` does, and as the entries do for their options.
        PluginError: when an entry lacks a method of the protocols.
    """
    acting: Any = policy
    chosen = options_of(names)
    for entry in layers(names, delayed=delay > 0):
        acting = build_layer(entry, acting, delay, spec=policy.spec, options=chosen.get(entry, {}))
    return acting  # type: ignore[no-any-return]


def options_of(names: Sequence[str]) -> dict[type, dict[str, Any]]:
    """Return the options behind names of entries; raises UsageError as ``layers`` does."""
    return dict(_parsed(name) for name in names)


def build_layer(
    entry: type,
    inner: Any,
    delay: int = 0,
    *,
    spec: PolicySpec | None = None,
    options: Mapping[str, Any] | None = None,
    clock: Callable[[], float] | None = None,
) -> Any:
    """Return a layer around another, with what it takes of these; raises PluginError as ``build_controller``."""
    given = {"spec": spec, "delay": delay, "clock": clock}
    given = {**{name: value for name, value in given.items() if value}, **(options or {})}
    layer = entry(inner, **{name: value for name, value in given.items() if _takes(entry, name)})
    if not isinstance(layer, Controller if _layer(entry) else Policy):
        raise PluginError(f"{entry.__name__}, an entry of vlatool.{KIND}, lacks methods or properties.",
                          "give it those of a protocol in vlatool/runtime/interface.py")  # fmt: skip
    return layer


def takes_delay(entry: type) -> bool:
    """Return whether a controller acts while its policy infers."""
    return _takes(entry, "delay")


def _layers(names: Sequence[str], delayed: bool) -> list[_Layer]:
    if isinstance(names, str):
        raise UsageError(f"The controllers are the text '{names}'; allowed: names.", f"pass controllers=['{names}']")
    found: dict[str, _Layer] = {}
    for name, layer in map(_named, names):
        if name in found:
            raise UsageError(f"The controller {name} is named twice.", "name each once, with all of its options")
        found[name] = layer
    players = [name for name, layer in found.items() if _layer(layer.entry) == 1]
    if len(players) > 1:
        raise UsageError(f"Both {players[0]} and {players[1]} play the chunks of the policy.", "name one of them")
    player = players[0] if players else PLAYER_WITH_DELAY if delayed else DEFAULT_PLAYER
    found.setdefault(player, _parsed(player))
    if delayed and not _takes(found[player].entry, "delay"):
        raise UsageError(f"The controller {player} waits for each inference: its actions cannot come late.",
                         f"use {PLAYER_WITH_DELAY}, or leave the latency out")  # fmt: skip
    if delayed and "delay" in found[player].options:
        raise UsageError(f"The delay of {player} is given, and it is that of the latency.", "leave one of them out")
    return sorted(found.values(), key=lambda layer: _layer(layer.entry))


def _named(named: str) -> tuple[str, _Layer]:
    if not isinstance(named, str):
        raise UsageError(f"A controller is {short_repr(named)}; allowed: a name.", "pass controllers=['NAME']")
    return named.partition(":")[0], _parsed(named)


def _parsed(named: str) -> _Layer:
    """Return the entry and the options of ``NAME:KEY=VALUE:KEY=VALUE``."""
    name, *given = named.split(":")
    entry = registry.load(KIND, name)
    types = _option_types(entry) if given else {}
    options: dict[str, Any] = {}
    for option in given:
        key, equals, value = option.partition("=")
        if key not in types:
            raise UsageError.unknown(f"The controller {name} has no option '{key}'", key, sorted(types))
        if not equals or key in options:
            raise UsageError(f"'{named}' gives {key} {'twice' if equals else 'no value'}.", f"write {name}:{key}=VALUE")
        options[key] = _value(f"{name}:{key}", value, types[key])
    return _Layer(entry, options)


def _option_types(entry: type) -> dict[str, tuple[Any, ...]]:
    """Return the parameters of an entry that have a default and a type that can be written -> their types."""
    hints = get_type_hints(entry.__init__)  # type: ignore[misc]
    defaults = {
        name for name, parameter in inspect.signature(entry).parameters.items()
        if parameter.default is not inspect.Parameter.empty
    }  # fmt: skip
    types = {name: _union(hints[name]) for name in defaults if name in hints}
    return {name: kinds for name, kinds in types.items() if any(kind in WRITABLE for kind in kinds)}


def _union(hint: Any) -> tuple[Any, ...]:
    return get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)


def _value(where: str, text: str, types: tuple[Any, ...]) -> Any:
    """Return the value that a text says, of the first of some types that it can be; raises UsageError for none."""
    if bool in types and text in TRUTH:
        return TRUTH[text]
    for kind in (int, float):
        if kind in types:
            try:
                number = kind(text)
            except ValueError:
                continue
            if math.isfinite(number):
                return number
    if str in types:
        return text
    allowed = {bool: "true or false", int: "a whole number", float: "a number"}
    words = " or ".join(word for kind, word in allowed.items() if kind in types)
    raise UsageError(f"{where} is '{text}'; allowed: {words}.", f"write {where}=VALUE with such a value")


def _layer(entry: type) -> int:
    """Return 0 for a policy wrapper, 1 for a player of a policy, 2 for a controller wrapper."""
    return hasattr(entry, "act") * (1 + (not _takes(entry, "policy")))


def _rank(entry: type) -> int:
    return RANKS.get(registry.entry_of(entry).rpartition(".")[2], 2 * _layer(entry))


def _takes(entry: type, parameter: str) -> bool:
    return parameter in inspect.signature(entry).parameters
