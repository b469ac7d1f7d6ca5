"""The script that measures every change of what was in service meets those that were taken back, too."""

import json

import numpy as np
import pytest
from deployed_changes import changes, served
from spring_run import run_spring

from ccdtools.controllers import LearnedPolicy
from ccdtools.studies import RunFolder
from ccdtools.studies.stage_storage import Stage
from learning import ActorCritic, NetworkConfig

AGENTS = {name: ActorCritic([-1, 0], [1, 2], [-1], [1], config=NetworkConfig((3,)), seed=k)
          for k, name in enumerate("ABCD")}  # fmt: skip


@pytest.fixture
def told(tmp_path):
    """Return a function: designed, updates (name, accepted), replaces and carried of each generation → folder."""

    def folder(generations, last):
        run = RunFolder(tmp_path)
        entries = []
        for g, (designed, updates, replaces, carried) in enumerate(generations, 1):
            after = [designed, *(name for name, accepted in updates if accepted)][-1]
            tried = {f"update-{k}": AGENTS[name] for k, (name, _) in enumerate(updates, 1)}
            run.keep_stage(f"codesign-{g}", Stage(arrays={"design": np.ones(1)}, networks={"agent": AGENTS[designed]}))
            run.keep_stage(f"deployment-{g}", Stage(networks={"agent": AGENTS[after]} | tried))
            entries.append({
                "generation": g, "online_updates": [{"accepted": accepted} for _, accepted in updates],
                "delivery": {"replaces": replaces, "carried": carried},
            })  # fmt: skip
        (tmp_path / "results.json").write_text(json.dumps({"generations": entries}))
        run.save_policy(LearnedPolicy(AGENTS[last], [1.0]), {})
        return tmp_path

    return folder


def letters(folder):
    """What came in service, by the letters of its networks, in the order of time."""
    states = {name: agent.state_dict() for name, agent in AGENTS.items()}

    def letter(policy):
        own = policy.agent.state_dict()
        return next(name for name, state in states.items() if all(bool((own[key] == state[key]).all()) for key in own))

    return [(name, letter(before) + letter(after)) for name, after, before in changes(folder)]


def test_a_redesign_that_was_rolled_back_is_a_change_and_so_is_what_followed_it(told):
    folder = told([("A", [("B", True)], True, False), ("C", [("D", True)], False, False)], last="B")
    assert letters(folder) == [
        ("update 1 of generation 1", "AB"), ("design of generation 2", "BC"), ("update 1 of generation 2", "CD"),
        ("what followed the deployment of generation 2, rolled back", "DB"),
    ]  # fmt: skip


def test_updates_that_a_whole_deployment_took_back_return_to_what_was_before_them(told):
    folder = told([("A", [("B", True), ("C", True)], True, False), ("C", [], False, True)], last="A")
    assert letters(folder)[-1] == ("what followed the deployment of generation 2, rolled back", "CA")


def test_a_candidate_that_its_trial_refused_was_in_service_too(told):
    assert letters(told([("A", [("B", False)], True, False)], last="A")) == [
        ("update 1 of generation 1", "AB"), ("update 1 of generation 1, taken back", "BA"),
    ]  # fmt: skip


def test_a_run_that_ended_with_another_policy_is_refused(told):
    with pytest.raises(ValueError, match="not the last one found"):
        served(told([("A", [("B", True)], True, False)], last="A"))


@pytest.mark.check
def test_a_finished_run_ends_with_the_policy_that_was_last_in_service(stored):
    names = [name for name, _ in served(stored("spring", run_spring) / "run")]
    assert names[0] == "design of generation 1"
