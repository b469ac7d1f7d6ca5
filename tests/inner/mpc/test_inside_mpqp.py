"""What test_mpqp.py claims, seen from inside."""

import time

from partitions import integrator
from slow_exploration import solve_slowly

from mpc import MPQPStatus, solve_mpqp


def test_no_time_limit_pays_for_compilation(monkeypatch):
    compiling = []

    def slow():
        compiling.append(True)
        time.sleep(2.0)

    monkeypatch.setattr("mpc.explicit.mpqp.compile_exploration", slow)
    mpc = integrator(2, 0.1)
    assert solve_mpqp(mpc.build(), mpc.X, time_limit=1.9).status is MPQPStatus.COMPLETE
    assert compiling == [True]
    solve_slowly(mpc.build(), mpc.X, time_limit=1e-9)
    assert compiling == [True]
