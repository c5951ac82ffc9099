# A small BeMapNet for MiniCity, trained from scratch on two CPU cores. Crossings are rings here, as MapTR's metric has
# them, not the two edges of the release.
_base_ = [
    '../_base_/datasets/minicity.py', './_base_/model.py',
    '../_base_/schedules/minicity.py', '../_base_/default_runtime.py',
]

_width, _dim = 24, 128
model = dict(
    grid=_base_.grid, classes=_base_.classes,
    img_backbone=dict(depth=18, base_channels=_width, frozen_stages=-1, norm_eval=False, init_cfg=None),
    img_neck=dict(in_channels=(2 * _width, 4 * _width, 8 * _width), size=(9, 15), channels=48, num_rounds=2),
    bev_encoder=dict(
        in_channels=240, bev_pixel_m=1.875, embed_dims=_dim, num_layers=(1, 2), position_dims=4 * _dim,
        position_size=None, from_camera=False, layer_cfg=dict(num_heads=4, ffn_dims=2 * _dim, dropout=0.0)),
    map_head=dict(
        queries=(10, 16, 10), pieces=(3, 7, 7), embed_dims=_dim, mask_pixel_m=0.46875, bev_pixel_m=0.9375, to_end=True,
        losses=dict(mask_points=None, redrawn_in_px=False), decoder=dict(num_layers=2, num_heads=4, ffn_dims=2 * _dim)))
_targets = dict(type='FormatBezierTargets', edge_classes=(), thickness_px=2, sort_rings=True)
_scale = dict(type='ScaleImages', size=(320, 192))  # whatever the size of the files
train_dataloader = dict(batch_size=2, dataset=dict(pipeline=[_base_._load, _scale, _targets, _base_._pack]))
val_dataloader = test_dataloader = dict(dataset=dict(pipeline=[_base_._load, _scale, _base_._pack]))
