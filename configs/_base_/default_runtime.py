# Runtime settings that every config shares.
custom_imports = dict(imports=['gsmap.registered'], allow_failed_imports=False)
default_scope = 'mmdet3d'
env_cfg = dict(
    cudnn_benchmark=False,
    mp_cfg=dict(mp_start_method='fork', opencv_num_threads=0),
    dist_cfg=dict(backend='nccl', timeout=1800))  # seconds that ranks wait for each other
default_hooks = dict(
    runtime_info=dict(type='MapRuntimeInfoHook'),
    timer=dict(type='IterTimerHook'),
    logger=dict(type='LoggerHook', interval=50),
    param_scheduler=dict(type='ParamSchedulerHook'),
    checkpoint=dict(
        type='AtomicCheckpointHook',
        interval=1,
        max_keep_ckpts=3,
        save_best='chamfer/mAP',  # of the validations
        rule='greater'),
    sampler_seed=dict(type='DistSamplerSeedHook'),
    sync_buffers=dict(type='MapSyncBuffersHook'),  # every rank validates the model that is saved
    visualization=dict(type='MapVisualizationHook', draw=True, num_val_samples=2))
custom_hooks = [dict(type='RunSummaryHook'), dict(type='RigFitHook'), dict(type='GaussianHealthHook')]
val_evaluator = dict(type='MapMetric', eval=['chamfer'])
test_evaluator = dict(type='MapMetric', eval=['chamfer', 'raster'])
vis_backends = [dict(type='LocalVisBackend'), dict(type='TensorboardVisBackend')]
visualizer = dict(type='MapVisualizer', vis_backends=vis_backends)
log_processor = dict(type='MapLogProcessor', window_size=50, by_epoch=True)
log_level = 'INFO'
load_from = None
randomness = dict(seed=0)  # the log says it; None: another one each time
resume = False
