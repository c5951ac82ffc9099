# MapQR on Argoverse 2 with points of three coordinates (65.4 mAP published), 6 epochs, 4 x 8 samples per step.
# The annotation files are made with `--dim 3`.
_base_ = './mapqr_r50_av2_6e.py'

_heights = dict(dataset=dict(dim=3))
train_dataloader = _heights
val_dataloader = _heights
test_dataloader = _heights
model = dict(map_head=dict(reference=dict(coords=3, z_range=_base_.model.bev_encoder.z_range)))
