"""Records as messages of the Foxglove schemas, for MCAP viewers; mappings, from which the protobuf classes are made.

Pictures are `foxglove.RawImage` or `CompressedImage`, clouds `PointCloud`, boxes in space `SceneUpdate`, boxes in
pictures `ImageAnnotations`; points of annotations count from the picture's own corner, as table 8 does. Of a box,
what the drawing does not say stands in its metadata. The schemas know neither sensor_id nor seq, so they are given on
reading.

Source: the Foxglove schemas, package foxglove-schemas-protobuf 0.4.
"""

from sceneloom.fusion.messages.foxglove_form.message import FoxgloveMessage
from sceneloom.fusion.messages.foxglove_form.points import NUMERIC_TYPES
from sceneloom.fusion.messages.foxglove_form.records import FoxgloveRecord, from_foxglove, to_foxglove

__all__ = ["NUMERIC_TYPES", "FoxgloveMessage", "FoxgloveRecord", "from_foxglove", "to_foxglove"]
