"""Measurement of the extraction time of Argoverse 2 ground truth, for results/speed.md."""

import resource
import time
from collections.abc import Callable
from pathlib import Path

from mapdata.argoverse2.log import Argoverse2Log, find_logs
from mapdata.argoverse2.map import MAP_CLASSES, Argoverse2Map

# Classes that are extracted together, by the name of the set in the results. The order of
# MAP_CLASSES is divider, ped_crossing, boundary, centerline.
_SETS = {
    "divider": MAP_CLASSES[:1],
    "ped_crossing": MAP_CLASSES[1:2],
    "boundary": MAP_CLASSES[2:3],
    "centerline": MAP_CLASSES[3:],
    "three_classes": MAP_CLASSES[:3],
    "with_centerline": MAP_CLASSES,
}


def measure_extraction(root: Path, split: str = "val", stride: int = 10) -> dict[str, float]:
    """Measure the processor time of the extraction at every N-th pose of the logs of a split.

    Args:
        root: Root folder of the data set.
        split: Split of the logs.
        stride: Step N between the measured poses of a log, >= 1.

    Returns:
        Figures by name: milliseconds per frame for each set of classes, milliseconds per log for
        the preparation of its map, the number of frames, and the largest resident memory of the
        process in MB.
    """
    log_dirs = find_logs(root, split)
    start = time.process_time()
    maps = [Argoverse2Map.from_log(log_dir) for log_dir in log_dirs]
    preparation_s = time.process_time() - start
    frames = []  # pairs: map of the log, and transform (4, 4) from the vehicle to this map
    for log_map, log_dir in zip(maps, log_dirs, strict=True):
        poses = list(Argoverse2Log(log_dir).poses.values())
        for pose in poses[::stride]:
            frames.append((log_map, pose))

    def ms_per_frame(extract: Callable[..., object]) -> float:
        """Processor time of an extraction, averaged over the frames. Its result is not used."""
        start = time.process_time()
        for log_map, pose in frames:
            extract(log_map, pose)
        return 1e3 * (time.process_time() - start) / len(frames)

    result = {}
    for name, classes in _SETS.items():
        # `c=classes` binds the classes of this iteration.
        result[f"default_{name}_ms"] = ms_per_frame(lambda m, pose, c=classes: m.extract(pose, c))
    # The figures above are for the default rules of this project. MapTR has other rules.
    result["maptr_three_classes_ms"] = ms_per_frame(lambda m, pose: m.extract(pose, compat="maptr"))
    result["preparation_ms_per_log"] = 1e3 * preparation_s / len(maps)
    result["frames"] = len(frames)
    # Linux gives the resident memory in units of 1024 bytes.
    result["max_rss_mb"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return result
