"""Maps of earlier drives as an input of a detector, for any method."""
