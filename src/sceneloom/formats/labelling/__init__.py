"""Files of labelling tools: CVAT, COCO, Datumaro, YOLO and Label Studio."""
