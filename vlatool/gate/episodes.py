"""The closed-loop episodes of a gate: played once, for every claim that is about them."""

from __future__ import annotations

from functools import cached_property
from typing import Any

from vlatool.bundle.bundle import Bundle
from vlatool.evaluate.closed_loop import ClosedLoop
from vlatool.gate.config import AccuracyClaim, DisturbedClaim
from vlatool.report import Row
from vlatool.stage.base import Context


class Episodes:
    """The same episodes of both bundles.

    Args:
        candidate, baseline: Bundles.
        claim: Which episodes.
        disturbed: Under which disturbances they are played as well; under none when None.
        context: Progress and workers.
        engine: Of the runtime; the one that each bundle was made for when empty.
    """

    def __init__(
        self,
        candidate: Bundle,
        baseline: Bundle,
        claim: AccuracyClaim,
        context: Context,
        engine: str = "",
        disturbed: DisturbedClaim | None = None,
    ) -> None:
        self._candidate, self._context = candidate, context
        self._options: dict[str, Any] = {"episodes": claim.episodes, "baseline": baseline.path, "policy": claim.policy}
        self._options |= {"engine": engine}
        if disturbed:
            self._options |= {"disturb": disturbed.kinds, "strength": disturbed.strength}

    @cached_property
    def rows(self) -> tuple[Row, Row]:
        """The baseline's row, with what succeeds by chance, and the candidate's; played when first asked for.

        Raises:
            DataError: when no environment is named, or it fails.
        """
        stage = ClosedLoop(**self._options)
        stage.check(self._candidate, None)
        baseline, candidate = stage.run(self._candidate, self._context).rows
        return baseline, candidate
