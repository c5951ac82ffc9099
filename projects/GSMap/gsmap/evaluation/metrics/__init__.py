"""Further metrics of ``--eval``; a metric is in the file of its name."""
