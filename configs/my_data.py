# Your own data (docs/custom_data.md). Copy this file beside itself, say to configs/my_city.py, and edit the first part:
# it is the one place for files, frame, cameras, range and classes. `_base_` may be any config with a GKT encoder.
_base_ = './maptr/maptr_r18_minicity.py'
load_from = 'gsmap_r18_minicity'  # trained model to start from, fitted to what follows; None: from nothing

data_root = 'my_data/'  # holds train.arrow and val.arrow; --data-root names another folder
_frame = 'ego'  # x forward, y left; 'lidar': x right, y forward
_ground_z = 0.0  # height of the road in that frame, in metres, as in the annotation files (ground_z_m)
_cameras = ['front', 'rear']  # one or more
_file_size = (640, 360)  # of the image files, width and height: for benchmarks
_scale = 0.25  # of the image files' size: to some 160 x 90 pixels, which the model that ships was trained on
grid = dict(x_range=[-30.0, 30.0], y_range=[-15.0, 15.0])  # metres, as in the annotation files; sides: multiples of 30 m
classes = ['divider', 'ped_crossing', 'boundary']  # as in the annotation files
_queries = 20  # most elements that are found in a sample; `create_data.py check` says how many there are

# What follows from it
_cells = [round((b - a) / _base_.model.bev_encoder.bev_pixel_m) for a, b in (grid['y_range'], grid['x_range'])]
_data = dict(data_root=data_root, frame=_frame, ground_z_m=_ground_z, cameras=_cameras, grid=grid, classes=classes)
_load = [_base_._load, dict(type='ScaleImages', scale=_scale)]
_targets = [_base_._targets, dict(type='MakeBEVMask', size=_cells, thickness_px=1)]

_encoder = dict(num_cams=len(_cameras), z_range=(_ground_z - 0.25, _ground_z + 1.75))
optim_wrapper = dict(optimizer=dict(lr=3e-4))  # half of the base's, as training goes on from a trained model
model = dict(grid=grid, classes=classes, bev_encoder=_encoder, map_head=dict(type='GSMapHead', query_groups=[dict(num=_queries)]))
train_dataloader = dict(dataset=dict(**_data, ann_file='train.arrow', pipeline=[*_load, *_targets, _base_._pack]))
val_dataloader = test_dataloader = dict(dataset=dict(**_data, ann_file='val.arrow', pipeline=[*_load, _base_._pack]))
