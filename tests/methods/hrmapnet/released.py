"""Training settings of the release."""

from dataclasses import replace

from released_settings import MAPTR

RELEASED = {
    # HXMap/HRMapNet, projects/configs/hrmapnet
    "configs/hrmapnet/hrmapnet_r50_24e.py": replace(MAPTR, evaluated=4, images="scale distort"),
    "configs/hrmapnet/hrmapnet_r50_av2_30e.py": replace(
        MAPTR, warm_up=(200, 1 / 3), epochs=30, evaluated=5, images="scale distort"
    ),
}  # fmt: skip
