"""Labels made of tracks: annotations that a person goes over in a labelling tool, and what to look at first."""

from sceneloom.tracking.labels.making import Labelled, label_tracks
from sceneloom.tracking.labels.quality import Flag, FlagKind
from sceneloom.tracking.labels.settings import LabelSettings

__all__ = ["Flag", "FlagKind", "LabelSettings", "Labelled", "label_tracks"]
