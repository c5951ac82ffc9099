# GSMap on MapTRv2, nuScenes, with the 50 one-to-many queries of the paper's Table 3.
_base_ = '../../../configs/maptrv2/maptrv2_r50_o2m50_24e.py'

model = dict(map_head=dict(type='GSMapHead'))
