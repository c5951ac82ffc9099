"""Training settings of the release."""

from released_settings import Settings

RELEASED = {
    # Mrmoore98/VectorMapNet_code, configs/vectormapnet.py
    "configs/vectormapnet/vectormapnet_r50_130e.py": Settings(
        rates={
            "img_backbone": 1e-4, "img_neck": 1e-4, "bev_encoder.upsampling": 1e-4,
            "bev_encoder.reduction": 1e-4, "the rest": 1e-3,
        },
        clip=0.5, warm_up=(400, 0.1), schedule=("MultiStepLR", 100, 120, 0.1), epochs=130,
        batch=5, evaluated=1, images="scale", grid_mask=False, batch_norm="statistics fixed",
        frozen=-1, weights="resnet50_msra-5891d200.pth",
    ),
}  # fmt: skip
