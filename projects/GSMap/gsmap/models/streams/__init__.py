"""Memory over the frames of a drive, for any method: states of streams, BEV and queries."""
