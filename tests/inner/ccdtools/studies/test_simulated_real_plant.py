"""A study whose real plant is a simulator of which only a step is known."""

from dataclasses import replace

import numpy as np
import pytest
from small_runs import SPRING, tiny

from ccdtools import InputError, Study
from ccdtools.plants import BlackBox
from ccdtools.studies import Generations, RunFolder, configuration


def spring() -> Study:
    """The spring, whose real one is a plant that is not the model."""
    names = {}
    exec(SPRING, names)
    plant = names["plant"]
    real = replace(plant, dynamics=plant.dynamics - 0.1 * names["x"][1] ** 3)
    return replace(names["study"], real=replace(names["study"].real, plant=real))


def hidden(study: Study) -> BlackBox:
    """Its real plant behind a function of one sample."""
    real = study.real.plant
    return BlackBox(
        lambda x, u, w, p: real.stepper(p, batch=1)(x[None], u[None], w[None])[0], nx=2, nu=1, nw=1, dt=0.1,
        design=real.design,
    )  # fmt: skip


class Strange:
    """Its real plant with nothing but what `Simulable` asks for."""

    nx, nu, nw, dt = 2, 1, 1, 0.1

    def __init__(self, study: Study) -> None:
        self.hidden = study.real.plant
        self.design = study.real.plant.design

    def stepper(self, p, *, batch):
        return self.hidden.stepper(p, batch=batch)


def test_a_simulator_of_another_size_or_rate_is_refused():
    study = spring()
    with pytest.raises(InputError, match=r"real\.plant: got dt = 0\.2 s"):
        replace(study, real=replace(study.real, plant=replace(hidden(study), dt=0.2)))


@pytest.mark.check
def test_a_generation_on_a_simulator_is_that_on_the_plant_it_hides(tmp_path):
    study = spring()
    logs = []
    for name, plant in (("open", study.real.plant), ("hidden", hidden(study)), ("strange", Strange(study))):
        own = replace(study, real=replace(study.real, plant=plant))
        folder = RunFolder.create(tmp_path / name)
        config = tiny(configuration(own, quick=True))
        Generations(own, config, folder, generations=1, seed=1, echo=lambda line: None, progress=False).run()
        logs.append(folder.read_stage("deployment-1").arrays["states"])
    for other in logs[1:]:
        np.testing.assert_allclose(logs[0], other, rtol=1e-9, atol=1e-12)
