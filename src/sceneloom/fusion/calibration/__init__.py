"""The calibration data of DB34/T 4101-2022: table 3 as camera model and mounting, of several cameras and lidars."""
