# MapTR with cameras and LiDAR (SECOND) on nuScenes, 24 epochs; trains on a GPU, tests on a CPU with spconv.
_base_ = [
    '../_base_/datasets/nuscenes_lidar.py',
    '../_base_/models/maptr_r50_second.py',
    '../_base_/schedules/cosine_24e.py',
    '../_base_/default_runtime.py',
]
model = dict(grid=_base_.grid, classes=_base_.classes)
