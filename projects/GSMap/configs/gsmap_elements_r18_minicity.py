# A GSMap that updates its detections by those of the frame before. Nothing is trained for that: it takes any GSMap's
# checkpoint, such as tools/test.py THIS gsmap_r18_minicity, on drives.
_base_ = '../../../configs/maptr/maptr_r18_minicity.py'

model = dict(map_head=dict(type='GSMapHead'), temporal=dict(elements=dict()))
val_dataloader = dict(sampler=dict(_delete_=True, type='StreamTestSampler'))
test_dataloader = val_dataloader
