"""Parts of MGMapNet as its paper or release prints them; paper.json has further numbers."""

from paper_cases import head_of


def test_each_element_is_matched_six_times_by_the_further_queries():
    first, further = head_of("configs/mgmapnet/mgmapnet_r50_110e.py").query_groups
    assert (first.repeats, further.repeats, further.weight) == (1, 6, 1.0)


def test_masks_weigh_as_published():
    head = head_of("configs/mgmapnet/mgmapnet_r50_110e.py")
    assert (head.aux_heads["seg"].pos_weight, head.aux_heads["seg"].dice_weight) == (1.0, 3.0)
    assert head.losses["ins_seg"].dice_weight == 3.0
    assert head.losses["ins_seg"].last_layer_only
    assert head.losses["ins_seg"].first_group_only
