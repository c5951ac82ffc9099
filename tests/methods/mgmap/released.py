"""Training settings of the release."""

from dataclasses import replace

from released_settings import MAPTR

RELEASED = {
    # xiaolul2/MGMap, projects/configs/mgmap/mgmap_cam_r50_30e.py
    "configs/mgmap/mgmap_r50_30e.py": replace(
        MAPTR, rates={"img_backbone": 3e-5, "the rest": 3e-4}, epochs=30, evaluated=6
    ),
}  # fmt: skip
