"""The commands whose outputs make up the snapshot of behaviour: every verb, every format in both directions.

Options are named as the snapshot was recorded with them; `RENAMED_OPTIONS` says what they are called since. `{data}`
is the folder of real data, `{out}` the command's own folder, `{NAME}` the output folder of an earlier command.
"""

from dataclasses import dataclass

RENAMED_OPTIONS: dict[str, str] = {}
"""Options and verbs by the names that the snapshot was recorded with, and what they are called now."""

RENAMED_FIELDS: dict[str, str] = {}
"""Fields of `--json`, and of what is written as JSON, by the names of the snapshot, and what they are called now."""


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
    _command("demo", "demo --keep {out}/kept --frames 6"),
    _command("fuse_kitti", f"fuse {_KITTI} -o {{out}}/drive.sfs --trajectory lidar"),
    _command(
        "fuse_pandaset", f"fuse {_PANDASET} -o {{out}}/drive.sfs --start 0 --stop 1 --depth {{out}}/depth"
    ),
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
    _command("to_kitti_object", "convert {demo}/kept/demo.sfs {out}/drive --to kitti-object"),
    _command("to_kitti_tracking", "convert {demo}/kept/demo.sfs {out}/drive --to kitti-tracking"),
    _command("to_kitti_odometry", "convert {to_sfs}/drive.sfs {out}/drive --to kitti-odometry"),
    _command("to_nuscenes", "convert {demo}/kept/demo.sfs {out}/drive --to nuscenes"),
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
    _command("to_gnss", "convert {data}/recordings/kitti_oxts_0000 {out}/fixes.csv --to gnss"),
    _command("oxts_smoothed", "convert {data}/recordings/kitti_oxts_0000 {out}/drive.tum --trajectory gnss"),
    *(
        _command(f"from_{name}", f"convert {{to_{name}}}/{place} {{out}}/drive.sfs {more}".strip())
        for name, place, more in (
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
            ("kitti_bin", "drive", "--read-as kitti-bin"),
            ("nuscenes_bin", "drive", "--read-as nuscenes-bin"),
            ("npz", "drive", ""),
        )
    ),
    _command(
        "from_argoverse2",
        "convert {data}/real/argoverse2/7fab2350-7eaf-3b7e-a39d-6937a4c1bede {out}/drive.sfs",
    ),
    _command("from_scale_toolkit", "convert {data}/real/pandaset_scale_sample {out}/drive.sfs"),
    _command("from_kitti", "convert {data}/real/kitti_object {out}/drive.sfs"),
    # fused, coloured, followed, drawn
    _command("colour", f"colour {_PANDASET} -o {{out}}/map.ply {_SHORT} --voxel 0.2"),
    _command("colour_sweeps", "colour {to_sfs}/drive.sfs -o {out}/drive.sfs --per-sweep"),
    _command("depth", "depth {to_sfs}/drive.sfs -o {out}/depth"),
    _command("depth_dense", "depth {to_sfs}/drive.sfs -o {out}/depth --method fast --form npz"),
    _command("track", f"track {_TRACKING} -o {{out}}/results"),
    _command("track_offline", f"track {_TRACKING} -o {{out}}/results --offline"),
    _command("fuse_detections", f"fuse {_TRACKING} --type detection -o {{out}}/fused"),
    _command("view", "view {to_sfs}/drive.sfs --save {out}/drive.rrd"),
    _command("report", "report {to_sfs}/drive.sfs -o {out}/page.html --numbers {out}/numbers.json --quick"),
    # edited
    _command("edit_deskew", "edit deskew {to_sfs}/drive.sfs -o {out}/drive.sfs"),
    _command("edit_crop", "edit crop {to_sfs}/drive.sfs -o {out}/drive.sfs --range 30"),
    _command("edit_thin", "edit thin {to_sfs}/drive.sfs -o {out}/drive.sfs --voxel 0.5"),
    _command(
        "edit_merge", "edit merge {edit_crop}/drive.sfs {edit_thin}/drive.sfs -o {out}/drive.sfs --rename"
    ),
    _command("edit_to_world", "edit to-world {demo}/kept/demo.sfs -o {out}/drive.sfs"),
    _command("edit_to_ego", "edit to-ego {edit_to_world}/drive.sfs -o {out}/drive.sfs"),
    _command("edit_count", f"edit count {_ARGOVERSE} -o {{out}}/drive.sfs"),
    _command("edit_project", "edit project {demo}/kept/demo.sfs -o {out}/drive.sfs"),
    _command("edit_simplify", "edit simplify {to_sfs}/drive.sfs -o {out}/drive.sfs"),
    _command("edit_blur", "edit blur {edit_project}/drive.sfs -o {out}/drive.sfs --label car"),
    _command("edit_relative", "edit relative {to_sfs}/drive.sfs -o {out}/drive.sfs"),
    _command("edit_undistort", "edit undistort {to_sfs}/drive.sfs -o {out}/drive.sfs"),
    # judged
    _command("eval_trajectory", "eval trajectory {to_tum}/drive.tum {to_csv}/drive.csv"),
    _command(
        "eval_detection",
        "eval detection {fuse_detections}/fused {data}/real/kitti_tracking/label_02 --sequence 0012",
    ),
    _command(
        "eval_tracking", "eval tracking {track}/results {data}/real/kitti_tracking/label_02 --sequence 0012"
    ),
    _command("sync", f"sync {_PANDASET}"),
    _command("calibrate", f"calibrate {_KITTI} --check"),
    # many drives
    _command("batch", f"batch convert {_KITTI} {_PANDASET} -o {{out}}/all --to mcap {_SHORT}"),
    _command("catalog", "catalog build {to_sfs}/drive.sfs {demo}/kept/demo.sfs -o {out}/catalogue"),
    _command("catalog_query", "catalog query {catalog}/catalogue --label car"),
    # the service is checked by the conformance kit against itself
    _command("conformance", "conformance"),
)
