"""Networks on disk: a round trip, and nothing but our own files."""

import json
import pickle

import numpy as np
import pytest
import torch
from safetensors.torch import save_file
from toys import agent

from learning import LearningError, QuantileConfig, fit_quantiles, load, save
from learning.exceptions import CheckpointError

ANOTHER_LAYOUT = "tensors that do not fit the header, expected an intact file of this version"


@pytest.mark.parametrize("std_network", [False, True])
def test_an_agent_comes_back_as_it_was(tmp_path, std_network):
    net = agent(hidden=(7, 5), std_network=std_network)
    net.value_offset.fill_(-12.5)
    save(tmp_path / "a.safetensors", net, {"design": [1.0, 2.0], "note": "ü"})
    again, extra = load(tmp_path / "a.safetensors")
    assert extra == {"design": [1.0, 2.0], "note": "ü"}
    assert not again.training
    x = torch.randn(5, 2)
    for name in ("latent", "value", "std"):
        assert torch.equal(getattr(again, name)(x), getattr(net, name)(x))


def refused(path, message):
    with pytest.raises(CheckpointError, match=message) as caught:
        load(path)
    assert isinstance(caught.value, LearningError)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_missing_file_is_refused(tmp_path):
    refused(tmp_path / "nothing.safetensors", "expected a file written by ccdtools")


def test_a_folder_is_refused(tmp_path):
    refused(tmp_path, "expected a file written by ccdtools")


def test_a_pickle_is_refused_and_never_executed(tmp_path):
    class Boom:
        def __reduce__(self):
            return (pytest.fail, ("the pickle was executed",))

    (tmp_path / "evil.safetensors").write_bytes(pickle.dumps(Boom()))
    refused(tmp_path / "evil.safetensors", "expected a file written by ccdtools")
    torch.save(agent().state_dict(), tmp_path / "torch.pt")
    refused(tmp_path / "torch.pt", "expected a file written by ccdtools")


def test_an_empty_and_a_cut_file_are_refused(tmp_path):
    (tmp_path / "empty").write_bytes(b"")
    refused(tmp_path / "empty", "expected a file written by ccdtools")
    save(tmp_path / "whole", agent())
    (tmp_path / "cut").write_bytes((tmp_path / "whole").read_bytes()[:-100])
    refused(tmp_path / "cut", "expected a file written by ccdtools")


def test_someone_elses_safetensors_are_refused(tmp_path):
    save_file({"w": torch.zeros(2)}, str(tmp_path / "plain"))
    refused(tmp_path / "plain", "got format None of None, expected 'ccdtools-1'")
    save_file({"w": torch.zeros(2)}, str(tmp_path / "text"), metadata={"ccdtools": "not json"})
    refused(tmp_path / "text", "expected")
    save_file({"w": torch.zeros(2)}, str(tmp_path / "list"), metadata={"ccdtools": "[1]"})
    refused(tmp_path / "list", "expected")


def rewritten(tmp_path, **changes):
    net = agent()
    header = {"format": "ccdtools-1", "kind": "ActorCritic", "shape": net.shape(), "extra": {}} | changes
    header = {key: value for key, value in header.items() if value is not None}
    path = tmp_path / "changed"
    save_file(dict(net.state_dict()), str(path), metadata={"ccdtools": json.dumps(header)})
    return path


def test_another_version_or_kind_is_refused(tmp_path):
    refused(rewritten(tmp_path, format="ccdtools-9"), "got format 'ccdtools-9' of 'ActorCritic'")
    refused(rewritten(tmp_path, kind="os.system"), "of 'os.system', expected 'ccdtools-1'")


def test_a_header_that_does_not_fit_its_tensors_is_refused(tmp_path):
    refused(rewritten(tmp_path, shape=agent(hidden=(9,)).shape()), ANOTHER_LAYOUT)


def test_a_quantile_network_of_an_earlier_version_is_to_be_trained_anew(tmp_path):
    rng = np.random.default_rng(0)
    net = fit_quantiles(rng.normal(size=(200, 2)), rng.normal(size=200), rng=rng, config=QuantileConfig(steps=1))
    tensors = {name: value for name, value in net.state_dict().items() if name != "positions"}
    shape = {name: value for name, value in net.shape().items() if name != "samples"}
    header = {"format": "ccdtools-1", "kind": "QuantileNetwork", "shape": shape, "extra": {}}
    save_file(tensors, str(tmp_path / "earlier"), metadata={"ccdtools": json.dumps(header)})
    refused(tmp_path / "earlier", ANOTHER_LAYOUT)


@pytest.mark.parametrize("changes", [{"shape": None}, {"extra": None}, {"shape": {"bounds": []}}, {"shape": "?"}])
def test_a_broken_header_is_refused(tmp_path, changes):
    refused(rewritten(tmp_path, **changes), "expected")
