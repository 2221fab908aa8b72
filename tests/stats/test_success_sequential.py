from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import quad
from scipy.optimize import minimize_scalar
from scipy.stats import binom, multinomial, norm

from vlatool.stats.intervals import paired_drop
from vlatool.stats.success_sequential import Decision, Plan, exact_drop, exact_p, plan, spending_levels

RUNS = 10_000


@dataclass(frozen=True)
class Ended:
    """How simulated comparisons ended, one place each."""

    verdicts: NDArray[np.str_]
    pairs: NDArray[np.int64]
    lost: NDArray[np.int64]
    won: NDArray[np.int64]

    def __getitem__(self, verdict: str) -> int:
        return int((self.verdicts == verdict).sum())


@functools.cache
def verdict(comparison: Plan, lost: int, won: int, pairs: int) -> str:
    return comparison.verdict(lost, won, pairs)


def played(comparison: Plan, tasks: Sequence[tuple[float, float]], runs: int = RUNS, seed: int = 0) -> Ended:
    """Play comparisons whose tasks, equally often each, lose and win pairs with these chances; each until it ends."""
    random = np.random.default_rng(seed)
    verdicts, ends = np.full(runs, "go on", "U12"), np.zeros(runs, np.int64)
    counts, before = np.zeros((runs, 2), np.int64), 0
    for pairs in comparison.interim_analyses:
        each, left_over = divmod(pairs - before, len(tasks))
        assert not left_over, "an analysis without an equal share of each task"
        going = verdicts == "go on"
        for lose, win in tasks:
            drawn = random.multinomial(each, [lose, win, max(0.0, 1 - lose - win)], runs)[:, :2]
            counts += drawn * going[:, None]
        cells, places = np.unique(counts[going], axis=0, return_inverse=True)
        said = np.array([verdict(comparison, lost, won, pairs) for lost, won in cells.tolist()])
        verdicts[going] = said[places.ravel()]
        ends[going] = pairs
        before = pairs
    return Ended(verdicts, ends, counts[:, 0], counts[:, 1])


def on_the_limit(limit: float, discordant: float) -> tuple[float, float]:
    return (discordant + limit) / 2, (discordant - limit) / 2


def most_allowed(alpha: float, runs: int = RUNS) -> int:
    """False verdicts that a test with exactly this error would exceed once in a thousand times."""
    return int(binom.ppf(0.999, runs, alpha))


@pytest.mark.parametrize(("limit", "most", "discordant", "alpha"), [
    (0.03, 1000, 0.03, 0.025), (0.03, 1000, 0.06, 0.025), (0.03, 500, 0.04, 0.01), (0.03, 300, 0.1, 0.025),
    (0.01, 1000, 0.01, 0.025), (0.01, 1000, 0.02, 0.025), (0.05, 200, 0.05, 0.025), (0.0, 500, 0.02, 0.05),
])  # fmt: skip
def test_both_errors_hold_on_the_limit(limit: float, most: int, discordant: float, alpha: float) -> None:
    found = played(plan(limit, most, alpha), [on_the_limit(limit, discordant)])
    assert found["fail"] <= most_allowed(alpha)
    assert found["pass"] <= most_allowed(alpha)
    assert found["go on"] == 0
    assert found["fail"] + found["pass"] > 0, "something is decided at all"


def test_the_errors_hold_for_tasks_that_differ() -> None:
    """One task of four loses all that is lost; the drop over all of them is on the limit."""
    comparison = plan(0.03, 600, tasks=4)
    found = played(comparison, [(0.12, 0.0), (0.0, 0.0), (0.01, 0.01), (0.0, 0.0)])
    assert max(found["fail"], found["pass"]) <= most_allowed(0.025)
    assert found["fail"] > 0
    assert found["pass"] > 0


@pytest.mark.parametrize("swapped", [0.0025, 0.005, 0.01, 0.02, 0.04])
def test_without_a_drop_two_episodes_of_five_are_saved(swapped: float) -> None:
    """As many lost as won: policies that succeed in 90 to 99 % of episodes, 0.5 to 8 % of which end differently."""
    found = played(plan(limit=0.03, most=1000), [(swapped, swapped)])
    assert found.pairs.mean() <= 600
    assert found["fail"] <= 10
    assert found["pass"] >= (0.82 if swapped > 0.03 else 0.97) * RUNS


def test_fewer_discordant_pairs_save_more() -> None:
    means = [played(plan(0.03, 1000), [(share, share)], 2000).pairs.mean() for share in (0.0025, 0.01, 0.04)]
    assert means == sorted(means)
    assert means[0] < 350


def test_a_large_drop_is_found_early() -> None:
    found = played(plan(0.03, 1000), [(0.15, 0.01)], 2000)
    assert found["fail"] >= 1990
    assert found.pairs.mean() < 300


def test_what_is_hopeless_ends_early_and_nothing_else_changes() -> None:
    chances = [on_the_limit(0.05, 0.1)]
    early, late = (played(plan(0.05, 300, futile=futile), chances) for futile in (0.1, 0.0))
    assert early.pairs.mean() < 0.7 * 300
    assert late.pairs.mean() > 0.95 * 300
    decided = np.isin(early.verdicts, ["pass", "fail"])
    assert (early.verdicts[decided] == late.verdicts[decided]).all()
    assert decided.sum() > 0.9 * np.isin(late.verdicts, ["pass", "fail"]).sum()
    assert min(late["fail"], late["pass"]) > 0.6 * 0.025 * RUNS, "too wide bounds hold as well, and save less"
    assert max(late["fail"], late["pass"]) <= most_allowed(0.025)


@pytest.mark.parametrize(("lose", "win"), [(0.03, 0.03), (0.1, 0.02)])
def test_the_interval_covers_the_drop_wherever_the_comparison_ended(lose: float, win: float) -> None:
    comparison, runs = plan(limit=0.05, most=120), 300
    found = played(comparison, [(lose, win)], runs)
    cells = list(zip(found.lost.tolist(), found.won.tolist(), found.pairs.tolist(), strict=True))
    intervals = {cell: comparison.interval(*cell) for cell in set(cells)}
    ends = [intervals[cell] for cell in cells]
    assert sum(low > lose - win for _, low, _ in ends) <= most_allowed(0.025, runs)
    assert sum(high < lose - win for _, _, high in ends) <= most_allowed(0.025, runs)


@pytest.mark.parametrize("limit", [0.0, 0.03, 0.2])
def test_the_interval_agrees_with_the_verdict(limit: float) -> None:
    random = np.random.default_rng(1)
    comparison = plan(limit, most=200, futile=0)
    seen = set()
    for _ in range(40):
        pairs = int(random.choice(comparison.interim_analyses))
        lost = int(random.binomial(pairs, random.choice([0.01, 0.1, 0.3])))
        won = int(random.binomial(pairs - lost, random.choice([0.0, 0.02, 0.3])))
        found = comparison.judge(lost, won, pairs)
        assert -1 <= found.low <= found.drop <= found.high <= 1
        assert (found.low > limit) == (found.verdict == "fail")
        assert (found.high <= limit) == (found.verdict == "pass")
        assert found.verdict == comparison.verdict(lost, won, pairs)
        seen.add(found.verdict)
    assert {"fail", "go on"} <= seen


def test_the_interval_agrees_with_the_verdict_however_near_the_limit_is_to_a_bound() -> None:
    _, low, high = plan(0.0, 200).interval(20, 4, 200)
    for bound in (low, high):
        for off in np.linspace(-2e-5, 2e-5, 9):
            found = plan(bound + off, 200).judge(20, 4, 200)
            assert (found.low > found.limit) == (found.verdict == "fail")
            assert (found.high <= found.limit) == (found.verdict == "pass")


def restricted_by_search(lost: int, won: int, pairs: int, drop: float) -> float:
    """The chance to win with the greatest likelihood when the drop is known, found by search."""

    def loss(win: float) -> float:
        chances = (win + drop, win, 1 - 2 * win - drop)
        counts = (lost, won, pairs - lost - won)
        return -sum(count * math.log(max(chance, 1e-300)) for count, chance in zip(counts, chances, strict=True))

    return minimize_scalar(loss, bounds=(max(0.0, -drop), (1 - drop) / 2), method="bounded", options={"xatol": 1e-12}).x


@pytest.mark.parametrize(("lost", "won", "drop"), [(3, 0, 0.03), (5, 2, 0.0), (1, 1, -0.1), (9, 4, 0.2), (0, 0, -0.15)])
def test_the_p_value_is_the_sum_over_all_outcomes(lost: int, won: int, drop: float) -> None:
    pairs = 24

    def score(lost: int, won: int) -> float:
        variance = 2 * restricted_by_search(lost, won, pairs, drop) + drop * (1 - drop)
        return (lost - won - pairs * drop) / math.sqrt(pairs * max(variance, 1e-12))

    seen = score(lost, won)
    outcomes = [(one, two) for one in range(pairs + 1) for two in range(pairs + 1 - one)]
    beyond = np.array([(one, two, pairs - one - two) for one, two in outcomes if score(one, two) >= seen - 1e-5])
    root = math.sqrt(2 * restricted_by_search(lost, won, pairs, drop) + drop)
    sums = []
    for away in (-1, 0, 1):
        rate = max(abs(drop), max(0.0, root + away / math.sqrt(4 * pairs)) ** 2)
        sums.append(multinomial.pmf(beyond, pairs, [(rate + drop) / 2, (rate - drop) / 2, 1 - rate]).sum())
    assert exact_p(lost, won, pairs, drop) == pytest.approx(max(sums), rel=1e-4)


@pytest.mark.parametrize("drop", [0.0, 0.03, -0.03, 0.1, -0.1])
def test_the_level_of_one_analysis_holds_whatever_the_discordance(drop: float) -> None:
    """Over all outcomes of 50 pairs, to a fiftieth of the level (a normal score: 45 % over it)."""
    pairs = 50
    outcomes = np.array([(one, two, pairs - one - two) for one in range(pairs + 1) for two in range(pairs + 1 - one)])
    p_values = np.array([exact_p(int(lost), int(won), pairs, drop) for lost, won, _ in outcomes])
    for share in [*np.linspace(abs(drop) + 1e-6, 0.3, 12), 0.5, 0.8, 1.0]:
        chances = multinomial.pmf(outcomes, pairs, [(share + drop) / 2, (share - drop) / 2, 1 - share])
        for level in (0.001, 0.0025, 0.01, 0.025):
            assert chances[p_values <= level].sum() <= level * 1.02


@pytest.mark.parametrize("alpha", [0.01, 0.025, 0.1])
def test_the_levels_of_two_analyses_spend_the_error(alpha: float) -> None:
    """By one integral over the first score, instead of a recursion over sums."""
    first, second = (float(norm.isf(level)) for level in spending_levels((0.4, 1.0), alpha))
    assert norm.sf(first) == pytest.approx(0.4 * alpha, rel=1e-6)

    def late(score: float) -> float:
        return float(norm.pdf(score) * norm.sf((second - score * math.sqrt(0.4)) / math.sqrt(0.6)))

    assert quad(late, -9, first, epsabs=1e-12)[0] == pytest.approx(0.6 * alpha, rel=1e-5)


def test_the_levels_of_ten_analyses_spend_the_error_in_proportion() -> None:
    times = tuple(number / 10 for number in range(1, 11))
    bounds = norm.isf(spending_levels(times, 0.025))
    sums = np.random.default_rng(0).normal(size=(400_000, 10), scale=math.sqrt(0.1)).cumsum(axis=1)
    crossed = np.logical_or.accumulate(sums / np.sqrt(times) >= bounds, axis=1).mean(axis=0)
    assert crossed == pytest.approx(0.025 * np.array(times), rel=0.06)


def test_one_analysis_spends_it_all() -> None:
    assert spending_levels((1.0,), 0.025) == pytest.approx((0.025,), rel=1e-8)
    assert len(plan(0.03, 100, analyses=1).levels) == 1


def test_it_answers_the_same_every_time() -> None:
    first = plan(0.03, 1000).judge(12, 7, 500)
    spending_levels.cache_clear()
    assert plan(0.03, 1000).judge(12, 7, 500) == first
    one, two = (played(plan(0.03, 300), [(0.03, 0.02)], 500, seed=4) for _ in range(2))
    assert (one.verdicts == two.verdicts).all()


def test_a_decision_says_what_it_was_made_of() -> None:
    found = plan(limit=0.03, most=1000).judge(2, 1, 300)
    assert (found.verdict, found.over) == ("pass", True)
    assert (found.lost, found.won, found.pairs, found.most, found.limit) == (2, 1, 300, 1000, 0.03)
    assert found.drop == pytest.approx(1 / 300)
    going = plan(limit=0.03, most=1000).judge(2, 1, 100)
    assert (going.verdict, going.over) == ("go on", False)


def test_the_roles_mirror_the_interval() -> None:
    comparison = plan(0.0, 500)
    one, other = comparison.judge(14, 5, 250), comparison.judge(5, 14, 250)
    assert (one.drop, one.low, one.high) == pytest.approx((-other.drop, -other.high, -other.low))


def test_one_more_lost_pair_moves_both_bounds_up() -> None:
    comparison = plan(0.03, 500)
    ends = [comparison.interval(lost, 3, 250) for lost in range(12)]
    assert all((np.diff([end[place] for end in ends]) > 0).all() for place in range(3))


def test_a_later_analysis_narrows_the_interval() -> None:
    def width(pairs: int) -> float:
        _, low, high = plan(0.03, 1000).interval(pairs // 50, pairs // 50, pairs)
        return high - low

    widths = [width(pairs) for pairs in (100, 300, 600, 1000)]
    assert widths == sorted(widths, reverse=True)


@pytest.mark.parametrize(("lost", "won", "said"), [(100, 0, "fail"), (0, 100, "pass"), (50, 50, "go on")])
def test_counts_at_the_ends(lost: int, won: int, said: str) -> None:
    found = plan(0.03, 1000, futile=0).judge(lost, won, 100)
    assert found.verdict == said
    assert -1 <= found.low <= found.drop <= found.high <= 1


def test_without_a_discordant_pair_it_passes_no_sooner_than_the_limit_would_have_shown() -> None:
    """Nothing lost in n pairs has a chance of (1 - limit)^n when all that the limit allows is lost and nothing won."""
    comparison = plan(0.03, 1000)
    assert [comparison.verdict(0, 0, pairs) for pairs in (100, 200, 300)] == ["go on", "go on", "pass"]
    assert comparison.levels[0] < 0.97**100
    for limit, most in ((0.05, 100), (0.01, 400), (0.2, 30)):
        comparison = plan(limit, most)
        for pairs, level in zip(comparison.interim_analyses, comparison.levels, strict=True):
            assert comparison.verdict(0, 0, pairs) != "pass" or (1 - limit) ** pairs <= level


def test_the_last_analysis_is_the_last() -> None:
    found = plan(0.03, 200, futile=0).judge(8, 2, 200)
    assert (found.verdict, found.over, found.pairs) == ("inconclusive", True, 200)


@pytest.mark.parametrize(("most", "tasks", "analyses", "after"), [
    (1000, 1, 10, (100, 200, 300, 400, 500, 600, 700, 800, 900, 1000)), (500, 8, 4, (128, 256, 384, 504)),
    (5, 1, 10, (1, 2, 3, 4, 5)), (10, 10, 10, (10,)), (1, 3, 2, (3,)),
])  # fmt: skip
def test_each_analysis_has_equally_many_pairs_of_each_task(
    most: int, tasks: int, analyses: int, after: tuple[int, ...]
) -> None:
    assert plan(0.03, most, tasks=tasks, analyses=analyses).interim_analyses == after


@pytest.mark.parametrize(("made", "told"), [
    ({"limit": -0.01}, "limit is -0.01"), ({"limit": 1.0}, "limit is 1.0"), ({"limit": math.nan}, "limit is nan"),
    ({"alpha": 0.0}, "alpha is 0.0"), ({"alpha": 0.5}, "alpha is 0.5"), ({"alpha": math.nan}, "alpha is nan"),
    ({"futile": -0.1}, "futile is -0.1"), ({"futile": 1.0}, "futile is 1.0"), ({"most": 0}, "0 pairs"),
    ({"tasks": 0}, "0 tasks"), ({"analyses": 0}, "0 interim analyses"),
])  # fmt: skip
def test_a_plan_that_is_none_is_refused(made: dict[str, float], told: str) -> None:
    with pytest.raises(ValueError, match=told):
        plan(**{"limit": 0.03, "most": 100, **made})  # type: ignore[arg-type]


@pytest.mark.parametrize("after", [(), (0, 10), (20, 10), (10, 10)])
def test_interim_analyses_that_do_not_ascend_are_refused(after: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match="allowed: ascending numbers from 1"):
        Plan(0.03, after)


@pytest.mark.parametrize(("lost", "won", "pairs", "told"), [
    (1, 1, 150, "150 pairs; the interim analyses are after"), (-1, 0, 100, "-1 lost"), (0, -1, 100, "-1 won"),
    (60, 41, 100, "60 lost and 41 won of 100 pairs"),
])  # fmt: skip
@pytest.mark.parametrize("ask", ["judge", "verdict", "interval"])
def test_counts_that_are_none_are_refused(ask: str, lost: int, won: int, pairs: int, told: str) -> None:
    with pytest.raises(ValueError, match=told):
        getattr(plan(0.03, 1000), ask)(lost, won, pairs)


def test_a_decision_is_plain_numbers() -> None:
    found = plan(0.03, 500).judge(3, 1, 250)
    assert [type(value) for value in vars(found).values()] == [str, float, float, float, float, int, int, int, int]
    assert isinstance(found, Decision)


@pytest.mark.parametrize(("pairs", "limit", "confidence"), [(200, 0.01, 0.95), (200, 0.03, 0.98), (300, 0.01, 0.98)])
def test_a_fixed_number_of_pairs_passes_falsely_no_more_often_than_it_says(
    pairs: int, limit: float, confidence: float
) -> None:
    """On the limit, with nothing won: how often the upper bound lies below it, added up exactly."""
    alpha = (1 - confidence) / 2
    chances = [math.comb(pairs, lost) * limit**lost * (1 - limit) ** (pairs - lost) for lost in range(20)]
    errs = {
        bounds.__name__: sum(
            chance for lost, chance in enumerate(chances) if bounds(lost, 0, pairs, confidence)[2] <= limit
        )
        for bounds in (exact_drop, paired_drop)
    }
    assert errs["exact_drop"] <= alpha
    assert errs["paired_drop"] > 2 * alpha, "which is why the gate asks for the exact one"
