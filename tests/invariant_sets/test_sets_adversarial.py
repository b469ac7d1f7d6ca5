"""A small sample of the adversarial plants, judged by HiGHS alone; the large tables are in `benchmarks`."""

import time

import adversarial_sets as adversarial
import pytest
from set_cases import control_case

from invariant_sets import Status, maximal_control_invariant_set


@pytest.mark.quick(21)
@pytest.mark.parametrize("seed", range(0, 24))
def test_largest_positively_invariant_sets_are_invariant_bounded_as_said_and_miss_nothing(seed):
    assert adversarial.positive([seed])[0][1] == ""


@pytest.mark.long
@pytest.mark.quick(4)
@pytest.mark.parametrize("seed", range(0, 24))
def test_controllable_and_predecessor_sets_hold_exactly_the_states_with_a_good_input_sequence(seed):
    assert adversarial.controllable([seed])[0][1] == ""


@pytest.mark.long
@pytest.mark.quick(5)
@pytest.mark.parametrize("seed", [0, 1, 2, 3, 5, 7, 8, 9, 10, 13, 14, 15, 19, 20, 21, 26, 27, 56, 57])
def test_largest_control_invariant_sets_are_invariant_and_what_lies_outside_leaves(seed):
    assert adversarial.control([seed])[0][1] == ""


@pytest.mark.check
@pytest.mark.parametrize("seed", [16, 53])
def test_a_time_limit_holds_and_leaves_an_invariant_inner_set(seed):
    """Five and six states with three inputs: nothing like enough time."""
    case = control_case(seed)
    start = time.perf_counter()
    result = maximal_control_invariant_set(*case.matrices, case.states(case.X), case.inputs(), time_limit=3.0)
    spent = time.perf_counter() - start
    assert result.status is Status.TIME_LIMIT
    assert result.certificate.holds
    assert "time_limit" in result.status.advice
    assert adversarial.judge_control(case, result, spent, 20.0) == ""
    assert result.set.is_subset(result.outer, 1e-8)
