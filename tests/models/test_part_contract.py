"""The contract of all registered losses and costs, each asked in a small model that has it.

The model is that of the first config that has the part, of a method or of GSMap. A new loss or cost
without such a config fails.
"""

import copy
import inspect
import re
from argparse import Namespace
from functools import cache
from typing import Any

import pytest
import torch
from mmdet3d.registry import MODELS, TASK_UTILS
from test_configs import LEAVES, load, small

import gsmap.registered  # noqa: F401
from benchmarks.model import model_and_batch
from gsmap.models.base.losses import MapLoss
from gsmap.models.base.matching import MapCost

SIZE = (64, 96)  # of images
CONFIGS = sorted(
    (path for path in LEAVES if path.stem.endswith("_r18_minicity")),
    key=lambda path: path.parent.name == "configs",  # methods first, then combinations
)
PARTS = {
    name: part
    for registry in (MODELS, TASK_UTILS)
    for name, part in registry.module_dict.items()
    if inspect.isclass(part) and issubclass(part, (MapLoss, MapCost))
}
LOSSES = [name for name, part in PARTS.items() if issubclass(part, MapLoss)]
COSTS = [name for name, part in PARTS.items() if issubclass(part, MapCost)]
OF_MAPS = {"ForegroundLoss"}  # losses of all cells of the map, with or without elements
SUMS = {"EuclideanLoss"}  # relations of a sample's elements are added up, as in the released code
losses = pytest.mark.parametrize("name", LOSSES)
costs = pytest.mark.parametrize("name", COSTS)


def without_elements(samples: list) -> list:
    """Samples whose ground truth is empty; they are changed."""
    for sample in samples:
        sample.gt_instances_3d = sample.gt_instances_3d[:0]
    return samples


def with_single_points(samples: list) -> list:
    """Samples in which all points of an element are one; they are changed."""
    for sample in samples:
        truth = sample.gt_instances_3d
        truth.pts = truth.pts[:, :1].expand_as(truth.pts).contiguous()
        truth.pts_shifts = truth.pts_shifts[:, :, :1].expand_as(truth.pts_shifts).contiguous()
        truth.polylines = truth.pts
    return samples


KINDS = {
    "plain": list,
    "half": list,  # computed in half precision
    "empty": without_elements,
    "points": with_single_points,
}


class Case:
    """A small model with a batch of two samples.

    Args:
        number: Position of the config in ``CONFIGS``.
    """

    def __init__(self, number: int) -> None:
        cfg = small(load(CONFIGS[number]))
        options = Namespace(size=SIZE, device="cpu", threads=1)
        self.model, inputs, self.samples = model_and_batch(cfg, options, batch=2, num_elements=5)
        self.model.eval()  # a training draws at random
        self.computed: dict[tuple, tuple] = {}
        self.images = inputs["imgs"]
        head = self.model.map_head
        named_losses = getattr(head, "losses", None)
        self.losses = {}
        if isinstance(named_losses, torch.nn.ModuleDict):
            self.losses = dict(named_losses.items())
        for loss in self.losses.values():
            if hasattr(loss, "match_m"):
                loss.match_m = 1e3  # of a model that has learned nothing
        assigner = getattr(head, "assigner", None)
        self.costs = list(getattr(assigner, "match_costs", []))

    def has(self, name: str) -> bool:
        """Whether the head has a loss or cost of a class."""
        return any(type(part) is PARTS[name] for part in (*self.losses.values(), *self.costs))

    def values(self, *numbers: int, kind: str = "plain") -> dict[str, torch.Tensor]:
        """Losses of a batch, computed once.

        Args:
            *numbers: Positions of the samples of the batch.
            kind: Key of ``KINDS``.
        """
        key = (kind, numbers)
        if key not in self.computed:
            batch = KINDS[kind]([copy.deepcopy(self.samples[number]) for number in numbers])
            for position, sample in enumerate(batch):
                sample.set_metainfo({"scene": f"scene {position}"})
            inputs = {"imgs": self.images[list(numbers)]}
            model = copy.deepcopy(self.model)  # its memory is empty
            with torch.autocast("cpu", torch.bfloat16, enabled=kind == "half"):
                found = model(inputs=inputs, data_samples=batch, mode="loss")
            self.computed[key] = found, list(model.parameters())
        return self.computed[key][0]

    def gradients(self, name: str, kind: str) -> list[torch.Tensor]:
        """Gradients of a loss of both samples in the weights that it depends on."""
        total = sum(self.values_of(name, self.values(0, 1, kind=kind)).values())
        weights = [w for w in self.computed[kind, (0, 1)][1] if w.requires_grad]
        found = torch.autograd.grad(total, weights, retain_graph=True, allow_unused=True)
        return [gradient for gradient in found if gradient is not None]

    def values_of(self, name: str, values: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        """Losses of a class, of all decoder layers."""
        (key,) = (key for key, loss in self.losses.items() if type(loss) is PARTS[name])
        pattern = re.compile(rf"(d\d+\.)?loss_{key}(_\w+)?")
        found = {full: value for full, value in values.items() if pattern.fullmatch(full)}
        assert found
        return found


case_at = cache(Case)


def case_of(name: str) -> Case:
    """Return the first case that has a loss or cost of a class."""
    for number in range(len(CONFIGS)):
        case = case_at(number)
        if case.has(name):
            return case
    raise AssertionError(f"no config of {CONFIGS[0].name}'s kind has {name}")


@losses
def test_a_loss_does_not_depend_on_the_order_of_the_samples(name):
    case = case_of(name)
    forward = case.values_of(name, case.values(0, 1))
    backward = case.values_of(name, case.values(1, 0))
    torch.testing.assert_close(backward, forward, rtol=1e-4, atol=1e-6)  # another order of sums


@losses
def test_a_loss_of_a_sample_twice_is_that_of_the_sample(name):
    case = case_of(name)
    once = case.values_of(name, case.values(0))
    twice = case.values_of(name, case.values(0, 0))
    if name not in SUMS:
        torch.testing.assert_close(twice, once, rtol=1e-4, atol=1e-6)
    assert any(value != 0 for value in once.values())


@losses
def test_a_loss_without_elements_is_zero_and_has_finite_gradients(name):
    case = case_of(name)
    found = case.values_of(name, case.values(0, 1, kind="empty"))
    assert all(value.isfinite() for value in found.values())
    if name not in OF_MAPS:
        assert all(value == 0 for value in found.values())
    gradients = case.gradients(name, "empty")
    assert gradients
    assert all(gradient.isfinite().all() for gradient in gradients)


@losses
def test_a_loss_is_one_number_in_single_precision(name):
    case = case_of(name)
    for value in case.values_of(name, case.values(0, 1, kind="half")).values():
        assert value.shape == ()
        assert value.dtype == torch.float32
        assert value.isfinite()


@losses
def test_elements_of_one_point_give_finite_gradients(name):
    gradients = case_of(name).gradients(name, "points")
    assert gradients
    assert all(gradient.isfinite().all() for gradient in gradients)


class Rows:
    """View of some rows of a sample's predictions or ground truth.

    Args:
        view: The view of all rows.
        rows: Positions of the rows.
    """

    def __init__(self, view: Any, rows: list[int]) -> None:
        self._view = view
        self._rows = rows

    def __getattr__(self, name: str) -> torch.Tensor:
        return getattr(self._view, name)[self._rows]


@cache
def call_of(name: str) -> tuple[Any, Any, Any, Any]:
    """Return a cost, and the predictions, ground truth and metadata that it is called with."""
    case = case_of(name)
    part = PARTS[name]
    plain_call = part.__call__
    calls = []

    def record(self: Any, predictions: Any, truths: Any, *further: Any) -> torch.Tensor:
        if type(self) is part:
            calls.append((self, predictions, truths, further))
        return plain_call(self, predictions, truths, *further)

    part.__call__ = record
    case.computed.pop(("plain", (0, 1)), None)
    try:
        case.values(0, 1)
    finally:
        part.__call__ = plain_call
    return calls[0]


@costs
def test_a_cost_has_a_finite_value_for_each_pair(name):
    cost, predictions, truths, further = call_of(name)
    values = cost(predictions, truths, *further)
    assert values.shape == (len(predictions.pts), 5)
    assert values.dtype == torch.float32
    assert values.device == predictions.pts.device
    assert values.isfinite().all()
    assert values.min() < values.max()


@costs
def test_a_cost_of_a_pair_depends_on_this_pair_alone(name):
    cost, predictions, truths, further = call_of(name)
    values = cost(predictions, truths, *further)
    queries = [3, 0, 2]
    elements = [4, 1]
    found = cost(Rows(predictions, queries), Rows(truths, elements), *further)
    torch.testing.assert_close(found, values[queries][:, elements])


@costs
def test_a_cost_of_no_element_has_no_value(name):
    cost, predictions, truths, further = call_of(name)
    values = cost(predictions, Rows(truths, []), *further)
    assert values.shape == (len(predictions.pts), 0)


@pytest.mark.parametrize("name", PARTS)
def test_each_argument_is_described(name):
    part = PARTS[name]
    section = (inspect.getdoc(part) or "").partition("\nArgs:\n")[2].partition("\n\n")[0]
    described = set(re.findall(r"^    (\w+):", section, re.MULTILINE))
    assert described == set(inspect.signature(part).parameters)
