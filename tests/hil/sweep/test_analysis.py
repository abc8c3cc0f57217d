"""The answers of a table, against laws that are known: distributions, sums of squares, and Ishigami's function."""

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import beta, lognorm, norm

from hil.sweep.analysis import INTERACTIONS, QUANTILES, Analysis, difference, mean, quantile
from hil.sweep.function import UserFunction
from hil.sweep.study import Factor, Sampling, Study

TRIALS = 400
CERTAIN = 0.95 - 3.0 * np.sqrt(0.95 * 0.05 / TRIALS)
"""The share of the intervals that must hold the true value: 95 %, less three standard deviations of so many trials."""
MODEL = UserFunction("model", "", "here", lambda **factors: 0.0)
PI = np.pi


def table_of(study, **figures):
    """The table of a study as a sweep would write it, with these figures (N,); a run without the first one has failed."""
    points = study.points()
    columns = {each.name: [point[each.name] for point in points] for each in study.factors}
    failed = [value is None for value in next(iter(figures.values()))]
    status = ["failed" if each else "done" for each in failed]
    reason = ["it broke" if each else None for each in failed]
    keys = [str(number) for number in range(len(points))]
    return pa.table({"key": keys, "status": status, "reason": reason, **columns, **figures})


def analysed(study, **figures):
    return Analysis(study, table_of(study, **{name: list(values) for name, values in figures.items()}))


def study_of(*factors, **sampling):
    return Study(factors, sampling=Sampling(**sampling), model=MODEL)


@pytest.mark.slow
@pytest.mark.parametrize("share", QUANTILES)
@pytest.mark.parametrize("count", [40, 600])
def test_intervals_of_quantiles_hold_the_quantile_of_the_distribution(share, count):
    random, true = np.random.default_rng(5), lognorm(1.0).ppf(share)
    found = [quantile(lognorm(1.0).rvs(count, random_state=random), share) for _ in range(TRIALS)]
    assert np.mean([each.low <= true <= each.high for each in found]) >= CERTAIN
    # No wider than they need to be: the next pair of ordered values would hold it in less than 99.9 %.
    if count == 600 and share < 0.99:
        assert np.mean([each.low <= true <= each.high for each in found]) < 0.99


def test_the_interval_is_that_of_the_ordered_values():
    """By the beta distribution of ordered values, in place of the binomial one of their number."""
    values = np.random.default_rng(2).permutation(np.arange(1.0, 101.0))
    found = quantile(values, 0.9)
    assert (found.value, found.share) == (pytest.approx(np.quantile(values, 0.9)), 0.9)
    low, high = int(found.low), int(found.high)
    assert beta(low, 101 - low).cdf(0.9) >= 0.975 > beta(low + 1, 100 - low).cdf(0.9)
    assert beta(high, 101 - high).cdf(0.9) <= 0.025 < beta(high - 1, 102 - high).cdf(0.9)


def test_too_few_runs_tell_no_end():
    found = quantile(np.arange(20.0), 0.99)
    assert np.isfinite(found.low) and found.high == np.inf
    assert quantile([3.0], 0.5).low == -np.inf
    few = quantile([1.0, 2.0], 0.99)
    assert few.low <= few.value <= few.high == np.inf
    assert (mean([3.0]).low, mean([3.0]).value) == (-np.inf, 3.0)


@pytest.mark.slow
@pytest.mark.parametrize(("seeds", "cells", "common"), [(20, 9, 0.8), (12, 4, 1.0), (60, 6, 0.0)])
def test_runs_of_the_same_seed_are_no_independent_runs(seeds, cells, common):
    """Values with a part that all runs of a seed share, as IMUs have: their intervals hold, and naive ones would not."""
    random, shift = np.random.default_rng(3), np.linspace(-0.3, 0.3, cells)
    groups = [np.repeat(np.arange(seeds), cells)]

    def drawn(count):
        own = random.standard_normal((count, cells))
        values = common * random.standard_normal((count, 1)) + np.sqrt(1.0 - common**2) * own + shift
        return values.ravel()

    many = drawn(200_000)
    truths = {share: np.quantile(many, share) for share in (0.5, 0.9)}
    hits, naive = [], []
    for _ in range(TRIALS):
        values = drawn(seeds)
        found = {share: quantile(values, share, groups) for share in truths}
        centre, first = mean(values, groups), difference(values, np.tile(np.arange(cells) == 0, seeds), groups)
        hits.append(
            [each.low <= truths[share] <= each.high for share, each in found.items()]
            + [centre.low <= 0.0 <= centre.high, first.low <= shift[0] <= first.high]
        )
        alone = quantile(values, 0.5)
        naive.append(alone.low <= truths[0.5] <= alone.high)
    assert np.mean(hits, axis=0).min() >= CERTAIN
    if common:
        assert np.mean(naive) < 0.8


@pytest.mark.slow
@pytest.mark.parametrize("seeds", [2, *(pytest.param(seeds, marks=pytest.mark.slow) for seeds in (3, 4, 5))])
@pytest.mark.parametrize("common", [0.0, 0.5, 0.9])
def test_with_few_seeds_no_end_of_a_quantile_promises_more_than_it_holds(seeds, common):
    """Two seeds count as one or two independent values, which must not make the greatest of 24 runs the lower end."""
    random, groups = np.random.default_rng(6), [np.repeat(np.arange(seeds), 12)]
    beyond = []
    for _ in range(TRIALS):
        own, shared = random.standard_normal((seeds, 12)), random.standard_normal((seeds, 1))
        values = (np.sqrt(common) * shared + np.sqrt(1.0 - common) * own).ravel()
        found = [quantile(values, share, groups) for share in QUANTILES]
        beyond.append([(each.low > norm.ppf(each.share), each.high < norm.ppf(each.share)) for each in found])
    assert np.mean(beyond, axis=0).max() <= 0.025 + 3.0 * np.sqrt(0.025 * 0.975 / TRIALS)


def test_what_a_seed_does_to_all_values_alike_is_no_uncertainty_of_a_difference():
    seed = np.repeat(np.random.default_rng(1).normal(size=10), 2)
    chosen = np.tile([True, False], 10)
    found = difference(seed + 3.0 * chosen, chosen, [np.repeat(np.arange(10), 2)])
    assert found.value == pytest.approx(1.5)
    assert found.high - found.low < 1e-12
    assert difference(seed + 3.0 * chosen, chosen).high - found.value > 0.1


@given(st.integers(2, 6), st.integers(2, 6), st.integers(0, 2**32 - 1))
def test_shares_are_the_sums_of_squares_of_an_additive_law(first, second, seed):
    random = np.random.default_rng(seed)
    a, b = random.normal(size=first), random.normal(size=second)
    study = study_of(Factor("a", tuple(range(first))), Factor("b", tuple(range(second))))
    shares = analysed(study, y=np.add.outer(a, b).ravel()).shares("y")
    assert shares["a"] == pytest.approx(a.var() / (a.var() + b.var()), abs=1e-9)
    assert shares["b"] == pytest.approx(b.var() / (a.var() + b.var()), abs=1e-9)
    assert shares[INTERACTIONS] == pytest.approx(0.0, abs=1e-9)


def test_a_product_of_signs_is_all_interaction():
    study = study_of(Factor("a", (-1.0, 1.0)), Factor("b", (-1.0, 1.0)))
    assert analysed(study, y=[1.0, -1.0, -1.0, 1.0]).shares("y") == {"a": 0.0, "b": 0.0, INTERACTIONS: 1.0}


def test_shares_count_samples_together_and_need_every_run():
    study = study_of(Factor("a", ("x", "y")), Factor("p", (), 0.0, 1.0), Factor("q", (), 0.0, 1.0), count=8)
    points = study.points()
    values = [float(point["a"] == "y") + 2.0 * point["p"] + point["q"] for point in points]
    shares = analysed(study, y=values).shares("y")
    assert shares["a"] == pytest.approx(0.25 / np.var(values))
    assert shares["a"] + shares["p + q"] == pytest.approx(1.0)
    assert analysed(study, y=[None, *values[1:]]).shares("y") == {}
    assert analysed(study, y=[1.0] * len(values)).shares("y") == {}


def test_levels_are_the_runs_at_each_value_pooled_over_seeds():
    study = study_of(Factor("imu", ("b", "a")), Factor("rate", (1, 2, 3)), Factor("seed", tuple(range(5))))
    points = study.points()
    values = np.random.default_rng(4).normal(size=len(points))
    found = analysed(study, y=values)
    assert [each.name for each in found.crossed] == ["imu", "rate"]
    for number, level in enumerate(found.levels("y", study.factors[1])):
        own = values[[point["rate"] == number + 1 for point in points]]
        assert (level.value, level.runs) == (number + 1, 10)
        assert level.mean.value == pytest.approx(own.mean())
        assert level.difference.value == pytest.approx(own.mean() - values.mean())
        assert [each.value for each in level.quantiles] == pytest.approx(np.quantile(own, QUANTILES))
    assert [level.value for level in found.levels("y", study.factors[0])] == ["b", "a"]
    whole = found.over_all("y")
    assert (whole.value, whole.runs, whole.difference.value) == (None, 30, 0.0)


def test_a_sampled_range_is_seen_in_parts():
    study = study_of(Factor("p", (), 1.0, 16.0, logarithmic=True), count=32)
    values = [point["p"] for point in study.points()]
    levels = analysed(study, y=values).levels("y", study.factors[0])
    assert [each.value for each in levels] == [pytest.approx(ends) for ends in ((1, 2), (2, 4), (4, 8), (8, 16))]
    assert [each.runs for each in levels] == [8] * 4
    for each in levels:
        assert each.value[0] <= each.mean.value <= each.value[1]


def test_runs_without_a_finite_figure_do_not_count():
    study = study_of(Factor("a", (1, 2, 3, 4)))
    found = analysed(study, y=[None, 2.0, float("nan"), 4.0], z=[1.0, 2.0, 3.0, float("inf")])
    assert (found.failed, found.over_all("y").runs, found.over_all("z").runs) == (1, 2, 3)
    assert [each.value for each in found.levels("y", study.factors[0])] == [2, 4]
    assert found.over_all("nothing") is None
    assert found.names() == ["y", "z"]


def test_lists_and_switches_are_values_like_others():
    study = study_of(Factor("on", (False, True)), Factor("which", ([0, 1], [2, 3])))
    points = study.points()
    columns = {"on": [point["on"] for point in points], "which": [str(point["which"]) for point in points]}
    table = pa.table({"key": list("abcd"), "status": ["done"] * 4, "reason": [None] * 4, **columns, "y": [1.0, 2.0, 3.0, 4.0]})
    found = Analysis(study, table)
    assert [(each.value, each.mean.value) for each in found.levels("y", study.factors[0])] == [(False, 1.5), (True, 3.5)]
    assert [(each.value, each.mean.value) for each in found.levels("y", study.factors[1])] == [("[0, 1]", 2.0), ("[2, 3]", 3.0)]


def ishigami(x1, x2, x3, a=7.0, b=0.1):
    return np.sin(x1) + a * np.sin(x2) ** 2 + b * x3**4 * np.sin(x1)


def indices_of_ishigami(a=7.0, b=0.1):
    """First-order and total indices by the function's integrals (Ishigami and Homma 1990)."""
    one, two, together = 0.5 * (1.0 + b * PI**4 / 5.0) ** 2, a**2 / 8.0, 8.0 * b**2 * PI**8 / 225.0
    whole = one + two + together
    return np.array([one, two, 0.0]) / whole, np.array([one + together, two, together]) / whole


def ranges(*names):
    return tuple(Factor(name, (), -PI, PI) for name in names)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(6))
def test_sobol_indices_of_ishigami(seed):
    study = study_of(*ranges("x1", "x2", "x3"), method="saltelli", count=2048, seed=seed)
    found = analysed(study, y=[ishigami(**point) for point in study.points()]).sensitivities("y")
    first, total = indices_of_ishigami()
    np.testing.assert_allclose(first, [0.314, 0.442, 0.0], atol=5e-4)
    assert [each.factor for each in found] == ["x1", "x2", "x3"]
    np.testing.assert_allclose([each.first.value for each in found], first, rtol=0.0, atol=0.03)
    np.testing.assert_allclose([each.total.value for each in found], total, rtol=0.0, atol=0.03)
    for each, one, whole in zip(found, first, total, strict=True):
        assert each.first.low <= one <= each.first.high
        assert each.total.low <= whole <= each.total.high


def test_seeds_are_averaged_and_crossed_factors_stand_apart():
    """With noise of the seeds that cancels, the indices at each value of `b` are those of Ishigami's function with it."""
    factors = (Factor("b", (0.0, 0.1)), *ranges("x1", "x2", "x3"), Factor("seed", (0, 1)))
    study = study_of(*factors, method="saltelli", count=2048)
    points = study.points()
    values = [ishigami(*(point[f"x{n}"] for n in (1, 2, 3)), b=point["b"]) + (5.0, -5.0)[point["seed"]] for point in points]
    found = analysed(study, y=values).sensitivities("y")
    for number, b in enumerate((0.0, 0.1)):
        part = found[3 * number : 3 * number + 3]
        assert [each.at for each in part] == [{"b": b}] * 3
        np.testing.assert_allclose([each.first.value for each in part], indices_of_ishigami(b=b)[0], rtol=0.0, atol=0.03)


def test_sobol_indices_say_why_they_are_not_there():
    study = study_of(*ranges("x1", "x2", "x3"), method="saltelli", count=8)
    values = [ishigami(**point) for point in study.points()]
    broken = analysed(study, y=[None, *values[1:]])
    assert broken.no_sensitivities("y") == "Sobol indices need y of all 40 runs, and 1 lack it"
    assert broken.sensitivities("y") == []
    constant = analysed(study, y=[1.0] * 40)
    assert (constant.no_sensitivities("y"), constant.sensitivities("y")) == ("y is the same in all runs", [])
    other = study_of(*ranges("x1"), count=8)
    assert "saltelli" in analysed(other, y=[1.0] * 8).no_sensitivities("y")


def test_the_rows_of_a_base_sample_are_one_group():
    """A mean over Saltelli's design is as certain as one over its base samples: four rows that hardly differ tell no more."""
    study = study_of(*ranges("x1", "x2"), method="saltelli", count=64)
    values = np.repeat(np.random.default_rng(0).normal(size=64), 4)
    found = analysed(study, y=values).over_all("y").mean
    alone = mean(values[::4])
    assert found.high - found.low == pytest.approx(alone.high - alone.low, rel=1e-9)


def test_json_has_no_infinite_number():
    study = study_of(Factor("a", (1, 2)), Factor("seed", (0, 1, 2)))
    plain = analysed(study, y=[1.0, 2.0, 3.0, 4.0, 5.0, 7.0]).plain(["y"])["y"]
    assert plain["all"]["quantiles"][2]["high"] is None
    assert [each["value"] for each in plain["by_factor"]["a"]] == [1, 2]
    assert plain["by_factor"].keys() == {"a"}
    assert sum(plain["shares"].values()) == pytest.approx(1.0)
    assert plain["sensitivities"] == []
