# What HRMapNet adds to MapTRv2, as published: a raster of earlier predictions at the place of a frame, read in BEV cells
# of 0.3 m, fused with the BEV features and attended to by the queries; queries without a positional half.
_hrmapnet = dict(
    map_head=dict(type='HRMapNetHead'),
    prior=dict(
        type='RasterPrior',
        cell_m=0.3,
        score_threshold=0.4,
        softness=2.0,
        train_rule=dict(name='keep_maximum'),
        test_rule=dict(name='last_seen', gain=30.0, lowest=2, highest=240),
        bev=dict(
            threshold=0.8,
            layer=dict(
                cross_attn=dict(type='SpatialCrossAttention', num_heads=8, num_points=8, num_heights=4),
                layer_cfg=dict(num_heads=8, ffn_dims=512, dropout=0.1),
                num_cams=6)),
        queries=dict(num_heads=8, stride=2, threshold=0.8, dropout=0.0)))

# Its sizes for MiniCity: 4 x 4 cells of the raster in each BEV cell.
_hrmapnet_minicity = dict(
    prior=dict(
        bev=dict(layer=dict(cross_attn=dict(num_heads=4), layer_cfg=dict(num_heads=4, ffn_dims=256, dropout=0.0))),
        queries=dict(num_heads=4, stride=1)))
