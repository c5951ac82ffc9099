"""Training settings of the release."""

from dataclasses import replace

from released_settings import FOUR_E4, MAPTR

GEMAP = replace(MAPTR, decay=0.03, epochs=110, evaluated=1)
GEMAP_FULL = replace(GEMAP, images="scale distort", frozen=-1)
V2_99 = replace(GEMAP_FULL, batch=3, batch_norm="statistics fixed")

RELEASED = {
    # cnzzx/GeMap, projects/configs/gemap
    "configs/gemap/gemap_simple_r50_110e.py": GEMAP,
    "configs/gemap/gemap_simple_r50_av2_24e.py": replace(
        GEMAP, warm_up=(200, 1 / 3), epochs=24, images="scale distort", frozen=-1
    ),
    "configs/gemap/gemap_full_swint_110e.py": replace(
        GEMAP_FULL, rates=FOUR_E4, batch=3, drop_path=0.1, batch_norm="none",
        weights="swin_tiny_patch4_window7_224.pth",
    ),
    "configs/gemap/gemap_full_v299_110e.py": replace(
        V2_99, weights="vovnet99_ese_detectron2.pth"
    ),
    "configs/gemap/gemap_full_v299_dd3d_110e.py": replace(
        V2_99, batch=4, frozen=1,
        weights="depth_pretrained_v99-3jlw0p36-20210423_010520-model_final-remapped.pth",
    ),
}  # fmt: skip
