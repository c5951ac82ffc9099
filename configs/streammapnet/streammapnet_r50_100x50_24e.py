# StreamMapNet on nuScenes, 100 x 50 m with cells of 1 m, 24 epochs. The annotation files are made with
# `--tag _ego_100x50 --x-range -50 50 --y-range -25 25`.
_base_ = './streammapnet_r50_24e.py'

grid = dict(x_range=[-50.0, 50.0], y_range=[-25.0, 25.0])
model = dict(grid=grid, bev_encoder=dict(bev_pixel_m=1.0))
train_dataloader = dict(dataset=dict(grid=grid, ann_file='gsmap_nuscenes_train_ego_100x50.arrow'))
val_dataloader = dict(dataset=dict(grid=grid, ann_file='gsmap_nuscenes_val_ego_100x50.arrow'))
test_dataloader = val_dataloader
val_evaluator = dict(thresholds=[1.0, 1.5, 2.0])
test_evaluator = dict(thresholds=[1.0, 1.5, 2.0])
