"""The figures that evo 1.38.1 gives for the same poses; run outside, since its licence keeps it out of here."""

import pytest

from sceneloom import evaluate_trajectory
from sceneloom.scene import Trajectory

NAMES = ("mean", "rms", "median", "max", "min", "std")
OF_MOTIONS = {  # steps of 10 poses, all pairs; the alignment changes nothing but by its scale
    "rigid translation": (
        *(0.539278140984, 0.540045212634, 0.545736731135, 0.577026043127, 0.474121110536, 0.0287735702513),
    ),
    "sim3 translation": (
        *(0.204660281176, 0.225909462858, 0.186370908943, 0.381423148464, 0.0865661273078, 0.095651736618),
    ),
    "rotation": (
        *(0.952557343734, 0.985685644309, 0.918558452459, 1.36727407257, 0.577067051449, 0.253398295759),
    ),
}
ABSOLUTE = {
    "none translation": (
        *(16.949452533, 17.2595146863, 16.9771179467, 22.5570587622, 11.5371345358, 3.2568245327),
    ),
    "none rotation": (
        *(24.6586402426, 24.6786288863, 24.6194158975, 26.3141846509, 22.9253769399, 0.993068523397),
    ),
    "origin translation": (1.43182555501, 1.63483244429, 1.46965813031, 2.75213684662, 0.0, 0.789020089047),
    "origin rotation": (1.99126906987, 2.23291127125, 1.70818354405, 3.48676886917, 0.0, 1.01031689913),
    "se3 translation": (
        *(0.737420557704, 0.818580222555, 0.701484019255, 1.38151863806, 0.207217726455, 0.355365307584),
    ),
    "se3 rotation": (
        *(2.28354214923, 2.41239956352, 2.10617723255, 3.63911009083, 1.06387882029, 0.777886178545),
    ),
    "sim3 translation": (
        *(0.0639454395285, 0.0716996425337, 0.0573021594311, 0.12954455017, 0.00970780900512, 0.03243176688),
    ),
    "sim3 rotation": (
        *(2.28354214923, 2.41239956352, 2.10617723255, 3.63911009083, 1.06387882029, 0.777886178545),
    ),
}
# evo's figures are quoted with 12 digits; angles near 0 are off by the root of the rounding in its matrices
CLOSE = {"rel": 1e-10, "abs": 1e-7}


@pytest.mark.parametrize("align", ["none", "origin", "se3", "sim3"])
def test_the_errors_are_those_of_evo(align: str, curve: tuple[Trajectory, Trajectory]) -> None:
    report = evaluate_trajectory(*curve, align=align, associate="nearest", rpe_deltas=("10f",))
    motion = report.relative[0]
    assert report.absolute.rotation_deg is not None
    assert motion.rotation_deg is not None
    kind = "sim3" if align == "sim3" else "rigid"
    for ours, theirs in (
        (report.absolute.translation, ABSOLUTE[f"{align} translation"]),
        (report.absolute.rotation_deg, ABSOLUTE[f"{align} rotation"]),
        (motion.translation, OF_MOTIONS[f"{kind} translation"]),
        (motion.rotation_deg, OF_MOTIONS["rotation"]),
    ):
        assert [getattr(ours, name) for name in NAMES] == pytest.approx(list(theirs), **CLOSE)


def test_the_scale_is_that_of_evo(curve: tuple[Trajectory, Trajectory]) -> None:
    report = evaluate_trajectory(*curve, align="sim3")
    assert report.alignment.scale == pytest.approx(1.100306139998165, rel=1e-12)
