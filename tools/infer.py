#!/usr/bin/env python
"""Run a trained model on recordings without ground truth; write and draw its predictions.

Example: ``python tools/infer.py INPUT --model gsmap_r18_minicity --out map.json --show-dir
pictures``, or ``--model CONFIG CHECKPOINT``. INPUT is an annotation file (.arrow), an info file of
mmdet3d (.pkl), a nuScenes-format root, an Argoverse 2 log or a folder of logs, a folder of images
with calibration.yaml, or a bag of ROS 1 or 2 (docs/inference.md).
"""

import argparse
import hashlib
import json
import sys
from collections.abc import Collection, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, nullcontext, suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from gsmap.apis.result_log import ResultLog
from gsmap.checkpoints.named_models import checkpoint_for
from gsmap.datasets.annotations.file import AnnotationFile
from gsmap.datasets.pose_plausibility import pose_warnings
from gsmap.datasets.source import Mount, Source, frame_from_mount
from gsmap.engine.arguments import add_config_options
from gsmap.evaluation.core.results_json import SHARD_KIND as RESULTS
from gsmap.evaluation.core.results_json import vectors_of
from gsmap.utils.cli import CommandParser, output_file, run_command
from gsmap.utils.errors import InputError
from gsmap.utils.files import register_folder, write_bytes
from gsmap.utils.model_facts import CALIBRATION, CHECKPOINT, PRIORS
from gsmap.utils.progress import Progress
from gsmap.utils.ray_shards import run_on_ray
from gsmap.utils.shards import add_shard_options, digest
from gsmap.utils.split_lists import SPLIT_LIST, TRAINED_ON
from gsmap.utils.words import format_count
from gsmap.visualization.figure import FORMATS, sample_name, save_figure
from mapdata.bag_topics import parse_topics
from mapdata.calibration_check import (
    calibration_figure,
    calibration_warnings,
    first_samples,
    image_warnings,
)
from mapdata.command_line import parse_rate
from mapdata.inputs import open_input
from mapdata.options import InputOptions

if TYPE_CHECKING:  # slow to import
    import numpy as np
    from mmdet3d.structures import Det3DDataSample
    from mmengine.config import Config

    from gsmap import MapInferencer
    from gsmap.apis.frame_loader import BrokenFrame
    from gsmap.datasets.vectorized_map_dataset import VectorizedMapDataset
    from gsmap.prior.opening import AnyPrior

_ONE_SAMPLE_HZ = 1e-4  # at this rate, only one sample of each drive is read
_SAMPLES_SUFFIX = ".arrow"  # the annotation file of the samples is named like --out, but with this
SKIPPED = 1  # exit code after broken frames, which are samples with a missing or damaged file
IMPLAUSIBLE = 1  # exit code for an implausible calibration


def parse_args(argv: list[str] | None = None) -> argparse.Namespace:
    parser = CommandParser(description=__doc__)
    parser.add_argument("input", type=Path, help="recording to run on")
    parser.add_argument(
        "--model",
        nargs="+",
        metavar=("NAME_OR_CONFIG", "CHECKPOINT"),
        help="name of a trained model, or config and checkpoint",
    )
    parser.add_argument("--out", type=output_file, help="JSON file for the predictions")
    parser.add_argument("--show-dir", type=Path, help="folder for pictures")
    parser.add_argument(
        "--check-calibration",
        type=output_file,
        metavar="FILE.png",
        help="judge the calibration, draw the ground plane over the first images, and end",
    )
    parser.add_argument("--token", nargs="+", help="tokens of the samples to run; all by default")
    parser.add_argument("--max-samples", type=int, help="run this many samples, evenly spread")
    _add_input_options(parser)
    _add_prior_options(parser)
    _add_running_options(parser)
    _add_picture_options(parser)
    add_shard_options(parser)
    args = parser.parse_args(argv)
    if not args.model and not args.check_calibration:
        parser.error("the following arguments are required: --model")
    if args.out and args.out.suffix == _SAMPLES_SUFFIX:
        parser.error(
            f"--out names a JSON file, the samples go to a {_SAMPLES_SUFFIX}: got {args.out}"
        )
    if args.ground_z is not None and not args.show_dir:
        parser.error("--ground-z is for pictures: give --show-dir, too, or leave it out")
    if args.update_prior and not args.prior:
        parser.error("--update-prior changes the file of --prior: give it, too")
    if args.model and len(args.model) > 2:
        parser.error(f"--model takes a name, or a config and a checkpoint, got {args.model}")
    return args


def _add_input_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the recording."""
    group = parser.add_argument_group("input")
    group.add_argument("--version", help="version folder of a nuScenes-format root")
    group.add_argument(
        "--rate",
        type=parse_rate,
        default=2.0,
        help="samples per second of Argoverse 2 logs and bags, or all (default: %(default)s)",
    )
    group.add_argument("--vehicle-frame", help="the vehicle's frame in a bag, such as base_link")
    group.add_argument(
        "--vehicle-ground-z",
        type=float,
        help="height of the road in the vehicle's frame, in metres (default: 0)",
    )
    group.add_argument(
        "--topics",
        nargs="+",
        default=(),
        metavar="NAME=IMAGES,INFO",
        help="a bag's cameras: topics of their images and camera info (default: by their names)",
    )
    group.add_argument(
        "--calibration",
        type=Path,
        metavar="FILE.yaml",
        help="calibration of a bag's cameras, in place of camera info and transforms",
    )
    group.add_argument(
        "--allow-missing-cameras", action="store_true", help="leave absent cameras blank"
    )


def _add_prior_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the priors."""
    group = parser.add_argument_group("map of earlier drives, for a model that reads it")
    group.add_argument(
        "--prior", nargs="+", type=Path, default=[], metavar="FILE", help="maps, one for each place"
    )
    group.add_argument(
        "--update-prior",
        action="store_true",
        help="write the predictions to the maps of --prior; a FILE that does not exist is created",
    )


def _add_running_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the device and of the model."""
    group = parser.add_argument_group("running")
    group.add_argument(
        "--device",
        nargs="+",
        help="cpu, cuda, or several, cuda:0 cuda:1; a GPU by default if there is one",
    )
    group.add_argument("--batch-size", type=int, default=1, help="samples per forward pass")
    group.add_argument("--workers", type=int, default=0, help="processes that read images")
    group.add_argument("--amp", action="store_true", help="mixed precision")
    group.add_argument(
        "--cuda-graphs",
        action=argparse.BooleanOptionalAction,
        help="on a GPU, record the launches of a frame once and replay them",
    )
    add_config_options(parser)


def _add_picture_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the pictures."""
    group = parser.add_argument_group("pictures")
    group.add_argument("--format", default="png", choices=FORMATS)
    group.add_argument("--order", action="store_true", help="mark start and direction of elements")
    group.add_argument("--score-thr", type=float, help="smallest drawn score")
    group.add_argument(
        "--ground-z", type=float, help="height of a level ground in the frame, in metres"
    )
    group.add_argument("--width", type=int, help="width of the pictures in pixels")
    group.add_argument("--lidar", action="store_true", help="draw the LiDAR sweep faintly")


def _trained_cameras(args: argparse.Namespace) -> dict[str, tuple[float, ...]]:
    """Cameras that the model was trained with, by name.

    Returns:
        Width, height, fx, fy, cx and cy in pixels for each camera. Empty without ``--model``, or if
        the checkpoint lacks them.
    """
    if not args.model:
        return {}
    from gsmap.apis.loading import trained_rig
    from gsmap.checkpoints.reading import read_checked

    return trained_rig(read_checked(chosen_checkpoint(args)))


def chosen_checkpoint(args: argparse.Namespace) -> Path:
    """File with the weights of the model."""
    checkpoint = args.model[1] if len(args.model) > 1 else None
    return checkpoint_for(args.model[0], checkpoint)


def read_input(args: argparse.Namespace, frames: Path | None = None) -> Source:
    """Open the input and print the notes of its reader.

    Args:
        args: The options of the command.
        frames: Folder for images that the reader writes, such as the images of a bag. If it is
            given, a single sample of each drive is read. If it is None, samples are read at
            ``--rate``, and images are written to a folder beside the output.

    Returns:
        The samples of the input, in an `AnnotationFile` if the input is one.

    Raises:
        ValueError: If the input is not a recording.
    """
    rate_hz = _ONE_SAMPLE_HZ
    if frames is None:
        rate_hz = args.rate
        stem_without_out = (args.show_dir or Path()) / "input"
        stem = args.out.with_suffix("") if args.out else stem_without_out
        # A registered folder must not contain links that would lead files out of it.
        frames = register_folder(stem.with_name(f"{stem.name}_frames"))
    options = InputOptions(
        data_root=args.data_root,
        allow_missing_cameras=args.allow_missing_cameras,
        version=args.version,
        rate_hz=rate_hz,
        frames_dir=frames,
        vehicle_frame=args.vehicle_frame,
        vehicle_ground_z_m=args.vehicle_ground_z,
        topics=parse_topics(args.topics),
        calibration=args.calibration,
        trained=_trained_cameras(args),  # images of distorted cameras are rectified to these
    )
    source = open_input(args.input, options)
    for note in source.notes:
        print(note)
    if not source.has_poses:
        print("no pose is known: single frames only, no map of the drive")
    return source


def require_own_samples(path: Path) -> None:
    """Check that an annotation file does not exist, or is from an earlier run of this command.

    Raises:
        ValueError: If the file exists and was not written by this command.
    """
    from gsmap.apis.input_dataset import INFERENCE_COMMAND

    if not path.exists():
        return
    with suppress(ValueError):  # a file that is not an annotation file is refused below
        if AnnotationFile(path).meta.command == INFERENCE_COMMAND:
            return
    raise InputError(
        f"{path} is there, and not from an earlier run of this command, which writes the samples "
        "of its input to a file of this name: give another --out."
    )


def check_calibration(args: argparse.Namespace, source: Source) -> list[str]:
    """Print warnings about implausible properties of the cameras, and about the poses.

    With ``--check-calibration``, also draw the ground plane over the images of the first drive.

    Returns:
        The warnings about the cameras.
    """
    samples = first_samples(source.samples)
    root = source.data_root or Path()
    warnings = calibration_warnings(samples, source.frame, source.ground_z_m)
    for sample in samples:
        warnings += image_warnings(sample, root)
    warnings = list(dict.fromkeys(warnings))  # drives of one vehicle have equal ones
    for line in warnings:
        print(f"calibration: {line}")
    if source.has_poses:
        for line in pose_warnings(source.samples, source.frame):
            print(f"poses: {line}")
    if args.check_calibration:
        figure = calibration_figure(samples[0], source.frame, root, source.ground_z_m)
        path = save_figure(figure, args.check_calibration)
        number = format_count(len(warnings), "warning")
        print(f"{number}; the ground plane as the cameras should see it: {path}")
    return warnings


def open_model(args: argparse.Namespace) -> "MapInferencer":
    """Load the model and set the options of its pictures."""
    from gsmap import MapInferencer

    inferencer = MapInferencer(
        args.model[0],
        chosen_checkpoint(args),
        device=args.device,
        cfg_options=args.cfg_options,
        amp=args.amp,
        cuda_graphs=args.cuda_graphs,
    )
    visualizer = inferencer.visualizer
    visualizer.show_order = args.order
    if args.ground_z is not None:
        visualizer.ground_z_m = args.ground_z
    if args.width is not None:
        visualizer.width_px = args.width
    return inferencer


def result_header(
    args: argparse.Namespace, data: dict[str, Any], priors: Sequence[Mapping[str, Any]] = ()
) -> dict[str, Any]:
    """Header of the result file: classes, model and, if known, calibration and lists of scenes.

    Args:
        args: The options of the command.
        data: Meta information of the data set.
        priors: Facts of the maps of earlier drives (`describe_priors`).
    """
    from gsmap.checkpoints.reading import read_checked

    path = chosen_checkpoint(args)
    checkpoint = read_checked(path)
    header = {"classes": list(data["classes"]), CHECKPOINT: digest(path)}
    # The calibration relates the sizes of predicted Gaussians to the errors of their positions.
    optional: dict[str, Any] = {CALIBRATION: checkpoint.calibration, PRIORS: priors}
    # Lists by which scenes were split: of these samples, and of the training data of the model.
    if split_list := data.get(SPLIT_LIST):
        optional[SPLIT_LIST] = split_list
        optional[TRAINED_ON] = checkpoint.list_of(data["dataset"])
    for key, value in optional.items():
        if value:
            header[key] = value
    return header


def run_settings(args: argparse.Namespace, cfg: "Config") -> dict[str, str]:
    """Settings of the command that determine the predictions of a sample, by name.

    Args:
        args: The options of the command.
        cfg: Config of the model. It is included with its base files, because any of them can be
            changed between two runs.
    """
    from gsmap.checkpoints.settings import plain  # slow to import

    checkpoint = chosen_checkpoint(args)
    # Paths differ between machines, and the samples have a digest of their own.
    dataset = dict(cfg.test_dataloader.dataset)
    for name in ("ann_file", "data_root", "data_prefix"):
        dataset.pop(name, None)
    used = plain([cfg.model, dataset])
    settings = {
        "model": args.model[0],
        "config": hashlib.sha256(json.dumps(used, sort_keys=True).encode()).hexdigest(),
        "checkpoint": digest(checkpoint),
    }
    for name in ("cfg_options", "token", "max_samples", "allow_missing_cameras", "amp"):
        settings[name] = str(getattr(args, name))
    if args.update_prior:
        settings["update_prior"] = "True"
    for path in args.prior:
        settings[f"prior {path.resolve()}"] = digest(path) if path.exists() else "new"
    return settings


def needed_samples(
    args: argparse.Namespace,
    dataset: "VectorizedMapDataset",
    chosen: Sequence[int],
    done: Collection[str],
) -> list[int]:
    """Samples that an earlier run has not predicted, or of which a picture is missing.

    Args:
        args: The options of the command.
        dataset: The samples.
        chosen: Indices of the samples to predict.
        done: Tokens of the samples that an earlier run has predicted.
    """
    tokens = dataset.annotations.column("token")
    scenes = dataset.annotations.column("scene")
    needed = []
    for index in chosen:
        is_done = tokens[index] in done
        if is_done and args.show_dir:
            metainfo = {
                "token": tokens[index],
                "scene": scenes[index],
                "seconds": dataset.annotations.seconds_into_scene[index],
            }
            is_done = (args.show_dir / sample_name(metainfo, f".{args.format}")).is_file()
        if not is_done:
            needed.append(index)
    return needed


def open_log(
    args: argparse.Namespace,
    settings: dict[str, str],
    tokens: list[str],
    classes: Sequence[str],
) -> AbstractContextManager[ResultLog | None]:
    """Open the log of the predictions of this run. Without ``--out``, the context returns None.

    The log is a file beside ``--out`` with one line per sample. An interrupted run goes on from it.

    Args:
        args: The options of the command.
        settings: Settings and input that determine the predictions. If they equal the settings of
            an earlier run, its predictions are used.
        tokens: Tokens of the samples to predict, in their order.
        classes: Names of the classes.
    """
    if not args.out:
        return nullcontext()
    return ResultLog(args.shard.path_of(args.out), settings, tokens=tokens, classes=classes)


def predict(
    args: argparse.Namespace,
    inferencer: "MapInferencer",
    dataset: "VectorizedMapDataset",
    chosen: list[int],
    results: ResultLog | None,
    priors: Sequence["AnyPrior"],
    input_from_model: "Mapping[str, np.ndarray]",
) -> dict[str, str]:
    """Predict samples, draw them and log the predictions.

    Args:
        args: The options of the command.
        inferencer: The model.
        dataset: The samples.
        chosen: Indices of the samples to predict.
        results: Log of the predictions; None without ``--out``.
        priors: Maps of earlier drives.
        input_from_model: Transforms of the predictions that are logged, by token
            (`transforms_to_input`).

    Returns:
        The reason for each broken frame, by the token of its sample.
    """
    broken: dict[str, str] = {}
    # Predicted samples of an earlier run. A copy, because the log adds to its set.
    done = set(results.done) if results else set()
    with Progress(total=len(chosen), unit="samples", smoothing=0.05) as bar:
        if results and results.dropped:
            bar.write(
                f"{results.path} had {format_count(results.dropped, 'sample')} of a run with other "
                "settings, which are not used"
            )
        if results and done:
            bar.write(f"going on after {len(done)} of {format_count(len(chosen), 'sample')}")
            # A model that uses earlier frames must process all of them again. Their predictions are
            # not logged a second time.
            # Neither are those of samples whose pictures are missing.
            if not remembers(inferencer):
                needed = needed_samples(args, dataset, chosen, done)
                bar.update(len(chosen) - len(needed))
                chosen = needed

        def skip(frame: "BrokenFrame") -> None:
            """Record a broken frame, which the model does not predict."""
            broken[frame.token] = frame.reason
            bar.write(f"broken frame skipped: {frame.reason}")
            bar.update()

        samples = inferencer.predict(
            dataset,
            chosen,
            batch_size=args.batch_size,
            num_workers=args.workers,
            allow_missing_cameras=args.allow_missing_cameras,
            on_broken=skip,
            priors=priors,
            update_priors=args.update_prior,
        )
        for sample in samples:
            token = str(sample.metainfo["token"])
            if args.show_dir:
                draw(args, inferencer, dataset, sample)
            if results and token not in done:
                elements = inferencer.elements(sample)
                if token in input_from_model:
                    elements = elements.to_frame(input_from_model[token])
                results.add(token, vectors_of(elements, dataset.metainfo["classes"]))
            bar.update()
    return broken


def transforms_to_input(
    source: Source, dataset: "VectorizedMapDataset", mount: Mount
) -> "dict[str, np.ndarray]":
    """Transforms from the frame of the model to the frame of the samples of an annotation file.

    Results of an annotation file belong to this file. Of other inputs, the samples in the frame of
    the model are written beside the results.

    Args:
        source: The input.
        dataset: The samples in the frame of the model.
        mount: Annotation frame of the model, and its place in the vehicle.

    Returns:
        Transforms in metres (4, 4), by token; empty if the frames are equal.
    """
    samples = source.samples
    if not isinstance(samples, AnnotationFile):
        return {}
    if dataset.annotations.path == samples.path.resolve():  # `open_dataset` changes no frame
        return {}
    transforms = {}
    for sample in samples:
        transforms[sample.token] = frame_from_mount(
            sample, frame=source.frame, mount=mount, ground_z_m=source.ground_z_m
        )
    return transforms


def remembers(inferencer: "MapInferencer") -> bool:
    """Whether the predictions of a model depend on earlier samples, directly or through a prior."""
    return inferencer.model.temporal is not None or inferencer.model.prior is not None


def read_priors(
    args: argparse.Namespace,
    inferencer: "MapInferencer",
    dataset: "VectorizedMapDataset",
    chosen: Sequence[int],
    stack: ExitStack,
) -> list["AnyPrior"]:
    """Open the files of ``--prior``.

    Args:
        args: The options of the command.
        inferencer: The model.
        dataset: The samples.
        chosen: Indices of the samples to predict.
        stack: Stack that closes the files when it is closed.

    Returns:
        The priors in the order of the files; empty without ``--prior``.
    """
    if not args.prior:
        return []
    from gsmap.apis.map_priors import open_priors

    names = dataset.annotations.column("map_name")  # each is empty if unknown
    return open_priors(
        inferencer.model,
        args.prior,
        stack,
        update=args.update_prior,
        places={names[index] for index in chosen},
    )


def describe_priors(
    args: argparse.Namespace, priors: Sequence["AnyPrior"], tokens: Sequence[str]
) -> list[dict[str, Any]]:
    """Print a warning if priors were made of the samples, and return facts for the result file.

    A prior that this run updates does not contain its samples yet.

    Args:
        args: The options of the command.
        priors: The priors of ``--prior``, before the run changes them.
        tokens: Tokens of the samples to predict.
    """
    if not priors:
        return []
    from gsmap.apis.map_priors import facts_of_priors, leak_warnings

    facts = facts_of_priors(priors, args.prior, tokens)
    for line in leak_warnings(facts, len(tokens)):
        print(line)
    return facts


def finish_priors(args: argparse.Namespace, priors: Sequence["AnyPrior"]) -> None:
    """Print which priors had nothing near samples; with ``--update-prior``, write their files."""
    if not args.update_prior:  # a prior that is updated has nothing where the vehicle is new
        from gsmap.apis.map_priors import empty_reads

        for line in empty_reads(priors):
            print(line)
        return
    for prior, path in zip(priors, args.prior, strict=True):
        prior.save(path)
    print(f"updated: {', '.join(map(str, args.prior))}")


def draw(
    args: argparse.Namespace,
    inferencer: "MapInferencer",
    dataset: "VectorizedMapDataset",
    sample: "Det3DDataSample",
) -> None:
    """Draw a predicted sample into the folder of pictures.

    Args:
        args: The options of the command.
        inferencer: The model.
        dataset: The samples, from which the LiDAR sweeps of ``--lidar`` are read.
        sample: The prediction.
    """
    token = str(sample.metainfo["token"])
    points = None
    if args.lidar:
        index = dataset.annotations.column("token").index(token)
        points = inferencer.lidar_points(dataset, index)
    figure = inferencer.draw(sample, score_thr=args.score_thr, points=points)
    save_figure(figure, args.show_dir / sample_name(sample.metainfo, f".{args.format}"))


def main(argv: list[str] | None = None) -> str | None:
    """Run the command. A returned text is printed by `run_command`."""
    args = parse_args(argv)
    if args.executor:  # a Ray cluster runs this command once for each shard
        return run_on_ray(args, sys.argv)
    if args.check_calibration:
        with TemporaryDirectory() as frames:
            warnings = check_calibration(args, read_input(args, Path(frames)))
        sys.exit(IMPLAUSIBLE if warnings else 0)
    if not args.out and not args.show_dir:
        raise InputError("Nothing to do: give --out FILE, --show-dir FOLDER, or both.")
    if args.width is not None and args.width < 1:
        raise InputError(f"--width must be >= 1 pixel, got {args.width}.")
    source = read_input(args)
    # Samples of other inputs are written to an annotation file beside ``--out`` at the end
    # (`print_summary`), which must not replace a foreign file. Their calibration is checked, too.
    if not isinstance(source.samples, AnnotationFile):
        if args.out:
            require_own_samples(args.out.with_suffix(_SAMPLES_SUFFIX))
        check_calibration(args, source)
    from gsmap.apis.map_inferencer import select_samples

    inferencer = open_model(args)
    if args.shard.count and remembers(inferencer):  # the count is 0 without ``--shard``
        raise InputError(
            "--shard cuts drives, which a model that uses earlier frames or a prior needs whole: "
            "leave it out."
        )
    dataset = inferencer.dataset(source)
    tokens = dataset.annotations.column("token")
    # Indices of the samples to predict: the part of this shard, or all without ``--shard``.
    chosen = args.shard.part(select_samples(tokens, args.token, args.max_samples))
    settings = run_settings(args, inferencer.cfg)
    samples_digest = digest(dataset.annotations.path)
    # The log of an earlier run is used only if the settings and the input are equal. The data root
    # is included because the name of a folder of extracted images depends on their content and on
    # the calibration.
    log_settings = {**settings, "input": str(args.input.resolve()), "samples": samples_digest}
    log_settings["images"] = str(source.data_root)
    log_settings["frame"] = source.frame
    input_from_model = transforms_to_input(source, dataset, inferencer.model.mount)
    chosen_tokens = [tokens[index] for index in chosen]
    classes = dataset.metainfo["classes"]
    with ExitStack() as stack:
        log = open_log(args, log_settings, tokens=chosen_tokens, classes=classes)
        results = stack.enter_context(log)
        priors = read_priors(args, inferencer, dataset, chosen, stack)
        prior_facts = describe_priors(args, priors, chosen_tokens)
        broken = predict(args, inferencer, dataset, chosen, results, priors, input_from_model)
        if chosen and len(broken) == len(chosen):
            raise no_usable_frame(broken, source.notes)
        if results:
            # Writes the result file. The manifest describes the file of a shard for the command
            # that merges shards; without ``--shard``, none is written.
            count = results.finish(result_header(args, dataset.metainfo, prior_facts))
            args.shard.write_manifest(
                args.out,
                kind=RESULTS,
                source=samples_digest,
                options=settings,
                samples=count,
            )
        finish_priors(args, priors)
    print_summary(args, source, dataset.ann_file, len(chosen), broken)
    return None


def no_usable_frame(broken: dict[str, str], notes: Sequence[str]) -> InputError:
    """Error for a recording without a usable frame, with the first reason and the last note.

    Args:
        broken: Reasons of broken frames, by token.
        notes: Notes of the reader of the input.
    """
    reason = next(iter(broken.values()))
    if notes:
        reason = f"{reason}; note on the input: {notes[-1]}"
    return InputError(f"no frame can be used: {reason}")


def print_summary(
    args: argparse.Namespace, source: Source, ann_file: str, count: int, broken: dict[str, str]
) -> None:
    """Print the written files; exit with `SKIPPED` if frames were broken.

    Args:
        args: The options of the command.
        source: The recording.
        ann_file: Annotation file of the samples, which is copied to a file beside ``--out``.
        count: Number of samples of the run.
        broken: Reasons of broken frames, by token.
    """
    outputs = []
    if args.out:
        outputs.append(str(args.shard.path_of(args.out)))
    if args.show_dir:
        outputs.append(str(args.show_dir))
    written = " and ".join(outputs)
    print(f"{count - len(broken)} of {format_count(count, 'sample')} predicted: {written}")
    if args.out and not isinstance(source.samples, AnnotationFile):
        annotations = args.out.with_suffix(_SAMPLES_SUFFIX)
        write_bytes(annotations, Path(ann_file).read_bytes())
        if source.has_poses:
            print(
                f"the samples: {annotations}; the drive's map: python tools/build_map.py {args.out}"
                f" --ann {annotations} --data-root {source.data_root} --out FOLDER"
            )
    if broken:
        print(f"{len(broken)} broken frames skipped: {', '.join(broken)}")
        sys.exit(SKIPPED)


if __name__ == "__main__":
    run_command(main)
