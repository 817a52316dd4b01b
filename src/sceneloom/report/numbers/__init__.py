"""What a report tells, in numbers: collected from the scene, kept apart from how it is drawn."""
