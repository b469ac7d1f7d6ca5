"""What test_mpqp.py claims, seen from inside."""

import os
import time

import pytest
from partitions import integrator
from slow_exploration import solve_slowly

from mpc import MPQPStatus, solve_mpqp
from mpc.explicit.kernels import SOURCES, forget_stale


@pytest.mark.long
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


def test_what_was_compiled_before_a_tolerance_changed_is_forgotten(tmp_path):
    changed = max(source.stat().st_mtime for source in SOURCES)
    assert {"tolerances.py", "data.py", "halfspace.py"} <= {source.name for source in SOURCES}
    for name, age in (("old.1.nbc", 10.0), ("old.nbi", 10.0), ("new.nbi", -10.0), ("old.txt", 10.0)):
        (tmp_path / name).touch()
        os.utime(tmp_path / name, (changed - age, changed - age))
    forget_stale(str(tmp_path))
    assert {path.name for path in tmp_path.iterdir()} == {"new.nbi", "old.txt"}
