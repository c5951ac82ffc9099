# nuScenes with the extended classes of MapVR: stop lines, intersections and car parks, which are areas like crossings.
# `python tools/create_data.py nuscenes --root data/nuscenes --tag _extended --classes divider ped_crossing boundary
# stop_line intersection carpark_area` makes the annotation files.
_base_ = './nuscenes.py'

classes = [
    'divider', 'ped_crossing', 'boundary', 'stop_line', 'intersection', 'carpark_area'
]

train_dataloader = dict(
    dataset=dict(classes=classes, ann_file='gsmap_nuscenes_train_extended.arrow'))
val_dataloader = dict(
    dataset=dict(classes=classes, ann_file='gsmap_nuscenes_val_extended.arrow'))
test_dataloader = val_dataloader
