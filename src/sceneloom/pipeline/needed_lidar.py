"""What most of the jobs cannot do without."""

from sceneloom.errors import DataError
from sceneloom.scene.scene import Scene


def check_has_lidar(scene: Scene, needing: str) -> None:
    """Refuse a scene without a lidar.

    Args:
        scene: of the job.
        needing: what needs one, such as "fusing needs".

    Raises:
        DataError: it has none.
    """
    if not scene.lidars:
        raise DataError(
            scene.source, "", f"no lidar in it; {needing} one (`sceneloom info` lists what is there)"
        )
