"""What a few seeds can say: intervals, rank tests and corrections, each against closed forms."""

import math

import numpy as np
import pytest
import scipy.stats

from mjx_revolve.view import statistics


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ([], "–"), ([math.nan], "–"), ([0.12345], "0.123"), ([1234.5], "1234"), ([-2.0], "−2"),
        ([0.1, math.nan, 0.1], "0.1"), ([0.15, 0.16, 0.17], "0.160 ± 0.025"),
        ([-12.0, -15.0, -13.0], "−13.3 ± 3.8"), ([1000.0, 3000.0], "2000 ± 12706"),
        ([1e-12, 3e-12], "2e−12 ± 1e−11"),
    ],
)  # fmt: skip
def test_means_are_written_to_the_digits_that_count(values, text):
    assert str(statistics.interval(values)) == text


def test_intervals_are_students_and_welchs():
    draw = np.random.default_rng(0)
    a, b = draw.normal(1, 2, 7), draw.normal(0, 1, 5)
    found = statistics.interval(a)
    ends = scipy.stats.t.interval(0.95, 6, a.mean(), scipy.stats.sem(a))
    assert (found.low, found.high) == pytest.approx(ends) and found.size == 7
    found = statistics.difference(a, b)
    ends = scipy.stats.ttest_ind(a, b, equal_var=False).confidence_interval(0.95)
    assert (found.low, found.high) == pytest.approx(tuple(ends)) and found.size == 5
    assert statistics.difference([1, 1], [2, 2]) == (-1, 0, 2)
    assert np.isnan(statistics.difference([1], b).half) and statistics.difference([], b).size == 0


def test_columns_without_values_have_no_interval():
    rows = [[1.0, 5.0, np.nan], [2.0, np.nan, np.nan], [3.0, 5.0, np.nan]]
    mean, half, count = statistics.mean_and_half(rows)
    assert mean[:2].tolist() == [2, 5] and count.tolist() == [3, 2, 0]
    assert half[0] == pytest.approx(4.302653 / math.sqrt(3))  # t(0.975, 2) / √3
    assert half[1] == 0 and np.isnan([mean[2], half[2]]).all()
    assert statistics.quantiles(rows, [0.5])[0, :2].tolist() == [2, 5]


def test_intervals_of_few_seeds_cover_what_they_promise():
    draw = np.random.default_rng(1).normal(size=(2000, 5))
    mean, half, _ = statistics.mean_and_half(draw.T)
    assert np.mean(np.abs(mean) <= half) == pytest.approx(0.95, abs=0.015)


def test_rank_tests_are_exact_with_few_values_and_with_equal_ones():
    assert statistics.rank_test(range(5), range(5, 10)) == pytest.approx(2 / math.comb(10, 5))
    assert statistics.smallest_p(5, 5, 6) == pytest.approx(6 * 2 / 252)
    # Of the 184,756 ways to choose ten of twenty, 9,999 are drawn.
    least = statistics.rank_test(range(10), range(10, 20))
    assert statistics.smallest_p(10, 10) == pytest.approx(least)
    # Of the 20 ways to choose three of 1, 1, 2, 2, 3, 3, two have ranks as low as 1, 1, 2.
    assert statistics.rank_test([1, 1, 2], [2, 3, 3]) == pytest.approx(2 * 2 / 20)
    assert statistics.rank_test([1, 1], [1, 1, 1]) == 1
    # One value says nothing.
    assert statistics.rank_test([1], [2, 3, 4]) == statistics.smallest_p(1, 3) == 1
    assert statistics.compare({"a": [1], "b": [2]}).pairs == {("a", "b"): 1}


def test_holms_correction_by_hand():
    assert statistics.holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert statistics.holm([0.6, 0.7]) == [1, 1]


def test_groups_are_compared_together_and_in_pairs():
    found = statistics.compare({"a": [1, 2, 3], "b": [4, 5, 6], "c": [7, 8, 9]})
    # Of the 9! / 3!³ ways to share the ranks, 3! keep them apart.
    assert found.p == pytest.approx(6 / 1680)
    assert statistics.compare({"a": [1, 2, 3], "b": [4, 5, 6]}) == (0.1, {("a", "b"): 0.1})
    assert found.pairs == pytest.approx({("a", "b"): 0.3, ("a", "c"): 0.3, ("b", "c"): 0.3})
    alone = statistics.compare({"a": [1, 2, 3], "b": [4, 5, 6], "c": [7]})
    assert alone == (0.1, {("a", "b"): 0.1, ("a", "c"): 1, ("b", "c"): 1})
    assert statistics.compare({"a": [1, 1], "b": [1, 1]}).p == 1
    assert statistics.compare({"a": [1, 2]}) == (1, {})
