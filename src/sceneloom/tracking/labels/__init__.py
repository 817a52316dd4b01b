"""Labels made of tracks: annotations that a person goes over in a labelling tool, and what to look at first."""
