# The small GSMap on rendered Argoverse 2 logs with points of three coordinates; make the files with `--dim 3`.
_base_ = '../../../configs/maptr/maptr_r18_av2_rendered.py'

_heights = dict(dataset=dict(dim=3))
train_dataloader = _heights
val_dataloader = _heights
test_dataloader = _heights
model = dict(
    map_head=dict(type='GSMapHead', reference=dict(coords=3, z_range=(-5.0, 3.0))))
