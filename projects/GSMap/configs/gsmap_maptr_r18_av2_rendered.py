# A small GSMap on rendered Argoverse 2 logs, trained from scratch on two CPU cores.
_base_ = '../../../configs/maptr/maptr_r18_av2_rendered.py'

model = dict(map_head=dict(type='GSMapHead'))
