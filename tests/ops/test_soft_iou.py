import pytest
import torch

from gsmap.ops.soft_iou import dice_loss, pairwise_dice_loss, pairwise_soft_iou, soft_iou

BACKENDS = ["reference", "cpu"]


def sparse_masks(count, seed):
    generator = torch.Generator().manual_seed(seed)
    masks = torch.rand(count, 21, 33, generator=generator)
    return masks * (torch.rand(count, 21, 33, generator=generator) < 0.2)


@pytest.mark.parametrize("backend", BACKENDS)
def test_values_worked_by_hand(backend):
    """Against (1, 0.5, 0): itself 1; (0.5, 0.5, 1): (0.5 + 0.5) / (1 + 0.5 + 1); nothing: 0."""
    preds = torch.tensor([[[1, 0.5, 0]], [[0.5, 0.5, 1]], [[0, 0, 0]]])
    iou = pairwise_soft_iou(preds, preds[:1], backend=backend)
    torch.testing.assert_close(iou, torch.tensor([[1.0], [0.4], [0.0]]))


@pytest.mark.usefixtures("poisoned_empty")
def test_fused_kernel_equals_every_pair_in_float64():
    preds, targets = sparse_masks(7, 0), sparse_masks(5, 1)
    pairs = preds.double()[:, None], targets.double()[None]
    exact = torch.minimum(*pairs).sum((2, 3)) / torch.maximum(*pairs).sum((2, 3))
    torch.testing.assert_close(pairwise_soft_iou(preds, targets, backend="cpu"), exact.float())


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize(("n", "k"), [(0, 3), (3, 0), (0, 0)])
def test_no_prediction_and_no_ground_truth(backend, n, k):
    iou = pairwise_soft_iou(sparse_masks(n, 0), sparse_masks(k, 1), backend=backend)
    assert iou.shape == (n, k)


def test_dice_loss_by_hand():
    """p = (1, 0.5, 0), t = (0.5, 0.5, 1): 1 - (2 * 0.75 + 1) / (1.5 + 2 + 1); of nothing: 0."""
    preds = torch.tensor([[[1, 0.5, 0]], [[0, 0, 0]]])
    targets = torch.tensor([[[0.5, 0.5, 1]], [[0, 0, 0]]])
    torch.testing.assert_close(dice_loss(preds, targets), torch.tensor([4 / 9, 0.0]))
    # the other pairs: 1 - 1 / (1.5 + 1) and 1 - 1 / (2 + 1)
    expected = torch.tensor([[4 / 9, 0.6], [2 / 3, 0.0]])
    torch.testing.assert_close(pairwise_dice_loss(preds, targets), expected)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_large_masks_in_half_precision_are_summed_in_float32(dtype):
    """The sums of 90,000 ones, and products of them, are beyond float16."""
    ones = torch.ones(2, 300, 300, dtype=dtype)
    for loss in (dice_loss(ones, ones), pairwise_dice_loss(ones, ones)):
        assert loss.dtype == torch.float32
        assert loss.abs().max() < 1e-6
    torch.testing.assert_close(soft_iou(ones, ones), torch.ones(2))
    preds, targets = sparse_masks(5, 0).to(dtype), sparse_masks(5, 1).to(dtype)
    pairs = pairwise_soft_iou(preds, targets)
    torch.testing.assert_close(soft_iou(preds, targets), pairs.diagonal())
    with torch.autocast("cpu", torch.bfloat16):
        pairs = pairwise_dice_loss(preds.float(), targets.float())
    torch.testing.assert_close(dice_loss(preds, targets), pairs.diagonal())


def test_two_empty_masks_have_no_overlap():
    empty = torch.zeros(1, 4, 5)
    assert pairwise_soft_iou(empty, empty).item() == 0


def test_gradient_is_given_where_it_is_asked_for():
    preds = sparse_masks(2, 0).double().requires_grad_()
    pairwise_soft_iou(preds, sparse_masks(3, 1).double()).sum().backward()
    single = sparse_masks(2, 0).requires_grad_()
    pairwise_soft_iou(single, sparse_masks(3, 1)).sum().backward()
    torch.testing.assert_close(single.grad, preds.grad.float())


def test_a_fused_kernel_has_no_gradient():
    preds = sparse_masks(2, 0).requires_grad_()
    assert not pairwise_soft_iou(preds, sparse_masks(3, 1), backend="cpu").requires_grad


def test_shapes_that_disagree_are_named():
    with pytest.raises(ValueError, match=r"\(2, 4, 5\) and \(2, 5, 4\)"):
        pairwise_soft_iou(torch.zeros(2, 4, 5), torch.zeros(2, 5, 4))
