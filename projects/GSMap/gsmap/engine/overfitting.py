"""Training on a few samples until a model reproduces them, as a first test of a new data set."""

from mmengine.config import Config

from gsmap.checkpoints.settings import single_dataset_of
from gsmap.engine.launch import has_trained_memory
from gsmap.utils.errors import InputError

LOG_LINES = 10  # number of times that a run logs its losses
WARM_UP = 20  # number of iterations in which the learning rate rises


def overfit(cfg: Config, samples: int, iterations: int) -> None:
    """Restrict a training config to the first samples of its training data, in place.

    The run counts iterations, skips validation, writes one checkpoint at its end, and logs its
    losses about `LOG_LINES` times. The learning rate rises during the first `WARM_UP` iterations
    and then stays constant.

    Args:
        cfg: Training config, as returned by `load_config`.
        samples: Number of samples, at least 1.
        iterations: Number of training iterations, at least 1.

    Raises:
        ValueError: If a number is below 1, the training data are wrapped by another data set, or
            the sampler makes streams of frames.
    """
    for name, number in (("--overfit", samples), ("--overfit-iterations", iterations)):
        if number < 1:
            raise InputError(f"{name} must be >= 1, got {number}.")
    dataset = single_dataset_of(cfg, part="train", purpose="--overfit")
    loader = cfg.train_dataloader
    sampler = loader.sampler.type
    if sampler != "DefaultSampler":
        raise InputError(
            f"--overfit takes samples one by one, but train_dataloader.sampler of {cfg.filename} "
            f"is a {sampler}: take a config of a model without memory."
        )
    if has_trained_memory(cfg):
        raise InputError(
            f"--overfit counts iterations, in which the memory of the model of {cfg.filename} "
            "would be empty: take a config of a model without memory."
        )
    # This sampler repeats the samples without end, which suits a training that counts iterations.
    loader.sampler = {"type": "InfiniteSampler", "shuffle": True}
    dataset.indices = samples  # for mmengine, a number selects the first samples
    loader.batch_size = min(loader.batch_size, samples)
    loader.num_workers = 0  # a few samples are loaded in the process of the training
    loader.persistent_workers = False  # not allowed without workers
    cfg.train_cfg = {
        "type": "IterBasedTrainLoop",
        "max_iters": iterations,
        "val_interval": iterations + 1,  # after the end, so there is no validation
    }
    cfg.val_cfg = None
    cfg.val_dataloader = None
    cfg.val_evaluator = None
    cfg.param_scheduler = [
        {"type": "LinearLR", "start_factor": 0.1, "by_epoch": False, "begin": 0, "end": WARM_UP}
    ]
    interval = max(iterations // LOG_LINES, 1)
    hooks = cfg.default_hooks
    hooks.logger = {"type": "LoggerHook", "interval": interval}
    hooks.checkpoint.interval = iterations
    hooks.checkpoint.by_epoch = False
    hooks.checkpoint.save_best = None  # there is no validation to compare
    hooks.visualization.draw = False
    cfg.log_processor.by_epoch = False
    cfg.log_processor.window_size = interval  # each log line has the mean since the previous one
