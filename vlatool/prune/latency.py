"""Pruning to a latency: blocks, heads, neurons and channels are removed by their latency, here or on a board."""

from __future__ import annotations

import functools
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from pydantic import Field, model_validator

from vlatool.bundle.bundle import Bundle, hash_file
from vlatool.errors import DataError, RecipeError
from vlatool.files.printable import amount
from vlatool.files.scratch import scratch_directory
from vlatool.hardware.profile import Profile, load_profile, profile_file, profile_names
from vlatool.latency_model.board import Candidate
from vlatool.latency_model.board_measurements import calibrations
from vlatool.machine.host import fingerprint, matches
from vlatool.module.blocks import stacks_of
from vlatool.module.edits import Edit, edits_from
from vlatool.module.feeds import unrecorded_note
from vlatool.module.stage import ModuleChanges, ModuleStage
from vlatool.prune._block_ranking import BlockRanking
from vlatool.prune._latency_costs import (
    Stack,
    first_kept_member,
    is_inside_removed,
    keep_edits,
    measure_costs,
    prefix_of,
    rank_blocks,
    role_of,
)
from vlatool.prune._latency_meter import LatencyMeter, LatencyPredictor
from vlatool.prune._selection import Selection
from vlatool.prune._trials import Trials
from vlatool.prune._unit_groups import Macs, Rank, UnitGroup, find_groups, no_units, rank_units, trace_walks
from vlatool.prune.depth import PROTECTED_WORDS
from vlatool.stage.base import Context
from vlatool.stage.record import made_by

if TYPE_CHECKING:
    from torch import nn
    from typing_extensions import Self

TARGET_SHARE, TOLERANCE = 0.98, 0.04
"""Share of the requested latency to aim at, and how far below the request a result may lie."""
MAX_ROUNDS = 8
"""Largest number of rounds of selection and measurement."""
MAX_CORRECTION = 1.5
"""Largest factor by which one result may correct the goal: the next one corrects a disturbed one."""


class LatencyPruning(ModuleStage):
    """Remove the parts of least importance for each millisecond, until an inference reaches the target latency.

    Milliseconds are measured on this machine in float32: without half of the units of each kind of layer, and without
    one block of each stack, all in one run. The selection is then measured as a whole, and repeated until the latency
    lies within 4 % below the target. With ``--profile`` of another board nothing is measured: the same exports are
    predicted for that board, with the uncertainty of such predictions. ``gate`` ranks blocks and units alike, by how
    much the action changes when one is scaled. Quantize the result afterwards, which makes it faster.
    """

    target_ms: float = Field(gt=0, le=1e6, description="milliseconds that an inference may take, in float32")
    board: str = Field("", description="profile to predict for; --profile sets it; measured on this machine when empty")
    engine: str = Field("", description="engine of the runtime; the default one when empty")
    threads: int = Field(1, ge=1, le=1024, description="intra-op threads")
    rank: Rank = Field("gate", description="how units are ranked")
    blocks: bool = Field(
        True, description="also remove blocks whose weights may all be removed: those of the trunk, and those included"
    )
    samples: int = Field(32, ge=1, description="recorded observations to rank on")
    multiple: int = Field(16, ge=1, description="keep a multiple of this many neurons and channels")
    least: float = Field(0.125, gt=0, le=1, description="minimum share of each group to keep")
    include: tuple[str, ...] = Field((), description="globs of weights to prune; all when empty")
    exclude: tuple[str, ...] = Field((), description="globs of weights to leave as they are")
    chosen: str = Field("", description="choice of an earlier run, from its manifest; nothing is measured then")

    def on(self, board: Profile | None) -> Self:
        """Return the stage that predicts for a board, or measures where the board is this machine.

        Raises:
            RecipeError: when no profile has its name, another board was named, or ``threads`` was set.
        """
        if board is None:
            return self
        if self.board:
            if load_profile(self.board) != board:
                message = f"--board {self.board} and --profile {board.name} are different boards."
                raise RecipeError(message, "name one of them")
            return self
        if matches(board.model_strings, fingerprint()):
            return self
        if board.name not in profile_names() or load_profile(board.name) != board:
            raise RecipeError(
                f"The bundle records for which board it was pruned, and {board.name} is not a known profile.",
                "name its file: --board FILE, or add its folder to VLATOOL_PROFILES",
            )
        self._refuse_threads(board.name)
        return self.model_copy(update={"board": board.name})

    @model_validator(mode="after")
    def _check_board(self) -> Self:
        """Refuse an unknown board, an engine that it lacks, or ``threads``: predictions are for whole boards."""
        if self.board and not self.chosen:
            board = load_profile(self.board)
            _ = Candidate(board, board.default_mode, self.engine or board.engine).figures
            self._refuse_threads(self.board)
        return self

    def _refuse_threads(self, board: str) -> None:
        if "threads" in self.model_fields_set and not self.chosen:
            raise RecipeError(
                f"--threads {self.threads} applies to measurements on this machine; {board} is predicted as a whole.",
                "omit --threads, or measure here: omit --profile and --board",
            )

    def key(self, source_hash: str) -> str:
        """Return the cache key, with the other inputs of predictions: the profile, and own measurements."""
        if not self.board or self.chosen:
            return super().key(source_hash)
        files = (profile_file(self.board), *sorted(calibrations().glob("*.json")))
        return super().key(" ".join([source_hash, *map(hash_file, files)]))

    def summarize(self, bundle: Bundle) -> tuple[str, ...]:
        """Report a latency that was only predicted."""
        predicted = f"predicted, not measured: {self.target_ms:g} ms or up to {TOLERANCE:.0%} less on {self.board}"
        return (predicted,) if self.board and not self.chosen else ()

    def change(self, modules: Mapping[str, nn.Module], source: Bundle, context: Context) -> ModuleChanges:
        """Choose the blocks and units to keep.

        Raises:
            RecipeError: when the policy is fast enough already, or cannot become fast enough.
            SourceError: when torch.export cannot trace a module.
            DataError: when the latency is not met because it varies from run to run.
        """
        if self.chosen:
            return ModuleChanges(_parse_edits(self.chosen))
        if self.board:
            self._predict_whole(source, context)
        context.progress("tracing the policy", None)
        walks = trace_walks(modules, source)
        groups = find_groups(walks, Selection(self.include, self.exclude), self.multiple, source.manifest.name)
        if not groups:
            raise no_units(source.manifest.name)
        context.progress(f"ranking the units of {amount(len(groups), 'group')}", None)
        rank_units(groups, self.rank, modules, source, self.samples)
        blocks = self.stacks(modules, source)
        work = Macs(walks, {step.graph: step.repeat for step in source.manifest.program}, groups)
        with scratch_directory() as scratch:
            meter = self._meter(source, scratch, context)
            edits = self._meet_target(groups, blocks, work, meter, context)
        board = {"board": load_profile(self.board).name} if self.board else {}
        options = {"chosen": json.dumps([asdict(edit) for edit in edits]), **board}
        messages = unrecorded_note(source, self.samples) if self.rank == "gate" else ()
        return ModuleChanges(edits, options=options, messages=messages)

    def _predict_whole(self, source: Bundle, context: Context) -> None:
        """Predict the unpruned policy before the ranking, in case the target is met already."""
        context.progress(f"predicting for {self.board}", None)
        with scratch_directory() as scratch:
            whole, _ = self._meter(source, scratch, context).times([])
        self._refuse_if_met(whole)

    def _meter(self, source: Bundle, scratch: Path, context: Context) -> LatencyMeter:
        arguments = (source, scratch, self.engine, self.threads, made_by(self), context)
        return LatencyPredictor(load_profile(self.board), *arguments) if self.board else LatencyMeter(*arguments)

    def _refuse_if_met(self, whole: float) -> None:
        if whole <= self.target_ms:
            here = f"takes {whole:.3g} ms here"
            takes = f"is predicted to take {whole:.3g} ms on {self.board}" if self.board else here
            raise RecipeError(f"An inference {takes} already; asked for {self.target_ms:g} ms.", "ask for less")

    def stacks(self, modules: Mapping[str, nn.Module], source: Bundle) -> list[Stack]:
        """Return the stacks that may lose blocks, with the importance of each block; none for a policy without any."""
        if not self.blocks or self.rank != "gate":
            return []
        protected = Selection.protecting(PROTECTED_WORDS, source.manifest.parts)
        found = [
            Stack(lists, tuple(name for name, _ in blocks.named_children()))
            for lists, blocks in stacks_of(modules)
            if self._may_remove(lists, blocks) and (self.include or not any(map(protected.protects, lists.values())))
        ]
        if found:
            rank_blocks(found, BlockRanking(modules, source, self.samples))
        return found

    def _may_remove(self, lists: Mapping[str, str], blocks: nn.Module) -> bool:
        """Return whether all weights of a stack may be removed, since blocks are removed as a whole."""
        selection = Selection(self.include, self.exclude)
        weights = [weight for weight, _ in blocks.named_parameters()]
        return all(selection.selects((prefix_of(name) + weight,)) for name in lists.values() for weight in weights)

    def _meet_target(
        self, groups: Sequence[UnitGroup], blocks: Sequence[Stack], work: Macs, meter: LatencyMeter, context: Context
    ) -> tuple[Edit, ...]:
        """Return edits that meet the target, selecting again until they do."""
        context.progress(f"measuring {len({role_of(group) for group in groups})} kinds of layers", None)
        whole, prices = measure_costs(groups, blocks, work, meter)
        self._refuse_if_met(whole)
        selector = _Selector(groups, blocks, work, prices, self.least)
        trials = Trials(meter, [whole])
        wanted = 1.0
        for number in range(MAX_ROUNDS):
            goal = TARGET_SHARE * self.target_ms / trials.undisturbed_ms * whole
            select = functools.partial(selector.select_until, whole, asked=self.target_ms)
            edits = trials.next_choice(select, wanted * goal, whole)
            if self._is_met(trials.measure(edits)):  # confirm with a second run
                trials.measure(edits)
            ms = trials.record_result(edits, wanted)
            context.progress(f"{ms:.3g} ms of {self.target_ms:g}", (number + 1) / MAX_ROUNDS)
            if self._is_met(ms):
                return edits
            next_one = TARGET_SHARE * self.target_ms / trials.result_ratio
            wanted = min(MAX_CORRECTION * wanted, max(wanted / MAX_CORRECTION, next_one))
        how, quiet = ("predicted", "") if self.board else ("measured", "let nothing else run meanwhile; ")
        raise DataError(
            f"The latency of {self.target_ms:g} ms was not met within {TOLERANCE:.0%}; {how}: "
            f"{', '.join(f'{ms:.3g}' for ms in trials.results)} ms.",
            f"{quiet}let units go one by one: --multiple 1",
        )

    def _is_met(self, ms: float) -> bool:
        return (1 - TOLERANCE) * self.target_ms <= ms <= self.target_ms


def _parse_edits(text: str) -> tuple[Edit, ...]:
    """Return the edits that an earlier run chose."""
    edits = edits_from(text, "--chosen")
    if not edits:
        raise RecipeError("--chosen is an empty list: nothing would be pruned.", "omit it for a new selection")
    return edits


@dataclass(frozen=True, order=True)
class _Candidate:
    """Next candidate for removal: importance for each millisecond saved, milliseconds, and what is removed."""

    cost: float
    ms: float
    index: int
    removed: tuple[int, ...]


class _Selector:
    """Selects units and blocks by their costs; ``prices`` maps roles of groups to ms for a multiply-accumulate."""

    def __init__(
        self,
        groups: Sequence[UnitGroup],
        stacks: Sequence[Stack],
        work: Macs,
        prices: Mapping[str, float],
        least: float,
    ) -> None:
        self._groups, self._stacks, self._work, self._least = groups, stacks, work, least
        self._prices = [prices[role_of(group)] for group in groups]
        self._saved = [0.0] * len(groups)

    def select_until(self, whole: float, goal: float, asked: float) -> tuple[Edit, ...]:
        """Remove the candidates of least importance for each millisecond, from the whole policy, until the goal.

        Args:
            whole: Milliseconds of the unpruned policy when the costs were measured.
            goal: Milliseconds to reach.
            asked: Milliseconds that the user requested, before the correction to ``goal``.

        Raises:
            RecipeError: when the goal is out of reach.
        """
        self._saved = [0.0] * len(self._groups)
        for group in self._groups:
            group.keep = list(range(group.size))
        for stack in self._stacks:
            stack.keep = list(range(len(stack.blocks)))
        left = whole
        while left > goal:
            candidates = [*self._units(), *self._blocks()]
            fit = [candidate for candidate in candidates if left - candidate.ms >= (1 - TOLERANCE) * goal]
            if not candidates:
                reachable = left * TARGET_SHARE * asked / goal
                raise RecipeError(
                    f"No less than about {reachable:.3g} ms can be reached; asked for {asked:g}.",
                    "ask for more, or let less stay (--least); quantization makes it faster, too",
                )
            candidate = min(fit) if fit else min(candidates, key=lambda candidate: candidate.ms)
            self._remove(candidate)
            left -= candidate.ms
        return keep_edits(self._groups, self._stacks)

    def _units(self) -> Iterator[_Candidate]:
        """Yield the next units of each group outside of removed blocks."""
        for number, group in enumerate(self._groups):
            if first_kept_member(group, self._stacks) is None:
                continue
            importance, removed = group.cheapest_units(self._least)
            macs = self._work.saved_alone(number, group.remaining - len(removed))
            ms = self._prices[number] * macs - self._saved[number]
            if removed and ms > 0:
                yield _Candidate(importance / ms, ms, number, tuple(removed))

    def _blocks(self) -> Iterator[_Candidate]:
        """Yield the next block of each stack; the last one stays."""
        for index, stack in enumerate(self._stacks):
            if len(stack.keep) < 2 or is_inside_removed(stack, self._stacks):
                continue
            block = stack.least_important
            inside = (number for number, group in enumerate(self._groups) if stack.contains(group, block))
            ms = stack.ms - sum(self._saved[number] for number in inside)
            if ms > 0:
                yield _Candidate(stack.importance[block] / ms, ms, len(self._groups) + index, (block,))

    def _remove(self, candidate: _Candidate) -> None:
        if candidate.index < len(self._groups):
            self._groups[candidate.index].remove(candidate.removed)
            self._saved[candidate.index] += candidate.ms
        else:
            self._stacks[candidate.index - len(self._groups)].keep.remove(*candidate.removed)
