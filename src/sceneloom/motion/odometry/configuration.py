"""The settings of lidar odometry."""

from dataclasses import dataclass

from sceneloom.errors import OptionError


@dataclass(frozen=True, slots=True, kw_only=True)
class OdometryConfiguration:
    """Settings of lidar odometry; the defaults are meant for every lidar on every road vehicle.

    Attributes:
        cube: side of the cubes that the map cuts space into [m].
        spacing: of a sweep, one point per cube of this side is registered [m].
        nearest, farthest: points nearer or farther than this are not used [m]: the ego itself, and noise.
        map_reach: what lies farther from the ego is dropped from the map [m].
        range_noise: standard deviation of a point across a flat surface [m].
        acceleration: how fast the velocity usually changes [m/s²].
        yaw_acceleration: how fast the yaw rate usually changes [rad/s²].
        least_points: a sweep with fewer usable points is not registered.

    Raises:
        OptionError: a number is not positive, or farthest is not beyond nearest.
    """

    cube: float = 1.0
    spacing: float = 0.75
    nearest: float = 1.5
    farthest: float = 120.0
    map_reach: float = 120.0
    range_noise: float = 0.02
    acceleration: float = 3.0
    yaw_acceleration: float = 1.0
    least_points: int = 200

    def __post_init__(self) -> None:
        for name in self.__slots__:
            if not getattr(self, name) > 0:
                raise OptionError(f"odometry.{name}: {getattr(self, name)}; expected a positive number")
        if self.farthest <= self.nearest:
            raise OptionError(
                f"odometry.farthest: {self.farthest} m; expected more than nearest, {self.nearest} m"
            )
