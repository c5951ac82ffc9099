# MapTR with a parallel segmentation branch, the baseline of MapVR's Table 5e, which names neither classes nor weight:
# all classes in one mask, as in MapTRv2.
_base_ = '../maptr/maptr_r50_24e.py'

_pipeline = _base_.train_dataloader.dataset.pipeline
model = dict(
    map_head=dict(aux_heads=[dict(type='BEVMaskHead', loss_weight=1.0, pos_weight=4.0)]))
train_dataloader = dict(
    dataset=dict(
        pipeline=[*_pipeline[:-1], dict(type='MakeBEVMask', size=(200, 100)), _pipeline[-1]]))
