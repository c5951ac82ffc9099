"""Start, checkpoints and resumption of a run: arguments, config checks, hooks, optimizers."""
