"""Parts of VectorMapNet as its paper or release prints them; paper.json has further numbers."""

from paper_cases import head_of

from gsmap.models.vectormapnet.targets import FormatPolylineTargets


def test_vectormapnet_weighs_and_draws_as_released():
    head = head_of("configs/vectormapnet/vectormapnet_r50_130e.py")
    detector, generator, targets = head.detector, head.generator, FormatPolylineTargets()
    assert (detector.box_weight, detector.giou_weight, head.loss_weight) == (0.1, 1.0, 1.0)
    assert (detector.loss_cls.loss_weight, detector.cost_cls.weight) == (2.0, 2.0)
    assert (detector.elements.num_embeddings, detector.coder.max_num) == (120, 35)
    assert (detector.coder.margin_m, detector.coder.score_threshold) == (None, None)
    assert len(detector.layers) == len(generator.layers) == 6
    layers = detector.layers[0], generator.layers[0]
    assert [layer.self_attn.num_heads for layer in layers] == [8, 8]
    assert [layer.self_attn.dropout for layer in layers] == [0.1, 0.2]
    assert layers[0].ffn.feedforward_channels == layers[1].ffn[0].out_features == 512
    assert (layers[0].cross_attn.num_heads, layers[0].cross_attn.num_points) == (8, 4)
    assert (generator.top_p, generator.max_points, generator.redraw) == (0.9, 64, True)
    noise = generator.noise_share, generator.noise_px, generator.box_noise_by_x
    assert noise == (0.3, (2.0, 1.0), True)
    canvas = head.canvas
    assert (canvas.size, canvas.num_tokens, canvas.margin_m) == ((200, 100), 201, 2.0)
    assert (targets.pixel_m, targets.margin_m, targets.tolerance_m) == (0.3, 2.0, 0.2)
    assert (targets.smallest_box, targets.border_px) == (0.02, 0.1)
    assert targets.edge_classes == (2,)
