# GSMap on MapTR, nuScenes, 100 x 50 m, 24 epochs: BEV cells and masks of 0.25 m, because 0.3 m do not divide the map.
# The annotation files are made with `--tag _100x50 --x-range -25 25 --y-range -50 50`.
_base_ = '../../../configs/maptr/maptr_r50_24e.py'

grid = dict(x_range=[-25.0, 25.0], y_range=[-50.0, 50.0])
model = dict(
    grid=grid, bev_encoder=dict(bev_pixel_m=0.25),
    map_head=dict(type='GSMapHead', masks=dict(pixel_m=0.25)))
train_dataloader = dict(dataset=dict(grid=grid, ann_file='gsmap_nuscenes_train_100x50.arrow'))
val_dataloader = dict(dataset=dict(grid=grid, ann_file='gsmap_nuscenes_val_100x50.arrow'))
test_dataloader = val_dataloader
val_evaluator = dict(thresholds=[1.0, 1.5, 2.0])  # as published at this range
test_evaluator = dict(thresholds=[1.0, 1.5, 2.0])
