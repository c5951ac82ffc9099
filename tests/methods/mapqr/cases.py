"""Cases of general tests for this method."""

EXPORTS = {"as it is": ("configs/mapqr/mapqr_r18_minicity.py", {})}

LOSSES = ("pts", ())  # field of the ground truth; losses that may be zero
