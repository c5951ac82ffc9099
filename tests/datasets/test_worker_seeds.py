"""Random numbers of a loader's workers depend on the seed, epoch, rank and worker."""

import random

import numpy as np
import pytest
import torch
from dataset_cases import MINICITY, dataset_config
from mmengine.dataset import pseudo_collate
from torch.utils.data import DataLoader

from gsmap.utils.worker_seeds import follow_epoch, seed_epoch


def draw(results):
    """A transform that adds a random number of each library."""
    numbers = [random.random(), np.random.random(), float(torch.rand(()))]  # noqa: NPY002
    return {"inputs": torch.tensor(numbers, dtype=torch.float64)}


def first_seed(worker_id):
    np.random.seed(worker_id)  # noqa: NPY002


@pytest.fixture
def load(build, minicity_root, minicity_annotations):
    """The numbers of some epochs of a new loader: (epochs, samples, libraries)."""
    config = dataset_config(MINICITY, "train_dataloader", minicity_root)
    config["pipeline"] = [draw]
    dataset = build(**config)

    def load(*epochs, seed=0, rank=0, persistent=True, workers=2, **options):
        loader = DataLoader(
            dataset,
            num_workers=workers,
            persistent_workers=persistent and workers > 0,
            collate_fn=pseudo_collate,
            worker_init_fn=first_seed,
            **options,
        )
        numbers = []
        for epoch in epochs:
            seed_epoch(loader, seed=seed, epoch=epoch, rank=rank)
            numbers.append(torch.stack([batch["inputs"][0] for batch in loader]))
        return torch.stack(numbers)

    return load


@pytest.mark.parametrize("persistent", [False, True])
def test_an_epoch_has_its_numbers_whatever_came_before(load, persistent):
    whole = load(0, 1, 2, persistent=persistent)
    resumed = load(1, 2, persistent=persistent)
    assert torch.equal(whole[1:], resumed)
    assert len(whole.unique()) == whole.numel()  # no number is drawn twice


def test_seeds_ranks_and_workers_have_numbers_of_their_own(load):
    numbers = torch.cat([load(3), load(3, seed=1), load(3, rank=1)])
    assert len(numbers.unique()) == numbers.numel()


@pytest.mark.faults
def test_a_started_process_sees_the_epochs_as_well(load):
    options = {"workers": 1, "multiprocessing_context": "forkserver"}
    assert torch.equal(load(0, 1, **options), load(0, 1, workers=1))


def test_without_workers_nothing_is_seeded(load):
    torch.manual_seed(1)
    wanted = torch.rand(3)
    torch.manual_seed(1)
    follow_epoch()
    assert torch.equal(torch.rand(3), wanted)
    assert not torch.equal(load(0, workers=0), load(0, workers=0))
