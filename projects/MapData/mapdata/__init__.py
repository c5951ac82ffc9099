"""From raw recordings to annotation files or samples: a reader for each data set and format."""
