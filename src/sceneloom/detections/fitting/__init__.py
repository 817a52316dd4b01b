"""What two detectors are like, fitted to drives of which the truth is known."""
