"""Cases of general tests for this method."""

LOSSES = ("pts", ())  # field of the ground truth; losses that may be zero
