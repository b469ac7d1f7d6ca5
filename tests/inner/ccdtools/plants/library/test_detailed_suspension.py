"""The suspension designed by its dimensions: formulas of machine design, rules, and the quarter car that they make."""

import numpy as np
import pytest
from active_suspension.independent import damping, rules_along, rules_of_design, stiffness
from active_suspension.statement import PUBLISHED

from ccdtools import InputError, discretise
from ccdtools.plants.library import quarter_car
from ccdtools.plants.library.coil_spring import CoilSpring, SpringSteel
from ccdtools.plants.library.detailed_suspension import StrutRules, detailed_active_suspension
from ccdtools.plants.library.valved_damper import DamperValve, ValvedDamper

INCH, POUND = 0.0254, 4.4482216153  # m, N
PSI = POUND / INCH**2
SIMULTANEOUS = np.array(PUBLISHED["simultaneous"])


@pytest.fixture(scope="module", params=[True, False], ids=["published", "default"])
def either(request):
    """Return the plant of both statements, with which one it is."""
    return detailed_active_suspension(published=request.param), request.param


def test_a_spring_has_the_values_of_a_textbook():
    # Budynas and Nisbett, Shigley's Mechanical Engineering Design, example 10-1: music wire no. 16, outer diameter
    # 7/16 in, squared ends, 12 1/2 turns: C = 10.8, K_B = 1.124, S_sy = 146 kpsi, 6.46 lbf, 4.13 lbf/in
    music = SpringSteel(
        shear_modulus=11.85e6 * PSI, strength=201e3 * PSI * (INCH / 1e-3) ** 0.145, exponent=0.145, yielding=0.45,
    )  # fmt: skip
    spring = CoilSpring(0.037 * INCH, 0.400 * INCH, 0.19 * INCH, 10.5, music)
    assert spring.index == pytest.approx(10.8, abs=0.05)
    assert spring.yield_stress / PSI == pytest.approx(146e3, rel=3e-3)
    assert spring.stress(6.46 * POUND) == pytest.approx(spring.yield_stress, rel=3e-3)
    assert spring.stiffness * INCH / POUND == pytest.approx(4.13, rel=5e-3)  # the book leaves out direct shear, 0.4 %


def test_at_the_largest_pressure_the_valve_passes_what_the_piston_displaces():
    valve = DamperValve()
    damper = ValvedDamper(0.0097, 0.0405, 0.17, valve)
    speed = valve.pressure * np.pi * 0.0405**2 / 4 / damper.damping
    lift = np.pi * 0.0097**2 / 4 * valve.pressure / 7500.0
    jet = 0.7 * np.sqrt(2 * valve.pressure / 850.0)
    assert np.pi * 0.0097 * lift * 0.9 * 0.1 * jet == pytest.approx(speed * np.pi * 0.0405**2 / 4, rel=1e-12)
    assert damper.pressure(speed) == pytest.approx(4.75e6, rel=1e-12)
    assert damper.lift(speed) == pytest.approx(lift, rel=1e-12)


def test_the_damping_has_the_coefficient_of_the_published_code():
    # 281.5194 D_p⁴/D_o³, of the simultaneous statement of Sundarrajan and Herber 2021
    for valve, piston in ((0.0097, 0.0405), (0.003, 0.08)):
        expected = 281.5194 * piston**4 / valve**3
        assert ValvedDamper(valve, piston, 0.1, DamperValve()).damping == pytest.approx(expected, rel=1e-6)


def test_rules_of_the_dimensions_are_those_written_apart(either, rng):
    space = either[0].design
    for p in (SIMULTANEOUS, *space.latin_hypercube(20, rng)):
        known = dict(zip(space.constraint_names, space.constraint_values(p)))
        for name, value in rules_of_design(p).items():
            assert known.pop(name) == pytest.approx(value, rel=1e-9, abs=1e-12)
        standing = rules_along(p, np.zeros((1, 4)), True)
        for name, same in (("bump stop", "bump stop"), ("linear range", "linear range"), ("fatigue", "Soderberg")):
            assert known.pop(f"{name} at rest") == pytest.approx(standing[same][0], rel=1e-9, abs=1e-12)
        assert not known


def test_rules_along_a_trajectory_are_those_written_apart(either, rng):
    plant, published = either
    x = rng.normal(size=(50, 4)) * [0.01, 1.0, 0.05, 1.0]
    for p in (SIMULTANEOUS, np.array(PUBLISHED["nested"])):
        outputs = np.array([np.asarray(plant.output(row, 0.0, p)).ravel() for row in x])
        for name, value in rules_along(p, x, published).items():
            columns = [i for i, output in enumerate(plant.output_names) if output.startswith(name)]
            assert outputs[:, columns].max(axis=1) == pytest.approx(value, rel=1e-6, abs=1e-9)


def test_a_strut_pressed_together_breaks_the_default_rules_and_not_the_published_ones():
    pressed = [0.0, 0.0, -0.05, 0.0]
    broken = {}
    for published in (True, False):
        plant = detailed_active_suspension(published=published)
        values = np.asarray(plant.output(pressed, 0.0, SIMULTANEOUS)).ravel()
        broken[published] = {name for name, value in zip(plant.output_names, values) if value > 0}
    assert broken == {True: set(), False: {"bump stop", "linear range"}}


def test_it_moves_as_the_quarter_car_of_its_stiffness_and_damping(either, rng):
    plant, plain = either[0], quarter_car()
    same = [stiffness(SIMULTANEOUS), damping(SIMULTANEOUS)]
    for _ in range(5):
        x, u, w = rng.normal(size=4), 100 * rng.normal(), rng.normal()
        expected = np.asarray(plain.right_hand_side(x, u, w, same))
        assert np.asarray(plant.right_hand_side(x, u, w, SIMULTANEOUS)) == pytest.approx(expected, rel=1e-9)


def test_every_design_is_sampled_fast_enough_and_the_plant_is_linear():
    plant = detailed_active_suspension()
    assert plant.linear
    discretise(plant)  # warns, which fails, if a design oscillates too fast


def test_the_published_designs_keep_the_rules_as_far_as_they_are_printed():
    space = detailed_active_suspension(published=True).design
    assert space.feasible(SIMULTANEOUS)
    # four digits of the pitch and the coils leave the nested one 0.3 mm too long for its damper
    values = dict(zip(space.constraint_names, space.constraint_values(PUBLISHED["nested"])))
    assert max(values, key=lambda name: values[name]) == "damper stroke"
    assert 0 < values["damper stroke"] < 2e-3


@pytest.mark.parametrize(
    ("kind", "arguments", "message"),
    [
        (SpringSteel, {"shear_modulus": 0.0}, "shear_modulus"),
        (SpringSteel, {"yielding": 1.2}, "yielding: got 1.2, expected a share"),
        (DamperValve, {"discharge": -0.1}, "discharge"),
        (StrutRules, {"safety": np.nan}, "safety"),
        (detailed_active_suspension, {"published": "yes"}, "published"),
        (detailed_active_suspension, {"steel": 3.0}, "steel"),
        (detailed_active_suspension, {"rules": StrutRules(pocket_length=0.1)}, "no design that keeps them"),
    ],
)
def test_what_no_strut_has_is_refused_by_name(kind, arguments, message):
    with pytest.raises(InputError, match=message):
        kind(**arguments)
