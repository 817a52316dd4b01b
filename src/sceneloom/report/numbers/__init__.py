"""What a report reports, in numbers: collected from the scene, kept apart from how it is drawn."""
