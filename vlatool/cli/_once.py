"""An option that is given twice, with two values, is refused: one of them would be ignored without a word."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from typing import Any

from vlatool.errors import UsageError


def once(command: Any) -> Any:
    """Return a click command that refuses such options; of a group, each of its commands does."""
    for each in (command, *getattr(command, "commands", {}).values()):
        each.parse_args = partial(_parsed, each, each.parse_args)
    return command


def _parsed(command: Any, parse: Any, ctx: Any, args: list[str]) -> list[str]:
    if not ctx.resilient_parsing:
        for option in command.get_params(ctx):
            _refuse_two(option, args)
    parsed: list[str] = parse(ctx, args)
    return parsed


def _refuse_two(option: Any, args: Sequence[str]) -> None:
    """Refuse words that give one option two values.

    Raises:
        UsageError: naming both.
    """
    if option.param_type_name != "option" or option.multiple or getattr(option, "count", False):
        return
    given = list(dict.fromkeys(_given(option, args)))
    if len(given) > 1:
        flags = " and ".join(given[:2]) if option.is_flag else f"{option.opts[0]} {given[0]} and {given[1]}"
        raise UsageError(f"{flags} are given at once; only one of them can be.", f"give {option.opts[0]} once")


def _given(option: Any, args: Sequence[str]) -> Iterator[str]:
    """Yield each value that words give an option: of a flag, the form of it that is typed first of its kind."""
    words = args[: args.index("--")] if "--" in args else args
    for at, word in enumerate(words):
        name, equals, value = word.partition("=")
        if option.is_flag and word in (*option.opts, *option.secondary_opts):
            yield option.opts[0] if word in option.opts else option.secondary_opts[0]
        elif not option.is_flag and name in option.opts:
            yield value if equals else next(iter(words[at + 1 :]), "")
