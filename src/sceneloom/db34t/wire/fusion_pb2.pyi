from google.protobuf.internal import containers as _containers
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class Timestamp(_message.Message):
    __slots__ = ("s", "ns")
    S_FIELD_NUMBER: _ClassVar[int]
    NS_FIELD_NUMBER: _ClassVar[int]
    s: int
    ns: int
    def __init__(self, s: _Optional[int] = ..., ns: _Optional[int] = ...) -> None: ...

class Value(_message.Message):
    __slots__ = ("bool_value", "integer_value", "number_value", "string_value", "list_value")
    BOOL_VALUE_FIELD_NUMBER: _ClassVar[int]
    INTEGER_VALUE_FIELD_NUMBER: _ClassVar[int]
    NUMBER_VALUE_FIELD_NUMBER: _ClassVar[int]
    STRING_VALUE_FIELD_NUMBER: _ClassVar[int]
    LIST_VALUE_FIELD_NUMBER: _ClassVar[int]
    bool_value: bool
    integer_value: int
    number_value: float
    string_value: str
    list_value: ValueList
    def __init__(self, bool_value: _Optional[bool] = ..., integer_value: _Optional[int] = ..., number_value: _Optional[float] = ..., string_value: _Optional[str] = ..., list_value: _Optional[_Union[ValueList, _Mapping]] = ...) -> None: ...

class ValueList(_message.Message):
    __slots__ = ("values",)
    VALUES_FIELD_NUMBER: _ClassVar[int]
    values: _containers.RepeatedCompositeFieldContainer[Value]
    def __init__(self, values: _Optional[_Iterable[_Union[Value, _Mapping]]] = ...) -> None: ...

class Status(_message.Message):
    __slots__ = ("status", "reason", "cause")
    STATUS_FIELD_NUMBER: _ClassVar[int]
    REASON_FIELD_NUMBER: _ClassVar[int]
    CAUSE_FIELD_NUMBER: _ClassVar[int]
    status: int
    reason: str
    cause: str
    def __init__(self, status: _Optional[int] = ..., reason: _Optional[str] = ..., cause: _Optional[str] = ...) -> None: ...

class AddPropertyRequest(_message.Message):
    __slots__ = ("name", "description", "type", "session")
    NAME_FIELD_NUMBER: _ClassVar[int]
    DESCRIPTION_FIELD_NUMBER: _ClassVar[int]
    TYPE_FIELD_NUMBER: _ClassVar[int]
    SESSION_FIELD_NUMBER: _ClassVar[int]
    name: str
    description: str
    type: str
    session: str
    def __init__(self, name: _Optional[str] = ..., description: _Optional[str] = ..., type: _Optional[str] = ..., session: _Optional[str] = ...) -> None: ...

class SetPropertyRequest(_message.Message):
    __slots__ = ("name", "value", "session")
    NAME_FIELD_NUMBER: _ClassVar[int]
    VALUE_FIELD_NUMBER: _ClassVar[int]
    SESSION_FIELD_NUMBER: _ClassVar[int]
    name: str
    value: Value
    session: str
    def __init__(self, name: _Optional[str] = ..., value: _Optional[_Union[Value, _Mapping]] = ..., session: _Optional[str] = ...) -> None: ...

class GetPropertyRequest(_message.Message):
    __slots__ = ("name", "session")
    NAME_FIELD_NUMBER: _ClassVar[int]
    SESSION_FIELD_NUMBER: _ClassVar[int]
    name: str
    session: str
    def __init__(self, name: _Optional[str] = ..., session: _Optional[str] = ...) -> None: ...

class ListPropertiesRequest(_message.Message):
    __slots__ = ("session",)
    SESSION_FIELD_NUMBER: _ClassVar[int]
    session: str
    def __init__(self, session: _Optional[str] = ...) -> None: ...

class Property(_message.Message):
    __slots__ = ("name", "description", "type", "unit", "value", "predefined")
    NAME_FIELD_NUMBER: _ClassVar[int]
    DESCRIPTION_FIELD_NUMBER: _ClassVar[int]
    TYPE_FIELD_NUMBER: _ClassVar[int]
    UNIT_FIELD_NUMBER: _ClassVar[int]
    VALUE_FIELD_NUMBER: _ClassVar[int]
    PREDEFINED_FIELD_NUMBER: _ClassVar[int]
    name: str
    description: str
    type: str
    unit: str
    value: Value
    predefined: bool
    def __init__(self, name: _Optional[str] = ..., description: _Optional[str] = ..., type: _Optional[str] = ..., unit: _Optional[str] = ..., value: _Optional[_Union[Value, _Mapping]] = ..., predefined: _Optional[bool] = ...) -> None: ...

class Properties(_message.Message):
    __slots__ = ("properties", "revision")
    PROPERTIES_FIELD_NUMBER: _ClassVar[int]
    REVISION_FIELD_NUMBER: _ClassVar[int]
    properties: _containers.RepeatedCompositeFieldContainer[Property]
    revision: int
    def __init__(self, properties: _Optional[_Iterable[_Union[Property, _Mapping]]] = ..., revision: _Optional[int] = ...) -> None: ...

class Calibration(_message.Message):
    __slots__ = ("image_size", "distortion_coeffs", "intrinsic_matrix", "reference_frame", "extrinsic_matrix")
    IMAGE_SIZE_FIELD_NUMBER: _ClassVar[int]
    DISTORTION_COEFFS_FIELD_NUMBER: _ClassVar[int]
    INTRINSIC_MATRIX_FIELD_NUMBER: _ClassVar[int]
    REFERENCE_FRAME_FIELD_NUMBER: _ClassVar[int]
    EXTRINSIC_MATRIX_FIELD_NUMBER: _ClassVar[int]
    image_size: _containers.RepeatedScalarFieldContainer[int]
    distortion_coeffs: _containers.RepeatedScalarFieldContainer[float]
    intrinsic_matrix: _containers.RepeatedScalarFieldContainer[float]
    reference_frame: int
    extrinsic_matrix: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, image_size: _Optional[_Iterable[int]] = ..., distortion_coeffs: _Optional[_Iterable[float]] = ..., intrinsic_matrix: _Optional[_Iterable[float]] = ..., reference_frame: _Optional[int] = ..., extrinsic_matrix: _Optional[_Iterable[float]] = ...) -> None: ...

class SetCalibrationRequest(_message.Message):
    __slots__ = ("calibration", "camera_id", "lidar_id", "session")
    CALIBRATION_FIELD_NUMBER: _ClassVar[int]
    CAMERA_ID_FIELD_NUMBER: _ClassVar[int]
    LIDAR_ID_FIELD_NUMBER: _ClassVar[int]
    SESSION_FIELD_NUMBER: _ClassVar[int]
    calibration: Calibration
    camera_id: int
    lidar_id: int
    session: str
    def __init__(self, calibration: _Optional[_Union[Calibration, _Mapping]] = ..., camera_id: _Optional[int] = ..., lidar_id: _Optional[int] = ..., session: _Optional[str] = ...) -> None: ...

class Pose(_message.Message):
    __slots__ = ("timestamp", "position", "quaternion_xyzw")
    TIMESTAMP_FIELD_NUMBER: _ClassVar[int]
    POSITION_FIELD_NUMBER: _ClassVar[int]
    QUATERNION_XYZW_FIELD_NUMBER: _ClassVar[int]
    timestamp: Timestamp
    position: _containers.RepeatedScalarFieldContainer[float]
    quaternion_xyzw: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, timestamp: _Optional[_Union[Timestamp, _Mapping]] = ..., position: _Optional[_Iterable[float]] = ..., quaternion_xyzw: _Optional[_Iterable[float]] = ...) -> None: ...

class SendMotionRequest(_message.Message):
    __slots__ = ("poses", "session")
    POSES_FIELD_NUMBER: _ClassVar[int]
    SESSION_FIELD_NUMBER: _ClassVar[int]
    poses: _containers.RepeatedCompositeFieldContainer[Pose]
    session: str
    def __init__(self, poses: _Optional[_Iterable[_Union[Pose, _Mapping]]] = ..., session: _Optional[str] = ...) -> None: ...

class RawData(_message.Message):
    __slots__ = ("sensor_id", "timestamp", "seq", "length", "data")
    SENSOR_ID_FIELD_NUMBER: _ClassVar[int]
    TIMESTAMP_FIELD_NUMBER: _ClassVar[int]
    SEQ_FIELD_NUMBER: _ClassVar[int]
    LENGTH_FIELD_NUMBER: _ClassVar[int]
    DATA_FIELD_NUMBER: _ClassVar[int]
    sensor_id: int
    timestamp: Timestamp
    seq: int
    length: int
    data: bytes
    def __init__(self, sensor_id: _Optional[int] = ..., timestamp: _Optional[_Union[Timestamp, _Mapping]] = ..., seq: _Optional[int] = ..., length: _Optional[int] = ..., data: _Optional[bytes] = ...) -> None: ...

class ImageData(_message.Message):
    __slots__ = ("sensor_id", "timestamp", "seq", "height", "width", "encoding", "channel", "data")
    SENSOR_ID_FIELD_NUMBER: _ClassVar[int]
    TIMESTAMP_FIELD_NUMBER: _ClassVar[int]
    SEQ_FIELD_NUMBER: _ClassVar[int]
    HEIGHT_FIELD_NUMBER: _ClassVar[int]
    WIDTH_FIELD_NUMBER: _ClassVar[int]
    ENCODING_FIELD_NUMBER: _ClassVar[int]
    CHANNEL_FIELD_NUMBER: _ClassVar[int]
    DATA_FIELD_NUMBER: _ClassVar[int]
    sensor_id: int
    timestamp: Timestamp
    seq: int
    height: int
    width: int
    encoding: str
    channel: int
    data: bytes
    def __init__(self, sensor_id: _Optional[int] = ..., timestamp: _Optional[_Union[Timestamp, _Mapping]] = ..., seq: _Optional[int] = ..., height: _Optional[int] = ..., width: _Optional[int] = ..., encoding: _Optional[str] = ..., channel: _Optional[int] = ..., data: _Optional[bytes] = ...) -> None: ...

class PointCloudData(_message.Message):
    __slots__ = ("sensor_id", "timestamp", "seq", "number", "fields", "fields_number", "data", "sensor_type", "beam", "ring")
    SENSOR_ID_FIELD_NUMBER: _ClassVar[int]
    TIMESTAMP_FIELD_NUMBER: _ClassVar[int]
    SEQ_FIELD_NUMBER: _ClassVar[int]
    NUMBER_FIELD_NUMBER: _ClassVar[int]
    FIELDS_FIELD_NUMBER: _ClassVar[int]
    FIELDS_NUMBER_FIELD_NUMBER: _ClassVar[int]
    DATA_FIELD_NUMBER: _ClassVar[int]
    SENSOR_TYPE_FIELD_NUMBER: _ClassVar[int]
    BEAM_FIELD_NUMBER: _ClassVar[int]
    RING_FIELD_NUMBER: _ClassVar[int]
    sensor_id: int
    timestamp: Timestamp
    seq: int
    number: int
    fields: _containers.RepeatedScalarFieldContainer[str]
    fields_number: int
    data: bytes
    sensor_type: int
    beam: int
    ring: int
    def __init__(self, sensor_id: _Optional[int] = ..., timestamp: _Optional[_Union[Timestamp, _Mapping]] = ..., seq: _Optional[int] = ..., number: _Optional[int] = ..., fields: _Optional[_Iterable[str]] = ..., fields_number: _Optional[int] = ..., data: _Optional[bytes] = ..., sensor_type: _Optional[int] = ..., beam: _Optional[int] = ..., ring: _Optional[int] = ...) -> None: ...

class Box3d(_message.Message):
    __slots__ = ("id", "points_seq", "confidence", "timestamp", "X", "Y", "Z", "length", "width", "height", "direction", "velocity", "velocity_vector")
    ID_FIELD_NUMBER: _ClassVar[int]
    CLASS_FIELD_NUMBER: _ClassVar[int]
    POINTS_SEQ_FIELD_NUMBER: _ClassVar[int]
    CONFIDENCE_FIELD_NUMBER: _ClassVar[int]
    TIMESTAMP_FIELD_NUMBER: _ClassVar[int]
    X_FIELD_NUMBER: _ClassVar[int]
    Y_FIELD_NUMBER: _ClassVar[int]
    Z_FIELD_NUMBER: _ClassVar[int]
    LENGTH_FIELD_NUMBER: _ClassVar[int]
    WIDTH_FIELD_NUMBER: _ClassVar[int]
    HEIGHT_FIELD_NUMBER: _ClassVar[int]
    DIRECTION_FIELD_NUMBER: _ClassVar[int]
    VELOCITY_FIELD_NUMBER: _ClassVar[int]
    VELOCITY_VECTOR_FIELD_NUMBER: _ClassVar[int]
    id: int
    points_seq: int
    confidence: float
    timestamp: Timestamp
    X: float
    Y: float
    Z: float
    length: float
    width: float
    height: float
    direction: _containers.RepeatedScalarFieldContainer[float]
    velocity: float
    velocity_vector: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, id: _Optional[int] = ..., points_seq: _Optional[int] = ..., confidence: _Optional[float] = ..., timestamp: _Optional[_Union[Timestamp, _Mapping]] = ..., X: _Optional[float] = ..., Y: _Optional[float] = ..., Z: _Optional[float] = ..., length: _Optional[float] = ..., width: _Optional[float] = ..., height: _Optional[float] = ..., direction: _Optional[_Iterable[float]] = ..., velocity: _Optional[float] = ..., velocity_vector: _Optional[_Iterable[float]] = ..., **kwargs) -> None: ...

class Boxes3d(_message.Message):
    __slots__ = ("sensor_id", "seq", "timestamp", "boxes")
    SENSOR_ID_FIELD_NUMBER: _ClassVar[int]
    SEQ_FIELD_NUMBER: _ClassVar[int]
    TIMESTAMP_FIELD_NUMBER: _ClassVar[int]
    BOXES_FIELD_NUMBER: _ClassVar[int]
    sensor_id: int
    seq: int
    timestamp: Timestamp
    boxes: _containers.RepeatedCompositeFieldContainer[Box3d]
    def __init__(self, sensor_id: _Optional[int] = ..., seq: _Optional[int] = ..., timestamp: _Optional[_Union[Timestamp, _Mapping]] = ..., boxes: _Optional[_Iterable[_Union[Box3d, _Mapping]]] = ...) -> None: ...

class Box2d(_message.Message):
    __slots__ = ("id", "image_seq", "confidence", "timestamp", "x1", "y1", "x2", "y2")
    ID_FIELD_NUMBER: _ClassVar[int]
    CLASS_FIELD_NUMBER: _ClassVar[int]
    IMAGE_SEQ_FIELD_NUMBER: _ClassVar[int]
    CONFIDENCE_FIELD_NUMBER: _ClassVar[int]
    TIMESTAMP_FIELD_NUMBER: _ClassVar[int]
    X1_FIELD_NUMBER: _ClassVar[int]
    Y1_FIELD_NUMBER: _ClassVar[int]
    X2_FIELD_NUMBER: _ClassVar[int]
    Y2_FIELD_NUMBER: _ClassVar[int]
    id: int
    image_seq: int
    confidence: float
    timestamp: Timestamp
    x1: int
    y1: int
    x2: int
    y2: int
    def __init__(self, id: _Optional[int] = ..., image_seq: _Optional[int] = ..., confidence: _Optional[float] = ..., timestamp: _Optional[_Union[Timestamp, _Mapping]] = ..., x1: _Optional[int] = ..., y1: _Optional[int] = ..., x2: _Optional[int] = ..., y2: _Optional[int] = ..., **kwargs) -> None: ...

class Boxes2d(_message.Message):
    __slots__ = ("sensor_id", "seq", "timestamp", "boxes")
    SENSOR_ID_FIELD_NUMBER: _ClassVar[int]
    SEQ_FIELD_NUMBER: _ClassVar[int]
    TIMESTAMP_FIELD_NUMBER: _ClassVar[int]
    BOXES_FIELD_NUMBER: _ClassVar[int]
    sensor_id: int
    seq: int
    timestamp: Timestamp
    boxes: _containers.RepeatedCompositeFieldContainer[Box2d]
    def __init__(self, sensor_id: _Optional[int] = ..., seq: _Optional[int] = ..., timestamp: _Optional[_Union[Timestamp, _Mapping]] = ..., boxes: _Optional[_Iterable[_Union[Box2d, _Mapping]]] = ...) -> None: ...

class SendRequest(_message.Message):
    __slots__ = ("raw", "image", "points", "boxes_3d", "boxes_2d", "box_3d", "box_2d", "session")
    RAW_FIELD_NUMBER: _ClassVar[int]
    IMAGE_FIELD_NUMBER: _ClassVar[int]
    POINTS_FIELD_NUMBER: _ClassVar[int]
    BOXES_3D_FIELD_NUMBER: _ClassVar[int]
    BOXES_2D_FIELD_NUMBER: _ClassVar[int]
    BOX_3D_FIELD_NUMBER: _ClassVar[int]
    BOX_2D_FIELD_NUMBER: _ClassVar[int]
    SESSION_FIELD_NUMBER: _ClassVar[int]
    raw: RawData
    image: ImageData
    points: PointCloudData
    boxes_3d: Boxes3d
    boxes_2d: Boxes2d
    box_3d: Box3d
    box_2d: Box2d
    session: str
    def __init__(self, raw: _Optional[_Union[RawData, _Mapping]] = ..., image: _Optional[_Union[ImageData, _Mapping]] = ..., points: _Optional[_Union[PointCloudData, _Mapping]] = ..., boxes_3d: _Optional[_Union[Boxes3d, _Mapping]] = ..., boxes_2d: _Optional[_Union[Boxes2d, _Mapping]] = ..., box_3d: _Optional[_Union[Box3d, _Mapping]] = ..., box_2d: _Optional[_Union[Box2d, _Mapping]] = ..., session: _Optional[str] = ...) -> None: ...

class SendSummary(_message.Message):
    __slots__ = ("accepted", "refused", "refusals")
    ACCEPTED_FIELD_NUMBER: _ClassVar[int]
    REFUSED_FIELD_NUMBER: _ClassVar[int]
    REFUSALS_FIELD_NUMBER: _ClassVar[int]
    accepted: int
    refused: int
    refusals: _containers.RepeatedCompositeFieldContainer[Refusal]
    def __init__(self, accepted: _Optional[int] = ..., refused: _Optional[int] = ..., refusals: _Optional[_Iterable[_Union[Refusal, _Mapping]]] = ...) -> None: ...

class Refusal(_message.Message):
    __slots__ = ("number", "status")
    NUMBER_FIELD_NUMBER: _ClassVar[int]
    STATUS_FIELD_NUMBER: _ClassVar[int]
    number: int
    status: Status
    def __init__(self, number: _Optional[int] = ..., status: _Optional[_Union[Status, _Mapping]] = ...) -> None: ...

class GetRequest(_message.Message):
    __slots__ = ("fusion_type", "wait_ms", "session")
    FUSION_TYPE_FIELD_NUMBER: _ClassVar[int]
    WAIT_MS_FIELD_NUMBER: _ClassVar[int]
    SESSION_FIELD_NUMBER: _ClassVar[int]
    fusion_type: int
    wait_ms: int
    session: str
    def __init__(self, fusion_type: _Optional[int] = ..., wait_ms: _Optional[int] = ..., session: _Optional[str] = ...) -> None: ...

class SubscribeRequest(_message.Message):
    __slots__ = ("fusion_type", "most", "session", "track")
    FUSION_TYPE_FIELD_NUMBER: _ClassVar[int]
    MOST_FIELD_NUMBER: _ClassVar[int]
    SESSION_FIELD_NUMBER: _ClassVar[int]
    TRACK_FIELD_NUMBER: _ClassVar[int]
    fusion_type: int
    most: int
    session: str
    track: bool
    def __init__(self, fusion_type: _Optional[int] = ..., most: _Optional[int] = ..., session: _Optional[str] = ..., track: _Optional[bool] = ...) -> None: ...

class NoData(_message.Message):
    __slots__ = ()
    def __init__(self) -> None: ...

class GetReply(_message.Message):
    __slots__ = ("sensor_data", "detections", "no_data", "number", "configuration")
    SENSOR_DATA_FIELD_NUMBER: _ClassVar[int]
    DETECTIONS_FIELD_NUMBER: _ClassVar[int]
    NO_DATA_FIELD_NUMBER: _ClassVar[int]
    NUMBER_FIELD_NUMBER: _ClassVar[int]
    CONFIGURATION_FIELD_NUMBER: _ClassVar[int]
    sensor_data: SensorFusionData
    detections: FusedDetections
    no_data: NoData
    number: int
    configuration: Properties
    def __init__(self, sensor_data: _Optional[_Union[SensorFusionData, _Mapping]] = ..., detections: _Optional[_Union[FusedDetections, _Mapping]] = ..., no_data: _Optional[_Union[NoData, _Mapping]] = ..., number: _Optional[int] = ..., configuration: _Optional[_Union[Properties, _Mapping]] = ...) -> None: ...

class SensorFusionData(_message.Message):
    __slots__ = ("timestamp", "image_seq", "points_seq", "camera_id", "lidar_id", "height", "width", "encoding", "image_channel", "image_data", "image_depth", "point_num", "point_fields", "fields_number", "point_data", "depth_kind", "point_frame", "motion_compensated", "image_timestamp")
    TIMESTAMP_FIELD_NUMBER: _ClassVar[int]
    CLASS_FIELD_NUMBER: _ClassVar[int]
    IMAGE_SEQ_FIELD_NUMBER: _ClassVar[int]
    POINTS_SEQ_FIELD_NUMBER: _ClassVar[int]
    CAMERA_ID_FIELD_NUMBER: _ClassVar[int]
    LIDAR_ID_FIELD_NUMBER: _ClassVar[int]
    HEIGHT_FIELD_NUMBER: _ClassVar[int]
    WIDTH_FIELD_NUMBER: _ClassVar[int]
    ENCODING_FIELD_NUMBER: _ClassVar[int]
    IMAGE_CHANNEL_FIELD_NUMBER: _ClassVar[int]
    IMAGE_DATA_FIELD_NUMBER: _ClassVar[int]
    IMAGE_DEPTH_FIELD_NUMBER: _ClassVar[int]
    POINT_NUM_FIELD_NUMBER: _ClassVar[int]
    POINT_FIELDS_FIELD_NUMBER: _ClassVar[int]
    FIELDS_NUMBER_FIELD_NUMBER: _ClassVar[int]
    POINT_DATA_FIELD_NUMBER: _ClassVar[int]
    DEPTH_KIND_FIELD_NUMBER: _ClassVar[int]
    POINT_FRAME_FIELD_NUMBER: _ClassVar[int]
    MOTION_COMPENSATED_FIELD_NUMBER: _ClassVar[int]
    IMAGE_TIMESTAMP_FIELD_NUMBER: _ClassVar[int]
    timestamp: Timestamp
    image_seq: int
    points_seq: int
    camera_id: int
    lidar_id: int
    height: int
    width: int
    encoding: str
    image_channel: int
    image_data: bytes
    image_depth: bytes
    point_num: int
    point_fields: _containers.RepeatedScalarFieldContainer[str]
    fields_number: int
    point_data: bytes
    depth_kind: str
    point_frame: str
    motion_compensated: bool
    image_timestamp: Timestamp
    def __init__(self, timestamp: _Optional[_Union[Timestamp, _Mapping]] = ..., image_seq: _Optional[int] = ..., points_seq: _Optional[int] = ..., camera_id: _Optional[int] = ..., lidar_id: _Optional[int] = ..., height: _Optional[int] = ..., width: _Optional[int] = ..., encoding: _Optional[str] = ..., image_channel: _Optional[int] = ..., image_data: _Optional[bytes] = ..., image_depth: _Optional[bytes] = ..., point_num: _Optional[int] = ..., point_fields: _Optional[_Iterable[str]] = ..., fields_number: _Optional[int] = ..., point_data: _Optional[bytes] = ..., depth_kind: _Optional[str] = ..., point_frame: _Optional[str] = ..., motion_compensated: _Optional[bool] = ..., image_timestamp: _Optional[_Union[Timestamp, _Mapping]] = ..., **kwargs) -> None: ...

class FusedDetection(_message.Message):
    __slots__ = ("id", "confidence", "timestamp", "X", "Y", "Z", "center_cov", "length", "width", "height", "size_cov", "direction", "velocity", "x1", "y1", "x2", "y2", "velocity_vector", "box_3d_id", "box_2d_id")
    ID_FIELD_NUMBER: _ClassVar[int]
    CONFIDENCE_FIELD_NUMBER: _ClassVar[int]
    TIMESTAMP_FIELD_NUMBER: _ClassVar[int]
    CLASS_FIELD_NUMBER: _ClassVar[int]
    X_FIELD_NUMBER: _ClassVar[int]
    Y_FIELD_NUMBER: _ClassVar[int]
    Z_FIELD_NUMBER: _ClassVar[int]
    CENTER_COV_FIELD_NUMBER: _ClassVar[int]
    LENGTH_FIELD_NUMBER: _ClassVar[int]
    WIDTH_FIELD_NUMBER: _ClassVar[int]
    HEIGHT_FIELD_NUMBER: _ClassVar[int]
    SIZE_COV_FIELD_NUMBER: _ClassVar[int]
    DIRECTION_FIELD_NUMBER: _ClassVar[int]
    VELOCITY_FIELD_NUMBER: _ClassVar[int]
    X1_FIELD_NUMBER: _ClassVar[int]
    Y1_FIELD_NUMBER: _ClassVar[int]
    X2_FIELD_NUMBER: _ClassVar[int]
    Y2_FIELD_NUMBER: _ClassVar[int]
    VELOCITY_VECTOR_FIELD_NUMBER: _ClassVar[int]
    BOX_3D_ID_FIELD_NUMBER: _ClassVar[int]
    BOX_2D_ID_FIELD_NUMBER: _ClassVar[int]
    id: int
    confidence: float
    timestamp: Timestamp
    X: float
    Y: float
    Z: float
    center_cov: _containers.RepeatedScalarFieldContainer[float]
    length: float
    width: float
    height: float
    size_cov: _containers.RepeatedScalarFieldContainer[float]
    direction: _containers.RepeatedScalarFieldContainer[float]
    velocity: float
    x1: int
    y1: int
    x2: int
    y2: int
    velocity_vector: _containers.RepeatedScalarFieldContainer[float]
    box_3d_id: int
    box_2d_id: int
    def __init__(self, id: _Optional[int] = ..., confidence: _Optional[float] = ..., timestamp: _Optional[_Union[Timestamp, _Mapping]] = ..., X: _Optional[float] = ..., Y: _Optional[float] = ..., Z: _Optional[float] = ..., center_cov: _Optional[_Iterable[float]] = ..., length: _Optional[float] = ..., width: _Optional[float] = ..., height: _Optional[float] = ..., size_cov: _Optional[_Iterable[float]] = ..., direction: _Optional[_Iterable[float]] = ..., velocity: _Optional[float] = ..., x1: _Optional[int] = ..., y1: _Optional[int] = ..., x2: _Optional[int] = ..., y2: _Optional[int] = ..., velocity_vector: _Optional[_Iterable[float]] = ..., box_3d_id: _Optional[int] = ..., box_2d_id: _Optional[int] = ..., **kwargs) -> None: ...

class FusedDetections(_message.Message):
    __slots__ = ("detections", "image_seq", "points_seq", "camera_id", "lidar_id", "timestamp", "motion_compensated", "image_timestamp")
    DETECTIONS_FIELD_NUMBER: _ClassVar[int]
    IMAGE_SEQ_FIELD_NUMBER: _ClassVar[int]
    POINTS_SEQ_FIELD_NUMBER: _ClassVar[int]
    CAMERA_ID_FIELD_NUMBER: _ClassVar[int]
    LIDAR_ID_FIELD_NUMBER: _ClassVar[int]
    TIMESTAMP_FIELD_NUMBER: _ClassVar[int]
    MOTION_COMPENSATED_FIELD_NUMBER: _ClassVar[int]
    IMAGE_TIMESTAMP_FIELD_NUMBER: _ClassVar[int]
    detections: _containers.RepeatedCompositeFieldContainer[FusedDetection]
    image_seq: int
    points_seq: int
    camera_id: int
    lidar_id: int
    timestamp: Timestamp
    motion_compensated: bool
    image_timestamp: Timestamp
    def __init__(self, detections: _Optional[_Iterable[_Union[FusedDetection, _Mapping]]] = ..., image_seq: _Optional[int] = ..., points_seq: _Optional[int] = ..., camera_id: _Optional[int] = ..., lidar_id: _Optional[int] = ..., timestamp: _Optional[_Union[Timestamp, _Mapping]] = ..., motion_compensated: _Optional[bool] = ..., image_timestamp: _Optional[_Union[Timestamp, _Mapping]] = ...) -> None: ...

class GetCountersRequest(_message.Message):
    __slots__ = ("session",)
    SESSION_FIELD_NUMBER: _ClassVar[int]
    session: str
    def __init__(self, session: _Optional[str] = ...) -> None: ...

class Counters(_message.Message):
    __slots__ = ("counts",)
    class CountsEntry(_message.Message):
        __slots__ = ("key", "value")
        KEY_FIELD_NUMBER: _ClassVar[int]
        VALUE_FIELD_NUMBER: _ClassVar[int]
        key: str
        value: int
        def __init__(self, key: _Optional[str] = ..., value: _Optional[int] = ...) -> None: ...
    COUNTS_FIELD_NUMBER: _ClassVar[int]
    counts: _containers.ScalarMap[str, int]
    def __init__(self, counts: _Optional[_Mapping[str, int]] = ...) -> None: ...

class FlushRequest(_message.Message):
    __slots__ = ("session",)
    SESSION_FIELD_NUMBER: _ClassVar[int]
    session: str
    def __init__(self, session: _Optional[str] = ...) -> None: ...

class CloseSessionRequest(_message.Message):
    __slots__ = ("session",)
    SESSION_FIELD_NUMBER: _ClassVar[int]
    session: str
    def __init__(self, session: _Optional[str] = ...) -> None: ...
