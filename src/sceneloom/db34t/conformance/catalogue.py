"""What a conformance check is: its number, the clause or table row it stands for (quoted in Chinese and English).

The sessions it works with, and what it observes.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from types import MappingProxyType
from typing import Any, NamedTuple, TypeVar

from google.protobuf.message import Message

from sceneloom.db34t.conformance import scene as conformance_scene
from sceneloom.db34t.tables import TABLES
from sceneloom.db34t.transport import SERVICE, CallFailedError, Transport
from sceneloom.db34t.wire import fusion_pb2


class _Quote(NamedTuple):
    """What stands at one location.

    Attributes:
        english: translated.
        chinese: as printed.
    """

    english: str
    chinese: str


CLAUSES: Mapping[str, _Quote] = MappingProxyType(
    {
        "4.1": _Quote(
            "sensor data fusion takes the lidar's point clouds and the camera's images, the calibration data, "
            "and the "
            "mode that the configuration data give, and puts out fused data",
            "分别从激光雷达和摄像头接收激光点云数据和图像数据,从标定数据获取标定信息,"
            "按配置数据中给出的传感器数据融合模式"
            "进行融合,输出融合数据",
        ),
        "4.2": _Quote(
            "detection fusion takes the two-dimensional boxes of images and the three-dimensional boxes of point "
            "clouds, the calibration data, and the mode that the configuration data give, and puts out fused "
            "detections",
            "分别获取图像目标检测二维包围框和点云目标检测三维包围框,从标定数据获取标定信息,"
            "按配置数据中给出的目标检测结果"
            "融合模式进行融合,输出融合后的目标检测结果",
        ),
        "5.2": _Quote(
            "the configuration data of the interface are those of table 2", "配置接口的配置数据见表2"
        ),
        "5.3.1": _Quote(
            "the fusion system offers an interface that adds a configuration property: its name, its "
            "description, the "
            "type of its value",
            "融合系统提供添加配置属性接口, 添加配置属性, 包括属性名称、属性描述、属性值的类型等",
        ),
        "5.3.2": _Quote(
            "inputs: name of the property; description of the property; type of its value",
            "接口输入参数: 属性名称; 属性描述; 属性值的类型",
        ),
        "5.3.3": _Quote(
            "the interface returns whether the property was added: 1 added, 0 not added",
            "接口返回值: 属性添加成功与否的状态, 1—添加成功、0—添加失败",
        ),
        "5.4.1": _Quote(
            "the fusion system offers an interface that sets the value of the property with a given name",
            "融合系统提供设置配置属性值接口, 设置指定属性名的属性值",
        ),
        "5.4.2": _Quote("inputs: the name of a property; the value", "接口输入参数: 指定属性名; 属性值"),
        "5.4.3": _Quote(
            "the interface returns whether the value was set: 1 set, 0 not set",
            "接口返回值: 属性值设置成功与否的状态, 1—设置成功、0—设置失败",
        ),
        "5.5.1": _Quote(
            "the fusion system offers an interface that gets the value of the property with a given name",
            "融合系统提供获取配置属性值接口, 获取指定属性名的属性值",
        ),
        "5.5.2": _Quote("input: the name of a property", "接口输入参数: 指定属性名"),
        "5.5.3": _Quote("the interface returns the value of the property", "接口返回值: 属性值"),
        "5.6.1": _Quote(
            "the sender gives the fusion system data through the receiving interface: raw data (6.2), image "
            "data (6.3), "
            "point cloud data (6.4), 3D boxes (6.5) or 2D boxes (6.6)",
            "数据发送端通过数据接收接口向融合系统提供待融合的数据, 可以是原始数据 (6.2)、图像数据 (6.3)、"
            "点云数据 (6.4)、"
            "点云目标检测三维包围框信息 (6.5)、图像目标检测二维包围框信息 (6.6) 之一",
        ),
        "5.6.2": _Quote(
            "input: data of one of the types that the specification defines",
            "接口输入参数: 数据, 规范中定义的数据类型的数据",
        ),
        "5.6.3": _Quote(
            "the interface returns whether the data were sent: 1 sent, 0 not sent",
            "接口返回值: 设置/发送成功与否的状态, 1—设置/发送成功、0—设置/发送失败",
        ),
        "5.7.1": _Quote(
            "fused data are fetched through the interface: fused sensor data (6.7) or fused detections (6.8)",
            "融合系统通过数据获取接口获取融合后数据, 可以是传感器数据融合后数据 (6.7)、"
            "目标检测结果融合后目标检测结果数据 (6.8)",
        ),
        "5.7.2": _Quote("input: the fusion type", "接口输入参数: 融合类型, 指定融合的类型"),
        "5.7.3": _Quote("the interface returns the fused data", "接口返回值: 融合后的数据"),
        "6.2": _Quote("raw data are as table 4 says", "原始数据描述 应符合表4的规定"),
        "6.3": _Quote("image data are as table 5 says", "图像数据描述 应符合表5的规定"),
        "6.4": _Quote("point cloud data are as table 6 says", "点云数据描述 应符合表6的规定"),
        "6.5": _Quote("3D boxes are as table 7 says", "点云目标检测三维包围框信息描述 应符合表7的规定"),
        "6.7": _Quote("fused sensor data are as table 9 says", "传感器数据融合后数据描述 应符合表9的规定"),
        "6.8": _Quote("fused detections are as table 10 says", "目标检测结果融合后数据描述 应符合表10的规定"),
    }
)
"""By clause."""

TYPE_ROWS: Mapping[str, _Quote] = MappingProxyType(
    {
        "bool": _Quote("bool: truth value", "bool 布尔型"),
        "int8": _Quote("int8: whole number of 8 bits", "int8 8位整型"),
        "uint8": _Quote("uint8: whole number of 8 bits without a sign", "uint8 无符号8位整型"),
        "int32": _Quote("int32: whole number of 32 bits", "int32 32位整型"),
        "uint32": _Quote("uint32: whole number of 32 bits without a sign", "uint32 无符号32位整型"),
        "float": _Quote(
            "float: floating-point number of single precision (32 bits)", "float 单精度浮点（32bit）"
        ),
        "double": _Quote(
            "double: floating-point number of double precision (64 bits)", "double 双精度浮点（64-bit）"
        ),
        "string": _Quote("string: text", "string 字符串类型"),
        "enum": _Quote("enum: enumeration", "enum 枚举类型"),
    }
)
"""Table 1, by the type."""

PROPERTY_ROWS: Mapping[str, _Quote] = MappingProxyType(
    {
        "fusion_type": _Quote(
            "fusion type, bool, 0: sensor data fusion, 1: detection fusion",
            "fusion_type 融合类型 bool 0: 传感器数据融合; 1: 目标检测结果融合",
        ),
        "chirality": _Quote(
            "chirality, bool, 0: right-handed frames, 1: left-handed frames",
            "chirality 手征: 右手坐标系或者左手坐标系 bool 0: 右手坐标系; 1: 左手坐标系",
        ),
        "camera_coordinate": _Quote(
            "axes of the camera frame that the vehicle's forward, right and vertical directions go along; 0, 1, "
            "2 mean "
            "x, y, z, negative numbers the opposite direction",
            "camera_coordinate 记录车辆前进方向、右侧方向、竖直方向对应摄像头坐标系的轴 (int8, int8, int8) "
            "数字0, 1, 2分别表示"
            "x, y, z轴, 负数表示负方向",
        ),
        "lidar_coordinate": _Quote(
            "axes of the lidar frame that the vehicle's forward, right and vertical directions go along; 0, 1, "
            "2 mean "
            "x, y, z, negative numbers the opposite direction",
            "lidar_coordinate 记录车辆前进方向、右侧方向、竖直方向对应激光雷达坐标系的轴 (int8, int8, int8) "
            "数字0, 1, 2分别表示"
            "x, y, z轴, 负数表示负方向",
        ),
        "camera_frequency": _Quote(
            "frequency of the camera's data, uint32, Hz", "camera_frequency 摄像头获取数据频率 uint32 HZ"
        ),
        "lidar_frequency": _Quote(
            "frequency of the lidar's data, uint32, Hz", "lidar_frequency 激光雷达获取数据频率 uint32 HZ"
        ),
        "fusion_algorithm": _Quote("algorithm of the fusion, string", "fusion_algorithm 融合所用算法 string"),
    }
)
"""Table 2, by the property."""

_TIME = "uint32. uint32 s. ns / 秒. 纳秒"

ROWS: Mapping[int, Mapping[str, str]] = MappingProxyType(
    {
        3: {
            "image_size": "图像大小 uint32[2] 1×2向量",
            "distortion_coeffs": "畸变参数向量 缺省所有形变系数都设为0 double[5] 该畸变参数适用于针孔相机模型",
            "intrinsic_matrix": "内参矩阵 double[9] 3×3矩阵, 包含摄像头的光学中心和焦距信息, "
            "表示摄像头坐标系到图像坐标系的映射"
            "关系",
            "reference_frame": "参考坐标系 bool 外参矩阵参考坐标系, 0:摄像头坐标系 1:激光雷达坐标系",
            "extrinsic_matrix": "外参矩阵 double[16] 4×4矩阵, 包括旋转与平移信息, 表示参考坐标系之间的空间转换关系",
        },
        4: {
            "sensor_id": "产生原始数据的传感器id uint8",
            "timestamp": f"数据生成的时间戳 {_TIME}",
            "seq": "数据的序列 uint32",
            "length": "原始数据字节数 uint32",
            "data": "原始数据字节流 int8[]",
        },
        5: {
            "sensor_id": "产生图像数据的摄像头传感器id uint8",
            "timestamp": f"图片生成的时间戳 {_TIME}",
            "seq": "图像的序列 uint32",
            "height": "图像高度, 即像素行数 uint32",
            "width": "图像宽度, 即像素列数 uint32",
            "encoding": "图像编码 string",
            "channel": "图像的通道数 uint8",
            "data": "图像数据, width * height * channel个uint8数据 uint8[]",
        },
        6: {
            "sensor_id": "产生点云数据的激光雷达id uint8",
            "timestamp": f"点云的时间戳 {_TIME}",
            "seq": "连续递增的序列唯一标识 uint32",
            "number": "点云中的点的个数 uint32",
            "fields": "点云中一个点所包含的数据类别 string[] 一个点云数据包括必须的x, y, z三维坐标信息, "
            "以及可选的reflectivity"
            "反射率信息等",
            "fields_number": "一个点包含的数据类别数 uint8 如fields为[x, y, z], 则fields_number为3",
            "data": "点云数据, number * fields_number个float数 float[] 每fields_number个浮点数表示点云中的一个点",
            "sensor_type": "机械式激光雷达/固态激光雷达 bool 0为机械式激光雷达 1为固态激光雷达",
            "beam": "机械式激光雷达线束 uint32 当sensor_type为0时可选",
            "ring": "点云点所属的机械式激光雷达线束 uint32 当sensor_type为0时可选",
        },
        7: {
            "id": "包围框的id int32",
            "class": "目标类别 enum",
            "points_seq": "点云序列 uint32 对应的点云序列号",
            "confidence": "目标存在的概率 float [0, 1]范围内的小数, 表示目标存在的概率",
            "timestamp": f"该三维包围框对应的时间戳 {_TIME}",
            "X": "包围框的中心点在激光雷达坐标系中的x坐标 float",
            "Y": "包围框的中心点在激光雷达坐标系中的y坐标 float",
            "Z": "包围框的中心点在激光雷达坐标系中的z坐标 float",
            "length": "包围框的长度 float m/米",
            "width": "包围框的宽度 float m/米",
            "height": "包围框的高度 float m/米",
            "direction": "三维包围框的在激光雷达坐标系下的朝向向量 float[3]",
            "velocity": "三维包围框速度 float m/s 米/秒",
        },
        8: {
            "id": "二维包围框的id int32",
            "class": "目标类别 enum",
            "image_seq": "对应的图像的序列 uint32",
            "confidence": "目标存在的概率 float [0, 1]范围内的小数, 表示目标存在的概率",
            "timestamp": f"该二维包围框对应的时间戳 {_TIME}",
            "x1": "图像坐标系中的包围框左上角横坐标 uint32 像素的在图像坐标系中的位置",
            "y1": "图像坐标系中的包围框左上角纵坐标 uint32 像素的在图像坐标系中的位置",
            "x2": "图像坐标系中的包围框右下角横坐标 uint32 像素的在图像坐标系中的位置",
            "y2": "图像坐标系中的包围框右下角纵坐标 uint32 像素的在图像坐标系中的位置",
        },
        9: {
            "timestamp": f"时间戳 {_TIME}",
            "class": "目标类别 enum",
            "image_seq": "融合所用图像数据序列号 uint32",
            "points_seq": "融合所用的点云数据序列号 uint32",
            "camera_id": "生成图像的传感器id uint8",
            "lidar_id": "生成点云的激光雷达id uint8",
            "height": "图像高度, 即像素行数 uint32",
            "width": "图像宽度, 即像素列数 uint32",
            "encoding": "图像编码 string",
            "image_channel": "图像的通道数 uint8",
            "image_data": "图像数据，数组长度为width * height * image_channel uint8[]",
            "image_depth": "融合后得到的像素值为摄像头到场景中各点的距离（深度）的深度图像，数组长度为width * "
            "height float[]",
            "point_num": "点云中点的数量 uint32",
            "point_fields": "融合后点云中一个点所包含的数据类别 string[]",
            "fields_number": "融合后点云中一个点包含的数据类别数 uint8",
            "point_data": "点云数据 float[]",
        },
        10: {
            "id": "id int32",
            "confidence": "目标存在的概率 float [0, 1]范围内的小数，表示目标存在的概率",
            "timestamp": f"时间戳 {_TIME}",
            "class": "目标类别 enum",
            "X": "融合后目标包围框的中心点在激光雷达坐标系中的x坐标 float",
            "Y": "融合后目标包围框的中心点在激光雷达坐标系中的y坐标 float",
            "Z": "融合后目标包围框的中心点在激光雷达坐标系中的z坐标 float",
            "center_cov": "融合后中心点协方差 float[9] 3×3矩阵，表示目标位置的不确定度",
            "length": "融合后目标包围框的长度 float m/米",
            "width": "融合后目标包围框的宽度 float 米",
            "height": "融合后目标包围框的高度 float 米",
            "size_cov": "融合后的尺寸协方差 float[9] 3×3矩阵，表示尺寸的不确定度",
            "direction": "融合后包围框的在激光雷达坐标系下的朝向向量 float[3]",
            "velocity": "融合后目标速度 float m/s / 米/秒",
            "x1": "融合后图像坐标系中的包围框左上角横坐标 uint32 像素的在图像坐标系中的位置",
            "y1": "融合后图像坐标系中的包围框左上角纵坐标 uint32 像素的在图像坐标系中的位置",
            "x2": "融合后图像坐标系中的包围框右下角横坐标 uint32 像素的在图像坐标系中的位置",
            "y2": "融合后图像坐标系中的包围框右下角纵坐标 uint32 像素的在图像坐标系中的位置",
        },
    }
)
"""Tables 3 to 10: description, type and note of each row."""

_Made = TypeVar("_Made")

_WAIT_MS = 5_000
"""How long a result may take."""

SENSOR_DATA, DETECTIONS = 0, 1
"""Fusion types, table 2, row 1."""

RESULT_NAMES = ("sensor_data", "detections")
"""What a reply calls the result of each fusion type."""

_INPUTS = {method.name: getattr(fusion_pb2, method.input_type.name) for method in SERVICE.methods}


class NoResultError(Exception):
    """A result that should have been there was not."""


class Peer:
    """One session of the server under test."""

    def __init__(self, transport: Transport, session: str) -> None:
        """Talk to a session by this name."""
        self.transport, self.session = transport, session

    def call(self, method: str, **fields: Any) -> Any:
        """Call a method that takes one message and gives one."""
        return self.transport.call(method, _INPUTS[method](session=self.session, **fields))

    def add(self, name: str, description: str, type: str) -> int:
        """Clause 5.3; the status."""
        return int(self.call("AddProperty", name=name, description=description, type=type).status)

    def set(self, name: str, value: Any) -> int:
        """Clause 5.4; the status."""
        return int(self.call("SetProperty", name=name, value=_value_message(value)).status)

    def get(self, name: str) -> Any:
        """Clause 5.5; the message."""
        return self.call("GetProperty", name=name)

    def value(self, name: str) -> Any:
        """Clause 5.5; the value."""
        return plain_value(self.get(name).value)

    def calibrate(
        self,
        *,
        camera_id: int = conformance_scene.CAMERA_ID,
        lidar_id: int = conformance_scene.LIDAR_ID,
        **changed: Any,
    ) -> int:
        """Send a calibration, that of the scene but for what is stated; the status."""
        return self.calibrate_with(
            conformance_scene.calibration(**changed), camera_id=camera_id, lidar_id=lidar_id
        )

    def calibrate_with(
        self,
        calibration: fusion_pb2.Calibration,
        *,
        camera_id: int = conformance_scene.CAMERA_ID,
        lidar_id: int = conformance_scene.LIDAR_ID,
    ) -> int:
        """Send a calibration; the status."""
        reply = self.call("SetCalibration", calibration=calibration, camera_id=camera_id, lidar_id=lidar_id)
        return int(reply.status)

    def send(self, request: fusion_pb2.SendRequest) -> int:
        """Clause 5.6; the status."""
        return int(self.send_for_status(request).status)

    def send_for_status(self, request: fusion_pb2.SendRequest) -> Any:
        """Clause 5.6; the message."""
        return self.transport.call("Send", self._owned(request))

    def send_stream(self, requests: Iterable[fusion_pb2.SendRequest]) -> Any:
        """Clause 5.6 for several records; the summary."""
        return self.transport.send_stream([self._owned(request) for request in requests])

    def fetch(self, fusion_type: int | None, *, wait_ms: int = _WAIT_MS) -> Any:
        """Clause 5.7; the reply."""
        return self.call("Get", fusion_type=fusion_type, wait_ms=wait_ms)

    def result(self, fusion_type: int) -> Any:
        """Clause 5.7; the record or records of the next result.

        Raises:
            NoResultError: none came.
        """
        return result_of(self.fetch(fusion_type), fusion_type)

    def subscribe(self, fusion_type: int, most: int) -> Iterator[Any]:
        """Clause 5.7 as a stream of so many replies."""
        request = fusion_pb2.SubscribeRequest(fusion_type=fusion_type, most=most, session=self.session)
        return self.transport.subscribe(request)

    def close(self) -> None:
        """End the session, if the server knows how."""
        try:
            self.call("CloseSession")
        except CallFailedError:
            return

    def _owned(self, request: fusion_pb2.SendRequest) -> fusion_pb2.SendRequest:
        owned = fusion_pb2.SendRequest()
        owned.CopyFrom(request)
        owned.session = self.session
        return owned


class Bench:
    """Gives sessions to a check and ends them after it; keeps answers that several checks look at."""

    def __init__(self, transport: Transport, prefix: str) -> None:
        """Talk to a server in sessions whose names begin so."""
        self.transport = transport
        self._prefix, self._count = prefix, 0
        self._open: list[Peer] = []
        self._kept: dict[Callable[[Peer], Any], Any] = {}

    def peer(self) -> Peer:
        """A session that nothing was done in."""
        self._count += 1
        peer = Peer(self.transport, f"{self._prefix}-{self._count}")
        self._open.append(peer)
        return peer

    def ready(self) -> Peer:
        """A session that has the scene's calibration."""
        peer = self.peer()
        peer.calibrate()
        return peer

    def once(self, make: Callable[[Peer], _Made]) -> _Made:
        """Give what a function makes in a calibrated session, made by the first check that asks."""
        if make not in self._kept:
            self._kept[make] = make(self.ready())
        kept: _Made = self._kept[make]
        return kept

    def end_sessions(self) -> None:
        """End the sessions that the last check had."""
        while self._open:
            self._open.pop().close()


def fused_pair(peer: Peer) -> Any:
    """The record of table 9 of the scene."""
    peer.send(conformance_scene.image())
    peer.send(conformance_scene.cloud())
    return peer.result(SENSOR_DATA)


def fused_boxes(peer: Peer) -> Any:
    """The records of table 10 of the scene."""
    peer.send(conformance_scene.boxes_2d())
    peer.send(conformance_scene.boxes_3d())
    return peer.result(DETECTIONS)


def result_of(reply: Any, fusion_type: int) -> Any:
    """The record or records that a reply holds.

    Raises:
        NoResultError: it holds others, or none.
    """
    name = RESULT_NAMES[fusion_type]
    held = reply.WhichOneof("result")
    if held != name:
        raise NoResultError(f"a reply with {held or 'nothing'}; expected {name}")
    return getattr(reply, name)


def detection_of(result: Any, box: conformance_scene.SentBox) -> Any:
    """The fused detection that stands where a box was sent.

    Raises:
        NoResultError: there is none.
    """
    for found in result.detections:
        if max(abs(a - b) for a, b in zip((found.X, found.Y, found.Z), box.center, strict=True)) < 1.0:
            return found
    raise NoResultError(f"no detection near {box.center}, where a {box.name} was sent")


def _value_message(value: Any) -> fusion_pb2.Value:
    """The message of a value."""
    if isinstance(value, bool):
        return fusion_pb2.Value(bool_value=value)
    if isinstance(value, int):
        return fusion_pb2.Value(integer_value=value)
    if isinstance(value, float):
        return fusion_pb2.Value(number_value=value)
    if isinstance(value, str):
        return fusion_pb2.Value(string_value=value)
    return fusion_pb2.Value(list_value=fusion_pb2.ValueList(values=map(_value_message, value)))


def plain_value(message: Any) -> Any:
    """The value of a message; None where it holds none, truth values as 0 and 1."""
    kind = message.WhichOneof("kind")
    if kind is None:
        return None
    if kind == "list_value":
        return [plain_value(item) for item in message.list_value.values]
    value = getattr(message, kind)
    return int(value) if kind == "bool_value" else value


def reported(message: Message) -> str:
    """A message in one line."""
    return " ".join(str(message).split())


class Basis(StrEnum):
    """What a check rests on."""

    TEXT = "text"
    """The words of the standard."""
    READING = "reading"
    """Our reading of a location that the standard leaves open; docs/db34t-4101.md says which."""
    EXTENSION = "extension"
    """The service's own calls and fields, which the standard does not have."""


@dataclass(frozen=True, slots=True)
class Seen:
    """One thing that a check looked at.

    Attributes:
        sent: what was sent.
        expected: what the answer has to be.
        found: what it was.
        agrees: whether it is as expected.
    """

    sent: str
    expected: str
    found: str
    agrees: bool


Look = Callable[["Bench"], Iterator[Seen]]
"""What a check does: talks to the server, and reports one thing after the other."""


@dataclass(frozen=True, slots=True)
class Check:
    """One numbered check.

    Attributes:
        id: clause and number ("5.4-3"), table and row ("T6-7"), or an extension's number ("X-2").
        location: of the standard, in words.
        title: what has to be so.
        basis: what it rests on.
        quote: what stands there, in English and Chinese.
        look: finds out.
    """

    id: str
    location: str
    title: str
    basis: Basis
    quote: _Quote
    look: Look


@dataclass(slots=True)
class Catalogue:
    """The checks of one part of the standard, in order.

    Attributes:
        title: of the part.
        checks: gathered as they are declared.
    """

    title: str
    checks: list[Check] = field(default_factory=list)

    def clause(
        self, number: str, of_clause: str, title: str, *, basis: Basis = Basis.TEXT
    ) -> Callable[[Look], Look]:
        """Declare what looks whether a clause is kept."""
        return self._declare(number, f"clause {of_clause}", title, basis, CLAUSES[of_clause])

    def row(self, table: int, name: str, title: str, *, basis: Basis = Basis.TEXT) -> Callable[[Look], Look]:
        """Declare what looks at a row of a table."""
        row_number, quote = _row(table, name)
        return self._declare(
            f"T{table}-{row_number}", f"table {table}, row {row_number} ({name})", title, basis, quote
        )

    def extension(self, number: int, location: str, title: str) -> Callable[[Look], Look]:
        """Declare what looks at something that the standard does not have."""
        quote = _Quote("not in the standard", "本文件未规定")
        return self._declare(f"X-{number}", location, title, Basis.EXTENSION, quote)

    def _declare(
        self, number: str, location: str, title: str, basis: Basis, quote: _Quote
    ) -> Callable[[Look], Look]:
        def declared(look: Look) -> Look:
            self.checks.append(Check(number, location, title, basis, quote, look))
            return look

        return declared


def _row(table: int, name: str) -> tuple[int, _Quote]:
    if table == 1:
        return list(TYPE_ROWS).index(name) + 1, TYPE_ROWS[name]
    if table == 2:
        return list(PROPERTY_ROWS).index(name) + 1, PROPERTY_ROWS[name]
    row = TABLES[table].row(name)
    unit = f" [{row.unit}]" if row.unit else ""
    return row.number, _Quote(f"{name}: {row.type}{unit}: {row.meaning}", ROWS[table][name])


def same(sent: str, expected: Any, found: Any) -> Seen:
    """See whether two values are equal."""
    return Seen(sent, _short(expected), _short(found), bool(expected == found))


def true(sent: str, expected: str, found: Any, *, agrees: bool) -> Seen:
    """See whether something holds that is stated in words."""
    return Seen(sent, expected, _short(found), agrees)


def near(sent: str, expected: float, found: float, tolerance: float) -> Seen:
    """See whether a number is as near to another as it has to be."""
    agrees = abs(found - expected) <= tolerance
    return Seen(sent, f"{expected:.6g} ± {tolerance:g}", f"{found:.6g}", agrees)


def _short(value: Any) -> str:
    """A value in a report, cut where it is long."""
    text = value if isinstance(value, str) else repr(value)
    return text if len(text) <= 200 else f"{text[:197]}…"
