"""Parts of StreamMapNet as its paper or release prints them; paper.json has further numbers."""

from paper_cases import head_of, load

from gsmap.models.streams.memory import StreamMemory


def test_streammapnets_head_and_memory_weigh_as_released():
    """Section 3 and 4 of the release's description: 5 and 50 for classes and lines, 0.1 x 50."""
    cfg, head = (of("configs/streammapnet/streammapnet_r50_24e.py") for of in (load, head_of))
    assert [group.num for group in head.query_groups] == [100]
    assert [(loss.loss_weight, loss.beta) for loss in head.losses.values()] == [(50.0, 0.01)]
    assert [cost.weight for cost in head.assigner.match_costs] == [5.0, 50.0]
    assert (head.loss_cls.loss_weight, head.loss_cls.alpha, head.loss_cls.gamma) == (5.0, 0.25, 2.0)
    assert (head.num_points, head.embed_dims, len(head.decoder.layers)) == (20, 512, 6)
    attention = head.decoder.layers[0].cross_attn
    assert (attention.num_heads, attention.num_points) == (8, 20)
    assert head.coder.max_num == 100
    memory = StreamMemory(head, **cfg.model.temporal)
    assert (memory.bev.end_points, memory.bev.kept_dims, memory.half) == (False, None, False)
    queries = memory.queries
    assert (queries.num, queries.loss_weight, queries.beta) == (33, 5.0, 0.01)
    released = load("configs/streammapnet/streammapnet_r50_released_24e.py")
    assert released.model.temporal.bev.end_points
    assert released.model.bev_encoder.mirrored_self_attn
    assert released.train_dataloader.sampler.late_switch
