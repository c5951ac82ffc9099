"""Training settings of the release."""

from dataclasses import replace

from released_settings import MAPTR

RELEASED = {
    # hustvl/MapTR (branch maptrv2), projects/configs/maptrv2
    "configs/maptrv2/maptrv2_r50_24e.py": replace(MAPTR, images="scale distort"),
    "configs/maptrv2/maptrv2_r50_av2_3d_6e.py": replace(
        MAPTR, warm_up=(200, 1 / 3), epochs=6, evaluated=1, images="scale distort"
    ),
}  # fmt: skip
