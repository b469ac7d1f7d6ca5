"""Fixtures shared by the tests of `learning` and `ccdtools`: the case studies, and a cheap clone of each."""

import os
import sys
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

DATA = Path(os.environ.get("CCDTOOLS_DATA") or Path(__file__).resolve().parents[1].parent / "shared" / "data")


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    """Mark as `check` the cases beyond those that `@pytest.mark.quick(count)` leaves to `make test`.

    Tests of stored runs come first, so that one process makes them and no other waits for it.
    """
    items.sort(key=lambda item: "stored" not in item.fixturenames)
    seen: Counter[str] = Counter()
    for item in items:
        quick = item.get_closest_marker("quick")
        if quick is not None:
            name = item.nodeid.split("[")[0]
            seen[name] += 1
            if seen[name] > quick.args[0]:
                item.add_marker("check")


@pytest.fixture(scope="session", autouse=True)
def _one_thread():
    """Small networks are fastest on one thread; tests that need no torch do not import it."""
    torch = sys.modules.get("torch")
    if torch is not None:
        torch.set_num_threads(1)


@pytest.fixture(autouse=True)
def _same_draws():
    """What a test draws from torch's own generator does not depend on the tests before it."""
    torch = sys.modules.get("torch")
    if torch is not None:
        torch.manual_seed(0)


@pytest.fixture
def brief(monkeypatch):
    """First policies are made in a few steps, for a test that does not look at how good they are."""
    from brief_policies import shorten

    shorten(monkeypatch)


@pytest.fixture
def rng():
    """Return a seeded generator."""
    return np.random.default_rng(20240611)


@pytest.fixture(scope="session")
def stored(tmp_path_factory, worker_id):
    """Return a function: (name, make) → folder that one process has filled with ``make(folder)`` for all of them."""
    from filelock import FileLock

    base = tmp_path_factory.getbasetemp()
    root = base if worker_id == "master" else base.parent

    def folder(name, make):
        place = root / "stored" / name
        place.mkdir(parents=True, exist_ok=True)
        with FileLock(f"{place}.lock"):
            if not place.with_suffix(".made").exists():
                make(place)
                place.with_suffix(".made").touch()
        return place

    return folder


@pytest.fixture(scope="session")
def suspension():
    """Return the suspension study."""
    from ccdtools.studies import load_study

    return load_study("suspension")


@pytest.fixture(scope="session")
def illustrative():
    """Return the illustrative study."""
    from ccdtools.studies import load_study

    return load_study("illustrative")


@pytest.fixture(scope="session", params=["illustrative", "suspension"])
def study(request):
    """Return each case study in turn."""
    return request.getfixturevalue(request.param)


@pytest.fixture(scope="session")
def expert_data():
    """Return a function: study → its expert's data, made once."""
    from ccdtools.co_design import expert_dataset

    made = {}

    def data(study):
        if study.name not in made:
            made[study.name] = expert_dataset(study.problem(), samples=150, rng=np.random.default_rng(0))
        return made[study.name]

    return data


@pytest.fixture(scope="session")
def clone(expert_data):
    """Return a function: study → a small agent cloned from its expert, made once; tests must not train it."""
    from learning import CloningConfig, NetworkConfig, fit_actor_critic

    made = {}

    def agent(study):
        if study.name not in made:
            data, problem = expert_data(study), study.problem()
            made[study.name] = fit_actor_critic(
                data.inputs,
                data.actions,
                data.values,
                action_bounds=problem.input_bounds,
                input_bounds=problem.observation_bounds,
                rng=np.random.default_rng(0),
                network=NetworkConfig((24, 24)),
                config=CloningConfig(steps=1000, batch=256),
            )
            made[study.name].zero_grad(set_to_none=True)
        return made[study.name]

    return agent


@pytest.fixture(scope="session")
def recorded():
    """Return a function: name → path of a recorded file, or skip."""

    def path(name):
        if not (DATA / name).is_file():
            pytest.skip(f"the recorded file {name} is not part of the project; set CCDTOOLS_DATA to its folder")
        return DATA / name

    return path


@pytest.fixture(scope="session")
def recorded_road(recorded):
    """Return the recorded road velocity (15000, 1), or skip."""
    from ccdtools import read_disturbance

    return read_disturbance(recorded("dz_dt_mild_driver1.csv"), dt=0.05)[:15000, None]
