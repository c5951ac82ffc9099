"""MapTR (arXiv 2208.14437): the flow that every method uses, from queries to predictions."""
