# GSMap on MapTR, nuScenes with the six classes of the extended set, 24 epochs.
_base_ = '../../../configs/maptr/maptr_r50_extended_24e.py'

model = dict(map_head=dict(type='GSMapHead'))
