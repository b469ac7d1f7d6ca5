"""What test_method_comparison.py claims, seen from inside."""

from ccdtools.co_design.compare_methods import known_methods, named_methods
from ccdtools.co_design.method_names import NAMES


def test_names_are_found_whatever_their_capitals():
    assert next(iter(named_methods("all"))) == "sequential"
    assert list(named_methods(["nested-lqr", "cma-es", "PPO"])) == ["nested LQR", "CMA-ES", "ppo"]
    assert set(named_methods("all")) <= set(known_methods()) == set(NAMES)
