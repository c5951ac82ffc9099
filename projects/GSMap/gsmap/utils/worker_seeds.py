"""Random numbers of the workers of a data loader, which begin anew with each epoch.

Persistent workers live for a whole training. If their random numbers depended on earlier epochs, a
resumed training would augment its samples differently.
"""

import random
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:  # a data set alone needs no torch
    import torch
    from torch.utils.data import DataLoader

_BEFORE_FIRST_EPOCH = -1
_NUM_SEEDS = 2**32  # numpy's generator takes seeds below


@dataclass
class _EpochSeeds:
    """Seeds of the workers of a training, as a worker sees them.

    Attributes:
        seed: Seed of the current epoch, a number in memory that is shared with the training. ()
        worker_id: Index of the worker, from 0 on.
        seen: Seed of the latest epoch of which this worker has loaded a sample.
    """

    seed: "torch.Tensor"
    worker_id: int
    seen: int = _BEFORE_FIRST_EPOCH


_seeds: _EpochSeeds | None = None  # of this process, if it is a worker of a training


@dataclass
class _WorkerStart:
    """The ``worker_init_fn`` of a data loader.

    Attributes:
        seed: See `_EpochSeeds`.
        previous: Function that the loader had before.
    """

    seed: "torch.Tensor"
    previous: Callable[[int], None] | None

    def __call__(self, worker_id: int) -> None:
        """Let this worker see the seeds of the epochs."""
        global _seeds
        if self.previous is not None:
            self.previous(worker_id)
        _seeds = _EpochSeeds(self.seed, worker_id=worker_id)


def seed_epoch(loader: "DataLoader", seed: int, epoch: int, rank: int) -> None:
    """Let the workers of a loader begin with new random numbers at their next sample.

    Without this call, they keep those of ``worker_init_fn``.

    Args:
        loader: Loader of the training. Its workers have not started yet in the first call.
        seed: Seed of the training.
        epoch: Number of the epoch, from 0 on.
        rank: Rank of this process.
    """
    import torch

    start = loader.worker_init_fn
    if not isinstance(start, _WorkerStart):
        number = torch.tensor(_BEFORE_FIRST_EPOCH).share_memory_()
        start = _WorkerStart(seed=number, previous=start)
        loader.worker_init_fn = start
    numbers = np.random.SeedSequence([seed, epoch, rank])
    start.seed.fill_(int(numbers.generate_state(1)[0]))


def follow_epoch() -> None:
    """Seed the generators of Python, numpy and torch if a new epoch has begun.

    A data set calls it before it augments a sample. Outside of a worker it does nothing.
    """
    if _seeds is None:
        return
    seed = int(_seeds.seed)
    if seed == _seeds.seen:
        return
    import torch

    _seeds.seen = seed
    seed = (seed + _seeds.worker_id) % _NUM_SEEDS
    random.seed(seed)
    np.random.seed(seed)  # noqa: NPY002 - the transforms of mmcv use this generator
    torch.manual_seed(seed)
