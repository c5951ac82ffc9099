"""Training settings of the release."""

from dataclasses import replace

from released_settings import MAPTR

RELEASED = {
    # hustvl/MapTR, projects/configs/maptr
    "configs/maptr/maptr_r50_24e.py": MAPTR,
    "configs/maptr/maptr_r50_110e.py": replace(MAPTR, epochs=110),
    "configs/maptr/maptr_r50_bevpool_24e.py": MAPTR,
    "configs/maptr/maptr_r50_av2_6e.py": replace(
        MAPTR, epochs=6, batch=6, images="scale distort"  # 6 epochs: papers; 24 in the release
    ),
    "configs/maptr/maptr_r18_nano_110e.py": replace(
        MAPTR, rates={"img_backbone": 4e-4, "the rest": 4e-3}, clip=50, epochs=110, batch=24,
        batch_norm="learns", frozen=-1, synchronized=True, weights="resnet18-f37072fd.pth",
    ),
}  # fmt: skip
