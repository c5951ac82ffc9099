"""Time per frame of exported models, in ONNX Runtime and in torch, with batch size 1 on the CPU."""

import argparse
import tempfile
from functools import partial
from pathlib import Path

import torch

from benchmarks.fps import frame_cost
from benchmarks.measure import Cost, in_own_process, measure
from benchmarks.model import add_arguments, model_and_batch, report
from gsmap.apis.export import export_onnx, quantize_onnx
from gsmap.apis.onnx_inferencer import OnnxInferencer
from gsmap.structures.calibration import calibration_arrays
from gsmap.utils.errors import InputError

# `add_arguments` adds the options that all benchmarks of models have.
__all__ = ["add_arguments", "run"]


def run(args: argparse.Namespace) -> None:
    """Measure and print the time of every config in torch and in ONNX Runtime.

    Args:
        args: Parsed options of ``add_arguments``.

    Raises:
        ValueError: If the device is not the CPU or the precision is not single.
    """
    if args.device != "cpu" or args.fp16:
        raise InputError("benchmarks export measures single precision and 8 bits on the CPU.")
    rows = []
    for path in args.configs:
        # Each model is measured in a fresh process, in which no earlier model has left memory.
        costs = {
            "torch": in_own_process(frame_cost, path, args),
            "ONNX Runtime": in_own_process(onnx_cost, path, args, False),
            "ONNX Runtime, 8 bits": in_own_process(onnx_cost, path, args, True),  # eight_bits
        }
        torch_cost = costs["torch"]  # the reference of the ratios in the last two columns
        for runtime, cost in costs.items():
            row = [
                Path(path).stem,
                runtime,
                f"{cost.cpu_s:.3f}",
                f"{cost.wall_s:.3f}",
                f"{cost.cpu_s / torch_cost.cpu_s:.2f}",
                f"{cost.wall_s / torch_cost.wall_s:.2f}",
            ]
            rows.append(row)
    header = ["model", "runtime", "processor s", "wall s", "processor s / torch", "wall s / torch"]
    report(args, header, rows=rows)


def onnx_cost(path: str, args: argparse.Namespace, eight_bits: bool) -> Cost:
    """Measure the inference of a config's model in ONNX Runtime, without the time of loading.

    Args:
        path: Config file.
        args: Parsed options of ``add_arguments``.
        eight_bits: Whether convolutions are in 8 bits, calibrated on the images of the batch.

    Returns:
        Time and memory of a frame.
    """
    model, inputs, samples = model_and_batch(path, args)  # random inputs of one sample
    # The inputs of the exported graph are the matrices that the encoder reads, and the images.
    arrays = calibration_arrays(samples[0].metainfo, model.bev_encoder.calibration)
    arrays["images"] = inputs["imgs"][0].numpy()  # (V, 3, H, W), normalised
    cameras, _, height, width = arrays["images"].shape
    names = [f"camera {i}" for i in range(cameras)]  # any names: the file must name its cameras
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, "model.onnx")
        export_onnx(model.eval(), file, names, (height, width))
        if eight_bits:
            quantize_onnx(file, file, [arrays])  # overwrites the file
        inferencer = OnnxInferencer(file, num_threads=args.threads)
    # ONNX Runtime has read the file into memory, so its folder may be deleted by now.
    return measure(partial(inferencer.run, arrays), torch.device("cpu"), repeats=args.repeats)
