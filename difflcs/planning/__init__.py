"""Policies that choose the next place to touch, by contact MPC from many places at once."""

from difflcs.planning.obstacles import Obstacles
from difflcs.planning.places import DiscPlaces, Places, Workspace
from difflcs.planning.sampling import Decision, Mode, SamplingPolicy, SamplingSettings
from difflcs.planning.travel import PlanarTravel, Travel

__all__ = [
    "Decision",
    "DiscPlaces",
    "Mode",
    "Obstacles",
    "Places",
    "PlanarTravel",
    "SamplingPolicy",
    "SamplingSettings",
    "Travel",
    "Workspace",
]
