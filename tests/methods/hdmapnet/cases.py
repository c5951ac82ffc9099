"""Cases of general tests for this method."""

TARGETS = (
    {"num_directions": 72, "pixel_m": 0.6},
    {"num_directions": 72, "pixel_m": 0.6},
)

LOSSES = ("pts", ("loss_pull",))  # embeddings of an element that are alike already

TRANSFORM_CASES = {
    "MakeLineMaps": {"adds": {"gt_lines", "gt_directions"}, "needs_truth": True},
}

ANY_NUMBER = True  # lines have no equal numbers of points


def check_targets(head, steps) -> None:
    """Lines have as many points as they need, so that no step of targets has their number."""
    assert not steps
