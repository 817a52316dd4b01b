"""Repair of a calibration: the extrinsic, the time offset and the focal length that a drive itself tells."""

from sceneloom.calibrate.refinement.refine import DEFAULT, refine
from sceneloom.calibrate.refinement.results import GROUPS, Refinement, RefinementVerdict

__all__ = ["DEFAULT", "GROUPS", "Refinement", "RefinementVerdict", "refine"]
