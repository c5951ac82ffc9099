"""Training settings of the release."""

from released_settings import EFFICIENT, Settings

RELEASED = {
    # Tsinghua-MARS-Lab/HDMapNet, train.py
    "configs/hdmapnet/hdmapnet_effb0_30e.py": Settings(
        rates={"the rest": 1e-3}, decay=1e-7, clip=5, warm_up=None, schedule=("StepLR", 10, 0.1),
        epochs=30, evaluated=5,  # the release takes IoUs after each epoch, no AP
        images="scale", grid_mask=False, left_out=False, **EFFICIENT,
    ),
}  # fmt: skip
