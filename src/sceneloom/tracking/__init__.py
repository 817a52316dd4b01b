"""Objects followed through time, by what sweeps and pictures show of them at each."""

from sceneloom.tracking.observation import Observation, View

__all__ = ["Observation", "View"]
