# MapTR tiny on nuScenes with the six classes of the extended set, 24 epochs. The added
# classes are areas, like crossings; docs/data.md makes their annotation files.
_base_ = [
    '../_base_/datasets/nuscenes.py', '../_base_/models/maptr_r50.py',
    '../_base_/schedules/cosine.py', '../_base_/default_runtime.py',
]

classes = ['divider', 'ped_crossing', 'boundary', 'stop_line', 'intersection', 'carpark_area']
train_dataloader = dict(dataset=dict(classes=classes, ann_file='gsmap_nuscenes_train_extended.arrow'))
val_dataloader = dict(dataset=dict(classes=classes, ann_file='gsmap_nuscenes_val_extended.arrow'))
test_dataloader = val_dataloader
model = dict(grid=_base_.grid, classes=classes)
