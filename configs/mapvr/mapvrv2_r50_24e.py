# MapVR on MapTRv2, ResNet-50, nuScenes, 24 epochs.
_base_ = '../maptrv2/maptrv2_r50_24e.py'

model = dict(map_head=dict(type='MapVRHead'))
