"""Launches and waits of a GPU in a frame and in a training step, by part, counted without one.

A launch costs a GPU's host some 20 microseconds for any kernel, and the GPU is idle during a wait.
Neither depends on the size of images. A step is mmengine's, with optimizer, gradient clipping and
figures; gradients count for the part that they belong to. See `benchmarks.pretended_gpu`.
"""

import argparse
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from functools import partial, wraps
from typing import Any

import torch
from mmengine.config import Config
from mmengine.optim import build_optim_wrapper

from benchmarks import model as models
from benchmarks.measure import markdown_table
from benchmarks.pretended_gpu import DEVICE, PretendedGPU, available
from gsmap.engine.figures import keep_figures
from gsmap.engine.launch import read_config
from gsmap.utils.errors import WorkError

# Attribute of the detector, method of the attribute, and name of the part.
PARTS = (
    ("data_preprocessor", "forward", "preprocessor"),
    ("", "extract_img_feats", "backbone, neck"),
    ("bev_encoder", "forward", "encoder"),
    ("lidar_encoder", "forward", "LiDAR encoder"),
    ("map_head", "forward", "head"),
    ("map_head.decoder", "forward", "decoder"),
    ("map_head.assigner", "assign", "matching"),
    ("map_head", "loss_by_feat", "losses"),
    ("map_head", "statistics", "statistics"),
    ("map_head", "predict_by_feat", "decoding"),
    ("temporal", "over", "memory"),
    ("", "parse_losses", "figures"),
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``benchmarks launches`` to a parser."""
    parser.add_argument("configs", nargs="+")
    parser.add_argument("--size", type=int, nargs=2, metavar=("H", "W"), default=(96, 160))
    parser.add_argument("--own-size", action="store_true", help="images as large as the config's")
    parser.add_argument("--batch", type=int, default=4, help="samples of a step")
    parser.add_argument("--waits", action="store_true", help="list the lines that wait")


def run(args: argparse.Namespace) -> None:
    """Count and print a step and a frame of every config.

    Args:
        args: Parsed options of ``add_arguments``.

    Raises:
        RuntimeError: If torch is too old.
    """
    if not available():
        raise WorkError(
            f"torch {torch.__version__} has no backends in Python: use a newer one, such as 2.13."
        )
    size = None if args.own_size else tuple(args.size)
    for path in args.configs:
        trial = Trial(path, size, batch=args.batch)
        with trial.gpu:
            for name, count in ((f"a step of {args.batch}", trial.step), ("a frame", trial.frame)):
                count()
                count()  # the first call makes constants and state
                print(f"{path}, {name}\n\n{_table(trial.gpu, args.waits)}")


class Trial:
    """Model of a config on the pretended GPU, with a batch of random inputs.

    Args:
        config: Config file, or a config.
        size: Rows and columns of the images; None for the config's.
        batch: Samples of a step.

    Attributes:
        gpu: Counts of the last step or frame; to be entered around ``step`` and ``frame``.
        model: The model.
    """

    def __init__(self, config: str | Config, size: tuple[int, int] | None, batch: int) -> None:
        options = argparse.Namespace(size=size, device="cpu", threads=torch.get_num_threads())
        self.model, inputs, self.samples = models.model_and_batch(config, options, batch=batch)
        self.inputs: dict[str, Any] = {}
        if self.model.bev_encoder is not None:
            pixels = (inputs["imgs"] * 50 + 120).clamp(0, 255).to(torch.uint8)
            self.inputs["img"] = list(pixels)
        if self.model.lidar_encoder is not None:
            scale = torch.tensor([20.0, 40.0, 2.0, 1.0, 0.0])
            self.inputs["points"] = [(torch.rand(2000, 5) - 0.5) * scale for _ in range(batch)]
        self.settings = read_config(config).optim_wrapper
        self.gpu = PretendedGPU()
        self.wrapper: Any = None

    def step(self) -> dict[str, Any]:
        """Count a training step; the first one includes the making of constants.

        Returns:
            Figures of the step.
        """
        if self.wrapper is None:
            self.model.to(DEVICE)
            self.model.init_weights()  # after the move to the device, as in mmengine
            self.wrapper = build_optim_wrapper(self.model, self.settings)
        self.model.train()
        models.drive_on(self.samples)
        self.gpu.clear()
        with self._count_parts():
            figures = self.model.train_step(self._data(self.samples), self.wrapper)
            with self.gpu.part("figures"):
                prefixed = {f"train/{name}": value for name, value in figures.items()}
                keep_figures(self.wrapper.message_hub, prefixed)
        return figures

    @torch.no_grad()
    def frame(self) -> Any:
        """Count a prediction of one sample; the first one includes the making of constants.

        Returns:
            Sample with the prediction.
        """
        self.model.to(DEVICE)
        self.model.eval()
        models.drive_on(self.samples)
        sample = self.samples[0].clone()
        for name in sample.keys():  # noqa: SIM118  as a pipeline for tests packs it
            delattr(sample, name)
        self.gpu.clear()
        with self._count_parts():
            return self.model.test_step(self._data([sample]))[0]

    def _data(self, samples: list[Any]) -> dict[str, Any]:
        """Batch of the first inputs, one for each sample."""
        inputs = {name: values[: len(samples)] for name, values in self.inputs.items()}
        return {"inputs": inputs, "data_samples": samples}

    @contextmanager
    def _count_parts(self) -> Iterator[None]:
        """Count methods of the model and of the optimizer as parts, inside the context."""
        gpu = self.gpu
        with ExitStack() as stack:
            for attribute, method, part in PARTS:
                owner: Any = self.model
                for name in attribute.split(".") if attribute else ():
                    owner = getattr(owner, name, None)
                if owner is not None and hasattr(owner, method):
                    stack.enter_context(_run_inside(owner, method, partial(gpu.part, part)))
            if self.wrapper is not None:
                wrapper = self.wrapper
                optimizer = partial(gpu.part, "optimizer")
                clipping = partial(gpu.part, "clipping")
                stack.enter_context(_run_inside(wrapper, "step", optimizer))
                stack.enter_context(_run_inside(wrapper, "_clip_grad", clipping))
                stack.enter_context(_run_inside(wrapper, "backward", gpu.backward))
            yield


@contextmanager
def _run_inside(
    owner: Any, method: str, make_context: Callable[[], AbstractContextManager[None]]
) -> Iterator[None]:
    """Replace a method of an object by one that runs inside a context.

    Args:
        owner: The object.
        method: Name of the method.
        make_context: Function that makes a context for each call.
    """
    original = getattr(owner, method)

    @wraps(original)
    def call_inside(*args: Any, **kwargs: Any) -> Any:
        with make_context():
            return original(*args, **kwargs)

    object.__setattr__(owner, method, call_inside)
    try:
        yield
    finally:
        object.__delattr__(owner, method)


def _table(gpu: PretendedGPU, with_waits: bool) -> str:
    """Format the counts by part, and the lines that wait if ``with_waits``."""
    launches: Counter[str] = Counter()
    waits: Counter[str] = Counter()
    names_by_part: dict[str, Counter[str]] = {}
    for (part, name), times in gpu.launches.items():
        launches[part] += times
        names_by_part.setdefault(part, Counter())[name] += times
    for (part, _, _), times in gpu.waits.items():
        waits[part] += times
    rows = [["all", launches.total(), waits.total(), ""]]
    for part, times in launches.most_common():
        most_common = names_by_part[part].most_common(4)
        names = ", ".join(f"{name} {number}" for name, number in most_common)
        rows.append([part or "rest", times, waits[part], names])
    text = markdown_table(["part", "launches", "waits", "mostly"], rows)
    if with_waits:
        wait_rows = []
        for (part, reason, line), times in gpu.waits.most_common():
            wait_rows.append([times, part or "rest", reason, line])
        text += "\n" + markdown_table(["waits", "part", "reason", "line"], wait_rows)
    return text
