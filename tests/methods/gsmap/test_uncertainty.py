"""Errors of points beside the Gaussians that are rendered, their loss, and temperatures."""

from types import SimpleNamespace

import pytest
import torch
from head_cases import ALONG_Y, GSMAP, HEAD, LANES, N, P, bev, build_head, losses_of, train_a_step
from mmdet3d.structures import Det3DDataSample
from predictions import pairs_of

from gsmap.models.gsmap.coder import GaussianCoder
from gsmap.models.gsmap.uncertainty import GaussianNLLLoss
from gsmap.structures.gaussians import Gaussians, extents_along_line

ERRORS = {
    "reference": {"type": "ErrorReference", "min_scale_m": 0.15},
    "losses": [*HEAD["losses"], {"type": "GaussianNLLLoss", "match_m": 100.0}],
}


def pairs_of_a_line(sigma: torch.Tensor, aside_m: float = 0.3, slip_m: float = 1.0):
    """A line of five points along x, predicted to the side and too far along."""
    truth = torch.stack([torch.arange(5.0), torch.zeros(5)], -1)[None]
    means = (truth + torch.tensor([slip_m, aside_m])).requires_grad_()
    gaussians = Gaussians(means, sigma.expand(1, 5, 2), torch.zeros(1, 5))
    reference = SimpleNamespace(errors=lambda _: gaussians)
    predictions = SimpleNamespace(reference=reference)
    return means, pairs_of(predictions=predictions, pred_references=None, gt_pts_m=truth)


def test_the_likelihood_of_a_line_by_hand():
    """Sigmas of 2 m along and 0.5 m across, errors of 1 m and 0.3 m."""
    sigma, errors = torch.tensor([2.0, 0.5]), torch.tensor([1.0, 0.3])
    _, pairs = pairs_of_a_line(sigma)
    normal = 0.5 * (2 * torch.pi * sigma**2).log() + (errors / sigma) ** 2 / 2
    torch.testing.assert_close(GaussianNLLLoss().values(pairs), normal[None])
    torch.testing.assert_close(GaussianNLLLoss(2.0)(pairs), 2 * normal.sum())
    width = sigma / 2**0.5  # of the same variance
    laplace = (2 * width).log() + errors / width
    torch.testing.assert_close(GaussianNLLLoss(laplace=True).values(pairs), laplace[None])


def test_points_get_a_gradient_only_if_that_is_asked_for():
    sigma = torch.tensor([2.0, 0.5], requires_grad=True)
    for detach in (True, False):
        means, pairs = pairs_of_a_line(sigma)
        found = torch.autograd.grad(
            GaussianNLLLoss(detach_points=detach)(pairs), (sigma, means), allow_unused=True
        )
        assert found[0].abs().min() > 0
        assert (found[1] is None) == detach


def test_a_pair_that_is_no_detection_does_not_count():
    _, pairs = pairs_of_a_line(torch.tensor([2.0, 0.5]), aside_m=1.6)
    assert GaussianNLLLoss()(pairs).item() == 0
    assert GaussianNLLLoss(match_m=1.7)(pairs).item() > 0


def test_learning_the_errors_changes_no_point_and_no_rendered_gaussian():
    """One step with the loss and one without: all weights but those of the errors are equal."""
    with_loss, without = (
        build_head(GSMAP, **ERRORS),
        build_head(GSMAP, **{**ERRORS, "losses": HEAD["losses"]}),
    )
    without.load_state_dict(with_loss.state_dict())
    losses = train_a_step(with_loss, LANES)
    assert losses["loss_nll"].item() > 0
    train_a_step(without, LANES)
    weights = without.state_dict()
    changed = {k for k, v in with_loss.state_dict().items() if not torch.equal(v, weights[k])}
    assert changed
    assert all(".error_branches." in f".{name}" for name in changed)


def test_detections_have_the_errors_along_their_lines():
    head = build_head(GSMAP, **ERRORS).eval()
    for branch in head.reference.error_branches:
        torch.nn.init.normal_(branch[-1].weight)
    outputs = head(bev())
    (found,) = head.predict_by_feat(outputs, [{}])
    extents = extents_along_line(Gaussians(found.pts, found.scales, found.rotations))
    torch.testing.assert_close(extents, found.scales)  # the first axis is the line's
    assert found.scales.std() > 0.1
    plain = build_head(GSMAP).eval()
    plain.load_state_dict(head.state_dict(), strict=False)
    torch.testing.assert_close(plain(bev())[-1].pts, outputs[-1].pts)
    references = outputs[-1].references
    assert references.shape == (1, N, P, 7)
    rendered = head.reference.render(references, head.masks.grid)
    expected = plain.reference.render(plain(bev())[-1].references, head.masks.grid)
    torch.testing.assert_close(rendered, expected)


def test_errors_of_a_head_without_gaussians_are_refused():
    with pytest.raises(ValueError, match="GaussianNLLLoss needs Gaussians, got PointReference"):
        build_head(HEAD, losses=[{"type": "GaussianNLLLoss"}])


def test_a_rendered_gaussian_learns_from_the_loss_too():
    losses = [*HEAD["losses"], {"type": "GaussianNLLLoss", "laplace": True, "match_m": 100.0}]
    head = build_head(GSMAP, losses=losses, loss_raster=None, iou_cost=None).train()
    losses_of(head, LANES)["loss_nll"].backward()
    assert head.reference.gaussian_branches[-1][-1].weight.grad.abs().max() > 0


def test_temperatures_stretch_the_sigmas_of_their_class():
    head, hot = build_head(GSMAP), build_head(GSMAP, temperatures=[[2, 1], [1, 1], [1, 0.5]])
    (plain,), (found,) = (h.eval().predict_by_feat(h(bev()), [{}]) for h in (head, hot))
    torch.testing.assert_close(found.pts, plain.pts)
    before, after = (
        extents_along_line(Gaussians(p.pts, p.scales, p.rotations)) for p in (plain, found)
    )
    factors = torch.tensor([[2, 1], [1, 1], [1, 0.5]])[plain.labels_3d][:, None]
    assert len(plain.labels_3d.unique()) > 1
    torch.testing.assert_close(after, before * factors)


@pytest.mark.parametrize("temperatures", [[[1, 1]], [[1, 1], [1, 0], [1, 1]], [[1], [1], [1]]])
def test_temperatures_that_do_not_fit_are_refused(temperatures):
    with pytest.raises(ValueError, match="temperatures must be two numbers > 0 for each of the 3"):
        build_head(GSMAP, temperatures=temperatures)


def test_scores_weighed_by_sigma_are_those_of_the_same_elements():
    """All elements stay, their odds are divided by their own sigmas; points have none."""
    plain = build_head(GSMAP, coder={"margin_m": None, "max_num": 200})
    plain.eval()
    torch.nn.init.normal_(plain.reference.gaussian_init.weight, std=0.1)
    weighed = build_head(GSMAP, coder={"margin_m": None, "max_num": 200, "sigma_power": 1.0})
    weighed.eval().load_state_dict(plain.state_dict())
    with torch.no_grad():
        (before,), (after,) = (
            head.predict(bev(), [Det3DDataSample()]) for head in (plain, weighed)
        )

    def odds(found):
        by_place = found.pts.flatten(1)[:, 0].double() + 1000 * found.labels_3d
        order = by_place.argsort()
        sigma = found.scales.amin(-1).log().mean(-1).exp()
        return (found.scores_3d.logit().exp())[order], sigma[order]

    (was, sigma), (now, same) = odds(before), odds(after)
    torch.testing.assert_close(sigma, same)
    assert sigma.std() > 0
    torch.testing.assert_close(now, was / sigma, rtol=1e-3, atol=0)
    with pytest.raises(ValueError, match=r"coder\.sigma_power is no setting of MapCoder"):
        build_head(HEAD, coder={"sigma_power": 1.0})
    with pytest.raises(ValueError, match="sigma_power must be >= 0, got nan"):
        build_head(GSMAP, coder={"sigma_power": float("nan")})


def test_odds_are_divided_by_the_smaller_sigma():
    """Odds of 3 and 2; the geometric means of the smaller sigmas are 1 and 0.5 m."""
    scores = torch.tensor([[3.0], [2.0]]).log()
    scales = torch.tensor([[[0.5, 9.0], [2.0, 2.0]], [[7.0, 0.25], [1.0, 1.0]]])
    for power, odds in ((0.0, [3, 2]), (1.0, [3, 4]), (2.0, [3, 8])):
        found = GaussianCoder(ALONG_Y, sigma_power=power).weigh_scores(scores, {"scales": scales})
        torch.testing.assert_close(found.exp()[:, 0], torch.tensor(odds).float())
