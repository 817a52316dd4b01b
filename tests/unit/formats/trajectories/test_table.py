"""Files of trajectories as other programs write them, and what is wrong with bad ones."""

import math

import numpy as np
import pytest

from sceneloom import read_trajectory, write_trajectory
from sceneloom.errors import DataError, OptionError, OutputError, PoseError, UnknownFormatError
from sceneloom.formats.trajectories.table import TRAJECTORY_FORMS, read_trajectory_file
from sceneloom.formats.trajectories.trajectory_file import TrajectoryFile
from sceneloom.scene import Poses, Trajectory

TUM = """# ground truth trajectory
# timestamp tx ty tz qx qy qz qw
1305031098.6659 1.3563 0.6305 1.6380 0.6132 0.5962 -0.3311 -0.3986
1305031098.675900123 1.3543 0.6306 1.6360 0.6129 0.5966 -0.3316 -0.3980
"""
EUROC = """#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z [], \
v_RS_R_x [m s^-1], v_RS_R_y [m s^-1], v_RS_R_z [m s^-1], b_w_RS_S_x [rad s^-1], b_w_RS_S_y [rad s^-1], \
b_w_RS_S_z [rad s^-1], b_a_RS_S_x [m s^-2], b_a_RS_S_y [m s^-2], b_a_RS_S_z [m s^-2]
1403636580838555648,4.688319,-1.786938,0.783338,0.534108,-0.153029,-0.827383,-0.082152,-0.027876,0.033207,0.800006,\
-0.003172,0.021267,0.078502,-0.025266,0.136696,0.075593
1403636580843555328,4.688177,-1.786770,0.787350,0.534640,-0.152990,-0.826976,-0.082863,-0.029272,0.033992,0.804771,\
-0.003172,0.021267,0.078502,-0.025266,0.136696,0.075593
"""
KITTI = "1 0 0 0.5 0 1 0 -0.25 0 0 1 2\n0 0 1 3 1 0 0 4 0 1 0 5\n"
FIXES = """Time,Lat,Lon,Alt,hAcc
12.5,49.0,8.0,110.0,0.5
12.6,49.0,8.001,111.0,
"""


def put(folder, name, text):
    path = folder / name
    path.write_text(text, "utf-8")
    return path


def test_a_tum_file_is_read_with_exact_times_and_one_of_euroc_with_w_first_velocities_and_biases(tmp_path):
    trajectory = read_trajectory(put(tmp_path, "gt.txt", TUM))
    assert trajectory.name == "gt"
    assert trajectory.timestamps_ns.tolist() == [1305031098665900000, 1305031098675900123]
    assert trajectory.positions[1].tolist() == [1.3543, 0.6306, 1.6360]
    assert trajectory.quaternions_xyzw[0].tolist() == [0.6132, 0.5962, -0.3311, -0.3986]
    content = read_trajectory_file(put(tmp_path, "data.csv", EUROC))
    trajectory = content.trajectory
    assert content.form == "euroc"
    assert trajectory.timestamps_ns.tolist() == [1403636580838555648, 1403636580843555328]
    assert trajectory.quaternions_xyzw[0].tolist() == [-0.153029, -0.827383, -0.082152, 0.534108]
    assert content.columns["velocities"][1].tolist() == [-0.029272, 0.033992, 0.804771]
    assert content.columns["accelerometer_biases"][0].tolist() == [-0.025266, 0.136696, 0.075593]
    assert len(write_trajectory(content, tmp_path / "again.csv")) == 0
    assert (tmp_path / "again.csv").read_text("utf-8").splitlines()[0] == EUROC.splitlines()[0]
    again = read_trajectory_file(tmp_path / "again.csv")
    for name, values in content.columns.items():
        assert np.array_equal(values, again.columns[name])
    losses = write_trajectory(content, tmp_path / "trajectory.tum")
    assert [loss.field.split(".")[-1] for loss in losses] == ["velocities", "gyroscope_biases", "accelerometer_biases"]
    # that of its position tracker has no orientations
    text = "#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m]\n1403636616613303296,0.1,0.2,0.3\n"
    trajectory = read_trajectory(put(tmp_path, "leica.csv", text))
    assert (trajectory.positions.tolist(), trajectory.quaternions_xyzw) == ([[0.1, 0.2, 0.3]], None)


def test_a_path_of_poses_is_written_as_it_is_and_poses_of_a_camera_are_rotated_to_x_forward(tmp_path):
    path = Poses(np.array([5], np.int64), np.ones((1, 3)), np.array([[0.0, 0, 0, 1]]))
    write_trajectory(path, tmp_path / "a.tum")
    assert read_trajectory(tmp_path / "a.tum").positions.tolist() == [[1.0, 1.0, 1.0]]
    with pytest.raises(PoseError, match="holds at all times"):
        write_trajectory(Poses.identity(), tmp_path / "b.tum")
    # 10 m ahead, 2 m to the right and 1 m down, rotated to the right: about the camera's y axis, which points down
    half = math.sqrt(0.5)
    path = put(tmp_path, "trajectory.tum", f"0 2 1 10 0 {half!r} 0 {half!r}\n")
    trajectory = read_trajectory(path, optical=True)
    assert trajectory.positions.tolist() == [[10.0, -2.0, -1.0]]
    np.testing.assert_allclose(trajectory.quaternions_xyzw, [[0, 0, -half, half]], atol=1e-15)


def test_kitti_poses_get_their_times_from_a_file_a_rate_or_the_folder(tmp_path):
    poses = put(tmp_path, "00.txt", KITTI)
    with pytest.raises(DataError, match="--from-rate HZ"):
        read_trajectory(poses)
    assert read_trajectory(poses, rate_hz=3).timestamps_ns.tolist() == [0, 333333333]
    named = put(tmp_path, "timestamps.txt", "5.0\n5.123456789\n")
    assert read_trajectory(poses, times=named).timestamps_ns.tolist() == [5000000000, 5123456789]
    put(tmp_path, "times.txt", "0.000000e+00\n1.036224e-01\n")
    content = read_trajectory_file(poses)
    assert content.trajectory.timestamps_ns.tolist() == [0, 103622400]
    assert [warning.code for warning in content.warnings] == ["times-beside"]
    # the second rotation rotates x to y, y to z and z to x: 120° about (1, 1, 1)
    assert content.trajectory.quaternions_xyzw[1].tolist() == [0.5, 0.5, 0.5, 0.5]
    assert content.trajectory.positions.tolist() == [[0.5, -0.25, 2.0], [3.0, 4.0, 5.0]]


def test_fixes_are_metres_from_the_first_or_a_named_origin_with_which_a_trajectory_is_written_as_fixes(tmp_path):
    content = read_trajectory_file(put(tmp_path, "fixes.csv", FIXES))
    assert (content.form, content.trajectory.quaternions_xyzw) == ("gnss", None)
    # a thousandth of a degree of longitude at 49°: 6378137 / sqrt(1 - e² sin² 49°) · cos 49° · π / 180000 m
    normal = 6378137.0 / np.sqrt(1 - 0.00669437999014 * np.sin(np.radians(49)) ** 2)
    east = (normal + 111.0) * np.cos(np.radians(49)) * np.radians(0.001)
    np.testing.assert_allclose(content.trajectory.positions[0], 0.0, atol=1e-9)
    # 1e-3 m: the earth's curvature lowers the second fix by 0.4 mm
    np.testing.assert_allclose(content.trajectory.positions[1], [east, 0.0, 1.0], atol=1e-3)
    np.testing.assert_array_equal(content.fixes.accuracies, [0.5, np.nan])
    trajectory = read_trajectory(tmp_path / "fixes.csv", origin_lla=(49.0, 8.0, 100.0))
    np.testing.assert_allclose(trajectory.positions[0], [0, 0, 10], atol=1e-6)
    trajectory = Trajectory("trajectory", np.array([0, 10], np.int64), np.array([[0.0, 0, 0], [10.0, 20, 1]]))
    with pytest.raises(OptionError, match="--origin"):
        write_trajectory(trajectory, tmp_path / "a.csv", form="gnss")
    write_trajectory(trajectory, tmp_path / "a.csv", form="gnss", origin_lla=(60.0, 25.0, 10.0))
    # degrees of 64 bits resolve 2e-9 m
    np.testing.assert_allclose(read_trajectory(tmp_path / "a.csv").positions, trajectory.positions, atol=1e-8)


KF_GINS = "456250.000  30.44478  114.47186  21.095  0.010  0.020  0.030\n456251  30.44479 114.47186 21 0.3 0.4 1\n"


def test_lines_of_kf_gins_are_fixes_with_their_deviations(tmp_path):
    content = read_trajectory_file(put(tmp_path, "fixes.txt", KF_GINS))
    np.testing.assert_array_equal(content.fixes.timestamps_ns, [456_250 * 10**9, 456_251 * 10**9])
    np.testing.assert_array_equal(content.fixes.positions_lla[0], [30.44478, 114.47186, 21.095])
    # across is the root of the mean square along each of two axes
    np.testing.assert_allclose(content.fixes.accuracies, [math.sqrt(0.00025), math.sqrt(0.125)])
    np.testing.assert_array_equal(content.fixes.vertical_accuracies, [0.03, 1.0])
    # a degree of latitude is 111 km
    assert content.trajectory.positions[1, 1] == pytest.approx(1.11, abs=0.01)
    assert [warning.code for warning in content.warnings] == ["gnss-week-unknown"]


@pytest.mark.parametrize(
    ("name", "text", "form"),
    [
        ("a.txt", TUM, "tum"),
        ("a.csv", EUROC, "euroc"),
        ("a.csv", EUROC.split("\n", 1)[1], "euroc"),
        ("a.txt", KITTI, "kitti"),
        ("a.csv", FIXES, "gnss"),
        ("a.txt", KF_GINS, "gnss"),
        ("a.csv", "timestamp_ns,x,y,z\n5,1,2,3\n", "csv"),
        ("a.csv", "t;px;py;pz;qx;qy;qz;qw\n5;1;2;3;0;0;0;1\n", "csv"),
        ("a.jsonl", '{"groundTruth":{"position":{"x":1,"y":2,"z":3}},"time":5}\n', "jsonl"),
        ("a.out", '{"time":5,"position":{"x":1,"y":2,"z":3}}\n', "jsonl"),
    ],
)
def test_the_form_is_known_by_the_content(tmp_path, name, text, form):
    assert TRAJECTORY_FORMS.of_file(put(tmp_path, name, text)).name == form


def test_a_suffix_decides_where_the_first_line_is_bad_and_what_is_none_or_would_be_ignored_is_refused(tmp_path):
    for name, text, options, error, word in (
        ("a.tum", "0 1 2 3 0 0 0\n", {}, DataError, "line 1: 7 values; expected 8"),
        ("a.jsonl", "{torn\n", {}, DataError, "line 1"),
        ("a.txt", "hello world\n", {}, UnknownFormatError, "tum, lines of 8 numbers"),
        ("absent.txt", None, {}, UnknownFormatError, "no such file"),
        ("b.bin", "\0\1\2", {}, UnknownFormatError, "b.bin"),
        ("tum.tum", TUM, {"rate_hz": 10.0}, OptionError, "has its own times; the rate 10 Hz would not be used"),
        ("tum.tum", TUM, {"origin_lla": (48.0, 9.0, 300.0)}, OptionError, "the origin would not be used"),
        ("a.kitti", KITTI, {"rate_hz": 10.0, "unit": "seconds"}, OptionError, "unit 'seconds' would not be used"),
    ):
        path = tmp_path / name if text is None else put(tmp_path, name, text)
        with pytest.raises(error, match=word):
            read_trajectory(path, **options)


JSONL = """{"sensor":{"type":"gyroscope","values":[0,0,0]},"time":1403636580.838555648}
{"pose":{"name":"vio","position":{"x":9,"y":9,"z":9}},"time":1403636580.838555648}
{"groundTruth":{"position":{"x":1,"y":2,"z":3},"orientation":{"x":0,"y":0,"z":0,"w":1}},"time":1403636580.838555648}
{"ARKit":{"position":{"x":4,"y":5,"z":6}},"time":1403636580.9}
{"time":1403636581,"position":{"x":7,"y":8,"z":9},"status":"TRACKING"}
"""


def test_lines_of_json_hold_trajectories_under_any_key_and_so_does_a_recording(tmp_path):
    path = put(tmp_path, "lines.jsonl", JSONL)
    for name, x, timestamp_ns in (
        (None, 1.0, 1403636580838555648),
        ("vio", 9.0, 1403636580838555648),
        ("ARKit", 4.0, 1403636580900000000),
        ("output", 7.0, 1403636581000000000),
    ):
        for trajectory in (read_trajectory(path, name=name), read_trajectory(f"{path}:{name}" if name else path)):
            assert (trajectory.positions[0, 0], trajectory.timestamps_ns.tolist()) == (x, [timestamp_ns])
    with pytest.raises(OptionError, match="vio, groundTruth, ARKit, output"):
        read_trajectory(path, name="slam")
    folder, fix = tmp_path / "drive", '{"gps":{"latitude":49,"longitude":8,"altitude":1},"time":1403636581}\n'
    folder.mkdir()
    put(folder, "data.jsonl", JSONL + fix)
    assert read_trajectory(folder).name == "groundTruth"
    for source in (folder, put(tmp_path, "log.jsonl", JSONL + fix)):  # a log that lies by itself, too
        assert read_trajectory(f"{source}:vio").positions[0, 0] == 9.0
        fixes = read_trajectory(f"{source}:fixes")
        assert (fixes.timestamps_ns.tolist(), fixes.quaternions_xyzw) == ([1403636581 * 10**9], None)
    with pytest.raises(OptionError, match=r"there are: groundTruth, .*gnss, fixes$"):
        read_trajectory(folder, name="slam")


def pose(time, x=1, w=1):
    rotation = f'{{"x":0,"y":0,"z":0,"w":{w}}}'
    return f'{{"groundTruth":{{"position":{{"x":{x},"y":2,"z":3}},"orientation":{rotation}}},"time":{time}}}\n'


BAD = [
    ("tum", "0 1 2 3 0 0 0 1\n0.1 1 2 3 0 0 0\n", "line 2: 7 values; expected 8"),
    ("tum", "0 1 2 3 0 0 0 1\n0.1 1 x 3 0 0 0 1\n", "line 2: column 3: 'x'; expected a finite number"),
    ("tum", "0 1 2 3 0 0 0 1\n0.1 1 nan 3 0 0 0 1\n", "line 2: column 3: 'nan'"),
    ("tum", "0 1 2 3 0 0 0 1\nnan 1 2 3 0 0 0 1\n", "line 2: 'nan'; expected a number"),
    ("tum", "0 1 2 3 0 0 0 1\n1 1 2 3 0 0 0 1.2\n", "line 2: orientation .* of length 1.2"),
    ("tum", "0 1 2 3 0 0 0 1\n# x\n\n0.0 1 2 3 0 0 0 1\n", "line 4: the time 0.0 s stands in line 1 already"),
    ("tum", "0 1e300 2 3 0 0 0 1\n", "line 1: position .*; expected metres"),
    ("tum", "1403636580838555648 1 2 3 0 0 0 1\n", "nanoseconds"),
    ("tum", "# nothing\n", "is empty"),
    ("kitti", "1 0 0 0 0 1 0 0 0 0 -1 0\n", "line 1: .*orthonormal right-handed"),
    ("kitti", "1 0 0 0 0 1 0 0 0 0 1\n", "line 1: 11 values; expected 12"),
    ("euroc", "5,1,2,3,1,0,0\n", "line 1: 7 values; expected 4, 8, 11, 14, 17"),
    ("gnss", "time,lat,lon,alt\n1,95,8,3\n", "line 2: latitude 95.0, .*within ±90"),
    ("gnss", "time,lat,lon,alt,accuracy\n1,45,8,3,bad\n", "line 2: accuracy: 'bad'; expected metres, or nothing"),
    ("gnss", "time,lat,alt\n1,95,8\n", "line 1: no column for longitude among time, lat, alt"),
    ("gnss", "time,lat,lon,alt\n", "holds no fixes"),
    ("csv", "t,x,y,z,qx\n1,1,2,3,0\n", "line 1: no column for qy, qz, qw"),
    ("csv", "t,x,y,z\n", "holds no poses"),
    ("jsonl", pose(0) + "{torn", "line 2: .*not a JSON object"),
    ("jsonl", pose(0) + pose('"1"'), 'line 2: time: "1"; expected a number'),
    ("jsonl", pose(0) + pose("null"), "line 2: time: null"),
    ("jsonl", pose(0) + pose(1, x='"a"'), "line 2: .*position.x"),
    ("jsonl", pose(0) + pose(1, w=0.5), "line 2: orientation .* of length 0.5"),
    ("jsonl", '{"groundTruth":{"position":{"x":1,"y":2,"z":3}}}\n', "line 1: time: missing"),
    ("jsonl", '{"time":1}\n', "holds no poses"),
]


@pytest.mark.parametrize(("form", "text", "problem"), BAD)
def test_bad_content_is_one_error_with_its_line(tmp_path, form, text, problem):
    path = put(tmp_path, "bad.txt", text)
    with pytest.raises(DataError, match=problem):
        read_trajectory(path, form=form, rate_hz=10 if form == "kitti" else None)


def test_a_lenient_reading_leaves_out_what_is_bad_and_poses_out_of_order_are_sorted(tmp_path):
    torn = pose(0) + "{torn\n" + pose(1, w=0.5) + pose(0) + pose(2)
    far = "-9000000000 1 0 0 0 0 0 1\n9000000000 2 0 0 0 0 0 1\n"  # no int64 holds their difference
    for name, text, times_s, codes in (
        ("a.jsonl", torn, [0, 2], {"bad-lines", "unusable-poses", "repeated-poses"}),
        ("a.txt", "2 2 0 0 0 0 0 1\n1 1 0 0 0 0 0 1\n", [1, 2], {"poses-sorted"}),
        ("a.txt", far, [-9_000_000_000, 9_000_000_000], set()),
    ):
        content = read_trajectory_file(put(tmp_path, name, text), lenient=name == "a.jsonl")
        assert content.trajectory.timestamps_ns.tolist() == [time_s * 10**9 for time_s in times_s]
        assert {warning.code for warning in content.warnings} == codes
        assert name != "a.txt" or content.trajectory.positions[:, 0].tolist() == [1.0, 2.0]


def test_fixes_of_kf_gins_that_run_backwards_are_sorted_and_the_first_line_is_named(tmp_path):
    rows = [f"{357473 + k} {30.5 + 1e-5 * k:.6f} 114.5 22.5 0.1 0.1 0.2" for k in (0, 1, 3, 2, 5, 4)]
    content = read_trajectory_file(put(tmp_path, "a.txt", "\n".join(rows)))
    assert np.diff(content.trajectory.timestamps_ns).tolist() == [10**9] * 5
    assert (np.diff(content.trajectory.positions[:, 1]) > 0).all()
    found = {one.code: one.location.rpartition("/")[2] for one in content.warnings}
    assert found == {"gnss-week-unknown": "a.txt", "poses-sorted": "a.txt: line 4"}


def test_files_are_not_replaced_unasked_and_what_no_form_holds_is_refused(tmp_path):
    trajectory = Trajectory("trajectory", np.array([0], np.int64), np.zeros((1, 3)))
    for name in ("a.tum", "a.kitti", "a.csv"):
        with pytest.raises(OptionError, match="positions without orientations"):
            write_trajectory(trajectory, tmp_path / name)
        assert not (tmp_path / name).exists()
    write_trajectory(trajectory, tmp_path / "a.csv", form="csv")
    assert read_trajectory(tmp_path / "a.csv").quaternions_xyzw is None
    trajectory = read_trajectory(put(tmp_path, "a.txt", TUM))
    write_trajectory(trajectory, tmp_path / "a.kitti")
    (tmp_path / "a.kitti").unlink()
    with pytest.raises(OutputError, match=r"a\.times\.txt: exists already"):
        write_trajectory(trajectory, tmp_path / "a.kitti")
    assert not (tmp_path / "a.kitti").exists()
    with pytest.raises(OptionError, match=r"expected one of: tum \(\.tum \.txt\)"):
        write_trajectory(TrajectoryFile(trajectory), tmp_path / "a.poses")
    write_trajectory(trajectory, tmp_path / "a.kitti", overwrite=True)
    assert read_trajectory(tmp_path / "a.kitti").timestamps_ns.tolist() == trajectory.timestamps_ns.tolist()


def test_fixes_before_reception_are_no_origin(tmp_path):
    locations = [(0, 0, 0), (0, 0, 0), (49, 8, 1), (49.001, 8, 1)]
    fields = '{{"gps":{{"latitude":{},"longitude":{},"altitude":{}}},"time":{}}}\n'
    lines = [fields.format(*location, k) for k, location in enumerate(locations)]
    path = put(tmp_path, "log.jsonl", "".join(lines))
    content = read_trajectory_file(f"{path}:fixes")
    assert content.trajectory.timestamps_ns.tolist() == [2 * 10**9, 3 * 10**9]
    # a thousandth of a degree of latitude at 49 degrees. Source: WGS84's radius there, 6380 km
    np.testing.assert_allclose(content.trajectory.positions, [[0, 0, 0], [0, 111.2, 0]], atol=0.1)
    assert [(n.code, n.count) for n in content.warnings if "fixes" in n.code] == [("gnss-fixes-left-out", 2)]
    nowhere = put(tmp_path, "none.jsonl", "".join(lines[:2]))
    with pytest.raises(PoseError, match="no usable GNSS fixes"):
        read_trajectory(f"{nowhere}:fixes")
