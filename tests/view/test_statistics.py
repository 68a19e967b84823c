"""What a few seeds can say: intervals, rank tests and corrections, each against closed forms."""

import math

import numpy as np
import pytest

from mjx_revolve.view import statistics


def test_intervals_are_the_quantiles_of_resampled_means():
    # Of 0 and 1, a quarter of all resamples is (0, 0), a quarter (1, 1); of differences 1 in 16.
    assert statistics.interval([0, 1]) == (0.5, 0, 1)
    assert statistics.difference([10, 11], [0, 1]) == (10, 9, 11)
    assert statistics.interval([3, np.nan, 3]) == (3, 3, 3)
    assert str(statistics.interval([-2.0])) == "−2"
    assert str(statistics.interval([])) == "–"
    assert str(statistics.Interval(0.12345, -0.0, 1234.5)) == "0.123 [0, 1234]"


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
    # Mean ranks 2, 5, 8: H = 12 / (9 · 10) · 3 (3² + 0 + 3²) = 7.2, of two degrees of freedom.
    assert found.p == pytest.approx(math.exp(-7.2 / 2))
    assert found.pairs == pytest.approx({("a", "b"): 0.3, ("a", "c"): 0.3, ("b", "c"): 0.3})
    assert statistics.compare({"a": [1, 1], "b": [1, 1]}).p == 1
    assert statistics.compare({"a": [1, 2]}) == (1, {})
