"""Parts of MGMap as its paper or release prints them; paper.json has further numbers."""

from paper_cases import head_of, require_target


def test_mgmaps_masks_and_refinement_weigh_as_published():
    head = head_of("configs/mgmap/mgmap_r50_30e.py")
    assert (head.losses["ins"].dice_weight, head.losses["seg"].dice_weight) == (2.0, 15.0)
    assert head.losses["seg"].pos_weight == 4.0
    assert head.decoder.branches == [0, 1, 2, 3, 4, 5, 4, 5]
    attention, stage = head.decoder.layers[0].cross_attn, head.decoder.refinements[0].layer
    assert (attention.num_parts, attention.num_points, attention.num_heads) == (4, 16, 8)
    assert (stage.linear1.out_features, stage.self_attn.num_heads) == (1024, 8)


def test_a_pipeline_without_targets_is_refused():
    require_target("configs/mgmap/mgmap_r18_minicity.py", "FormatMapTargets", "MapHead")
