"""Requested and reached reduction of a pruning, and the operators that keep the rest."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from vlatool.errors import FallsShort
from vlatool.module.axes import Walk
from vlatool.prune._unit_groups import Macs

MIN_REACHED = 0.9
"""Share of the requested reduction that a result must reach."""
MAX_NAMED = 6
"""Largest number of keepers in a message."""
MIN_NAMED_SHARE = 0.005
"""Least share of the work of a keeper in a message."""


def reduction_record(goal: float, work: Macs, whole: Sequence[int], kept: Sequence[int], walks: Iterable[Walk]) -> Any:
    """Return the record of a pruning.

    Args:
        goal: Share of the multiply-accumulates to remove.
        whole: Units of each group before pruning.
        kept: Units of each group that stay.

    Returns:
        ``goal`` and ``reached`` (shares), ``macs`` (before, after), ``keeps`` (operator, or inputs and outputs ->
        share of the remaining work, in layers of which it keeps a whole width) and ``without_rule``, the operators
        whose effect on axes vlatool does not know.
    """
    before, after = work.macs(whole), work.macs(kept)
    keeps = {keeper: round(share, 4) for keeper, share in work.keepers(kept).items() if share >= MIN_NAMED_SHARE}
    unknown = sorted(set().union(*(walk.unknown for walk in walks)))
    reached = 1 - after / before if before else 0.0
    return {"asked": goal, "reached": round(reached, 4), "macs": [before, after], "keeps": keeps,
            "without_rule": unknown}  # fmt: skip


def describe_reduction(record: Mapping[str, Any]) -> tuple[str, ...]:
    """Describe the requested and reached reduction, and the operators without a rule that keep axes."""
    before, after = record["macs"]
    work = f"{before:,} -> {after:,} multiply-accumulates"
    reached = f"asked for {record['asked']:.1%} less work, reached {record['reached']:.1%} ({work})"
    keeps = record["keeps"]
    unknown = [f"{name} ({keeps.get(name, 0):.1%})" for name in record["without_rule"]]
    explanation = "no rule says what these do to heads and channels; all that touch them stay (share of the work left)"
    return (reached, *([f"{explanation}: {', '.join(unknown)}"] if unknown else []))


def refuse_shortfall(record: Mapping[str, Any]) -> None:
    """Refuse what missed the requested reduction by more than a tenth."""
    if record["reached"] >= MIN_REACHED * record["asked"]:
        return
    names = [f"{name} ({share:.1%})" for name, share in list(record["keeps"].items())[:MAX_NAMED]]
    names += [f"{len(record['keeps']) - MAX_NAMED} more"] if len(record["keeps"]) > MAX_NAMED else []
    keepers = f" Widths that stay, with the share of the work left: {', '.join(names)}." if names else ""
    unknown = f" Without a rule: {', '.join(record['without_rule'])}." if record["without_rule"] else ""
    less = f"ask for less: --ratio {int(100 * record['reached']) / 100:.2f}; " if record["reached"] >= 0.01 else ""
    more = "let less stay: --least, --multiple 1; look at --include and --exclude; " if record["reached"] else ""
    raise FallsShort(
        f"Asked for {record['asked']:.1%} less work; no more than {record['reached']:.1%} of the multiply-accumulates "
        f"can go.{keepers}{unknown}",
        f"{less}{more}whole blocks: vlatool prune depth",
    )
