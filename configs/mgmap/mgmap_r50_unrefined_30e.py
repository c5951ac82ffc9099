# MGMap on nuScenes without its refinement, and so without the segmentation that it reads.
_base_ = './mgmap_r50_30e.py'

model = dict(map_head=dict(decoder=dict(refinements=0), losses=_base_.model.map_head.losses[:3]))
