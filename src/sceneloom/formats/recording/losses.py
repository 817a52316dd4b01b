"""What of a scene a recording cannot hold, and what the vendor's software refuses or ignores when it replays one."""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches

import numpy as np

from sceneloom.arrays import Int64Array
from sceneloom.formats.base.losses import Loss, Support
from sceneloom.scene.cameras import CameraSensor, DepthCameraSensor, ShootingSensor, shots_of
from sceneloom.scene.clouds import LidarSensor, PointsSensor, RadarSensor
from sceneloom.scene.motion import GnssSensor, ImuSensor, OdometrySensor, PlainSensor
from sceneloom.scene.poses import Trajectory
from sceneloom.scene.scene import Scene, Sensor

_DEFAULT_FPS = 10.0


def shooting_sensors(scene: Scene) -> Sequence[ShootingSensor]:
    """The cameras in the order of `cameraInd`: as they were read from a recording, else those of depth last.

    The vendor's software takes the first two for a pair of stereo images, or for an image and its depth.
    """
    found = [sensor for sensor in scene.sensors if isinstance(sensor, CameraSensor | DepthCameraSensor)]
    if of_recording(scene):
        return found
    return sorted(found, key=lambda sensor: isinstance(sensor, DepthCameraSensor))


def of_recording(scene: Scene) -> bool:
    """Whether a scene was read from a recording, be it through a scene file."""
    return scene.format == "recording" or "recording" in scene.metadata


def frame_rate(sensor: ShootingSensor) -> float:
    """Nominal images a second."""
    timestamps = shots_of(sensor).timestamps_ns
    if sensor.fps:
        return sensor.fps
    span = (int(timestamps[-1]) - int(timestamps[0])) * 1e-9 if len(timestamps) > 1 else 0.0
    return (len(timestamps) - 1) / span if span > 0 else _DEFAULT_FPS


_HYBVIO = """
visualUpdateEnabled visualUpdateForEveryNFrame maxVisualUpdates maxSuccessfulVisualUpdates batchVisualUpdate
batchVisualUpdateMaxSizeMultiplier trackMinFrames trackRmseThreshold trackChiTestOutlierR
trackOutlierThresholdGrowthFactor scoreVisualUpdateTracks useLinearTriangulation useIndependentStereoTriangulation
triangulationConvergenceThreshold triangulationConvergenceR triangulationRcondThreshold
triangulationGaussNewtonIterations triangulationMinDist triangulationMaxDist trackSampling randomTrackSamplingRatio
fullPointCloud sampleSyncLag sampleSyncFrameCount sampleSyncFrameBufferSize sampleSyncSmartFrameRateLimiter
cameraTrailLength cameraTrailHanoiLength cameraTrailStridedLength cameraTrailStridedStride cameraTrailFixedScheme
hybridMapSize noiseScale useDecayingZeroVelocityUpdate blacklistTracks visualR augmentR usePseudoVelocity
pseudoVelocityLimit pseudoVelocityTarget pseudoVelocityR zuptR rotationZuptR initZuptR useVisualStationarity
visualStationarityMovementThreshold visualStationarityScoreThreshold visualStationarityFrameCountThreshold visualZuptR
gravity noiseInitialPos noiseInitialOri noiseInitialVel noiseInitialPosTrail noiseInitialOriTrail noiseInitialBGA
noiseInitialBAA noiseInitialBAT noiseInitialSFT noiseProcessAcc noiseProcessGyro noiseProcessBAA noiseProcessBGA
noiseProcessBAARev noiseProcessBGARev estimateImuCameraTimeShift rngSeed processingQueueSize imuToCameraMatrix
secondImuToCameraMatrix stereoCameraTranslation imuToCameraShiftSeconds secondImuToCameraShiftSeconds
resetUntilInitSucceeds resetOnFailedTracking resetAfterTrackingFailsToInitialize freezeOnFailedTracking
goodFramesToTracking goodFramesToTrackingFailed goodFramesTimeWindowSeconds predictOpticalFlow
independentStereoOpticalFlow predictOpticalFlowMinTriangulationDistance maxStereoEpipolarDistance targetFps focalLength
focalLengthX focalLengthY principalPointX principalPointY secondFocalLength secondFocalLengthX secondFocalLengthY
secondPrincipalPointX secondPrincipalPointY fisheyeCamera validCameraFov distortionCoeffs secondDistortionCoeffs
maxTracks maxTrackLength useHybridRansac ransacMaxIters ransac2InliersToSkipRansac5 ransac2InliersOverRansac5Needed
ransac2Threshold ransac5Threshold ransac5Prob ransacMinInlierFraction useTheiaRansac5 theiaRansac5ErrorThresh
theiaRansac5FailureProbability theiaRansac5MaxIterations theiaRansac5MinIterations theiaRansac5UseMle useRansac3
ransac3ErrorThresh ransac3FailureProbability ransac3MaxIterations ransac3MinIterations ransac3UseMle useStereoUpright2p
ransacStereoUpright2pErrorThresh ransacStereoUpright2pFailureProbability ransacStereoUpright2pMaxIterations
ransacStereoUpright2pMinIterations ransacStereoUpright2pUseMle ransacRngSeed relativeMaskRadius featureDetector
gfttQualityLevel gfttMinDistance gfttBlockSize gfttK gfttMinResponse subPixWindowSize subPixMaxIter subPixEpsilon
pyrLKMaxLevel pyrLKWindowSize pyrLKMaxIter pyrLKEpsilon pyrLKMinEigThreshold displayMaxTrackLength useStereo
leftCameraId rightCameraId partOfImageToDetectFeatures useRectification rectificationZoom computeDenseStereoDepth
computeStereoPointCloud stereoPointCloudStride useSlam slamThread maxKeypoints minLoopClosureFeatureMatches
loopClosureRansacMinInliers loopClosureRansacIterations requireTringulationForLoopClosures
loopClosureFeatureMatchLoweRatio maximumDriftMetersPerSecond maximumDriftRadiansPerSecond maximumDriftMetersPerTraveled
maximumDriftRadiansPerTraveled loopClosureRansacFixScale loopClosureInlierThreshold applyLoopClosures
applyLocalBundleAdjustment relativeReprojectionErrorThreshold epipolarCheckThresholdDegrees minObservationsForBA
minMapPointCullingAge minKeyframesInBA minVisibleMapPointsInCurrentFrameBA minVisibleMapPointsInNeighborhoodBA
minVisibleMapPointsInForNonKeyframeBA nonKeyFramePoseAdjustment adjacentSpaceSize localBAProblemSize
loopClosureLocalBAProblemSize globalBAIterations poseBAIterations odometryPriorStrengthPosition
odometryPriorStrengthRotation odometryPriorSimpleUncertainty odometryPriorFixed minNeighbourCovisiblitities
keyframeCandidateInterval useFrontendSlam copySlamMapEveryNSlamFrames backendProcessDelay copyPartialMapToFrontend
deterministicSlamMapCopy delayIntervalMultiplier removeOdometryTransformZAxisTilt useOdometryPoseTrailDelta
useVariableLengthDeltas keyframeDecisionAlways keyframeDecisionMinIntervalSeconds keyframeDecisionCovisibilityRatio
keyframeDecisionDistanceThreshold keyframeCullMaxCriticalRatio keyframeCullEnabled cullMapPoints vocabularyPath
bowMinInCommonRatio bowScoreRatio minTriangulationAngleTwoObs minTriangulationAngleMultipleObs
loopClosureRigidTransform globalBAAfterLoop orbScaleLevels orbScaleFactor orbInitialFastThreshold orbMinFastThreshold
orbLkTrackLevel orbExtraKeyPoints useGpuImagePyramid slamFeatureDetector kfAsciiWidth kfAsciiBA kfAsciiAdjacent
saveOpticalFlow saveStereoEpipolar rot allowSkippedFrames outputCameraPose outputJsonExtras outputJsonPoseTrail ffmpeg
vf videoReaderThreads convertVideoToGray matchStereoIntensities matchSuccessiveIntensities targetOutputDelaySeconds
printVisualUpdateStats printLoopCloserStats printBaStats videoRotation
"""
"""Source: `codegen/parameter_definitions.c` and `codegen/parameters_base.cpp` of HybVIO."""

_SDK = """
alreadyRectified computeDenseStereoDepthKeyFramesOnly delayFrames depthErrorScale ffmpegPngPreviewNthFrame
ffmpegPngPreviewScale ffmpegVideoCodec icpVoxelSize imuAnomalyFilterGyroEnabled imuStationaryEnabled mapSavePath
maxMapSize maxSlamResultQueueSize noWaitingForResults optimizerMaxIterations outputOnFrames parameterSets
passthroughColorImages recMeshSavePath recTexturize skipFirstNFrames stereoPointCloudMinDepth
trackingStatusInitMinSeconds
"""
"""Source: the settings that the public examples, the ROS 2 node and the command line tools of the SDK write."""

KNOWN_KEYS: frozenset[str] = frozenset((*_HYBVIO.split(), *_SDK.split()))
"""Names of settings in `vio_config.yaml`; the software may know more."""

_SETTING = re.compile(
    r"""(?P<quote>["']?)(?P<key>[^\s"':#{}\[\],&*!|>%@`][^"':#]*?)(?P=quote)\s*:(?:\s+(?P<value>.*))?"""
)

_BEGINS_LIST = ("- ", "-\t")

_MARKS = ("---", "...", "%YAML")


@dataclass(frozen=True, slots=True)
class Setting:
    """One setting.

    Attributes:
        key: its name.
        value: the text behind the colon, without a comment; "" where the value stands in the lines below.
        line: where it stands, counted from 1.
    """

    key: str
    value: str
    line: int


@dataclass(frozen=True, slots=True)
class VioConfig:
    """What a text says.

    Attributes:
        settings: in the order of the lines.
        strange: the lines that are no setting, by number; the vendor's software stops at them.
    """

    settings: tuple[Setting, ...]
    strange: Mapping[int, str]


def read_vio_config(text: str) -> VioConfig:
    """Read the settings at the root of a text; lines that are indented, or items of a list, belong to one above."""
    settings: list[Setting] = []
    strange: dict[int, str] = {}
    for number, line in _content(text):
        match = _SETTING.fullmatch(line)
        if match is not None:
            settings.append(Setting(match["key"], match["value"] or "", number))
        elif not (settings and line.startswith(_BEGINS_LIST)):
            strange[number] = line
    return VioConfig(tuple(settings), strange)


def _content(text: str) -> Iterator[tuple[int, str]]:
    """The lines at the root that state something, without their comments."""
    for number, line in enumerate(text.lstrip("\ufeff").splitlines(), start=1):
        stated = _without_comment(line).rstrip()
        if stated and not stated[0].isspace() and not stated.startswith(_MARKS):
            yield number, stated


def _without_comment(line: str) -> str:
    """Cut what stands behind a `#` that begins a comment: one that is in no quotes and follows a blank."""
    quote = ""
    for location, letter in enumerate(line):
        if quote:
            quote = "" if letter == quote else quote
        elif letter in "\"'":
            quote = letter
        elif letter == "#" and (location == 0 or line[location - 1].isspace()):
            return line[:location]
    return line


def unknown_keys(text: str) -> list[str]:
    """The names of settings that are not publicly known, in the order of the lines; the SDK stops at those it lacks."""
    return [setting.key for setting in read_vio_config(text).settings if setting.key not in KNOWN_KEYS]


def repeated_keys(text: str) -> list[str]:
    """The names of settings that stand there more than once; which value counts is not stated."""
    keys = [setting.key for setting in read_vio_config(text).settings]
    return sorted({key for key in keys if keys.count(key) > 1})


def similar_key(key: str) -> str | None:
    """The known name that a name comes closest to, None where none is near."""
    by_letters = {known.lower(): known for known in KNOWN_KEYS}
    near = get_close_matches(key.lower(), by_letters, n=1, cutoff=0.8)
    return by_letters[near[0]] if near else None


_FIELD = "replay"
"""Under which these stand in a loss report: the recording holds the data all the same."""

_NEEDED = ("accelerometer", "gyroscope")

_MOST_CAMERAS = 2


def unreplayable(
    cameras: Sequence[ShootingSensor],
    lidars: Sequence[LidarSensor],
    imu: ImuSensor | None,
    vio_config: str | None,
) -> list[Loss]:
    """Name what will not be replayed as it was meant.

    Args:
        cameras: what is written, in the order of `cameraInd`.
        lidars: what is written.
        imu: what is written.
        vio_config: the text of `vio_config.yaml`.
    """
    return [
        *_of_missing(cameras, imu),
        *_of_cameras(cameras),
        *_of_equal_times(cameras, imu),
        *_of_lidars(lidars),
        *_of_settings(vio_config),
    ]


def _of_missing(cameras: Sequence[ShootingSensor], imu: ImuSensor | None) -> Iterator[Loss]:
    there = {name for name, samples in imu.streams.items() if len(samples)} if imu is not None else set()
    missing = [name for name in _NEEDED if name not in there]
    if missing and any(len(shots_of(camera)) for camera in cameras):
        yield _loss(f"the vendor's software gives no output without {' and '.join(missing)}")


def _of_cameras(cameras: Sequence[ShootingSensor]) -> Iterator[Loss]:
    if len(cameras) > _MOST_CAMERAS:
        names = ", ".join(str(camera.id) for camera in cameras[_MOST_CAMERAS:])
        yield _loss(
            f"the vendor's software uses the first two cameras, not {names}", len(cameras) - _MOST_CAMERAS
        )
    if cameras and isinstance(cameras[0], DepthCameraSensor):
        yield _loss(f"the vendor's software tracks in the first camera, and {cameras[0].id} measures depth")


def _of_equal_times(cameras: Sequence[ShootingSensor], imu: ImuSensor | None) -> Iterator[Loss]:
    if imu is None or not cameras:
        return
    timestamps: Int64Array = np.concatenate([shots_of(camera).timestamps_ns for camera in cameras])
    measured = [samples.timestamps_ns for name, samples in imu.streams.items() if name in _NEEDED]
    equal = int(np.isin(np.unique(timestamps), np.concatenate([*measured, np.zeros(0, np.int64)])).sum())
    if equal:
        yield _loss(
            "images have the very times of IMU samples, which makes the vendor's diagnosis suspect that their times "
            "were not measured; they are written as they are",
            equal,
        )


def _of_lidars(lidars: Sequence[LidarSensor]) -> Iterator[Loss]:
    if len(lidars) > 1:
        yield _loss("the vendor's software does not report lidars apart (`lidarInd`)", len(lidars))


def _of_settings(vio_config: str | None) -> Iterator[Loss]:
    unknown = unknown_keys(vio_config or "")
    if unknown:
        named = ", ".join(unknown)
        yield _loss(
            f"the vendor's software may stop at settings that are not publicly known: {named}", len(unknown)
        )


def _loss(what: str, count: int = 1) -> Loss:
    return Loss(field=_FIELD, what=what, count=count, support=Support.KEPT)


_NO_POSITION = "left out: the format has none"

_RECORDING_EXTRAS = {"calibration", "lidarInd"}


def unwritten(
    scene: Scene,
    cameras: Sequence[ShootingSensor],
    trajectories: Sequence[Trajectory],
    imu: ImuSensor | None,
) -> list[Loss]:
    """Name everything of a scene that its recording will not hold.

    Args:
        scene: what is written.
        cameras: those of its cameras that are written.
        trajectories: what is written as trajectories.
        imu: the inertial unit that is written.
    """
    return [
        *_of_root(scene),
        *(loss for sensor in scene.sensors for loss in _of_sensor(sensor)),
        *_of_odometry(scene, trajectories),
        *_unwritten_of_cameras(scene, cameras),
        *_of_repeated(scene, imu),
        *_of_ids(scene, cameras, imu),
        *_of_order(scene, cameras, imu),
        *_of_antennas(scene),
        *_of_default(scene, trajectories),
    ]


def _of_root(scene: Scene) -> Iterator[Loss]:
    counts = {
        "annotations": len(scene.annotations),
        "attributes": len(scene.attributes),
        **{f"metadata.{name}": 1 for name in scene.metadata if name != "recording"},
        **{f"extras.{name}": 1 for name in scene.extras},
    }
    yield from (Loss(field=name, what=_NO_POSITION, count=count) for name, count in counts.items() if count)


def _of_sensor(sensor: Sensor) -> Iterator[Loss]:
    if isinstance(sensor, RadarSensor | PointsSensor | PlainSensor):
        yield Loss(field=f"sensors[{sensor.id}]", what=_NO_POSITION)
        return
    for name in sensor.extras:
        if name not in _RECORDING_EXTRAS:
            yield Loss(field=f"sensors[{sensor.id}].{name}", what=_NO_POSITION)
    if sensor.parent_id is not None:
        yield Loss(field=f"sensors[{sensor.id}].parent_id", what=_NO_POSITION)


def _of_odometry(scene: Scene, trajectories: Sequence[Trajectory]) -> Iterator[Loss]:
    """The format knows no sensors of the ego's own motion, but trajectories."""
    names = {trajectory.name for trajectory in trajectories} - set(scene.trajectories)
    for sensor in scene.sensors:
        if isinstance(sensor, OdometrySensor):
            written = f"written as trajectory {str(sensor.id)!r}"
            if sensor.poses.static:
                written = "left out: the format has no path without end"
            elif str(sensor.id) not in names:
                written = "left out: a trajectory says the same"
            left_out = written.startswith("left out")
            yield Loss(
                field=f"sensors[{sensor.id}]",
                what=written,
                support=Support.DROPPED if left_out else Support.CONVERTED,
            )


def _unwritten_of_cameras(scene: Scene, cameras: Sequence[ShootingSensor]) -> Iterator[Loss]:
    for camera in shooting_sensors(scene):
        if camera not in cameras:
            yield Loss(
                field=f"sensors[{camera.id}]", what="left out: it has no images, while other cameras have"
            )


def _of_repeated(scene: Scene, imu: ImuSensor | None) -> Iterator[Loss]:
    for sensor in [sensor for sensor in scene.sensors if isinstance(sensor, ImuSensor) and sensor is not imu]:
        yield Loss(field=f"sensors[{sensor.id}]", what=f"left out: the format has one {sensor.type} only")


def _of_ids(scene: Scene, cameras: Sequence[ShootingSensor], imu: ImuSensor | None) -> Iterator[Loss]:
    """The ids that reading gives differ from the scene's: the format knows sensors by number only."""
    lidars = scene.lidars
    names: dict[str, Sequence[Sensor]] = {
        "camera": cameras,
        "lidar": lidars,
        "imu": [] if imu is None else [imu],
        "gnss": main_receiver([sensor for sensor in scene.sensors if isinstance(sensor, GnssSensor)]),
    }
    for name, sensors in names.items():
        for index, sensor in enumerate(sensors):
            numbered = name == "camera" or (name == "lidar" and len(lidars) > 1)
            found = f"{name}{index}" if numbered else name
            if sensor.id != found:
                yield Loss(field=f"sensors[{sensor.id}].id", what=f"read back as {found!r}")


def _of_order(scene: Scene, cameras: Sequence[ShootingSensor], imu: ImuSensor | None) -> Iterator[Loss]:
    receivers = [sensor for sensor in scene.sensors if isinstance(sensor, GnssSensor)]
    found = [sensor.id for sensor in (*scene.lidars, *cameras, *([] if imu is None else [imu]), *receivers)]
    if found != [sensor.id for sensor in scene.sensors if sensor.id in found]:
        what = "read back in another order: lidars, cameras, those of depth last, IMU, satellite receivers"
        yield Loss(field="sensors", what=what)


def _of_antennas(scene: Scene) -> Iterator[Loss]:
    """The locations of antennas but that of the one receiver for which the format has a field."""
    found = [sensor for sensor in scene.sensors if isinstance(sensor, GnssSensor)]
    for sensor in found:
        if sensor.mount is not None and sensor not in main_receiver(found):
            yield Loss(field=f"sensors[{sensor.id}].mount", what=_NO_POSITION)


def main_receiver(receivers: Sequence[GnssSensor]) -> list[GnssSensor]:
    """Give the one whose lines are `gps` lines: the one that is called so, else the first that has no other name."""
    others = [sensor for sensor in receivers if sensor.id != "rtkgps"]
    return [sensor for sensor in others if sensor.id == "gnss"][:1] or others[:1]


def _of_default(scene: Scene, trajectories: Sequence[Trajectory]) -> Iterator[Loss]:
    default = next(iter(scene.trajectories), None)
    names = [trajectory.name for trajectory in trajectories]
    if default != "groundTruth" and "groundTruth" in names:
        yield Loss(field="trajectories.order", what=f"read back with 'groundTruth' first, not {default!r}")
    for trajectory in trajectories:
        if trajectory.covariances is not None:
            yield Loss(field=f"trajectories.{trajectory.name}.covariances", what=_NO_POSITION)
