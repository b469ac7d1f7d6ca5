"""Model predictive control: linear MPC online, explained infeasibility, explicit MPC and its C code."""

from ccdtools_ground.front_door import front_door

__all__, __getattr__, __dir__ = front_door(__name__, __file__)
