# MapQR as its release has been since 2024-09-19 (66.6 mAP by its author): query groups do not see each other.
_base_ = './mapqr_r50_24e.py'

model = dict(map_head=dict(decoder=dict(layer=dict(mask_groups=True))))
