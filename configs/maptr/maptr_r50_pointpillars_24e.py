# MapTR with cameras and LiDAR (PointPillars) on nuScenes, 24 epochs.
_base_ = [
    '../_base_/datasets/nuscenes_lidar.py',
    '../_base_/models/maptr_r50_pointpillars.py',
    '../_base_/schedules/cosine_24e.py',
    '../_base_/default_runtime.py',
]
model = dict(grid=_base_.grid, classes=_base_.classes)
