# A small PivotNet for MiniCity, trained from scratch on two CPU cores. Crossings are rings here, as MapTR's metric has
# them, not the two edges of the release.
_base_ = [
    '../_base_/datasets/minicity.py', './_base_/model.py',
    '../_base_/schedules/minicity.py', '../_base_/default_runtime.py',
]

_width, _dim = 24, 128
model = dict(
    grid=_base_.grid, classes=_base_.classes,
    img_backbone=dict(
        depth=18, base_channels=_width, out_indices=(2, 3), norm_eval=False, init_cfg=None),
    bev_encoder=dict(
        image_size=(192, 320), in_channels=(4 * _width, 8 * _width), bev_pixel_m=1.875,
        embed_dims=_dim, num_layers=(1, 2), layer_cfg=dict(num_heads=4, num_points=4, ffn_dims=2 * _dim, dropout=0.0)),
    map_head=dict(
        queries=((10, 10), (16, 10), (10, 16)), embed_dims=_dim, mask_pixel_m=0.46875,
        decoder=dict(num_layers=2, num_heads=4, ffn_dims=2 * _dim)))
_targets = dict(type='FormatPivotTargets', edge_classes=(), thickness_px=2, sort_rings=True)
_scale = dict(type='ScaleImages', size=(320, 192))  # whatever the size of the files
train_dataloader = dict(batch_size=2, dataset=dict(pipeline=[_base_._load, _scale, _targets, _base_._pack]))
val_dataloader = test_dataloader = dict(dataset=dict(pipeline=[_base_._load, _scale, _base_._pack]))
