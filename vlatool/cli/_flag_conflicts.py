"""A flag that is given in both of its forms is refused: one would be ignored. Of others the last value counts."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from typing import Any

from vlatool.errors import UsageError


def refuse_conflicting_flags(command: Any) -> Any:
    """Return a click command that refuses such flags; of a group, each of its commands does."""
    for each in (command, *getattr(command, "commands", {}).values()):
        each.parse_args = partial(_parse, each, each.parse_args)
    return command


def _parse(command: Any, parse: Any, ctx: Any, args: list[str]) -> list[str]:
    if not ctx.resilient_parsing:
        for option in command.get_params(ctx):
            _refuse_conflict(option, args)
    parsed: list[str] = parse(ctx, args)
    return parsed


def _refuse_conflict(option: Any, args: Sequence[str]) -> None:
    """Refuse words that turn a flag on and off."""
    if option.param_type_name != "option" or not option.is_flag or getattr(option, "count", False):
        return
    given = list(dict.fromkeys(_given(option, args)))
    if len(given) > 1:
        flags = " and ".join(given[:2])
        raise UsageError(f"{flags} are given at once; only one of them can be.", f"leave one of them out: {flags}")


def _given(option: Any, args: Sequence[str]) -> Iterator[str]:
    """Yield the forms of a flag that are among words: its first name, or the first one that turns it off."""
    words = args[: args.index("--")] if "--" in args else args
    for word in words:
        if word in (*option.opts, *option.secondary_opts):
            yield option.opts[0] if word in option.opts else option.secondary_opts[0]
