"""Parts of MapQR as its paper or release prints them; paper.json has further numbers."""

from paper_cases import head_of, require_target


def test_mapqr_scatters_and_masks_as_published():
    head = head_of("configs/mapqr/mapqr_r50_24e.py")
    layer = head.decoder.layers[0]
    assert not layer.mask_groups
    assert (layer.cross_attn.num_heads, layer.cross_attn.num_points) == (8, 4)
    gather = [part.out_features for part in layer.cross_attn.output_proj if hasattr(part, "bias")]
    assert gather == [2560, 256, 256]
    assert (layer.ffn.feedforward_channels, layer.cross_attn.dropout.p) == (512, 0.1)
    masks = head.aux_heads
    assert (masks["seg"].pos_weight, masks["pv_seg"].pos_weight) == (4.0, 1.0)


def test_each_element_is_matched_six_times_by_the_further_queries():
    first, further = head_of("configs/mapqr/mapqr_r50_24e.py").query_groups
    assert (first.repeats, further.repeats, further.weight) == (1, 6, 1.0)


def test_a_pipeline_without_targets_is_refused():
    require_target("configs/mapqr/mapqr_r18_minicity.py", "MakeBEVMask", "BEVMaskHead")
    require_target("configs/mapqr/mapqr_r18_minicity.py", "MakePVMask", "PVMaskHead")
