"""The contract of the methods' heads, each asked in its small config for MiniCity."""

from argparse import Namespace
from functools import cache
from typing import Any

import pytest
import torch
from paper_cases import REPO
from test_configs import load, small

from benchmarks.model import model_and_batch
from gsmap.methods import METHODS

CONFIGS = {
    method.name: REPO / f"configs/{method.name}/{method.name}_r18_minicity.py"
    for method in METHODS
    if method.name != "gsmap"
}
CONFIGS["gsmap"] = REPO / "projects/GSMap/configs/gsmap_maptr_r18_minicity.py"
SIZE = (64, 96)  # of images, which encoders of one size take as well
OF_MAPS = {"seg"}  # losses of all cells of the map, with or without elements
methods = pytest.mark.parametrize("method", CONFIGS)


@cache
def outcome(method: str, number: int) -> tuple[Any, dict[str, torch.Tensor]]:
    """Return a method's model after a backward pass, and its losses.

    Args:
        method: Name of the method.
        number: Number of annotated elements of the one sample.
    """
    cfg = small(load(CONFIGS[method]))
    options = Namespace(size=SIZE, device="cpu", threads=1)
    model, inputs, samples = model_and_batch(cfg, options, num_elements=number)
    losses = model.train()(**{"inputs": inputs, "data_samples": samples}, mode="loss")
    total, _ = model.parse_losses(losses)
    total.backward()
    return model, losses


def in_total(losses: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Return the losses that are added up, and not the figures of the log."""
    return {name: value for name, value in losses.items() if "loss" in name}


@methods
@pytest.mark.parametrize("number", [0, 1, 5])
def test_any_number_of_elements_gives_finite_losses_and_gradients(method, number):
    model, losses = outcome(method, number)
    assert all(value.isfinite().all() for value in in_total(losses).values())
    gradients = [weight.grad for weight in model.parameters() if weight.grad is not None]
    assert all(gradient.isfinite().all() for gradient in gradients)


@methods
@pytest.mark.parametrize("number", [0, 1, 5])
def test_every_weight_of_a_head_takes_part_with_any_number_of_elements(method, number):
    """A weight without a gradient stops training on several GPUs."""
    model, _ = outcome(method, number)
    head = model.map_head
    assert [name for name, weight in head.named_parameters() if weight.grad is None] == []


@methods
def test_losses_have_one_set_of_names(method):
    names = [in_total(outcome(method, number)[1]).keys() for number in (0, 1, 5)]
    assert names[0] == names[1] == names[2]


@methods
def test_losses_of_pairs_are_zero_without_elements_and_positive_with_some(method):
    model, without = outcome(method, 0)
    _, some = outcome(method, 5)
    head = model.map_head
    of_pairs = getattr(head, "losses", None)
    pairs = of_pairs if isinstance(of_pairs, torch.nn.ModuleDict) else {}
    for name in pairs.keys() - OF_MAPS:
        names = [full for full in some if f"loss_{name}" in full]
        assert names
        assert all(without[full] == 0 for full in names)
        assert all(some[full] > 0 for full in names)
    if pairs:
        assert without["loss_cls"] > 0
