# A small MapTR for MiniCity, trained from scratch on two CPU cores.
_base_ = [
    '../_base_/datasets/minicity.py',
    '../_base_/models/maptr_r18_minicity.py',
    '../_base_/schedules/minicity.py',
    '../_base_/default_runtime.py',
]
