"""Conversion of a config of the authors' code."""

from methods.maptrv2.cases import upstream_config
from upstream_configs import converted


def test_masks_have_a_channel_for_each_class_of_the_file(tmp_path):
    four = "'boundary', 'centerline']"
    cfg, _ = converted(upstream_config().replace("'boundary']", four), tmp_path)
    steps = {step.type: step for step in cfg.train_dataloader.dataset.pipeline}
    assert len(cfg.train_dataloader.dataset.classes) == 4
    assert steps["MakeBEVMask"].num_classes == steps["MakePVMask"].num_classes == 4
