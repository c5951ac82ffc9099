# A small VectorMapNet for MiniCity, trained from scratch on two CPU cores. The generator learns from right boxes with
# right noise, sees its own output and finds its way back to metres.
_base_ = [
    '../_base_/datasets/minicity.py', './_base_/model.py',
    '../_base_/schedules/minicity.py', '../_base_/default_runtime.py',
]

_width, _dim, _layer = 24, 128, dict(num_layers=2, num_heads=4, ffn_dims=256)
model = dict(
    grid=_base_.grid, classes=_base_.classes,
    img_backbone=dict(
        depth=18, base_channels=_width, out_indices=(1, 2, 3), norm_eval=False, style='pytorch', dcn=None,
        stage_with_dcn=(False, False, False, False), init_cfg=None),
    img_neck=dict(in_channels=[2 * _width, 4 * _width, 8 * _width], out_channels=_width * 4, num_outs=3),
    bev_encoder=dict(bev_pixel_m=0.6, embed_dims=_width * 4, num_levels=3),
    map_head=dict(
        detector=dict(num_queries=40, in_channels=_width * 4, embed_dims=_dim, decoder=_layer, coder=dict(max_num=20)),
        generator=dict(
            in_channels=_width * 4, embed_dims=_dim, dropout=0.0, max_points=24, redraw=False, box_noise_by_x=False,
            **_layer)))
_steps = [_base_._load, _base_._scale, dict(type='FormatPolylineTargets', edge_classes=(2,)), _base_._pack]
train_dataloader = dict(batch_size=2, dataset=dict(pipeline=_steps))
