"""Further metrics of ``--eval``, each in a file with its name."""
