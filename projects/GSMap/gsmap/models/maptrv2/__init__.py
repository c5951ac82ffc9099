"""MapTRv2 (arXiv 2308.05736): decoupled self-attention, auxiliary heads."""
