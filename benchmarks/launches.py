"""Numbers of kernel launches and of waits for the GPU, counted without a GPU.

They are counted for the prediction of a frame and for a training step, and separately for each
part of the program (`PARTS`). A launch takes about 20 microseconds of the host, and the GPU is idle
during a wait. The numbers do not depend on the size of the images. A training step is mmengine's,
with optimizer, gradient clipping and the collection of figures (losses and statistics) for the
log. The backward pass of a part is listed as ``backward:`` and its name. The counts are made by
`benchmarks.pretended_gpu`, a device of torch that computes on the CPU and counts the launches and
waits that a GPU would have.
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

# Methods whose launches are counted separately: attribute of the detector with the method (empty
# for a method of the detector itself), name of the method, and name of the part. Several methods
# may belong to one part. Methods that a model does not have are left out.
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
    ("temporal", "recall", "memory"),  # fusion with features and queries of previous frames
    ("temporal", "collect_memory", "memory"),
    ("", "parse_losses", "figures"),  # losses for the log
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``benchmarks launches`` to a parser."""
    parser.add_argument("configs", nargs="+")
    parser.add_argument("--size", type=int, nargs=2, metavar=("H", "W"), default=(96, 160))
    parser.add_argument("--own-size", action="store_true", help="use the image size of the config")
    parser.add_argument("--batch", type=int, default=4, help="number of samples of a step")
    parser.add_argument(
        "--waits", action="store_true", help="list the lines of code that cause waits"
    )


def run(args: argparse.Namespace) -> None:
    """Count and print the launches and waits of a step and of a frame of every config.

    Args:
        args: Parsed options of ``add_arguments``.

    Raises:
        RuntimeError: If torch is too old.
    """
    if not available():
        raise WorkError(
            f"torch {torch.__version__} cannot run backends that are written in Python: use a "
            "newer version, such as 2.13."
        )
    size = None if args.own_size else tuple(args.size)
    for path in args.configs:
        trial = Trial(path, size, batch=args.batch)
        with trial.gpu:
            calls = {f"a step of {args.batch}": trial.step, "a frame": trial.frame}
            for name, call in calls.items():
                call()  # also creates constants and states, so its counts are discarded
                call()
                print(f"{path}, {name}\n\n{_table(trial.gpu, with_waits=args.waits)}")


class Trial:
    """Model on a pretended GPU, which computes on the CPU, with a batch of random inputs.

    Args:
        config: Config file, or a config.
        size: Rows and columns of the images; None for the size in the config.
        batch: Number of samples of a step.

    Attributes:
        gpu: Pretended GPU, which counts the launches and waits of the last step or frame. ``step``
            and ``frame`` must be called in its context.
        model: The model.
    """

    def __init__(self, config: str | Config, size: tuple[int, int] | None, batch: int) -> None:
        options = argparse.Namespace(size=size, device="cpu", threads=torch.get_num_threads())
        self.model, inputs, self.samples = models.model_and_batch(config, options, batch=batch)
        self.inputs: dict[str, Any] = {}
        if self.model.bev_encoder is not None:
            # The model normalizes its images itself, but these are normalized already. So the
            # normalization is undone, approximately.
            pixels = (inputs["imgs"] * 50 + 120).clamp(0, 255).to(torch.uint8)
            self.inputs["img"] = list(pixels)
        if self.model.lidar_encoder is not None:
            scale = torch.tensor([20.0, 40.0, 2.0, 1.0, 0.0])  # x, y, z in metres, intensity, time
            self.inputs["points"] = [(torch.rand(2000, 5) - 0.5) * scale for _ in range(batch)]
        self.settings = read_config(config).optim_wrapper  # config of the optimizer wrapper
        self.gpu = PretendedGPU()
        self.wrapper: Any = None

    def step(self) -> dict[str, Any]:
        """Count the launches of a training step. The first step also creates constants.

        Returns:
            Figures of the step.
        """
        if self.wrapper is None:
            self.model.to(DEVICE)
            self.model.init_weights()  # after the move to the device, as in mmengine
            self.wrapper = build_optim_wrapper(self.model, self.settings)
        self.model.train()
        models.advance_samples(self.samples)  # the next frame of each stream, for temporal models
        self.gpu.clear()
        with self._count_parts():
            figures = self.model.train_step(self._data(self.samples), self.wrapper)
            with self.gpu.part("figures"):  # the runner's hook stores them for the log in this way
                prefixed = {f"train/{name}": value for name, value in figures.items()}
                keep_figures(self.wrapper.message_hub, prefixed)
        return figures

    @torch.no_grad()
    def frame(self) -> Any:
        """Count the launches of the prediction of one sample.

        The first prediction also creates constants.

        Returns:
            Sample with the prediction.
        """
        self.model.to(DEVICE)
        self.model.eval()
        models.advance_samples(self.samples)
        sample = self.samples[0].clone()
        # Samples of a test pipeline have no targets, which are all of the fields that `keys` lists.
        for name in sample.keys():  # noqa: SIM118
            delattr(sample, name)
        self.gpu.clear()
        with self._count_parts():
            return self.model.test_step(self._data([sample]))[0]

    def _data(self, samples: list[Any]) -> dict[str, Any]:
        """Batch of the given samples and of the first inputs, one for each sample."""
        inputs = {name: values[: len(samples)] for name, values in self.inputs.items()}
        return {"inputs": inputs, "data_samples": samples}

    @contextmanager
    def _count_parts(self) -> Iterator[None]:
        """Count each launch for the part that is running.

        The parts are `PARTS`, the step of the optimizer, gradient clipping and the backward pass.
        """
        gpu = self.gpu
        with ExitStack() as stack:
            for attribute, method, part in PARTS:
                owner: Any = self.model
                names = attribute.split(".") if attribute else []
                for name in names:
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

    # An attribute of the object hides the method of its class until the attribute is deleted. It is
    # set by `object.__setattr__`, because `torch.nn.Module` overrides the setting of attributes.
    object.__setattr__(owner, method, call_inside)
    try:
        yield
    finally:
        object.__delattr__(owner, method)


def _table(gpu: PretendedGPU, with_waits: bool) -> str:
    """Format the counts by part, and the lines that cause waits if ``with_waits``.

    Work outside of all parts has an empty name, and is listed as ``rest``.
    """
    launches: Counter[str] = Counter()
    waits: Counter[str] = Counter()
    names_by_part: dict[str, Counter[str]] = {}
    for (part, name), number in gpu.launches.items():
        launches[part] += number
        names_by_part.setdefault(part, Counter())[name] += number
    for (part, _reason, _line), number in gpu.waits.items():
        waits[part] += number
    rows = [["all", launches.total(), waits.total(), ""]]
    for part, num_launches in launches.most_common():
        most_common = names_by_part[part].most_common(4)
        names = ", ".join(f"{name} {number}" for name, number in most_common)
        rows.append([part or "rest", num_launches, waits[part], names])
    text = markdown_table(["part", "launches", "waits", "mostly"], rows)
    if with_waits:
        wait_rows = []
        for (part, reason, line), number in gpu.waits.most_common():
            wait_rows.append([number, part or "rest", reason, line])
        text += "\n" + markdown_table(["waits", "part", "reason", "line"], wait_rows)
    return text
