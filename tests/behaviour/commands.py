"""The commands whose outputs make up the snapshot of behaviour: every verb, every format in both directions.

Options are named as the snapshot was recorded with them; `RENAMED_OPTIONS` says what they are called since. `{data}`
is the folder of real data, `{out}` the command's own folder, `{NAME}` the output folder of an earlier command,
`{address}` that of a service that runs meanwhile; `&&` stands between commands that write into one folder.
"""

import re
from dataclasses import dataclass

RENAMED_OPTIONS: dict[str, str] = {}
"""Options and verbs by the names that the snapshot was recorded with, and what they are called now."""

RENAMED_WORDS: tuple[tuple[str, str], ...] = (
    *(
        (rf"(?<![A-Za-z]){old}(?![A-Za-z])", new)
        for old, new in {
            "nowhere_share": "non_finite_share",
            "turn_rate": "yaw_rate",
            "turn_acceleration": "yaw_acceleration",
            "poses_endless": "poses_static",
            "pictures": "images",
            "picture": "image",
            "stamps": "timestamps",
            "stamp": "timestamp",
            "notices": "warnings",
            "notice": "warning",
            "lenses": "camera_models",
            "lens": "camera_model",
            "ways": "trajectories",
            "way": "trajectory",
            "places": "locations",
            "place": "location",
            "told": "reported",
            "said": "stated",
            "turns": "rotations",
            "turned": "rotated",
            "turning": "rotating",
            "turn": "rotation",
            "standing": "stationary",
            "fate": "support",
            "fates": "supports",
            "mended": "repaired",
            "endless": "static",
            "planted": "injected",
            "pieces": "chunks",
        }.items()
    ),
)
"""Regular expressions of words in names of fields and files as the snapshot has them, and what replaces them now.

They are applied one after the other to locations of the snapshot that are not found any more, and to its texts.
"""


def renamed(text: str) -> str:
    """Report a name of the snapshot in the words of now."""
    for pattern, word in RENAMED_WORDS:
        text = re.sub(pattern, word, text)
    return text


@dataclass(frozen=True)
class Command:
    """One command of the snapshot.

    Attributes:
        name: unique; later commands refer to its output folder by it.
        words: arguments, split at blanks.
        needs: names of the commands whose outputs it reads.
    """

    name: str
    words: str
    needs: tuple[str, ...] = ()


def _command(name: str, words: str) -> Command:
    needs = tuple(known for known in _KNOWN if "{" + known + "}" in words)
    _KNOWN.append(name)
    return Command(name, words, needs)


_KNOWN: list[str] = []
_SHORT = "--start 0 --stop 0.5"
_KITTI = "{data}/recordings/kitti_drive"
_PANDASET = "{data}/recordings/pandaset"
_ARGOVERSE = "{data}/real/sfs_reference/argoverse2_2frames_cuboids.sfs"
_TRACKING = "{data}/real/kitti_tracking --sequence 0012 --sequence 0014"

COMMANDS: tuple[Command, ...] = (
    # a simulated drive with lidar, camera and boxes, and real ones
    _command("inputs", "inputs {out}"),
    _command("demo", "demo --keep {out}/kept --frames 6"),
    _command("fuse_kitti", f"fuse {_KITTI} -o {{out}}/drive.sfs --trajectory lidar"),
    _command("fuse_pandaset", f"fuse {_PANDASET} -o {{out}}/drive.sfs --start 0 --stop 1 --depth {{out}}/depth"),
    _command("fuse_still", f"fuse {_KITTI} -o {{out}}/drive.sfs --trajectory identity --profile scale"),
    # what is in them
    _command("info_kitti", f"info {_KITTI}"),
    _command("info_pandaset", f"info {_PANDASET}"),
    _command("info_oxts", "info {data}/recordings/kitti_oxts_0000"),
    _command("info_sfs", f"info {_ARGOVERSE}"),
    _command("info_argoverse2", "info {data}/real/argoverse2/7fab2350-7eaf-3b7e-a39d-6937a4c1bede"),
    _command("info_scale_toolkit", "info {data}/real/pandaset_scale_sample"),
    _command("info_fused", "info {fuse_kitti}/drive.sfs"),
    _command("formats", "formats"),
    _command("rules", "validate --rules"),
    _command("checks", "conformance --checks"),
    _command("validate_kitti", f"validate {_KITTI}"),
    _command("validate_pandaset", f"validate {_PANDASET}"),
    _command("validate_sfs", f"validate {_ARGOVERSE}"),
    _command("validate_fused", "validate {fuse_kitti}/drive.sfs"),
    _command("diff", "diff {fuse_kitti}/drive.sfs {fuse_still}/drive.sfs"),
    # into every format, and back
    _command("to_sfs", f"convert {_PANDASET} {{out}}/drive.sfs {_SHORT}"),
    _command("to_recording", f"convert {_ARGOVERSE} {{out}}/drive --to recording"),
    _command("to_mcap", "convert {to_sfs}/drive.sfs {out}/drive.mcap"),
    _command("to_ros1", "convert {to_sfs}/drive.sfs {out}/drive.bag"),
    _command("to_ros2", "convert {to_sfs}/drive.sfs {out}/drive.ros2"),
    _command("to_kitti_raw", "convert {to_sfs}/drive.sfs {out}/drive --to kitti-raw"),
    _command("to_kitti_object", "convert {inputs}/drive.sfs {out}/drive --to kitti-object"),
    _command("to_kitti_tracking", "convert {inputs}/drive.sfs {out}/drive --to kitti-tracking"),
    _command("to_kitti_odometry", "convert {to_sfs}/drive.sfs {out}/drive --to kitti-odometry"),
    _command("to_nuscenes", "convert {inputs}/drive.sfs {out}/drive --to nuscenes"),
    _command("to_openlabel", f"convert {_ARGOVERSE} {{out}}/labels.json --to openlabel"),
    _command("to_pcd", f"convert {_ARGOVERSE} {{out}}/drive --to pcd"),
    _command("to_ply", f"convert {_ARGOVERSE} {{out}}/drive --to ply"),
    _command("to_las", f"convert {_ARGOVERSE} {{out}}/drive --to las"),
    _command("to_laz", f"convert {_ARGOVERSE} {{out}}/drive --to laz"),
    _command("to_kitti_bin", f"convert {_ARGOVERSE} {{out}}/drive --to kitti-bin"),
    _command("to_nuscenes_bin", f"convert {_ARGOVERSE} {{out}}/drive --to nuscenes-bin"),
    _command("to_npz", f"convert {_ARGOVERSE} {{out}}/drive --to npz"),
    _command("to_colmap", "convert {to_sfs}/drive.sfs {out}/drive.colmap"),
    _command("to_nerfstudio", "convert {to_sfs}/drive.sfs {out}/drive.nerfstudio"),
    _command("to_tum", f"convert {_PANDASET} {{out}}/drive.tum"),
    _command("to_kitti_lines", f"convert {_PANDASET} {{out}}/drive.kitti"),
    _command("to_euroc_lines", f"convert {_PANDASET} {{out}}/drive.csv"),
    _command("to_csv", f"convert {_PANDASET} {{out}}/drive.csv --to csv"),
    _command("to_gnss", "convert {data}/recordings/kitti_oxts_0000 {out}/fixes.csv --to gnss --origin 49 8.4 110"),
    _command("oxts_smoothed", "convert {data}/recordings/kitti_oxts_0000 {out}/drive.tum --trajectory gnss"),
    *(
        _command(f"from_{name}", f"convert {{to_{name}}}/{location} {{out}}/drive.sfs {more}".strip())
        for name, location, more in (
            ("recording", "drive", ""),
            ("mcap", "drive.mcap", ""),
            ("ros1", "drive.bag", ""),
            ("ros2", "drive.ros2", ""),
            ("kitti_raw", "drive", ""),
            ("kitti_object", "drive", ""),
            ("kitti_tracking", "drive", ""),
            ("kitti_odometry", "drive", ""),
            ("nuscenes", "drive", ""),
            ("openlabel", "labels.json", ""),
            ("pcd", "drive", ""),
            ("ply", "drive", ""),
            ("las", "drive", ""),
            ("laz", "drive", ""),
            ("kitti_bin", "drive", "--input-format kitti-bin"),
            ("nuscenes_bin", "drive", "--input-format nuscenes-bin"),
            ("npz", "drive", ""),
        )
    ),
    _command("from_argoverse2", "convert {data}/real/argoverse2/7fab2350-7eaf-3b7e-a39d-6937a4c1bede {out}/drive.sfs"),
    _command("from_scale_toolkit", "convert {data}/real/pandaset_scale_sample {out}/drive.sfs"),
    _command("from_kitti", "convert {data}/real/kitti_object {out}/drive.sfs"),
    # fused, coloured, followed, drawn
    _command("colour", f"colour {_PANDASET} -o {{out}}/map.ply {_SHORT} --voxel 0.2"),
    _command("colour_sweeps", "colour {to_sfs}/drive.sfs -o {out}/drive.sfs --per-sweep"),
    _command("depth", "depth {to_sfs}/drive.sfs -o {out}/depth"),
    _command("depth_dense", "depth {to_sfs}/drive.sfs -o {out}/depth --method dense --form npz"),
    _command("track", f"track {_TRACKING} -o {{out}}/results"),
    _command("track_offline", f"track {_TRACKING} -o {{out}}/results --offline"),
    _command("fuse_detections", f"fuse {_TRACKING} --type detection -o {{out}}/fused"),
    _command("view", "view {to_sfs}/drive.sfs --save {out}/drive.rrd"),
    _command("report", "report {to_sfs}/drive.sfs -o {out}/page.html --numbers {out}/numbers.json --quick"),
    # edited
    _command("edit_deskew", "edit deskew {to_sfs}/drive.sfs -o {out}/drive.sfs"),
    _command("edit_crop", "edit crop {to_sfs}/drive.sfs -o {out}/drive.sfs --range 30"),
    _command("edit_thin", "edit thin {to_sfs}/drive.sfs -o {out}/drive.sfs --voxel 0.5"),
    _command("edit_merge", "edit merge {edit_crop}/drive.sfs {edit_thin}/drive.sfs -o {out}/drive.sfs --rename"),
    _command("edit_to_world", "edit to-world {inputs}/drive.sfs -o {out}/drive.sfs"),
    _command("edit_to_ego", "edit to-ego {edit_to_world}/drive.sfs -o {out}/drive.sfs"),
    _command("edit_count", f"edit count {_ARGOVERSE} -o {{out}}/drive.sfs"),
    _command("edit_project", "edit project {inputs}/drive.sfs -o {out}/drive.sfs"),
    _command("edit_simplify", "edit simplify {to_sfs}/drive.sfs -o {out}/drive.sfs"),
    _command("edit_blur", "edit blur {edit_project}/drive.sfs -o {out}/drive.sfs --label car"),
    _command("edit_relative", "edit anonymise {to_sfs}/drive.sfs -o {out}/drive.sfs"),
    _command("edit_undistort", "edit undistort {to_sfs}/drive.sfs -o {out}/drive.sfs"),
    # judged
    _command("eval_trajectory", "eval trajectory {to_tum}/drive.tum {to_csv}/drive.csv"),
    _command(
        "eval_detection", "eval detection {fuse_detections}/fused {data}/real/kitti_tracking/label_02 --sequence 0012"
    ),
    _command("eval_tracking", "eval tracking {track}/results {data}/real/kitti_tracking/label_02 --sequence 0012"),
    _command("sync", f"sync {_PANDASET}"),
    _command("calibrate", f"calibrate {_KITTI} --check"),
    _command("sync_apply", "sync {inputs}/drive.sfs --streams groundTruth --apply {out}/drive.sfs"),
    _command("calibrate_refine", "calibrate {inputs}/rotated --refine -o {out}/drive.sfs"),
    _command("calibrate_table_3", "calibrate {inputs}/rotated --refine -o {out}/pair.json"),
    _command("calibrate_hand_eye", "calibrate {data}/recordings/pandaset --hand-eye"),
    _command("calibrate_two_lidars", "calibrate {inputs}/two_lidars --lidar-to-lidar --lidar lidar1"),
    _command("calibrate_conventions", f"calibrate {_KITTI} --conventions"),
    _command("calibrate_target", "calibrate {inputs}/rotated --target 7x5:0.12:1.1x0.86"),
    _command("edit_apply", "edit apply {calibrate_refine}/drive.sfs -o {out}/drive.sfs"),
    _command("edit_to_sensor", "edit to-sensor {inputs}/drive.sfs -o {out}/drive.sfs"),
    _command("edit_lens", "edit camera-model {inputs}/drive.sfs -o {out}/drive.sfs --model fisheye"),
    # read only, or files of one trajectory
    _command("from_euroc_mav", "convert {inputs}/MH_01 {out}/drive.sfs"),
    _command("from_rig", "convert {inputs}/rig {out}/drive.sfs"),
    _command("from_pandaset", "convert {inputs}/pandaset {out}/drive.sfs"),
    _command("to_jsonl", "convert {to_tum}/drive.tum {out}/drive.jsonl"),
    _command("from_jsonl", "convert {to_jsonl}/drive.jsonl {out}/drive.tum"),
    _command("from_kitti_lines", "convert {to_kitti_lines}/drive.kitti {out}/drive.tum --from-rate 10"),
    _command("from_euroc_lines", "convert {to_euroc_lines}/drive.csv {out}/drive.tum --from-form euroc"),
    _command("from_csv", "convert {to_csv}/drive.csv {out}/drive.tum --from-form csv"),
    _command("from_gnss", "convert {to_gnss}/fixes.csv {out}/drive.csv --from-form gnss --to csv"),
    *(
        _command(f"info_{name}", f"info {{data}}/real/strangers/{path}")
        for name, path in (
            ("mcap", "mcap/custom-camera-model.mcap"),
            ("ros1", "ros1_bags/test1.bag"),
            ("ros1_lidar", "ros1_bags/tilt_laser.bag"),
            ("ros2_lidar", "hesai_bag/xt32m"),
            ("pcd", "pcd/lidar.pcd"),
            ("openlabel", "openlabel/uai/openlabel100_example_cuboids.json"),
        )
    ),
    _command("info_euroc_mav", "info {inputs}/MH_01"),
    _command("info_drive", "info {inputs}/drive.sfs"),
    _command("fields_of_sfs", "formats sfs"),
    _command("template", "formats --template {out}/rig.toml --from {inputs}/rig"),
    _command("doctor", "doctor"),
    *(_command(f"completion_{shell}", f"completion {shell}") for shell in ("bash", "zsh", "fish")),
    # broken, and repaired
    _command("salvage", "salvage {inputs}/cut.sfs -o {out}/drive.sfs"),
    _command("validate_cut", "validate {inputs}/cut.sfs"),
    _command("validate_drive", "validate {inputs}/drive.sfs --strict"),
    _command("validate_scale", "validate {inputs}/drive.sfs --profile scale --fix {out}/drive.sfs"),
    _command("no_such_file", "info {inputs}/nothing.sfs"),
    _command("no_such_option", "info {inputs}/drive.sfs --nothing"),
    _command("no_such_format", "convert {inputs}/drive.sfs {out}/drive --to nothing"),
    # what detectors found in a drive
    _command(
        "fuse_boxes",
        "fuse {inputs}/drive.sfs --type detection --boxes3d {inputs}/boxes3d.jsonl"
        " --boxes2d {inputs}/boxes2d.jsonl -o {out}/objects.jsonl",
    ),
    _command("track_boxes", "track {inputs}/drive.sfs --boxes3d {inputs}/boxes3d.jsonl -o {out}/tracks.sfs --offline"),
    _command("fuse_drive", "fuse {inputs}/drive.sfs -o {out}/drive.sfs --algorithm blending --visualize {out}/drawn"),
    _command("fuse_gnss", "fuse {inputs}/drive.sfs -o {out}/drive.sfs --trajectory gnss"),
    # many drives
    _command("batch", f"batch convert {_KITTI} {_PANDASET} -o {{out}}/all --to mcap {_SHORT}"),
    _command("batch_fuse", f"batch fuse {_KITTI} {{inputs}}/drive.sfs -o {{out}}/all {_SHORT} --trajectory identity"),
    _command("batch_validate", "batch validate {inputs}/drive.sfs {inputs}/cut.sfs -o {out}/all"),
    _command("batch_track", "batch track {data}/real/kitti_tracking -o {out}/all --sequence 0012"),
    _command("batch_report", "batch report {inputs}/drive.sfs -o {out}/all --quick"),
    _command("batch_status", "batch status {batch}/all"),
    _command("catalog", "catalog build {to_sfs}/drive.sfs {inputs}/drive.sfs -o {out}/catalogue"),
    _command("catalog_query", "catalog query {catalog}/catalogue --label car"),
    _command(
        "catalog_update", "catalog build {to_sfs}/drive.sfs -o {out}/all && catalog update {out}/all {inputs}/drive.sfs"
    ),
    # the service
    _command("conformance", "conformance {address}"),
    _command(
        "send_and_get",
        "send {inputs}/drive.sfs {address} --rate 0 --session one"
        " && get {address} --type sensor -o {out}/sensor --session one --count 4 --wait 60"
        " && get {address} --type detection -o {out}/objects.jsonl --session one --wait 20",
    ),
)
