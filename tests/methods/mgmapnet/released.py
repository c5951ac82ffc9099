"""Training settings of the release."""

from dataclasses import replace

from released_settings import FOUR_E4, MAPTR

RELEASED = {
    # Tongji-MIC-Lab/MGMapNet, projects/configs/MGA/100query_class3_110epoch.py
    "configs/mgmapnet/mgmapnet_r50_110e.py": replace(
        MAPTR, rates=FOUR_E4, epochs=110, batch=2, evaluated=5, images="scale distort"
    ),
}  # fmt: skip
