"""Launches and waits of a GPU in a frame and in a training step, by part, counted without one.

A launch costs a GPU's host some 20 microseconds, whatever it computes, and a wait lets the GPU
idle. Neither depends on the size of images. A step is mmengine's, with optimizer, clipping and
figures; gradients count as the part whose gradients they are. See `benchmarks.pretended_gpu`.
"""

import argparse
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import wraps
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

# attribute of the detector, its method, and what that is part of
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
    """Add the command's arguments."""
    parser.add_argument("configs", nargs="+")
    parser.add_argument("--size", type=int, nargs=2, metavar=("H", "W"), default=(96, 160))
    parser.add_argument("--own-size", action="store_true", help="images as large as the config's")
    parser.add_argument("--batch", type=int, default=4, help="samples of a step")
    parser.add_argument("--waits", action="store_true", help="list the lines that wait")


def run(args: argparse.Namespace) -> None:
    """Count and print a frame and a step of every config.

    Raises:
        RuntimeError: If torch is too old.
    """
    if not available():
        raise WorkError(
            f"torch {torch.__version__} has no backends in Python: use a newer one, such as 2.13."
        )
    for path in args.configs:
        trial = Trial(path, None if args.own_size else tuple(args.size), args.batch)
        with trial.gpu:
            for what, count in ((f"a step of {args.batch}", trial.step), ("a frame", trial.frame)):
                count()
                count()
                print(f"{path}, {what}\n\n{_table(trial.gpu, args.waits)}")


class Trial:
    """A config's model on the pretended GPU, with a batch of random inputs.

    Args:
        config: The config, by file, or changed.
        size: Rows and columns of the images; None takes the config's.
        batch: Samples of a step.

    Attributes:
        gpu: What was counted last; everything happens while it is entered.
        model: The model.
    """

    def __init__(self, config: str | Config, size: tuple[int, int] | None, batch: int) -> None:
        options = argparse.Namespace(size=size, device="cpu", threads=torch.get_num_threads())
        self.model, inputs, self.samples = models.model_and_batch(config, options, batch)
        pixels = (inputs["imgs"] * 50 + 120).clamp(0, 255).to(torch.uint8)
        self.inputs = {"img": list(pixels)} if self.model.bev_encoder is not None else {}
        if self.model.lidar_encoder is not None:
            scale = torch.tensor([20.0, 40.0, 2.0, 1.0, 0.0])
            self.inputs["points"] = [(torch.rand(2000, 5) - 0.5) * scale for _ in range(batch)]
        self.settings = read_config(config).optim_wrapper
        self.gpu = PretendedGPU()
        self.wrapper: Any = None

    def step(self) -> dict[str, Any]:
        """Count a training step and return its figures; the first one makes what is kept."""
        if self.wrapper is None:
            self.model.to(DEVICE)
            self.model.init_weights()  # as mmengine does, once the model is on its device
            self.wrapper = build_optim_wrapper(self.model, self.settings)
        self.model.train()
        models.drive_on(self.samples)
        self.gpu.clear()
        with self._parts():
            figures = self.model.train_step(self._data(self.samples), self.wrapper)
            with self.gpu.part("figures"):
                named = {f"train/{name}": value for name, value in figures.items()}
                keep_figures(self.wrapper.message_hub, named)
        return figures

    @torch.no_grad()
    def frame(self) -> Any:
        """Count a prediction of one sample and return it; the first one makes what is kept."""
        self.model.to(DEVICE)
        self.model.eval()
        models.drive_on(self.samples)
        sample = self.samples[0].clone()
        for name in sample.keys():  # noqa: SIM118  as a pipeline for tests packs it
            delattr(sample, name)
        self.gpu.clear()
        with self._parts():
            return self.model.test_step(self._data([sample]))[0]

    def _data(self, samples: list[Any]) -> dict[str, Any]:
        inputs = {name: values[: len(samples)] for name, values in self.inputs.items()}
        return {"inputs": inputs, "data_samples": samples}

    @contextmanager
    def _parts(self) -> Iterator[None]:
        """Let methods of the model and of the optimizer count as parts."""
        gpu = self.gpu
        with ExitStack() as stack:
            for attribute, method, part in PARTS:
                owner: Any = self.model
                for name in attribute.split(".") if attribute else ():
                    owner = getattr(owner, name, None)
                if owner is not None and hasattr(owner, method):
                    stack.enter_context(_counted(owner, method, gpu.part, part))
            if self.wrapper is not None:
                stack.enter_context(_counted(self.wrapper, "step", gpu.part, "optimizer"))
                stack.enter_context(_counted(self.wrapper, "_clip_grad", gpu.part, "clipping"))
                stack.enter_context(_counted(self.wrapper, "backward", gpu.backward))
            yield


@contextmanager
def _counted(owner: Any, method: str, enter: Callable[..., Any], *names: str) -> Iterator[None]:
    """Let a method of an object run within a context."""
    original = getattr(owner, method)

    @wraps(original)
    def within(*args: Any, **kwargs: Any) -> Any:
        with enter(*names):
            return original(*args, **kwargs)

    object.__setattr__(owner, method, within)
    try:
        yield
    finally:
        object.__delattr__(owner, method)


def _table(gpu: PretendedGPU, with_waits: bool) -> str:
    """Lay out what was counted, part by part."""
    launches: Counter[str] = Counter()
    waits: Counter[str] = Counter()
    kinds: dict[str, Counter[str]] = {}
    for (part, name), times in gpu.launches.items():
        launches[part] += times
        kinds.setdefault(part, Counter())[name] += times
    for (part, _, _), times in gpu.waits.items():
        waits[part] += times
    rows = [["all", launches.total(), waits.total(), ""]]
    for part, times in launches.most_common():
        most = ", ".join(f"{name} {number}" for name, number in kinds[part].most_common(4))
        rows.append([part or "rest", times, waits[part], most])
    text = markdown_table(["part", "launches", "waits", "mostly"], rows)
    if with_waits:
        lines = [[n, part or "rest", *why] for (part, *why), n in gpu.waits.most_common()]
        text += "\n" + markdown_table(["waits", "part", "reason", "line"], lines)
    return text
