"""The method of docs/add_a_method.md: its blocks run, and its head trains."""

import re
from pathlib import Path

import pytest
import torch
from head_cases import GSMAP, HEAD, LANES, build_head, losses_of, train_a_step

PAGE = Path(__file__).resolve().parents[1] / "docs/add_a_method.md"
BLOCKS = re.findall(r"^```python\n(.*?)^```", PAGE.read_text(), re.MULTILINE | re.DOTALL)


@pytest.fixture(scope="module")
def page() -> dict:
    """Run the blocks of the page as one module, and return its names."""
    names: dict = {"__name__": "added"}
    exec("\n".join(BLOCKS), names)  # the last block, a config, holds plain assignments
    return names


def test_the_config_of_the_page_turns_the_small_maptr_into_the_method(page):
    assert page["_base_"] == "../maptr/maptr_r18_minicity.py"
    head = build_head(HEAD, **page["model"]["map_head"])
    assert [cost.weight for cost in head.assigner.match_costs] == [2.0, 5.0, 2.0]
    losses = train_a_step(head, LANES)
    assert losses["loss_ends"] > 0
    without = build_head(HEAD, type="EndsHead", loss_ends=None, ends_cost=None)
    assert set(losses) - set(losses_of(without, LANES)) == {"loss_ends", "d0.loss_ends"}


def test_its_parts_combine_with_gaussians(page):
    losses = [*HEAD["losses"], {"type": "EndsLoss", "last_layer_only": True}]
    costs = [*HEAD["match_costs"], {"type": "EndsCost"}]
    found = train_a_step(build_head(GSMAP, losses=losses, match_costs=costs), LANES)
    assert "loss_ends" in found
    assert "d0.loss_ends" not in found


def test_values_of_the_page_by_hand(page):
    """Ends are off by (1, 0) and (0, 2); the point between them does not count."""
    from predictions import pairs_of

    pred = torch.tensor([[[1.0, 0.0], [9.0, 9.0], [0.0, 2.0]]])
    pairs = pairs_of(pred_pts=pred, gt_pts=torch.zeros(1, 3, 2), avg_factor=2.0)
    assert page["EndsLoss"](loss_weight=4.0)(pairs).item() == 4 * 3 / 2
