"""Logs that lost outputs."""

import numpy as np
import pytest
from logged_spring import RUNS, STEPS, P, logged, spring, stated, with_gaps

from ccdtools import InputError, Measurement
from ccdtools.twin import OutputLog, fit_plant, updated_problem


@pytest.mark.long
def test_what_a_sensor_missed_tells_nothing():
    problem = stated()
    log = logged(problem, spring(0.5))
    outputs = np.array(log.outputs)
    outputs[:, STEPS // 2 :] = np.nan
    gaps = fit_plant(problem, OutputLog(outputs, log.inputs, P))
    half = fit_plant(problem, OutputLog(outputs[:, : STEPS // 2], log.inputs[:, : STEPS // 2], P))
    assert (np.abs(gaps.values - half.values) < 0.01 * half.deviations).all()
    assert gaps.innovation_variance == pytest.approx(half.innovation_variance, rel=1e-4)
    outputs = np.array(log.outputs)
    outputs[::2, 40:60] = np.nan
    some = fit_plant(problem, OutputLog(outputs, log.inputs, P))
    assert gaps.status.name == "SOLVED"
    assert some.status.name == "ANSWERED"  # the law saw what the log lost
    with pytest.raises(InputError, match="ANSWERED"):
        updated_problem(problem, some)
    assert half.deviations[2] > 1.1 * some.deviations[2]  # what follows the gaps counts


@pytest.mark.parametrize(
    ("law", "lost", "status"),
    [pytest.param("sees all", 0.1, "ANSWERED", marks=pytest.mark.check), ("sees all", 0.02, "ANSWERED"),
     ("as told", 0.1, "SOLVED"), ("open", 0.1, "SOLVED"), ("holds", 0.05, "SOLVED"), ("pulses", 0.1, "SOLVED"),
     ("pulses", 0.01, "SOLVED")],
)  # fmt: skip
def test_inputs_that_answered_outputs_that_the_log_lost_are_told(law, lost, status):
    found = fit_plant(stated(), with_gaps(law, lost, 3))
    assert found.status.name == status
    if status == "SOLVED":
        assert abs(found.values[2] + 0.2) < 3.5 * found.deviations[2]


@pytest.mark.parametrize(("law", "status"), [("sees all", "ANSWERED"), ("as told", "SOLVED"), ("holds", "SOLVED")])
@pytest.mark.parametrize(
    "every",
    [
        pytest.param(2, marks=pytest.mark.check),
        pytest.param(3, marks=pytest.mark.long),
        4,
        pytest.param(6, marks=pytest.mark.long),
    ],
)
def test_they_are_told_where_outputs_are_told_seldom(law, status, every):
    found = fit_plant(stated(), with_gaps(law, 0.0, 303, every=every))
    assert found.status.name == status
    assert (abs(found.values[2] + 0.2) < 3.5 * found.deviations[2]) == (status == "SOLVED")


@pytest.mark.long
@pytest.mark.parametrize("apart", [0.0, 1e-4], ids=["one design", "many designs"])
@pytest.mark.parametrize(("law", "status"), [("sees all", "ANSWERED"), ("as told", "SOLVED")])
def test_they_are_told_in_logs_of_one_run_each_too(law, status, apart):
    log = with_gaps(law, 0.05, 3)
    runs = [OutputLog(log.outputs[[run]], log.inputs[[run]], P + apart * run) for run in range(RUNS)]
    assert fit_plant(stated(), runs).status.name == status


@pytest.mark.long
def test_experiments_that_are_louder_where_outputs_are_lost_answer_nothing():
    lost = np.where(np.arange(RUNS) < RUNS - 4, 0.0, 0.2)[:, None, None]
    found = [fit_plant(stated(), with_gaps("louder each run", lost, seed)).status.name for seed in range(20)]
    assert found.count("SOLVED") >= 18  # 2 % are told by chance


@pytest.mark.parametrize("law", ["holds its input", "rests"])
@pytest.mark.parametrize("lost", [0.02, pytest.param(0.2, marks=pytest.mark.long)])
def test_actuators_that_hold_or_rest_where_an_output_is_lost_answer_nothing(law, lost):
    assert fit_plant(stated(), with_gaps(law, lost, 5)).status.name == "SOLVED"


@pytest.mark.long
@pytest.mark.parametrize("law", ["sees all", "as told"])
def test_units_of_inputs_and_outputs_change_nothing(law):
    log = with_gaps(law, 0.05, 3)
    told, scaled = fit_plant(stated(), log), fit_plant(stated(unit=1e3), OutputLog(1e3 * log.outputs, log.inputs, P))
    assert told.status == scaled.status
    assert told.values[2] == pytest.approx(scaled.values[2], abs=0.01 * told.deviations[2])


def test_a_sensor_that_tells_nothing_at_all_changes_nothing():
    log, dead = with_gaps("open", 0.1, 3), np.full((RUNS, STEPS, 1), np.nan)
    problem = stated(measurement=Measurement(np.eye(2), noise=[0.05, 0.05]))
    found = fit_plant(problem, OutputLog(np.concatenate([log.outputs, dead], axis=2), log.inputs, P))
    alone = fit_plant(stated(), log)
    assert found.status == alone.status
    assert (np.abs(found.values - alone.values)[:4] < 0.01 * alone.deviations[:4]).all()


@pytest.mark.parametrize(("law", "status"), [("sees all", "ANSWERED"), ("open", "SOLVED")])
def test_a_log_of_another_law_beside_it_changes_nothing(law, status):
    logs = [with_gaps("holds", 0.0, 4), with_gaps(law, 0.1, 3)]
    assert fit_plant(stated(), logs).status.name == status
