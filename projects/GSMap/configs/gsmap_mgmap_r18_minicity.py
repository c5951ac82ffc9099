# A small model of Gaussians on MGMap's decoder, for MiniCity; the masks of the pipeline are also those of its loss.
_base_ = '../../../configs/mgmap/mgmap_r18_minicity.py'

model = dict(map_head=dict(type='GSMapHead', masks=dict(source='targets', pixel_m=1.2, cost_pixel_m=1.2)))
