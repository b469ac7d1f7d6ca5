"""How thoroughly a study runs."""

from dataclasses import replace

import numpy as np
import pytest

from ccdtools import CoDesignConfig, InputError
from ccdtools.studies import configuration


def test_quick_is_the_same_path_with_fewer_samples(study):
    whole, quick = configuration(study), configuration(study, quick=True)
    assert quick.quick
    assert not whole.quick
    for name in ("samples", "model_runs", "real_runs", "mpc_runs"):
        assert getattr(quick, name) < getattr(whole, name)
    assert quick.codesign.iterations < whole.codesign.iterations
    assert quick.online.updates >= 1
    assert quick.real_steps is not None
    assert quick.quantile.levels == whole.quantile.levels


def test_the_paper_preset_takes_the_papers_networks_rates_and_gradient(suspension, illustrative):
    config = configuration(suspension, preset="paper")
    assert config.network.hidden == (16, 32, 32, 16)
    assert configuration(illustrative, preset="paper").network.hidden == (32, 32, 16, 16)
    assert not config.network.skip
    assert config.codesign.iterations == 10_000
    assert config.codesign.design_gradient == "network_input"
    assert config.codesign.design_rate == config.codesign.ppo.learning_rate == 1e-5
    assert config.codesign.policy_rate == 0
    assert config.redesign == config.codesign


def test_the_gradient_is_an_option(study):
    config = configuration(study, design_gradient="network_input")
    assert config.codesign.design_gradient == config.redesign.design_gradient == "network_input"


def test_sets_and_their_time_limit_come_from_the_study_unless_they_are_given(illustrative):
    study = replace(illustrative, sets="lqr", sets_time_limit=7)
    assert (configuration(study).sets, configuration(study).sets_time_limit) == ("lqr", 7.0)
    other = configuration(study, sets="none", sets_time_limit=3.0)
    assert (other.sets, other.sets_time_limit) == ("none", 3.0)


def test_a_study_may_state_how_thoroughly_it_runs(illustrative):
    config = configuration(replace(illustrative, settings={"model_runs": 50, "codesign": CoDesignConfig(starts=1)}))
    assert (config.model_runs, config.codesign.starts) == (50, 1)
    assert config.mpc_runs == configuration(illustrative).mpc_runs
    with pytest.raises(InputError, match=r"settings: got model_rum, expected names of fields of StudyConfig"):
        configuration(replace(illustrative, settings={"model_rum": 50}))
    with pytest.raises(InputError, match="settings"):
        replace(illustrative, settings=[("model_runs", 50)])
    for wrong, words in [
        ({"model_runs": "many"}, "model_runs: got"), ({"mpc_runs": 2.5}, "mpc_runs: got"),
        ({"sets": "zzz"}, "sets: got"),
        ({"expert": "foo"}, "expert: got 'foo'"), ({"online": 3}, "online: got 3, expected a OnlineConfig"),
        ({"codesign": {"iterations": 3}}, "codesign: got"), ({"quick": True}, "settings: got quick"),
        ({"preset": "paper"}, "settings: got preset"), ({"method": "x"}, "method: got 'x'"),
    ]:  # fmt: skip
        with pytest.raises(InputError, match=words):
            configuration(replace(illustrative, settings=wrong))
    stated = replace(illustrative, settings={"expert": "mpc", "sets": "none", "model_runs": 30})
    asked = configuration(stated, expert="lqr", sets="lqr", quick=True)
    assert (asked.expert, asked.sets, asked.model_runs) == ("lqr", "lqr", 30)
    assert configuration(stated).expert == "mpc"


def test_the_expert_of_a_study_may_be_one_of_its_laws(illustrative):
    study = replace(illustrative, laws={"bang": lambda problem, design: np.sign}, expert="bang")
    assert configuration(study).expert == "bang"
    assert configuration(study, expert="mpc").expert == "mpc"
    with pytest.raises(InputError, match="expert: got 'clang', expected one of auto, lqr, mpc, explicit, bang"):
        replace(study, expert="clang")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"preset": "fast"}, "preset: got 'fast', expected one of default, paper"),
        ({"expert": "pid"}, "expert: got 'pid', expected one of auto, lqr, mpc"),
        ({"design_gradient": "magic"}, "design_gradient: got 'magic'"),
        ({"sets": "some"}, "sets: got 'some', expected one of auto, lqr, none"),
        ({"sets_time_limit": 0.0}, "sets_time_limit: got 0.0"),
    ],
)
def test_unknown_options_are_refused(study, options, message):
    with pytest.raises(InputError, match=message):
        configuration(study, **options)


@pytest.mark.parametrize("drift", [0.0, 5.0, "5 %"])
def test_a_probability_of_false_alarms_is_one(study, drift):
    with pytest.raises(InputError, match="drift: got"):
        replace(configuration(study), drift=drift)


def test_trials_and_drift_are_asked_for_by_name(study):
    usual, asked = configuration(study), configuration(study, drift=0.05, trial=True, quick=True)
    assert usual.drift is usual.online.trial is None
    assert asked.drift == 0.05
    assert asked.online.trial.level == 0.05
    with pytest.raises(InputError, match="trial: got 'yes'"):
        configuration(study, trial="yes")
