"""Exported models in ONNX Runtime against torch, batch 1, on the CPU."""

import argparse
import tempfile
from functools import partial
from pathlib import Path

import torch

from benchmarks.fps import frame_cost
from benchmarks.measure import Cost, measure
from benchmarks.model import add_arguments, in_fresh_processes, model_and_batch, report
from gsmap.apis.export import export_onnx
from gsmap.apis.onnx_inferencer import OnnxInferencer
from gsmap.structures.calibration import calibration_arrays

__all__ = ["add_arguments", "run"]


def run(args: argparse.Namespace) -> None:
    """Measure and print both ways' time of every config.

    Raises:
        ValueError: If another device or precision is asked for.
    """
    if args.device != "cpu" or args.fp16:
        raise ValueError("benchmarks export measures single precision on the CPU.")
    jobs = [(path, args) for path in args.configs]
    in_torch, in_onnx = (in_fresh_processes(task, jobs) for task in (frame_cost, onnx_cost))
    report(
        args,
        ["model", "torch, s", "ONNX Runtime, s", "ratio", "torch, wall s", "ONNX Runtime, wall s"],
        [
            [
                *(Path(path).stem, f"{a.cpu_s:.3f}", f"{b.cpu_s:.3f}", f"{b.cpu_s / a.cpu_s:.2f}"),
                *(f"{a.wall_s:.3f}", f"{b.wall_s:.3f}"),
            ]
            for (path, a), (_, b) in zip(in_torch, in_onnx, strict=True)
        ],
    )


def onnx_cost(path: str, args: argparse.Namespace) -> Cost:
    """Measure a config's way in ONNX Runtime; the file's own reading is not counted."""
    model, inputs, samples = model_and_batch(path, args)
    arrays = calibration_arrays(samples[0].metainfo, model.bev_encoder.calibration)
    arrays["images"] = inputs["imgs"][0].numpy()
    cameras, _, height, width = arrays["images"].shape
    names = [f"camera {i}" for i in range(cameras)]
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, "model.onnx")
        export_onnx(model.eval(), file, names, (height, width))
        exported = OnnxInferencer(file, num_threads=args.threads)
    return measure(partial(exported.run, arrays), torch.device("cpu"), args.repeats)
