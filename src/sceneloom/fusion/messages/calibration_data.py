"""The calibration of one camera and one lidar as a record."""

from dataclasses import dataclass

from sceneloom.fusion.messages.tables import CALIBRATION


@dataclass(frozen=True, slots=True, kw_only=True)
class CalibrationData:
    """The camera model of a camera, and where it is seen from a lidar or a lidar from it.

    What the numbers mean as a camera model and as frames is judged by those who use them.

    Attributes:
        image_size: width and height [px], each at least 1.
        intrinsic_matrix: 9 numbers, 3x3 row-major.
        reference_frame: the frame that `extrinsic_matrix` maps into: 0 camera, 1 lidar.
        extrinsic_matrix: 16 numbers, 4x4; by columns, as the standard's example, or by rows.
        distortion_coeffs: 5 numbers, k1 k2 p1 p2 k3; None for none.

    Raises:
        DataError: a field is missing, of another type or out of range.

    Source: DB34/T 4101-2022, table 3.
    """

    image_size: tuple[int, int]
    intrinsic_matrix: tuple[float, ...]
    reference_frame: int
    extrinsic_matrix: tuple[float, ...]
    distortion_coeffs: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        CALIBRATION.settle(self)
