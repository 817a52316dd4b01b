"""Files are opened by `sceneloom.formats.base.files`, which waits for no pipe and reads no device."""

import ast

READING_MODES = ("r", "rb", "rt")

BY_PATH = {
    "Image.open", "av.open", "laspy.open", "np.fromfile", "np.genfromtxt", "np.load", "np.loadtxt", "np.memmap",
    "os.open", "pa.OSFile", "pa.memory_map", "feather.read_table", "sqlite3.connect", "zipfile.ZipFile", "ZipFile",
    "gzip.open", "gzip.GzipFile", "io.open", "io.FileIO", "tarfile.open", "ET.parse", "cv2.imread", "YAML",
}  # fmt: skip
"""What opens a file by its path, if it is given one; `read_bytes()` and `read_text()` of any object, and `open` of any
object with a mode for reading, are others."""

ALLOWED = {
    ("sceneloom.formats.base.files", "os.open"): "the one location where files are opened",
    ("sceneloom.formats.base.files", "open"): "the one location where files are opened",
    ("sceneloom.formats.base.files", "path.open"): "files of remote folders open in their own trajectory",
    ("sceneloom.formats.base.output", "os.open"): "the lock in a folder of our own",
    ("sceneloom.formats.base.output", "read_bytes"): "of the running system",
    ("sceneloom.formats.remote.mirror", "open"): "of files that were fetched into a folder of our own",
    ("sceneloom.formats.remote.mirror", "read_bytes"): "the listing in a folder of our own",
    ("sceneloom.formats.remote.mirror", "io.FileIO"): "of files that were fetched into a folder of our own",
    ("sceneloom.formats.remote.stores", "source.open"): "what was written is sent",
    ("sceneloom.formats.sfs.writer", "path.open"): "what was written before is put together",
    ("sceneloom.formats.base.images", "Image.open"): "after `check_regular`, or of bytes in memory",
    ("sceneloom.formats.argoverse2.reader", "feather.read_table"): "after `check_regular`",
    ("sceneloom.formats.messages.ros", "sqlite3.connect"): "after `check_regular`",
    ("sceneloom.formats.base.yaml_files", "YAML"): "of a text",
    ("sceneloom.formats.points.cloud", "np.loadtxt"): "of lines in memory",
    ("sceneloom.formats.points.files", "laspy.open"): "of a stream, or for writing",
    ("sceneloom.formats.points.copc", "laspy.open"): "of an open file",
    ("sceneloom.formats.points.files", "np.load"): "of an open file",
    ("sceneloom.formats.points.spec", "zipfile.ZipFile"): "of an open file",
    ("sceneloom.formats.base.zipped", "ZipFile"): "of an open file",
    ("sceneloom.formats.pandaset.pickles", "gzip.GzipFile"): "of an open file",
    ("sceneloom.formats.video.reader", "av.open"): "after a look whether it is a file",
    ("sceneloom.formats.video.writer", "av.open"): "for writing",
    ("sceneloom.formats.sfs.reader", "av.open"): "for writing",
    ("sceneloom.batch.cluster", "read_bytes"): "what a worker of ours left",
    ("sceneloom.batch.record", "sqlite3.connect"): "the lock and the record in a folder of our own",
    ("sceneloom.catalog.building", "pa.OSFile"): "what was drafted before, in a folder of our own",
    ("sceneloom.colouring.world_map", "np.load"): "what was written before, in a folder of our own",
    ("sceneloom.colouring.world_map", "np.fromfile"): "what was written before, in a folder of our own",
    ("sceneloom.pipeline.colouring", "np.memmap"): "what was written before, in a folder of our own",
    ("sceneloom.kernels.cache", "read_bytes"): "an index of compiled kernels that was found in a folder",
    ("sceneloom.service.result_files", "ZipFile"): "for writing",
    ("sceneloom.view.images", "np.load"): "after `check_regular`",
}
"""Module and call, and why it is in order."""


def called(node: ast.Call) -> str:
    """The last two names of what is called, such as `np.load`, or `.open` of something longer."""
    function = node.func
    if isinstance(function, ast.Name):
        return function.id
    if not isinstance(function, ast.Attribute):
        return ""
    return f"{function.value.id if isinstance(function.value, ast.Name) else ''}.{function.attr}"


def mode_of(node: ast.Call, location: int) -> str | None:
    """The mode that a file is opened with, or None where the call says none that can be read here."""
    given = [*node.args[location : location + 1], *(word.value for word in node.keywords if word.arg == "mode")]
    if not given:
        return "r" if {word.arg for word in node.keywords} & {"encoding", "buffering"} else None
    return given[0].value if isinstance(given[0], ast.Constant) and isinstance(given[0].value, str) else None


def opens_for_reading(node: ast.Call) -> str | None:
    """What a call is named by if it opens a file by its path to read it."""
    name = called(node)
    attribute = name.rpartition(".")[2]
    if name in BY_PATH:
        return name
    if attribute in {"read_bytes", "read_text"} and "." in name and not node.args:
        return attribute
    if name == "open":
        return name if (mode_of(node, 1) or "r") in READING_MODES else None
    if attribute == "open" and mode_of(node, 0) in READING_MODES:
        return name
    return None


def test_files_are_opened_by_the_one_function_that_refuses_pipes_and_devices(modules):
    found = {
        (module.name, name): f"line {node.lineno}"
        for module in modules
        for node in module.nodes
        if isinstance(node, ast.Call) and (name := opens_for_reading(node)) is not None
    }
    wrong = {key: line for key, line in found.items() if key not in ALLOWED}
    assert not wrong, f"use open_file or read_bytes of sceneloom.formats.base.files: {wrong}"
    assert set(ALLOWED) <= set(found), f"no longer needed: {set(ALLOWED) - set(found)}"
    # what opens files is distinguished from what does not
    reading = ["p.open('rb')", "p.open(encoding='utf-8')", "open(p)", "open(p, 'rb')", "a.b.read_bytes()", "np.load(p)"]
    other = ["p.open('wb')", "video.open()", "open(p, 'xb')", "read_bytes(p)", "open_file(p)", "form.open(path)"]
    assert all(opens_for_reading(ast.parse(text).body[0].value) for text in reading)
    assert not any(opens_for_reading(ast.parse(text).body[0].value) for text in other)
