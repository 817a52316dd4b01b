"""Objects followed through time, by what sweeps and pictures show of them at each moment."""

from sceneloom.tracking.drive import track_drive
from sceneloom.tracking.observation import Observation, View
from sceneloom.tracking.settings import PictureBox, TrackerSettings
from sceneloom.tracking.tracker import Tracker

__all__ = ["Observation", "PictureBox", "Tracker", "TrackerSettings", "View", "track_drive"]
