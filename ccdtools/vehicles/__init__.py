"""Cars and roads: plants, road profiles, and how a ride is measured. Studies use them, nothing below does."""

from ccdtools_ground.front_door import front_door

__all__, __getattr__, __dir__ = front_door(__name__, __file__)
