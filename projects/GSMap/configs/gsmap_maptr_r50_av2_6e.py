# GSMap on MapTR, Argoverse 2, 6 epochs: the paper's Table 2.
_base_ = '../../../configs/maptr/maptr_r50_av2_6e.py'

model = dict(map_head=dict(type='GSMapHead'))
