"""Reading of samples from any input, with the reader that suits the file or folder."""

from pathlib import Path

from gsmap.datasets.source import Source, open_annotations
from gsmap.utils.errors import InputError
from gsmap.utils.files import is_hidden
from mapdata.argoverse2.log import logs_in
from mapdata.argoverse2.samples import read_logs
from mapdata.bag_files import is_bag, parts_in, suffix_advice
from mapdata.bags import read_bag
from mapdata.folders.calibration_file import NAMES as CALIBRATION_NAMES
from mapdata.folders.images import read_image_folder
from mapdata.infos.recordings import read_info_file
from mapdata.nuscenes.tables import read_nuscenes, versions_in
from mapdata.options import InputOptions

_FILES = ("*.arrow", "*.pkl")
KINDS = (
    "an annotation file (.arrow), an info file of mmdet3d (.pkl), a nuScenes-format root, "
    "Argoverse 2 logs, a folder of images with calibration.yaml or calibration.json, a bag of ROS "
    "(.bag, .mcap, .db3, a folder of rosbag2 or of the parts of one recording)"
)


def open_input(path: str | Path, options: InputOptions | None = None) -> Source:
    """Read the samples of an input.

    Args:
        path: An annotation file, an info file of mmdet3d, a nuScenes-format root, an Argoverse 2
            log or a folder with logs, a folder of images with a calibration file (or the
            calibration file), a bag, or a folder with just one annotation or info file.
        options: Options of the readers; None takes the defaults.

    Returns:
        The samples.

    Raises:
        FileNotFoundError: If the input, or a file that the input names, does not exist, or if a
            folder contains no input.
        ValueError: If the path is no such input, or the input is damaged. The message contains the
            reason.
    """
    path = Path(path)
    options = options or InputOptions()
    if not path.exists():
        raise FileNotFoundError(f"There is no input {path}.")
    if is_bag(path):
        return read_bag(path, options)
    if path.is_dir():
        return _open_folder(path, options)
    _refuse_bag_options(path, options)
    if path.suffix == ".arrow":
        return open_annotations(path, options.data_root)
    if path.suffix == ".pkl":
        root = options.data_root or path.parent
        samples = read_info_file(path, root, allow_missing_cameras=options.allow_missing_cameras)
        return Source(samples, frame="lidar", data_root=root)
    if path.suffix in (".yaml", ".yml", ".json"):  # a calibration file
        # `options.trained` has the image sizes and intrinsics of the cameras that a model was
        # trained on. Images of distorted cameras are rectified to them.
        return read_image_folder(path, frames_dir=options.frames_dir, trained=options.trained)
    advice = suffix_advice(path)  # for a file that is probably a bag, such as a packed one
    if advice:
        raise InputError(f"{path} cannot be used: {advice}.")
    raise InputError(f"{path} is no input: it must be {KINDS}.")


def _refuse_bag_options(path: Path, options: InputOptions) -> None:
    """Raise a ``ValueError`` if an input that is no bag has options for bags."""
    if options.topics or options.calibration or options.vehicle_frame:
        raise InputError(
            f"--topics, --calibration and --vehicle-frame belong to a bag, and {path} is none."
        )
    if options.vehicle_ground_z_m is not None:
        raise InputError(
            f"--vehicle-ground-z belongs to a bag, and {path} is none: the height of the road is "
            "ground_z_m of a calibration file, or of an annotation file's AnnotationMeta."
        )


def _open_folder(folder: Path, options: InputOptions) -> Source:
    """Read the samples of a folder, with the reader for its content.

    The first kind of input that is found is read, and bags come last. So a data set or a
    calibration file may lie beside its bags.
    """
    if versions_in(folder):  # tables of nuScenes
        _refuse_bag_options(folder, options)
        samples, notes = read_nuscenes(folder, options.version)
        return Source(samples, frame="lidar", data_root=folder, notes=notes)
    logs = logs_in(folder)  # logs of Argoverse 2
    if logs:
        _refuse_bag_options(folder, options)
        # The paths of the samples are relative to the root and begin with the name of a log. So the
        # root is above the log if the folder is a log itself.
        root = folder.parent if logs == [folder] else folder
        samples, left_out = read_logs(logs, root, rate_hz=options.rate_hz)
        log_notes = []
        for reason, count in left_out.items():  # logs and samples that are left out, by reason
            log_notes.append(f"{len(samples)} samples used, left out: {count} for {reason}")
        return Source(samples, frame="ego", data_root=root, notes=tuple(log_notes))
    # The calibration files of the folder or, without any, its annotation and info files.
    files = [folder / name for name in CALIBRATION_NAMES if (folder / name).is_file()]
    if not files:
        for pattern in _FILES:
            files += [path for path in folder.glob(pattern) if not is_hidden(path)]
        files.sort()
    if len(files) == 1:
        return open_input(files[0], options)
    if files:
        names = ", ".join(path.name for path in files)
        raise InputError(f"{folder} holds several files ({names}): name one of them.")
    if parts_in(folder):
        return read_bag(folder, options)
    raise FileNotFoundError(f"{folder} holds no input: it must be {KINDS}.")
