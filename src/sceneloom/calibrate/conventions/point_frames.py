"""The frame in which the points of a lidar come, as far as the drive itself tells it."""

from sceneloom.checks.point_frames import distances, lie_nearer, meet_more, overlaps, plan_sweeps, sweep_of
from sceneloom.checks.subject import Subject
from sceneloom.scene import LidarSensor, PointsFrame, Scene


def possible_frames(scene: Scene, lidar: LidarSensor) -> tuple[PointsFrame, ...]:
    """List the frames in which the points of a lidar can be; one where the drive tells it.

    Points lie around the sensor that measured them, and what stands still meets itself from sweep to sweep. Each
    reading that another one beats clearly in either is left out; where the sensor does not move nothing is.

    Returns:
        Those left, in the order of `PointsFrame`; none where the sensor's place is not known.

    Raises:
        DataError: a sweep cannot be read.
    """
    subject = Subject(scene)
    sweeps = plan_sweeps(subject, "", lidar)
    for number in sorted(sweeps.wanted):
        sweeps.seen[number] = sweep_of(lidar.frames[number])
    away, meeting = distances(subject, sweeps), overlaps(subject, sweeps)
    nearest = min(away.values(), default=0.0)
    most = max(meeting.values(), default=0.0)
    return tuple(
        reading
        for reading in PointsFrame
        if reading in away
        and not lie_nearer(nearest, away[reading])
        and not meet_more(most, meeting.get(reading, most))
    )
