"""Pruning to a latency: blocks, heads, neurons and channels go by what they take here or on a board, not by work."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from pydantic import Field, model_validator

from vlatool.bundle.bundle import Bundle, hash_file
from vlatool.errors import DataError, RecipeError
from vlatool.files.scratch import scratch_directory
from vlatool.hardware.profile import Profile, load_profile, names, profile_file
from vlatool.latency_model.board import Candidate
from vlatool.latency_model.measured import calibrations
from vlatool.machine.host import fingerprint, matches
from vlatool.module.blocks import stacks_of
from vlatool.module.edits import Edit, edits_from
from vlatool.module.feeds import unrecorded_note
from vlatool.module.stage import ModuleChanges, ModuleStage
from vlatool.prune._clock import BoardClock, Clock
from vlatool.prune._prices import (
    Stack,
    edits_of,
    is_inside_gone,
    measured_prices,
    prefix_of,
    rank_blocks,
    role_of,
    staying,
)
from vlatool.prune._ranking import Ranking
from vlatool.prune._selection import Selection, protected_parts
from vlatool.prune._trials import Trials
from vlatool.prune._units import Group, Rank, Work, groups_of, nothing, rank_units, walks_of
from vlatool.prune.depth import PROTECTED
from vlatool.stage.base import Context

if TYPE_CHECKING:
    from torch import nn
    from typing_extensions import Self

AIM, CLOSE = 0.98, 0.04
"""The share of the asked latency that is aimed at, and how far below it a result may stay."""
ROUNDS = 8
"""Of choosing and measuring, at most."""
MOST_AT_ONCE = 1.5
"""Factor by which a result may change what is aimed at: one that was disturbed is corrected by the next."""


class LatencyPruning(ModuleStage):
    """Remove what matters least for the milliseconds that it takes, until an inference takes as long as asked.

    Milliseconds are measured on this machine in float32: without half of the units of each kind of layer, and without
    one block of each stack, all in one run. What is removed is then measured as a whole, and chosen again, until the
    latency lies within 4 % below the target. With ``--profile`` of another board nothing is measured: the same
    exports are predicted for that board, with the uncertainty that its predictions have. ``gate`` ranks blocks and
    units alike, by how much the action moves when one is scaled. Quantization comes afterwards, and makes it faster.
    """

    target_ms: float = Field(gt=0, le=1e6, description="milliseconds that an inference may take, in float32")
    board: str = Field("", description="profile to predict for; --profile sets it; measured on this machine when empty")
    engine: str = Field("", description="engine of the runtime; the default one when empty")
    threads: int = Field(1, ge=1, le=1024, description="intra-op threads")
    rank: Rank = Field("gate", description="how units are ranked")
    blocks: bool = Field(
        True, description="whether blocks may go whose weights all may: the trunk's, and those included"
    )
    samples: int = Field(32, ge=1, description="recorded observations to rank on")
    multiple: int = Field(16, ge=1, description="neurons and channels that stay are a multiple of this")
    least: float = Field(0.125, gt=0, le=1, description="share of each group that stays in any case")
    include: tuple[str, ...] = Field((), description="globs of weights to prune; all when empty")
    exclude: tuple[str, ...] = Field((), description="globs of weights to leave as they are")
    chosen: str = Field("", description="what an earlier run chose, as its manifest has it: nothing is measured then")

    def on(self, profile: Profile) -> Self:
        """Return the stage that predicts for a board, or measures where the board is this machine.

        Raises:
            RecipeError: when its profile cannot be found by its name, another board was named, or threads were.
        """
        if self.board:
            if load_profile(self.board) != profile:
                said = f"--board {self.board} and --profile {profile.name} are two boards."
                raise RecipeError(said, "name one of them")
            return self
        if matches(profile.model_strings, fingerprint()):
            return self
        if profile.name not in names() or load_profile(profile.name) != profile:
            raise RecipeError(
                f"The bundle records for which board it was pruned, and {profile.name} is not a known profile.",
                "name its file: --board FILE, or add its folder to VLATOOL_PROFILES",
            )
        self._refuse_threads(profile.name)
        return self.model_copy(update={"board": profile.name})

    @model_validator(mode="after")
    def _known(self) -> Self:
        """Refuse an unknown board, an engine that it does not have, or threads: predictions are of whole boards.

        Raises:
            ProfileError: naming those that there are.
            RecipeError: for threads.
        """
        if self.board and not self.chosen:
            board = load_profile(self.board)
            _ = Candidate(board, board.default_mode, self.engine or board.engine).figures
            self._refuse_threads(self.board)
        return self

    def _refuse_threads(self, board: str) -> None:
        if "threads" in self.model_fields_set and not self.chosen:
            raise RecipeError(
                f"--threads {self.threads} is of measurements on this machine; {board} is predicted as a whole.",
                "leave --threads out, or measure here: leave --profile and --board out",
            )

    def key(self, source_hash: str) -> str:
        """Return the cache key, with what predictions rest on besides the model: the profile, and own measurements."""
        if not self.board or self.chosen:
            return super().key(source_hash)
        files = (profile_file(self.board), *sorted(calibrations().glob("*.json")))
        return super().key(" ".join([source_hash, *map(hash_file, files)]))

    def lines(self, bundle: Bundle) -> tuple[str, ...]:
        """Return how large the modules are, and what was not measured."""
        predicted = f"predicted, not measured: {self.target_ms:g} ms or up to {CLOSE:.0%} less on {self.board}"
        return (*super().lines(bundle), *([predicted] if self.board and not self.chosen else []))

    def change(self, modules: Mapping[str, nn.Module], source: Bundle, context: Context) -> ModuleChanges:
        """Choose the blocks and units that stay.

        Raises:
            RecipeError: when it is fast enough already, or cannot be made so fast.
            SourceError: when torch.export cannot trace a module.
            DataError: when the latency is not met: it changes from run to run.
        """
        if self.chosen:
            return ModuleChanges(_edits_chosen(self.chosen))
        if self.board:
            self._predict_whole(source, context)
        context.progress("tracing the policy", None)
        walks = walks_of(modules, source)
        groups = groups_of(walks, Selection(self.include, self.exclude), self.multiple, source.manifest.name)
        if not groups:
            raise nothing(source.manifest.name)
        context.progress(f"ranking the units of {len(groups)} groups", None)
        context.messages.extend(unrecorded_note(source, self.samples) if self.rank == "gate" else ())
        rank_units(groups, self.rank, modules, source, self.samples)
        blocks = self.stacks(modules, source)
        work = Work(walks, {step.graph: step.repeat for step in source.manifest.program}, groups)
        with scratch_directory() as scratch:
            clock = self._clock(source, scratch, context)
            edits = self._met(groups, blocks, work, clock, context)
        board = {"board": load_profile(self.board).name} if self.board else {}
        return ModuleChanges(edits, options={"chosen": json.dumps([asdict(edit) for edit in edits]), **board})

    def _predict_whole(self, source: Bundle, context: Context) -> None:
        """Say at once, and not after the ranking, that there is nothing to do."""
        context.progress(f"predicting for {self.board}", None)
        with scratch_directory() as scratch:
            whole, _ = self._clock(source, scratch, context).times([])
        self._refuse_met(whole)

    def _clock(self, source: Bundle, scratch: Path, context: Context) -> Clock:
        of = (source, scratch, self.engine, self.threads, self.made_by(), context)
        return BoardClock(load_profile(self.board), *of) if self.board else Clock(*of)

    def _refuse_met(self, whole: float) -> None:
        if whole <= self.target_ms:
            here = f"takes {whole:.3g} ms here"
            takes = f"is predicted to take {whole:.3g} ms on {self.board}" if self.board else here
            raise RecipeError(f"An inference {takes} already; asked for {self.target_ms:g} ms.", "ask for less")

    def stacks(self, modules: Mapping[str, nn.Module], source: Bundle) -> list[Stack]:
        """Return the stacks that may lose blocks, with the importance of these; none for a policy without blocks."""
        if not self.blocks or self.rank != "gate":
            return []
        protected = Selection((), (), PROTECTED, protected_parts(source.manifest.parts, PROTECTED))
        found = [
            Stack(places, tuple(name for name, _ in blocks.named_children()))
            for places, blocks in stacks_of(modules)
            if self._chooses(places, blocks) and (self.include or not any(map(protected.protects, places.values())))
        ]
        if found:
            rank_blocks(found, Ranking(modules, source, self.samples))
        return found

    def _chooses(self, places: Mapping[str, str], blocks: nn.Module) -> bool:
        """Return whether all weights of a stack may go: those that stay would have no block to stay in."""
        selection = Selection(self.include, self.exclude)
        weights = [weight for weight, _ in blocks.named_parameters()]
        return all(selection.has((prefix_of(name) + weight,)) for name in places.values() for weight in weights)

    def _met(
        self, groups: Sequence[Group], blocks: Sequence[Stack], work: Work, clock: Clock, context: Context
    ) -> tuple[Edit, ...]:
        """Return edits that meet the target, choosing again as long as what was chosen does not."""
        context.progress(f"what {len({role_of(group) for group in groups})} kinds of layers take", None)
        whole, prices = measured_prices(groups, blocks, work, clock)
        self._refuse_met(whole)
        choice = _Choice(groups, blocks, work, prices, self.least)
        trials = Trials(clock, [whole])
        wanted = 1.0
        for number in range(ROUNDS):
            goal = AIM * self.target_ms / trials.undisturbed * whole
            edits = trials.untried(lambda share: choice.until(whole, share, self.target_ms), wanted * goal, whole)
            if self._is_met(trials.measured(edits)):  # once may be luck
                trials.measured(edits)
            ms = trials.seen(edits, wanted)
            context.progress(f"{ms:.3g} ms of {self.target_ms:g}", (number + 1) / ROUNDS)
            if self._is_met(ms):
                return edits
            next_one = AIM * self.target_ms / trials.for_each
            wanted = min(MOST_AT_ONCE * wanted, max(wanted / MOST_AT_ONCE, next_one))
        how, quiet = ("predicted", "") if self.board else ("measured", "let nothing else run meanwhile; ")
        raise DataError(
            f"The latency of {self.target_ms:g} ms was not met within {CLOSE:.0%}; {how}: "
            f"{', '.join(f'{ms:.3g}' for ms in trials.tried)} ms.",
            f"{quiet}let units go one by one: --multiple 1",
        )

    def _is_met(self, ms: float) -> bool:
        return (1 - CLOSE) * self.target_ms <= ms <= self.target_ms


def _edits_chosen(text: str) -> tuple[Edit, ...]:
    """Return the edits that an earlier run chose; there are some.

    Raises:
        SourceError: when the text is no list of edits.
        RecipeError: when it is an empty one.
    """
    edits = edits_from(text, "--chosen")
    if not edits:
        raise RecipeError("--chosen is an empty list: nothing would be pruned.", "leave it out: it is chosen anew")
    return edits


@dataclass(frozen=True, order=True)
class _Offer:
    """What may go next: how much it matters for each millisecond that it saves, and what it is."""

    price: float
    ms: float
    part: int
    loses: tuple[int, ...]


class _Choice:
    """Chooses what goes by prices that were measured.

    Args:
        groups: Units that may go.
        stacks: Blocks that may go.
        work: Of the groups.
        prices: Role of a group -> milliseconds for a multiply-accumulate.
        least: Share of each group that stays.
    """

    def __init__(
        self, groups: Sequence[Group], stacks: Sequence[Stack], work: Work, prices: Mapping[str, float], least: float
    ) -> None:
        self._groups, self._stacks, self._work, self._least = groups, stacks, work, least
        self._prices = [prices[role_of(group)] for group in groups]
        self._saved = [0.0] * len(groups)

    def until(self, whole: float, goal: float, asked: float) -> tuple[Edit, ...]:
        """Take away what matters least for the milliseconds that it saves, from all of it, until so many are left.

        Args:
            whole: Milliseconds of the whole policy, when the prices were measured.
            goal: Those that are to be left.
            asked: What the user asked for, which ``goal`` is a correction of.

        Raises:
            RecipeError: when no more may go before.
        """
        self._saved = [0.0] * len(self._groups)
        for group in self._groups:
            group.keep = list(range(group.size))
        for stack in self._stacks:
            stack.keep = list(range(len(stack.blocks)))
        left = whole
        while left > goal:
            offers = [*self._units(), *self._blocks()]
            fit = [offer for offer in offers if left - offer.ms >= (1 - CLOSE) * goal]
            if not offers:
                raise RecipeError(
                    f"No less than about {left * AIM * asked / goal:.3g} ms can be reached; asked for {asked:g}.",
                    "ask for more, or let less stay (--least); quantization makes it faster, too",
                )
            offer = min(fit) if fit else min(offers, key=lambda offer: offer.ms)
            self._take(offer)
            left -= offer.ms
        return edits_of(self._groups, self._stacks)

    def _units(self) -> Iterator[_Offer]:
        """Yield the next units of each group that is not in a block that is gone."""
        for number, group in enumerate(self._groups):
            if staying(group, self._stacks) is None:
                continue
            cost, loses = group.cheapest(self._least)
            ms = self._prices[number] * self._work.without(number, group.stays - len(loses)) - self._saved[number]
            if loses and ms > 0:
                yield _Offer(cost / ms, ms, number, tuple(loses))

    def _blocks(self) -> Iterator[_Offer]:
        """Yield the next block of each stack; the last one stays."""
        for place, stack in enumerate(self._stacks):
            if len(stack.keep) < 2 or is_inside_gone(stack, self._stacks):
                continue
            block = stack.least
            inside = (number for number, group in enumerate(self._groups) if stack.is_block_of(group, block))
            ms = stack.ms - sum(self._saved[number] for number in inside)
            if ms > 0:
                yield _Offer(stack.importance[block] / ms, ms, len(self._groups) + place, (block,))

    def _take(self, offer: _Offer) -> None:
        if offer.part < len(self._groups):
            self._groups[offer.part].without(offer.loses)
            self._saved[offer.part] += offer.ms
        else:
            self._stacks[offer.part - len(self._groups)].keep.remove(*offer.loses)
