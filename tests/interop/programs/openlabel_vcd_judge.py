"""What VCD says: whether files pass its schema, what its chain codes mean, and where its cameras see points.

`schema FILE ...`, `chains`, or `project FILE STREAM ROWS`; the answer is JSON.
"""

import json
import random
import sys
from pathlib import Path

import jsonschema
import numpy as np
from vcd import core, poly2d, scl, types
from vcd.schema import openlabel_schema


def schema(*names):
    judge = jsonschema.Draft7Validator(openlabel_schema)
    contents = [json.loads(Path(name).read_text("utf-8")) for name in names]
    return [[f"{list(e.absolute_path)}: {e.message[:200]}" for e in judge.iter_errors(one)] for one in contents]


def chains():
    draw, found = random.Random(5), []
    for _ in range(60):
        vertices = [draw.randint(-40, 40) for _ in range(2 * draw.randint(1, 9))]
        for mode in (types.Poly2DType.MODE_POLY2D_SRF6DCC, types.Poly2DType.MODE_POLY2D_RS6FCC):
            data = types.poly2d("p", tuple(vertices), mode, True).data
            *numbers, codes = data["val"]
            decode = {4: poly2d.get_vec_from_encoded_srf6, 6: poly2d.get_vec_from_encoded_rs6}[len(data["val"])]
            found.append([data, np.ravel(decode(*map(int, numbers), codes)).tolist()])
    return found


def project(name, stream, rows):
    label = core.OpenLABEL()
    label.load_from_file(name)
    points = np.array(json.loads(rows)).T
    camera = scl.Scene(label).get_camera(stream)
    return camera.project_points3d(np.vstack((points, np.ones(points.shape[1]))))[0][:2].T.tolist()


sys.stdout.write(json.dumps(globals()[sys.argv[1]](*sys.argv[2:])))
