"""Small things that every room may use: files, processes, errors of commands."""
