from ccdtools.co_design.closed_loop import closed_loop_returns as closed_loop_returns
from ccdtools.co_design.configuration import CoDesignConfig as CoDesignConfig
from ccdtools.co_design.custom_objective import CustomObjective as CustomObjective, output_objective as output_objective
from ccdtools.co_design.design_controllers import (
    linear_mpc as linear_mpc,
    nonlinear_mpc as nonlinear_mpc,
    saturated_lqr as saturated_lqr,
)
from ccdtools.co_design.design_env import DesignEnv as DesignEnv, DesignVectorEnv as DesignVectorEnv
from ccdtools.co_design.design_sensitivity import DesignSensitivity as DesignSensitivity
from ccdtools.co_design.environment import EpisodeEnv as EpisodeEnv
from ccdtools.co_design.expert import (
    admissible_inputs as admissible_inputs,
    expert_dataset as expert_dataset,
    feasible_sets as feasible_sets,
)
from ccdtools.co_design.learned_result import LearnedCoDesign as LearnedCoDesign
from ccdtools.co_design.measured import kalman_filter as kalman_filter
from ccdtools.co_design.methods.learned import Learned as Learned
from ccdtools.co_design.methods.nested import Nested as Nested
from ccdtools.co_design.methods.search import Search as Search
from ccdtools.co_design.methods.sequential import Sequential as Sequential
from ccdtools.co_design.methods.simultaneous import Simultaneous as Simultaneous
from ccdtools.co_design.multi_start import MultiStart as MultiStart
from ccdtools.co_design.objective import QuadraticObjective as QuadraticObjective
from ccdtools.co_design.output_filter import filter_problem as filter_problem
from ccdtools.co_design.output_history import history_problem as history_problem
from ccdtools.co_design.preview import (
    previewed_limits as previewed_limits,
    previewed_objective as previewed_objective,
    previewed_problem as previewed_problem,
)
from ccdtools.co_design.problem import CoDesignProblem as CoDesignProblem, FixedStart as FixedStart
from ccdtools.co_design.random_starts import RandomStarts as RandomStarts
from ccdtools.co_design.result import CoDesignResult as CoDesignResult
from ccdtools.co_design.risk import CVaR as CVaR, Mean as Mean, MeanSpread as MeanSpread, WorstCase as WorstCase
from ccdtools.co_design.secant import stochastic_linearisation as stochastic_linearisation
from ccdtools.co_design.trade_off import TradeOff as TradeOff
