"""Presets: how thoroughly a study runs."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from typing import Any

from ccdtools.co_design.configuration import METHODS, CoDesignConfig
from ccdtools.co_design.method_names import STUDY_EXPERTS
from ccdtools.co_design.risk import check_followed
from ccdtools.exceptions import InputError
from ccdtools.studies.options import CHOICES
from ccdtools.studies.study import Study
from ccdtools.twin.online import ONLINE_TRAINING, OnlineConfig
from ccdtools.twin.trial import TrialConfig
from ccdtools_ground.door import as_choice, as_count, as_flag, as_instance, as_positive, as_share
from learning.networks import NetworkConfig
from learning.ppo import PPOConfig
from learning.quantile import QuantileConfig
from learning.warm_start import CloningConfig

KINDS = {
    "network": NetworkConfig, "cloning": CloningConfig, "codesign": CoDesignConfig, "redesign": CoDesignConfig,
    "online": OnlineConfig, "quantile": QuantileConfig,
}  # fmt: skip


@dataclass(frozen=True)
class StudyConfig:
    """Configuration of a run: everything but the study.

    Attributes
    ----------
    preset : {"default", "paper"}
    quick : bool
        Same path, fewer samples.
    expert : str
        What the first policy imitates, as in `Study`.
    method : {"pathwise", "ppo", "pathwise+ppo"}
        What moves the policy in a co-design.
    samples : int
        Latin hypercube samples of the initialisation.
    sets : {"auto", "lqr", "none"}
        Which sets they are taken from, as in `expert_dataset`.
    sets_time_limit : float
        Budget for these sets [s], as work of a usual processor.
    model_runs, real_runs : int
        Rollouts of a comparison on the model, and on a real plant of short runs.
    mpc_runs : int
        Of them, those that online MPC sees.
    real_steps : int or None
        Cap on the length of a deployment.
    held_out_runs, held_out_steps : int
        Fresh runs of each held-out disturbance, and their length.
    drift : float or None
        Whether a deployment tells if the twin still describes the plant, with this probability of a false alarm.
    network, cloning, codesign, redesign, online, quantile
        Configurations of the stages; `redesign` is the co-design on the updated model.
    """

    preset: str = "default"
    quick: bool = False
    expert: str = "auto"
    method: str = "pathwise"
    samples: int = 1000
    sets: str = "auto"
    sets_time_limit: float = 20.0
    model_runs: int = 4000
    real_runs: int = 4000
    mpc_runs: int = 100
    real_steps: int | None = None
    held_out_runs: int = 20
    held_out_steps: int = 500
    network: NetworkConfig = field(default_factory=NetworkConfig)
    cloning: CloningConfig = field(default_factory=CloningConfig)
    codesign: CoDesignConfig = field(default_factory=CoDesignConfig)
    redesign: CoDesignConfig = field(default_factory=lambda: CoDesignConfig(iterations=200, policy_rate=3e-4))
    online: OnlineConfig = field(default_factory=OnlineConfig)
    quantile: QuantileConfig = field(default_factory=QuantileConfig)
    drift: float | None = None

    def __post_init__(self) -> None:
        for name in ("samples", "model_runs", "real_runs", "mpc_runs", "held_out_runs", "held_out_steps"):
            as_count(name, getattr(self, name))
        as_choice("sets", self.sets, CHOICES["sets"])
        as_choice("method", self.method, METHODS)
        as_positive("sets_time_limit", self.sets_time_limit)
        for name, kind in KINDS.items():
            as_instance(name, getattr(self, name), kind, f"a {kind.__name__}")
        if self.drift is not None:
            as_share("drift", self.drift)


def configuration(
    study: Study,
    *,
    preset: str = "default",
    quick: bool = False,
    expert: str | None = None,
    method: str | None = None,
    design_gradient: str | None = None,
    sets: str | None = None,
    sets_time_limit: float | None = None,
    drift: float | None = None,
    trial: bool = False,
) -> StudyConfig:
    """Configuration of a preset.

    With `drift` a deployment tells whether the twin still describes the plant, with this probability of a false alarm.
    With `trial` updates that are accepted on the replayed log are tried on the real plant, in turns with what is
    deployed, before they stay. `expert`, `sets` and `sets_time_limit` are those of the study unless given, and its
    `settings` hold besides.

    ``paper`` takes the paper's networks, loss, rates, epochs and design gradient; what the paper leaves unsaid or
    what its code has wrong (advantages, discount, bounds, one optimiser) stays as in the default.

    Raises
    ------
    InputError
        If `study` is none or has other settings, `preset`, `expert`, `method`, `design_gradient` or `sets` is unknown,
        or the time limit is not above 0; if the method follows the mean, and the study has a risk.
    """
    as_instance("study", study, Study, "a Study, as load_study returns")
    as_choice("preset", preset, CHOICES["preset"])
    unknown = set(study.settings) - ({field.name for field in fields(StudyConfig)} - {"preset", "quick"})
    if unknown:
        expected = "names of fields of StudyConfig, but preset and quick"
        raise InputError("settings", ", ".join(sorted(map(str, unknown))), expected)
    own: dict[str, Any] = {name: getattr(study, name) for name in ("expert", "sets", "sets_time_limit")}
    own |= study.settings
    given = {"expert": expert, "sets": sets, "sets_time_limit": sets_time_limit}
    own |= {name: value for name, value in given.items() if value is not None}
    as_choice("expert", own["expert"], (*STUDY_EXPERTS, *study.laws))
    config = StudyConfig(**({"samples": study.samples} | own), preset=preset)
    if drift is not None:
        config = replace(config, drift=as_share("drift", drift))
    if as_flag("trial", trial):
        config = replace(config, online=replace(config.online, trial=TrialConfig()))
    if preset == "paper":
        config = _paper(config, study)
    if method is not None:
        config = replace(config, method=as_choice("method", method, METHODS))
    if design_gradient is not None:
        config = replace(
            config,
            codesign=replace(config.codesign, design_gradient=design_gradient),
            redesign=replace(config.redesign, design_gradient=design_gradient),
        )
    check_followed(study.risk, config.method, config.codesign.design_gradient)
    return _quick(config) if quick else config


def _paper(config: StudyConfig, study: Study) -> StudyConfig:
    rate = 1e-5
    codesign = CoDesignConfig(
        iterations=10_000, block=10_000, starts=1, runs=1, design_gradient="network_input",
        design_rate=rate, policy_rate=0.0,
        constant_rates=True, evaluate_every=200, ppo=PPOConfig.warm(
            passes=1, minibatch=32, learning_rate=rate, value_rate=rate, kl_limit=float("inf"),
            critic_only=0,
        ),
    )  # fmt: skip
    network = NetworkConfig(study.paper_networks, skip=False, initial_std=0.01, std_network=True)
    return replace(config, method="ppo", network=network, codesign=codesign, redesign=codesign)


def _quick(config: StudyConfig) -> StudyConfig:

    def fewer(codesign: CoDesignConfig, iterations: int) -> CoDesignConfig:
        iterations = min(iterations, codesign.iterations)
        block = max(1, iterations // 2)
        return replace(codesign, iterations=iterations, block=block, runs=min(64, codesign.runs), pathwise_runs=64,
                       evaluation_runs=300, evaluate_every=max(1, iterations // 8))  # fmt: skip

    return replace(
        config,
        quick=True,
        samples=min(config.samples, 200),
        model_runs=min(config.model_runs, 400),
        real_runs=min(config.real_runs, 400),
        mpc_runs=min(config.mpc_runs, 10),
        real_steps=3000 if config.real_steps is None else min(config.real_steps, 3000),
        held_out_runs=min(config.held_out_runs, 5),
        held_out_steps=min(config.held_out_steps, 300),
        cloning=replace(config.cloning, steps=min(config.cloning.steps, 1000)),
        codesign=fewer(config.codesign, 40),
        redesign=fewer(config.redesign, 20),
        online=replace(
            config.online,
            updates=min(config.online.updates, 2),
            judged=min(config.online.judged, 200),
            training=replace(ONLINE_TRAINING, iterations=8),
        ),
        quantile=replace(config.quantile, steps=min(config.quantile.steps, 500)),
    )
