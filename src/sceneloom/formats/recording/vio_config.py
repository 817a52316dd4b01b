"""`vio_config.yaml`: the settings of the vendor's software at the root of a text, and which are publicly known."""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

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
class _Setting:
    """One setting."""

    key: str
    value: str  # the text behind the colon, without a comment; "" where the value stands in the lines below
    line: int  # where it stands, counted from 1


@dataclass(frozen=True, slots=True)
class VioConfig:
    """What a text says.

    Attributes:
        settings: in the order of the lines.
        strange: the lines that are no setting, by number; the vendor's software stops at them.
    """

    settings: tuple[_Setting, ...]
    strange: Mapping[int, str]

    @property
    def unknown_keys(self) -> list[str]:
        """The names of settings that are not publicly known, in the order of the lines; the SDK stops at others."""
        return [setting.key for setting in self.settings if setting.key not in KNOWN_KEYS]


def read_vio_config(text: str) -> VioConfig:
    """Read the settings at the root of a text; lines that are indented, or items of a list, belong to one above."""
    settings: list[_Setting] = []
    strange: dict[int, str] = {}
    for number, line in _content(text):
        match = _SETTING.fullmatch(line)
        if match is not None:
            settings.append(_Setting(match["key"], match["value"] or "", number))
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
