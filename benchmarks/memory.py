"""Memory of the nuScenes conversion as a function of the size of the data set."""

import json
import resource
import tempfile
from pathlib import Path
from typing import Any

from benchmarks.measure import in_own_process
from mapdata.nuscenes.convert import NuScenesOptions, convert_nuscenes

TRAINVAL_SAMPLES = 34_149  # samples of nuScenes trainval, train and val together
# Tables that are repeated, each with the fields that refer to other records. The remaining tables,
# such as the sensors, are written once.
_REFERENCES = {
    "sample": ("scene_token", "prev", "next"),
    "sample_data": ("sample_token", "ego_pose_token", "prev", "next"),
    "ego_pose": (),
    "scene": ("first_sample_token", "last_sample_token"),
}
_SWEEPS_PER_SAMPLE = 9


def tile_tables(source: Path, version: str, target: Path, copies: int) -> int:
    """Write a data root whose tables repeat the scenes of another one, without sensor files.

    Each key frame of the LiDAR gets nine sweeps before it, as in nuScenes. All scenes belong to the
    split ``train``.

    Args:
        source: Data root to repeat.
        version: Version folder of the data root.
        target: Data root to write; its version folder must not exist.
        copies: Number of repetitions, >= 1.

    Returns:
        Number of samples.
    """
    (target / version).mkdir(parents=True)
    (target / "maps").symlink_to((source / "maps").resolve())
    tables = {path.stem: json.loads(path.read_text()) for path in (source / version).glob("*.json")}
    for name, references in _REFERENCES.items():
        records = []
        for copy in range(copies):
            for record in tables[name]:
                records.append(_rename(record, references, copy))
        tables[name] = records
    _add_sweeps(tables)
    for name, records in tables.items():
        (target / version / f"{name}.json").write_text(json.dumps(records))
    # The conversion reads the splits from this file instead of using the official ones.
    scene_names = [scene["name"] for scene in tables["scene"]]
    (target / version / "splits.json").write_text(json.dumps({"train": scene_names}))
    return len(tables["sample"])


def _rename(record: dict[str, Any], references: tuple[str, ...], copy: int) -> dict[str, Any]:
    """Copy a record, and append the number of the copy to its token, name and references."""
    renamed = dict(record, token=f"{record['token']}_{copy}")
    if "name" in record:
        renamed["name"] = f"{record['name']}_{copy}"
    for key in references:
        if record[key]:  # `prev` and `next` are empty at the ends of a scene
            renamed[key] = f"{record[key]}_{copy}"
    return renamed


def _add_sweeps(tables: dict[str, list[dict[str, Any]]]) -> None:
    """Add sweeps before each key frame of the LiDAR, in place.

    Only the links ``prev`` are set, because the conversion follows only these links to the sweeps.
    """
    poses = {pose["token"]: pose for pose in tables["ego_pose"]}
    sweeps = []
    for record in tables["sample_data"]:
        # The record has no name of the sensor, but the path of its file contains the name.
        if "LIDAR_TOP" not in record["filename"] or not record["is_key_frame"]:
            continue
        previous_token = record["prev"]
        for number in range(_SWEEPS_PER_SAMPLE):
            token = f"{record['token']}_s{number}"
            sweep = dict(record, token=token, is_key_frame=False, prev=previous_token)
            sweep["ego_pose_token"] = f"{record['ego_pose_token']}_s{number}"
            pose = dict(poses[record["ego_pose_token"]], token=sweep["ego_pose_token"])
            tables["ego_pose"].append(pose)
            sweeps.append(sweep)
            previous_token = token
        record["prev"] = previous_token
    tables["sample_data"] += sweeps


def peak_of_conversion(root: Path, version: str, out_dir: Path) -> float:
    """Convert a data root, and measure the peak memory of this process.

    Args:
        root: Data root.
        version: Version folder of the data root.
        out_dir: Output folder.

    Returns:
        Peak memory of this process in MB.
    """
    convert_nuscenes(NuScenesOptions(root, version, out_dir=out_dir))
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024  # Linux gives kB


def measure_memory(root: Path, version: str, copies: tuple[int, int]) -> dict[str, float]:
    """Measure the peak memory of the conversion at two sizes and extrapolate to nuScenes trainval.

    Args:
        root: Data root to repeat.
        version: Version folder of the data root.
        copies: Number of repetitions at the small and at the large size; the second is larger.

    Returns:
        Sizes, peaks in MB, growth in kB per sample, and the peak extrapolated to 34,149 samples in
        MB.
    """
    samples = []
    peaks = []
    for number in copies:
        with tempfile.TemporaryDirectory() as folder:
            target = Path(folder, "root")
            samples.append(tile_tables(root, version, target=target, copies=number))
            out = Path(folder, "out")
            # The peak of a process never falls, so each size is measured in a fresh process.
            peaks.append(in_own_process(peak_of_conversion, target, version, out))
    # In MB per sample.
    growth = (peaks[1] - peaks[0]) / (samples[1] - samples[0])
    return {
        "samples_small": samples[0],
        "samples_large": samples[1],
        "peak_small_mb": peaks[0],
        "peak_large_mb": peaks[1],
        "growth_kb_per_sample": 1024 * growth,
        "trainval_mb": peaks[1] + growth * (TRAINVAL_SAMPLES - samples[1]),
    }
