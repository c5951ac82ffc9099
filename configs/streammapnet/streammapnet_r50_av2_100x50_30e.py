# StreamMapNet on Argoverse 2, 100 x 50 m with cells of 1 m, cameras of 640 x 640, 30 epochs. The annotation files are
# made with `--tag _2hz_100x50 --x-range -50 50 --y-range -25 25` besides.
_base_ = './streammapnet_r50_av2_30e.py'

grid = dict(x_range=[-50.0, 50.0], y_range=[-25.0, 25.0])
model = dict(grid=grid, bev_encoder=dict(bev_pixel_m=1.0))
_scale = dict(type='ScaleImages', size=(640, 640))
_train = [*_base_._train[:2], _scale, *_base_._train[3:]]
train_dataloader = dict(dataset=dict(grid=grid, ann_file='gsmap_av2_train_2hz_100x50.arrow', pipeline=_train))
val_dataloader = dict(
    dataset=dict(
        grid=grid, ann_file='gsmap_av2_val_2hz_100x50.arrow', pipeline=[_base_._load, _scale, _base_._pack]))
test_dataloader = val_dataloader
val_evaluator = dict(thresholds=[1.0, 1.5, 2.0])
test_evaluator = dict(thresholds=[1.0, 1.5, 2.0])
