"""Merged parameter groups: equal steps, old checkpoints, kernels on another device."""

import copy

import pytest
import torch
from mmengine.optim import AmpOptimWrapper, CosineAnnealingLR, LinearLR, build_optim_wrapper
from torch import nn

import gsmap.registered  # noqa: F401
from gsmap.engine.optimizers import MapAmpOptimWrapper, MapOptimWrapper, fit_optimizer_state

SETTINGS = {
    "type": "MapOptimWrapper",
    "optimizer": {"type": "AdamW", "lr": 0.05, "weight_decay": 0.1},
    "paramwise_cfg": {
        "custom_keys": {"first": {"lr_mult": 0.1}, "norm": {"decay_mult": 0.0}},
    },
    "clip_grad": {"max_norm": 0.5},
}
MERGED = {**SETTINGS, "constructor": "MergedGroupsConstructor"}


class Net(nn.Module):
    """Parameters of three settings in an order that mixes them."""

    def __init__(self) -> None:
        super().__init__()
        self.head = nn.Linear(3, 2)
        self.first = nn.Linear(4, 3)
        self.norm = nn.LayerNorm(3)
        self.tail = nn.Linear(2, 1)
        self.first_again = nn.Linear(1, 1)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.first_again(self.tail(self.head(self.norm(self.first(x))))).square().mean()


class Run:
    """A training of a few steps with schedules, which may go on from a checkpoint."""

    def __init__(self, settings: dict) -> None:
        torch.manual_seed(0)
        self.net = Net()
        self.wrapper = build_optim_wrapper(self.net, copy.deepcopy(settings))
        self.schedulers = [
            LinearLR(self.wrapper, start_factor=0.1, by_epoch=False, end=3),
            CosineAnnealingLR(self.wrapper, T_max=8, eta_min_ratio=0.01, by_epoch=False),
        ]

    def train(self, first: int, last: int) -> None:
        for number in range(first, last):
            generator = torch.Generator().manual_seed(number)
            self.wrapper.update_params(self.net(torch.randn(5, 4, generator=generator)))
            for scheduler in self.schedulers:
                scheduler.step()

    def checkpoint(self) -> dict:
        return copy.deepcopy(
            {
                "state_dict": self.net.state_dict(),
                "optimizer": self.wrapper.state_dict(),
                "param_schedulers": [scheduler.state_dict() for scheduler in self.schedulers],
            }
        )

    def resume(self, checkpoint: dict) -> None:
        checkpoint = copy.deepcopy(checkpoint)
        fit_optimizer_state(checkpoint, self.wrapper)
        self.net.load_state_dict(checkpoint["state_dict"])
        self.wrapper.load_state_dict(checkpoint["optimizer"])
        for scheduler, state in zip(self.schedulers, checkpoint["param_schedulers"], strict=True):
            scheduler.load_state_dict(state)


def weights(run: Run) -> torch.Tensor:
    return torch.cat([p.detach().flatten() for p in run.net.parameters()])


def test_groups_of_equal_settings_are_one_and_steps_are_equal():
    each, merged = Run(SETTINGS), Run(MERGED)
    assert len(each.wrapper.optimizer.param_groups) == 10
    found = merged.wrapper.optimizer.param_groups
    kinds = [(group["lr"], group["weight_decay"], len(group["params"])) for group in found]
    # the linear schedule starts at a tenth
    assert [kind[1:] for kind in kinds] == [(0.1, 4), (0.1, 4), (0.0, 2)]
    assert [kind[0] for kind in kinds] == pytest.approx([0.005, 0.0005, 0.005])
    for run in (each, merged):
        run.train(0, 6)
    torch.testing.assert_close(weights(merged), weights(each), rtol=0, atol=0)
    assert merged.wrapper.get_lr()["lr"][0] == each.wrapper.get_lr()["lr"][0]
    assert merged.wrapper.get_lr()["base_lr"] == each.wrapper.get_lr()["base_lr"]


@pytest.mark.parametrize("old", [SETTINGS, MERGED], ids=["a group a parameter", "merged"])
def test_a_checkpoint_goes_on_as_if_nothing_had_happened(old):
    whole, before, after = Run(old), Run(old), Run(MERGED)
    whole.train(0, 7)
    before.train(0, 4)
    after.resume(before.checkpoint())
    after.train(4, 7)
    torch.testing.assert_close(weights(after), weights(whole), rtol=0, atol=0)
    assert after.wrapper.get_lr()["lr"][0] == whole.wrapper.get_lr()["lr"][0]


def test_without_conversion_an_old_checkpoint_does_not_fit():
    with pytest.raises(ValueError, match="different number of parameter groups"):
        Run(MERGED).wrapper.load_state_dict(Run(SETTINGS).checkpoint()["optimizer"])


def test_groups_that_were_set_differently_are_not_mixed():
    old = Run({**SETTINGS, "paramwise_cfg": {"custom_keys": {"tail": {"lr_mult": 0.5}}}})
    old.train(0, 1)
    with pytest.raises(ValueError, match=r"groups differ in settings that are equal in the config"):
        Run(MERGED).resume(old.checkpoint())


def test_a_checkpoint_is_computed_by_the_kernels_of_the_device_that_goes_on():
    fused = copy.deepcopy(MERGED)
    fused["optimizer"]["fused"] = True
    before, after = Run(fused), Run(MERGED)
    before.train(0, 2)
    after.resume(before.checkpoint())
    assert not after.wrapper.optimizer.param_groups[0]["fused"]
    again = Run(fused)
    again.resume(after.checkpoint())
    assert all(group["fused"] for group in again.wrapper.optimizer.param_groups)
    again.train(2, 3)


def test_a_cpu_takes_no_fused_step_by_itself():
    assert not Run(MERGED).wrapper.optimizer.param_groups[0]["fused"]
    assert "fused_on_gpu" not in Run({**MERGED, "fused_on_gpu": False}).wrapper.__dict__


def test_without_settings_by_parameter_there_is_one_group():
    plain = {key: value for key, value in MERGED.items() if key != "paramwise_cfg"}
    run = Run(plain)
    assert len(run.wrapper.optimizer.param_groups) == 1
    checkpoint = run.checkpoint()
    Run(plain).resume(checkpoint)


def test_mixed_precision_keeps_mmengines_wrapper():
    assert issubclass(MapAmpOptimWrapper, AmpOptimWrapper)
    assert MapAmpOptimWrapper._clip_grad is MapOptimWrapper._clip_grad
