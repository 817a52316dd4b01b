"""How well a picture and a cloud agree under a candidate calibration."""
