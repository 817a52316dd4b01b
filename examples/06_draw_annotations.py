"""See what is stated about a scene: every type of annotation, drawn from a file.

A street is simulated together with one annotation of each type of the Sensor Fusion Scene format, and written. From
the file alone the images are drawn: what annotations look like in the images, from above, over time, and each
type by itself. `sceneloom info FILE --visualize FOLDER` does the same for a file of yours.

    python examples/06_draw_annotations.py [FOLDER]
"""

import sys
from pathlib import Path

from PIL import Image

import sceneloom
from sceneloom.simulate import annotate, demo_drive
from sceneloom.visualization import contact_sheet
from sceneloom.visualization.annotations import save_annotation_images

if __name__ == "__main__":
    where = Path(sys.argv[1] if len(sys.argv) > 1 else "annotated")
    where.mkdir(exist_ok=True)
    sceneloom.write(annotate(demo_drive(frames=4)).scene, where / "annotated.sfs", overwrite=True)

    with sceneloom.open(where / "annotated.sfs") as scene:
        images = save_annotation_images(scene, where / "images", at=0.3, overwrite=True)
    of_types = [Image.open(path) for path in sorted(images) if path.stem.startswith("type_")]
    of_types.sort(key=lambda image: image.height / image.width)  # rows of images of one shape
    contact_sheet(of_types, columns=3, width_px=1650).save(where / "annotations.jpg", quality=85)
    print(f"{len(of_types)} types of annotations on one sheet: {where / 'annotations.jpg'}")
