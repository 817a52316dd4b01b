"""How well an image and a cloud agree under a candidate calibration."""
