"""Training settings of the release."""

from dataclasses import replace

from released_settings import EFFICIENT, LINES, UPERNET

BEMAPNET = replace(
    LINES,
    rates={"img_backbone": 5e-5, "img_neck": 5e-5, "the rest": 2e-4},
    schedule=("MultiStepLR", 21, 27, 1 / 3),
    images="scale crop",  # the release mirrors at random besides
    frozen=1,
)

RELEASED = {
    # er-muyue/BeMapNet, configs
    "configs/bemapnet/bemapnet_r50_30e.py": BEMAPNET,
    "configs/bemapnet/bemapnet_swint_30e.py": replace(BEMAPNET, **UPERNET),
    "configs/bemapnet/bemapnet_effb0_30e.py": replace(BEMAPNET, **EFFICIENT),
}  # fmt: skip
