"""Ready-made plants, nominal or as a real one (`real=True`)."""

from ccdtools.plants.library.dc_servo import Servo, dc_servo  # noqa: F401 (the stub beside this file lists them)
from ccdtools.plants.library.illustrative import illustrative  # noqa: F401 (the stub beside this file lists them)
from ccdtools.plants.library.mass_chain import mass_chain  # noqa: F401 (the stub beside this file lists them)
from ccdtools.plants.library.pendulum_on_cart import CartPole, pendulum_on_cart  # noqa: F401 (the stub beside this file lists them)
from ccdtools.plants.library.two_tanks import Tanks, two_tanks  # noqa: F401 (the stub beside this file lists them)
from ccdtools.plants.library.wind_turbine import Turbine, wind_turbine  # noqa: F401 (the stub beside this file lists them)
from ccdtools_ground.front_door import front_door

__all__, __getattr__, __dir__ = front_door(__name__, __file__)  # cars stand in a folder of their own
