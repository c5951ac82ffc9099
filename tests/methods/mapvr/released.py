"""Training settings of the release."""

from dataclasses import replace

from released_settings import MAPTR

RELEASED = {
    # ZhangGongjie/MapVR, projects/configs/maptr/exp_tiny_r50_*
    "configs/mapvr/mapvr_r50_24e.py": replace(MAPTR, batch=8, evaluated=6),
    "configs/mapvr/mapvr_r50_110e.py": replace(MAPTR, epochs=110, evaluated=10),
}  # fmt: skip
