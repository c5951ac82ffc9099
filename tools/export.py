#!/usr/bin/env python
"""Write a trained model as one ONNX file of standard operators, and compare it with torch.

Examples:
    python tools/export.py CONFIG CHECKPOINT --out model.onnx --check 5
    python tools/export.py CONFIG CHECKPOINT --out model_int8.onnx --int8 --calibration train.arrow

The config sets the cameras: all cameras of the training or some, in any order. The image size is
the size of its test samples, or ``--size``.
"""

# Imported before all libraries: this handles Ctrl-C during their imports, and keeps them from
# reading settings files in the working folder.
import gsmap  # noqa: F401

# isort: split
import argparse
import logging
import math
import tempfile
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from gsmap.apis.export import (
    export_onnx,
    graph_inputs,
    halve_onnx,
    largest_differences,
    quantize_onnx,
)
from gsmap.apis.map_inferencer import MapInferencer, select_samples, spread_evenly
from gsmap.apis.onnx_inferencer import OnnxInferencer
from gsmap.checkpoints.settings import single_dataset_of
from gsmap.datasets.elements import elements_of_predictions
from gsmap.engine.arguments import add_config_options
from gsmap.utils.cli import CommandParser, output_file, run_command
from gsmap.utils.errors import InputError, WorkError

if TYPE_CHECKING:  # slow to import
    from gsmap.datasets.vectorized_map_dataset import VectorizedMapDataset

# Steps of a pipeline that do not change images.
_OTHER_STEPS = (
    "LoadCameraImages", "LoadLidarPoints", "LoadLidarSweeps", "PointsToFrame", "PackMapInputs",
)  # fmt: skip
_FEW_SAMPLES = 3  # rounding may change which elements of one sample or two have enough score
_RUN_LENGTH = 4  # smallest number of consecutive samples of a scene, for models with memory


def parse_args() -> argparse.Namespace:
    parser = CommandParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("config", help="config, by file or name, or the name of a trained model")
    parser.add_argument(
        "checkpoint",
        nargs="?",
        help="checkpoint of the model; not needed with the name of a trained model",
    )
    parser.add_argument("--out", type=output_file, required=True, help="ONNX file to write")
    parser.add_argument(
        "--size",
        type=int,
        nargs=2,
        metavar=("H", "W"),
        help="rows and columns of the images after the data pipeline; by default as in the test "
        "samples",
    )
    precision = parser.add_mutually_exclusive_group()
    precision.add_argument("--fp16", action="store_true", help="convolutions in half precision")
    precision.add_argument("--int8", action="store_true", help="convolutions in 8 bits")
    parser.add_argument(
        "--calibration", type=Path, help="samples for --int8; the config's training set by default"
    )
    parser.add_argument(
        "--calibration-samples",
        type=int,
        default=32,
        help="number of samples for --int8, evenly spread over --calibration",
    )
    parser.add_argument(
        "--samples", type=Path, help="samples to compare on; the config's test set by default"
    )
    parser.add_argument(
        "--check",
        type=int,
        metavar="N",
        help="compare with torch on N samples, evenly spread; "
        "for a model with memory, on consecutive samples of scenes",
    )
    parser.add_argument(
        "--results", type=output_file, help="JSON file for the predictions of ONNX Runtime"
    )
    add_config_options(parser)
    args = parser.parse_args()
    if args.results and not args.check:
        parser.error("--results needs --check N")
    return args


def open_samples(
    inferencer: MapInferencer, args: argparse.Namespace, source: Path | None, split: str
) -> "VectorizedMapDataset":
    """Open the samples of an annotation file.

    Args:
        inferencer: The model with its config.
        args: The options of the command.
        source: The annotation file; None for the annotation file in the config.
        split: ``train`` or ``test``: the data loader of the config whose file is used if ``source``
            is None.

    Returns:
        Data set of the samples with the test pipeline of the config.

    Raises:
        FileNotFoundError: If the file of the config does not exist.
    """
    if source is None:
        options = single_dataset_of(inferencer.cfg, part=split, purpose="an export")
        source = Path(args.data_root or options.data_root, options.ann_file)
        if not source.is_file():
            raise FileNotFoundError(
                f"There is no {source}, the config's {split} samples: name others (--samples, "
                "--calibration, --data-root), or give --size if only the image size is missing."
            )
    return inferencer.dataset(source, args.data_root)


def write_model(inferencer: MapInferencer, args: argparse.Namespace) -> OnnxInferencer:
    """Export the model in the chosen precision, and open the written file.

    Args:
        inferencer: The model with its config.
        args: The options of the command.

    Raises:
        ValueError: If the config lists no cameras, or the model cannot be exported.
    """
    options = inferencer.cfg.test_dataloader.dataset
    if not options.get("cameras"):
        raise InputError(f"{args.config} lists no cameras: set test_dataloader.dataset.cameras.")
    size = args.size
    if size is None:
        first_sample = open_samples(inferencer, args, args.samples, split="test")[0]
        size = first_sample["inputs"]["img"].shape[-2:]  # rows and columns
    write = partial(
        export_onnx,
        inferencer.model,
        cameras=options.cameras,
        image_size=tuple(size),
        frame=options.get("frame", "lidar"),
    )
    if not (args.fp16 or args.int8):
        write(args.out)
        return OnnxInferencer(args.out)
    # The other precisions are converted from a file in single precision.
    with tempfile.TemporaryDirectory(prefix="gsmap-") as folder:
        single_precision = Path(folder, "fp32.onnx")
        write(single_precision)
        if args.fp16:
            halve_onnx(single_precision, args.out)
        else:
            exported = OnnxInferencer(single_precision)
            samples = calibration_samples(inferencer, exported, args)
            quantize_onnx(single_precision, args.out, samples)
    return OnnxInferencer(args.out)


def calibration_samples(
    inferencer: MapInferencer, exported: OnnxInferencer, args: argparse.Namespace
) -> Iterator[dict[str, NDArray[np.float32]]]:
    """Yield the inputs that calibrate the 8-bit model.

    Args:
        inferencer: The model with its config.
        exported: The model in single precision, as ONNX.
        args: The options of the command.

    Yields:
        Arrays of one sample, by the name of the input.
    """
    dataset = open_samples(inferencer, args, args.calibration, split="train")
    chosen = choose_samples(inferencer, dataset, count=args.calibration_samples)
    for _, inputs in graph_inputs(exported, dataset, chosen):
        yield inputs


def choose_samples(
    inferencer: MapInferencer, dataset: "VectorizedMapDataset", count: int
) -> list[int]:
    """Choose samples that are evenly spread over a data set.

    For a model with memory, they are the first samples of some scenes, at least `_RUN_LENGTH` of
    each: the memory counts only in a sample that follows the one before.

    Args:
        inferencer: The model.
        dataset: The data set.
        count: Largest number of samples, at least 1.

    Returns:
        Indices of the samples, in the order of their times within a scene.

    Raises:
        ValueError: If ``count`` is smaller than 1.
    """
    if inferencer.model.temporal is None:
        return select_samples(dataset.annotations.column("token"), max_num=count)
    scenes = dataset.scenes()
    if count < 1 or not scenes:
        return select_samples(dataset.annotations.column("token"), max_num=count)  # its error
    length = max(_RUN_LENGTH, math.ceil(count / len(scenes)))  # samples of each chosen scene
    evenly = list(spread_evenly(len(scenes), max_num=math.ceil(count / length)))
    others = [number for number in range(len(scenes)) if number not in evenly]
    sizes = [len(scene) for scene in scenes]
    while sum(min(size, length) for size in sizes) < min(count, sum(sizes)):
        length *= 2  # other scenes are short
    chosen: list[int] = []
    for number in (*evenly, *others):  # further scenes if the first ones are short
        chosen += scenes[number][: min(length, count - len(chosen))]
    return chosen


def check(inferencer: MapInferencer, exported: OnnxInferencer, args: argparse.Namespace) -> str:
    """Compare the exported model with torch.

    Args:
        inferencer: The model in torch.
        exported: The exported model.
        args: The options of the command.

    Returns:
        A sentence with the largest differences.

    Raises:
        RuntimeError: If the predictions of a file in single precision differ in all samples.
    """
    dataset = open_samples(inferencer, args, args.samples, split="test")
    chosen = choose_samples(inferencer, dataset, count=args.check)
    # Indices of the classes whose points the model reorders to form a short path. The order is not
    # compared, since rounding decides between paths of nearly equal length.
    unfolded = exported.metadata.get("unfold_classes", [])
    map_note = ""
    if inferencer.model.prior is not None:
        # Otherwise torch would read a map of the samples before, which the graph does not get.
        inferencer.model.prior.test_memory = "none"
        map_note = ", with an empty map of earlier drives,"
    # Both yield the chosen samples in one order: predictions of torch, and inputs of the graph.
    torch_samples = inferencer.predict(dataset, chosen)
    onnx_inputs = graph_inputs(exported, dataset, chosen)
    differences = []  # largest differences of each sample: of scores, and of points in metres
    predictions = []  # token and map elements of each sample, predicted by ONNX Runtime
    num_continued = 0  # samples that the graph predicts with the memory of another one
    for sample, (token, inputs) in zip(torch_samples, onnx_inputs, strict=True):
        elements = exported.elements(exported.run(inputs))
        expected = elements_of_predictions(sample.pred_instances_3d)
        differences.append(largest_differences(elements, expected, unfolded))
        predictions.append((token, elements))
        num_continued += int(exported.has_memory and inputs["continues"][0] > 0)
    if args.results:
        exported.write(args.results, predictions)
    text = describe_differences(differences, note=map_note)
    if exported.has_memory:
        text += f"; {num_continued} of the samples continue a stream"
        if not num_continued:
            text += ", so the memory was not compared: give --check a larger N, or other --samples"
    differs = [not np.isfinite(pair).all() for pair in differences]
    if all(differs) and len(differs) >= _FEW_SAMPLES and not (args.fp16 or args.int8):
        raise WorkError(f"{text}: do not use {args.out}.")
    return text


def describe_differences(differences: list[tuple[float, float]], note: str = "") -> str:
    """Describe how much predictions of ONNX Runtime and torch differ.

    Args:
        differences: Results of `largest_differences`, one for each sample. They are infinite if
            the numbers of elements of a class differ.
        note: Further condition of the predictions.
    """
    finite_differences = [pair for pair in differences if np.isfinite(pair).all()]
    text = (
        f"in {len(finite_differences)} of {len(differences)} samples, ONNX Runtime and torch "
        f"predict{note} equal numbers of elements of each class"
    )
    if not finite_differences:
        return text
    score, distance_m = np.max(finite_differences, axis=0)
    return (
        f"{text}; in these samples, scores differ by at most {score:.1e}, and nearest elements by "
        f"at most {distance_m:.1e} m"
    )


def image_notes(pipeline: list[dict[str, Any]]) -> list[str]:
    """Sentences on steps of a pipeline that change images in another way than bilinear scaling.

    Such steps precede the exported file, so a vehicle must do them as well.

    Args:
        pipeline: Transforms of the test data, as in a config.
    """
    notes: list[str] = []
    for step in pipeline:
        kind = getattr(step["type"], "__name__", str(step["type"])).rpartition(".")[-1]
        options = ", ".join(f"{name}={value}" for name, value in step.items() if name != "type")
        is_usual = step.get("kernel", "bilinear") == "bilinear"
        if kind in _OTHER_STEPS or (kind == "ScaleImages" and is_usual):
            continue
        notes.append(
            f"the images of the training were also changed by {kind}({options}), which is not in "
            "the file: change the images of the vehicle in this way before the file gets them, and "
            "lidar2img alike."
        )
    return notes


def main() -> str:
    args = parse_args()
    for name in ("torch.onnx", "onnxscript"):  # their notes are about optional steps
        logging.getLogger(name).setLevel(logging.ERROR)
    inferencer = MapInferencer(
        args.config, args.checkpoint, device="cpu", cfg_options=args.cfg_options
    )
    exported = write_model(inferencer, args)
    rows, columns = exported.image_size
    print(
        f"{args.out}: {len(exported.cameras)} cameras of {rows} x {columns}, "
        f"{args.out.stat().st_size / 2**20:.1f} MiB"
    )
    for note in image_notes(inferencer.cfg.test_dataloader.dataset.pipeline):
        print(f"note: {note}")
    return check(inferencer, exported, args) if args.check else "not compared: give --check N"


if __name__ == "__main__":
    run_command(main)
