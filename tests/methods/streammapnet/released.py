"""Training settings of the release."""

from dataclasses import replace

from released_settings import Settings

STREAM = Settings(
    rates={"img_backbone": 5e-5, "the rest": 5e-4},
    schedule=("CosineAnnealingLR", 3e-3),
    evaluated=4,
    batch_norm="statistics fixed",
    frozen=-1,
    synchronized=True,
    weights="resnet50_msra-5891d200.pth",
)

RELEASED = {
    # yuantianyuan01/StreamMapNet, plugin/configs
    "configs/streammapnet/streammapnet_r50_24e.py": STREAM,
    "configs/streammapnet/streammapnet_r50_av2_30e.py": replace(STREAM, epochs=30, evaluated=5),
}  # fmt: skip
