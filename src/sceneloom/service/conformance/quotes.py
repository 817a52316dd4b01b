"""What the standard says at the locations that the checks stand for: Chinese as it is printed, English as we read it.

Source: DB34/T 4101-2022, clauses 5.1 to 5.7 and 6.1 to 6.8, tables 1 to 10. The English of tables 3 to 10 is in
`fusion.messages.tables`.
"""

from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple


class Quote(NamedTuple):
    """What stands at one location.

    Attributes:
        english: translated.
        chinese: as printed.
    """

    english: str
    chinese: str


CLAUSES: Mapping[str, Quote] = MappingProxyType(
    {
        "4.1": Quote(
            "sensor data fusion takes the lidar's point clouds and the camera's images, the calibration data, "
            "and the "
            "mode that the configuration data give, and puts out fused data",
            "分别从激光雷达和摄像头接收激光点云数据和图像数据,从标定数据获取标定信息,"
            "按配置数据中给出的传感器数据融合模式"
            "进行融合,输出融合数据",
        ),
        "4.2": Quote(
            "detection fusion takes the two-dimensional boxes of images and the three-dimensional boxes of point "
            "clouds, the calibration data, and the mode that the configuration data give, and puts out fused "
            "detections",
            "分别获取图像目标检测二维包围框和点云目标检测三维包围框,从标定数据获取标定信息,"
            "按配置数据中给出的目标检测结果"
            "融合模式进行融合,输出融合后的目标检测结果",
        ),
        "5.2": Quote(
            "the configuration data of the interface are those of table 2", "配置接口的配置数据见表2"
        ),
        "5.3.1": Quote(
            "the fusion system offers an interface that adds a configuration property: its name, its "
            "description, the "
            "type of its value",
            "融合系统提供添加配置属性接口, 添加配置属性, 包括属性名称、属性描述、属性值的类型等",
        ),
        "5.3.2": Quote(
            "inputs: name of the property; description of the property; type of its value",
            "接口输入参数: 属性名称; 属性描述; 属性值的类型",
        ),
        "5.3.3": Quote(
            "the interface returns whether the property was added: 1 added, 0 not added",
            "接口返回值: 属性添加成功与否的状态, 1—添加成功、0—添加失败",
        ),
        "5.4.1": Quote(
            "the fusion system offers an interface that sets the value of the property with a given name",
            "融合系统提供设置配置属性值接口, 设置指定属性名的属性值",
        ),
        "5.4.2": Quote("inputs: the name of a property; the value", "接口输入参数: 指定属性名; 属性值"),
        "5.4.3": Quote(
            "the interface returns whether the value was set: 1 set, 0 not set",
            "接口返回值: 属性值设置成功与否的状态, 1—设置成功、0—设置失败",
        ),
        "5.5.1": Quote(
            "the fusion system offers an interface that gets the value of the property with a given name",
            "融合系统提供获取配置属性值接口, 获取指定属性名的属性值",
        ),
        "5.5.2": Quote("input: the name of a property", "接口输入参数: 指定属性名"),
        "5.5.3": Quote("the interface returns the value of the property", "接口返回值: 属性值"),
        "5.6.1": Quote(
            "the sender gives the fusion system data through the receiving interface: raw data (6.2), image "
            "data (6.3), "
            "point cloud data (6.4), 3D boxes (6.5) or 2D boxes (6.6)",
            "数据发送端通过数据接收接口向融合系统提供待融合的数据, 可以是原始数据 (6.2)、图像数据 (6.3)、"
            "点云数据 (6.4)、"
            "点云目标检测三维包围框信息 (6.5)、图像目标检测二维包围框信息 (6.6) 之一",
        ),
        "5.6.2": Quote(
            "input: data of one of the types that the specification defines",
            "接口输入参数: 数据, 规范中定义的数据类型的数据",
        ),
        "5.6.3": Quote(
            "the interface returns whether the data were sent: 1 sent, 0 not sent",
            "接口返回值: 设置/发送成功与否的状态, 1—设置/发送成功、0—设置/发送失败",
        ),
        "5.7.1": Quote(
            "fused data are fetched through the interface: fused sensor data (6.7) or fused detections (6.8)",
            "融合系统通过数据获取接口获取融合后数据, 可以是传感器数据融合后数据 (6.7)、"
            "目标检测结果融合后目标检测结果数据 (6.8)",
        ),
        "5.7.2": Quote("input: the fusion type", "接口输入参数: 融合类型, 指定融合的类型"),
        "5.7.3": Quote("the interface returns the fused data", "接口返回值: 融合后的数据"),
        "6.2": Quote("raw data are as table 4 says", "原始数据描述 应符合表4的规定"),
        "6.3": Quote("image data are as table 5 says", "图像数据描述 应符合表5的规定"),
        "6.4": Quote("point cloud data are as table 6 says", "点云数据描述 应符合表6的规定"),
        "6.5": Quote("3D boxes are as table 7 says", "点云目标检测三维包围框信息描述 应符合表7的规定"),
        "6.7": Quote("fused sensor data are as table 9 says", "传感器数据融合后数据描述 应符合表9的规定"),
        "6.8": Quote("fused detections are as table 10 says", "目标检测结果融合后数据描述 应符合表10的规定"),
    }
)
"""By clause."""

TYPE_ROWS: Mapping[str, Quote] = MappingProxyType(
    {
        "bool": Quote("bool: truth value", "bool 布尔型"),
        "int8": Quote("int8: whole number of 8 bits", "int8 8位整型"),
        "uint8": Quote("uint8: whole number of 8 bits without a sign", "uint8 无符号8位整型"),
        "int32": Quote("int32: whole number of 32 bits", "int32 32位整型"),
        "uint32": Quote("uint32: whole number of 32 bits without a sign", "uint32 无符号32位整型"),
        "float": Quote(
            "float: floating-point number of single precision (32 bits)", "float 单精度浮点（32bit）"
        ),
        "double": Quote(
            "double: floating-point number of double precision (64 bits)", "double 双精度浮点（64-bit）"
        ),
        "string": Quote("string: text", "string 字符串类型"),
        "enum": Quote("enum: enumeration", "enum 枚举类型"),
    }
)
"""Table 1, by the type."""

PROPERTY_ROWS: Mapping[str, Quote] = MappingProxyType(
    {
        "fusion_type": Quote(
            "fusion type, bool, 0: sensor data fusion, 1: detection fusion",
            "fusion_type 融合类型 bool 0: 传感器数据融合; 1: 目标检测结果融合",
        ),
        "chirality": Quote(
            "chirality, bool, 0: right-handed frames, 1: left-handed frames",
            "chirality 手征: 右手坐标系或者左手坐标系 bool 0: 右手坐标系; 1: 左手坐标系",
        ),
        "camera_coordinate": Quote(
            "axes of the camera frame that the vehicle's forward, right and vertical directions go along; 0, 1, "
            "2 mean "
            "x, y, z, negative numbers the opposite direction",
            "camera_coordinate 记录车辆前进方向、右侧方向、竖直方向对应摄像头坐标系的轴 (int8, int8, int8) "
            "数字0, 1, 2分别表示"
            "x, y, z轴, 负数表示负方向",
        ),
        "lidar_coordinate": Quote(
            "axes of the lidar frame that the vehicle's forward, right and vertical directions go along; 0, 1, "
            "2 mean "
            "x, y, z, negative numbers the opposite direction",
            "lidar_coordinate 记录车辆前进方向、右侧方向、竖直方向对应激光雷达坐标系的轴 (int8, int8, int8) "
            "数字0, 1, 2分别表示"
            "x, y, z轴, 负数表示负方向",
        ),
        "camera_frequency": Quote(
            "frequency of the camera's data, uint32, Hz", "camera_frequency 摄像头获取数据频率 uint32 HZ"
        ),
        "lidar_frequency": Quote(
            "frequency of the lidar's data, uint32, Hz", "lidar_frequency 激光雷达获取数据频率 uint32 HZ"
        ),
        "fusion_algorithm": Quote("algorithm of the fusion, string", "fusion_algorithm 融合所用算法 string"),
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
