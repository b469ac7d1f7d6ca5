"""One design per use, on sensors: the study of two drivers, and another one of two seas."""

import re
from dataclasses import replace
from itertools import pairwise, product

import casadi as ca
import numpy as np
import pytest
from typer.testing import CliRunner

from ccdtools import Gaussian, InputError, simulate
from ccdtools.cli import app
from ccdtools.controllers import Passive
from ccdtools.studies import RunFolder, configuration, load_study


@pytest.fixture(scope="module")
def drivers():
    return load_study("full_car_drivers")


@pytest.mark.parametrize("accelerations", [(2.0, 0.0), (0.0, 3.0), (-1.5, 2.5)])
def test_tyre_loads_hold_the_body_against_the_manoeuvres_of_its_driver(drivers, accelerations):
    """Moments about the centre of mass of a steady car, 0.5 m above the road: they share no code with the plant."""
    plant, p = drivers.plant, np.array(drivers.p0)
    at = [np.zeros(plant.nx), np.zeros(4), np.zeros(6), p]
    A, E = (np.array(ca.Function("J", [plant.x, plant.u, plant.w, plant.p], [ca.jacobian(plant.dynamics, v)])(*at))
            for v in (plant.x, plant.w))  # fmt: skip
    x = -np.linalg.solve(A, E @ [0, 0, 0, 0, *accelerations])
    lifted = 2e5 * x[:4]  # N, that tyres lack
    np.testing.assert_allclose(lifted @ [0.9, 0.9, -1.2, -1.2], 1200 * 0.5 * accelerations[0], rtol=1e-9, atol=1e-6)
    np.testing.assert_allclose(lifted @ [0.9, -0.9, 0.9, -0.9], 1200 * 0.5 * accelerations[1], rtol=1e-9, atol=1e-6)
    np.testing.assert_allclose(lifted.sum(), 0, atol=1e-6)
    springs = np.array([28e3, 28e3, 21e3, 21e3]) * x[4:8]  # stand on the tyres
    np.testing.assert_allclose(springs, lifted, rtol=1e-9, atol=1e-6)


@pytest.mark.long
@pytest.mark.parametrize(("driver", "sizes"), [("mild", [0.25, 1.0]), ("aggressive", [1.5, 2.0])])
def test_drivers_manoeuvre_as_hard_as_is_said_and_the_aggressive_one_is_faster(drivers, driver, sizes):
    run = simulate(
        drivers.plant, Passive(4), x0=np.zeros((60, 17)), steps=1000, design=drivers.p0,
        disturbance=Gaussian(np.r_[np.zeros(4), drivers.uses[driver].terms[1].std]), rng=np.random.default_rng(1),
    )  # fmt: skip
    np.testing.assert_allclose(run.states[:, 400:, 15:].std(axis=(0, 1)), sizes, rtol=0.15)
    felt = {name: use.sample(6, 300, np.random.default_rng(0))[..., :4].std() for name, use in drivers.uses.items()}
    assert felt["aggressive"] > 1.1 * felt["mild"]


def test_the_sensors_measure_travels_the_acceleration_of_the_body_and_its_rates(drivers):
    rng, plant = np.random.default_rng(0), drivers.real.plant
    x, u = 0.05 * rng.normal(size=17), 300 * rng.normal(size=4)
    rate = np.array(plant.right_hand_side(x, u, np.zeros(6), drivers.p0)).ravel()
    measured = plant.observe(x, u, drivers.p0)
    np.testing.assert_allclose(measured, [*x[4:8], rate[12], *x[13:15], *x[15:]], rtol=1e-12)


def test_cost_and_effort_are_those_of_the_trajectory(drivers):
    w = drivers.uses["mild"].sample(2, 50, np.random.default_rng(0))
    run = simulate(drivers.plant, lambda x: np.tile([300.0, -200.0, 0.0, 100.0], (len(x), 1)), x0=np.zeros((2, 17)),
                   steps=50, disturbance=w, design=drivers.p0)  # fmt: skip
    found = drivers.metrics(run)
    assert found["mean square force [kN²]"] == pytest.approx((0.3**2 + 0.2**2 + 0.1**2) / 4)
    assert found["peak force [N]"] == 300.0
    by_hand = 0.0
    for x in run.states:
        for before, after in pairwise(x):
            by_hand += sum(((after - before)[12:15] / 0.01) ** 2) + sum((after[:4] / 0.01) ** 2)
            by_hand += sum((after[4:8] / 0.05) ** 2) + 0.3**2 + 0.2**2 + 0.1**2
    assert found["cost"] == pytest.approx(by_hand / 100)


BOAT = """
import casadi as ca
import numpy as np
from ccdtools import CoDesignConfig, CustomObjective, DesignSpace, Gaussian, Plant, RealPlant
from ccdtools.studies import SideBySide

def plant(drag):
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), ca.SX.sym("p", 2)
    rate = ca.vertcat(x[1], -p[0] * x[0] - p[1] * x[1] - drag * x[1] * ca.fabs(x[1]) + u + w)
    return Plant(x, u, w, p, rate, DesignSpace(["k", "c"], [0.5, 0.1], [4.0, 2.0]), dt=0.1, outputs=[x[0]])

calm, rough = Gaussian([0.3]), Gaussian([2.0])
study = SideBySide(
    name="boat", title="A boat in two seas", plant=plant(0.0), X=(-20, 20), U=(-3, 3), disturbance=calm,
    objective=CustomObjective(lambda x, u, p: x[0] ** 2 + 0.1 * u[0] ** 2 + 0.01 * p[0] ** 2), steps=40,
    x0=[1.0, 0.0], p0=[1.0, 0.5], uses={"calm": calm, "rough": rough}, noise=[0.05], history=3, limit_tolerance="off",
    real=RealPlant(plant(0.1), calm, [1.0, 0.0], 10, 60, held_out={"calm": calm, "rough": rough}),
    metrics=lambda run: {"mean square input": float(np.mean(run.inputs**2))},
    settings={"codesign": CoDesignConfig(iterations=4), "held_out_steps": 20},
)
"""


@pytest.fixture
def boat(tmp_path):
    (tmp_path / "boat.py").write_text(BOAT)
    return tmp_path / "boat.py"


@pytest.mark.check
def test_every_use_gets_a_design_and_meets_the_designs_of_all(boat):
    out = boat.with_name("out")
    done = CliRunner().invoke(app, ["run", str(boat), "--quick", "--output", str(out)])
    assert done.exit_code == 0, done.output
    designs, changes, values = (part.splitlines() for part in done.output.split("\n\n")[1:4])
    assert [line.split(":")[0] for line in designs] == [
        "start", *(f"{use}, {method}" for use in ("calm", "rough") for method in ("nested LQG", "pathwise"))
    ]  # fmt: skip
    found = {tuple(line.split()[:3]): float(line.split()[3]) for line in values[1:]}
    assert set(found) == set(product(("calm", "rough"), ("start", "calm", "rough"), ("LQG", "MPC", "learned")))
    for use in ("calm", "rough"):
        line = next(line for line in changes if re.match(rf"{use} +design +[−+\d]", line))
        percent = 100 * (found[use, use, "LQG"] / found[use, "start", "LQG"] - 1)
        assert float(re.search(r"[−+]?[\d.]+", line)[0].replace("−", "-")) == pytest.approx(percent, abs=0.6)
    assert (out / "report.html").read_text().count("<tr>") == 1 + 10 + 1 + 18
    assert (out / "gains.csv").read_text().count("\n") == 1 + 10
    assert (out / "side_by_side.png").read_bytes().startswith(b"\x89PNG")
    again = CliRunner().invoke(app, ["resume", str(out)])
    assert again.exit_code == 0, again.exception
    assert again.output.split("\n\n")[1:-1] == done.output.split("\n\n")[1:-1]


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"uses": {"calm": Gaussian([0.3]), "storm": Gaussian([9.0])}}, r"real.held_out: got \['calm', 'rough'\]"),
        ({"uses": {"calm": Gaussian([0.3, 0.3]), "rough": Gaussian([2.0])}}, r"uses\['calm'\]: got 2 channels"),
        ({"uses": 3}, "uses: got 3"),
        ({"uses": {}}, "uses: got none"),
        ({"uses": {"start": Gaussian([0.3])}}, "uses: got the name 'start'"),
        ({"uses": {"../calm": Gaussian([0.3])}}, "uses: got the name '../calm'"),
        ({"noise": [0.1, 0.1]}, "noise: got shape"),
        ({"noise": [0.0]}, r"noise: got \[0.0\], expected standard deviations above 0"),
        ({"history": 0}, "history: got 0"),
        ({"metrics": None}, "no metrics"),
    ],
)
def test_wrong_studies_are_named(boat, changes, words):
    with pytest.raises(InputError, match=words):
        replace(load_study(boat), **changes)


def test_every_use_starts_where_the_study_does(boat):
    study = replace(load_study(boat), starts=np.array([[2.0, 0.0], [-1.0, 0.5]]))
    for problem in study.problems.values():
        x0, _ = problem.scenarios.sample(50, 3, np.random.default_rng(0))
        assert {tuple(x) for x in x0} == {(2.0, 0.0), (-1.0, 0.5)}


def test_a_configuration_is_of_a_study():
    with pytest.raises(InputError, match="study: got 'illustrative'"):
        configuration("illustrative")


@pytest.mark.slow
def test_the_command_designs_a_softer_car_for_the_mild_driver_with_less_effort_for_both(tmp_path):
    """The whole quick form, on roads of other classes than the designs were made for."""
    runner = CliRunner()
    done = runner.invoke(app, ["run", "full_car_drivers", "--quick", "--output", str(tmp_path / "run")])
    assert done.exit_code == 0, done.output
    folder = RunFolder(tmp_path / "run")
    mild, aggressive = (folder.read_stage(f"design-{name}").arrays["design"] for name in ("mild", "aggressive"))
    assert (mild < [28000.0, 2500.0, 21000.0, 2000.0]).all()
    assert aggressive[0] > 1.2 * mild[0]
    assert aggressive[2] > 1.2 * mild[2]
    rows = [line for line in done.output.splitlines() if line.split()[1:2] == ["design"] and "[" in line]
    own = [row for row in rows if row.split()[2].startswith("−")]  # of the design alone: cost falls, and effort
    assert [row.split()[0] for row in own] == ["mild", "aggressive"]
    assert all(re.findall(r"([−+][\d.]+) %", row)[1].startswith("−") for row in own)
    assert (folder.path / "report.html").read_text().count("<tr>") == 1 + 10 + 1 + 18
    assert (folder.path / "gains.csv").read_text().count("\n") == 1 + 10
    assert (folder.path / "side_by_side.png").read_bytes().startswith(b"\x89PNG")
    again = runner.invoke(app, ["resume", str(folder.path)])
    assert again.exit_code == 0, again.exception
    assert again.output.split("\n\n")[1:-1] == done.output.split("\n\n")[1:-1]
