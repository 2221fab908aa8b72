"""What a pruning was asked for, what it came to, and who keeps the rest."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from vlatool.bundle.bundle import Bundle
from vlatool.errors import FallsShort
from vlatool.module.axes import Walk
from vlatool.prune._units import Work
from vlatool.stage.controls import PRUNED_KEY

SHORT = 0.9
"""Share of what was asked for below which a result falls short of it."""
NAMED = 6
"""Keepers that a message names."""
WORTH_NAMING = 0.005
"""Share of the work from which on a keeper is named."""


def recorded(asked: float, work: Work, whole: Sequence[int], left: Sequence[int], walks: Iterable[Walk]) -> Any:
    """Return the record of a pruning.

    Args:
        asked: Share of the multiply-accumulates that was to go.
        work: Counts them.
        whole: Units of each group before.
        left: Those that stay.
        walks: Of the graphs.

    Returns:
        ``asked`` and ``reached`` (shares), ``macs`` (before, after), ``keeps`` (operator, or inputs and outputs ->
        share of the work that is left, in layers of which it keeps a whole width) and ``without_rule``, those of the
        operators of which vlatool does not know what they do to axes.
    """
    before, after = work.macs(whole), work.macs(left)
    keeps = {keeper: round(share, 4) for keeper, share in work.keepers(left).items() if share >= WORTH_NAMING}
    unknown = sorted(set().union(*(walk.unknown for walk in walks)))
    reached = 1 - after / before if before else 0.0
    return {"asked": asked, "reached": round(reached, 4), "macs": [before, after], "keeps": keeps,
            "without_rule": unknown}  # fmt: skip


def sentences(record: Mapping[str, Any]) -> tuple[str, ...]:
    """Return what was asked for and reached, and which operators without a rule keep what touches them."""
    before, after = record["macs"]
    work = f"{before:,} -> {after:,} multiply-accumulates"
    reached = f"asked for {record['asked']:.1%} less work, reached {record['reached']:.1%} ({work})"
    keeps = record["keeps"]
    unknown = [f"{name} ({keeps.get(name, 0):.1%})" for name in record["without_rule"]]
    said = "no rule says what these do to heads and channels; all that touch them stay (share of the work left)"
    return (reached, *([f"{said}: {', '.join(unknown)}"] if unknown else []))


def refuse_short(bundle: Bundle) -> None:
    """Refuse a bundle whose pruning fell short of what was asked for by more than a tenth.

    Raises:
        FallsShort: naming who keeps the rest, and how much of the work that is left.
    """
    record = bundle.manifest.made_by[PRUNED_KEY]
    if record["reached"] >= SHORT * record["asked"]:
        return
    shown = [f"{name} ({share:.1%})" for name, share in list(record["keeps"].items())[:NAMED]]
    shown += [f"{len(record['keeps']) - NAMED} more"] if len(record["keeps"]) > NAMED else []
    keepers = f" Widths that stay, with the share of the work left: {', '.join(shown)}." if shown else ""
    unknown = f" Without a rule: {', '.join(record['without_rule'])}." if record["without_rule"] else ""
    less = f"ask for less: --ratio {int(100 * record['reached']) / 100:.2f}; " if record["reached"] >= 0.01 else ""
    more = "let less stay: --least, --multiple 1; look at --include and --exclude; " if record["reached"] else ""
    raise FallsShort(
        f"Asked for {record['asked']:.1%} less work; no more than {record['reached']:.1%} of the multiply-accumulates "
        f"can go.{keepers}{unknown}",
        f"{less}{more}whole blocks: vlatool prune depth",
    )
