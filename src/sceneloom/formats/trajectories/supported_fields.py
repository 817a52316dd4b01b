"""What files of a trajectory hold of a scene: one ego trajectory, and of that as much as the form has locations for."""

from types import MappingProxyType

from sceneloom.formats.loss import KEPT, Holding, Supports, converted, dropped

_ELSE = dropped("the file holds one trajectory and nothing else")
_TRAJECTORY: dict[str, Holding] = {
    "": _ELSE,
    "trajectories": KEPT,
    "trajectories.name": dropped("the form has no field for it"),
    "trajectories.order": dropped("the file holds one trajectory"),
    "trajectories.covariances": dropped("the form has no field for them"),
    "trajectories.file_seconds": dropped("only the exact times are written"),
}

HOLDS: Supports = MappingProxyType(_TRAJECTORY)
"""Of forms that hold poses with times, number for number."""

MATRICES: Supports = MappingProxyType(
    {**_TRAJECTORY, "trajectories.quaternions_xyzw": converted("as matrices of rotation, within 1e-14 rad")}
)
"""Of forms that hold poses as matrices."""

NAMED: Supports = MappingProxyType({**_TRAJECTORY, "trajectories.name": KEPT})
"""Of forms that state how the trajectory is called."""

LOCATIONS: Supports = MappingProxyType(
    {
        **_TRAJECTORY,
        "trajectories.positions": converted("as latitude, longitude and altitude"),
        "trajectories.quaternions_xyzw": dropped("locations on earth have no orientation"),
    }
)
"""Of a way in a form of locations on earth."""

FIXES: Supports = MappingProxyType(
    {
        "": _ELSE,
        "sensors.gnss.timestamps_ns": KEPT,
        "sensors.gnss.positions_lla": KEPT,
        "sensors.gnss.accuracies": KEPT,
        "sensors.gnss.vertical_accuracies": KEPT,
    }
)
"""Of what a satellite receiver reported, in a form of locations on earth."""

METRES: Supports = MappingProxyType(
    {
        "": _ELSE,
        "sensors.gnss.timestamps_ns": KEPT,
        "sensors.gnss.positions_lla": converted("as metres east, north and up of the first fix"),
    }
)
"""Of what a satellite receiver reported, in a form of poses."""
