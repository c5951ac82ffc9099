"""Memory over the frames of a drive, for any method: BEV features, queries and elements."""
