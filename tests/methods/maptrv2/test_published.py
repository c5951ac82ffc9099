"""Parts of MapTRv2 as its paper or release prints them; paper.json has further numbers."""

from paper_cases import head_of, require_target


def test_each_element_is_matched_six_times_by_the_further_queries():
    first, further = head_of("configs/maptrv2/maptrv2_r50_24e.py").query_groups
    assert (first.repeats, further.repeats, further.weight) == (1, 6, 1.0)


def test_masks_weigh_as_published():
    masks = head_of("configs/maptrv2/maptrv2_r50_24e.py").aux_heads
    assert (masks["seg"].pos_weight, masks["seg"].dice_weight) == (4.0, 0.0)
    assert masks["pv_seg"].pos_weight == 1.0


def test_a_pipeline_without_targets_is_refused():
    require_target("configs/maptrv2/maptrv2_r50_24e.py", "MakeDepthMap", "DepthSupervision")
