"""Cases of general tests for this method."""

EXPORTS = {
    "as it is": (
        "configs/hrmapnet/hrmapnet_r18_minicity.py",
        {"model.prior.test_memory": "none"},  # the graph of these tests gets no window
    )
}

LOSSES = ("pts", ())  # field of the ground truth; losses that may be zero
