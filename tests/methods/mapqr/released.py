"""Training settings of the release."""

from dataclasses import replace

from released_settings import MAPTR

RELEASED = {
    # HXMap/MapQR, projects/configs/mapqr
    "configs/mapqr/mapqr_r50_24e.py": replace(MAPTR, evaluated=4, images="scale distort"),
    "configs/mapqr/mapqr_r50_av2_6e.py": replace(
        MAPTR, warm_up=(200, 1 / 3), epochs=6, evaluated=1, images="scale distort"
    ),
}  # fmt: skip
