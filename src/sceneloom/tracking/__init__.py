"""Objects followed through time, by what sweeps and images show of them at each moment."""

from typing import TYPE_CHECKING

from sceneloom.lazy import names_on_first_use

if TYPE_CHECKING:
    from sceneloom.tracking.settings import ImageBox, TrackerSettings
    from sceneloom.tracking.smoother import track_drive
    from sceneloom.tracking.tracker import Observation, Tracker, View
else:
    __getattr__, __dir__ = names_on_first_use(
        __name__,
        {"settings": "ImageBox TrackerSettings", "smoother": "track_drive", "tracker": "Observation Tracker View"},
    )

__all__ = ["ImageBox", "Observation", "Tracker", "TrackerSettings", "View", "track_drive"]
