"""Cases of general tests for this method."""

EXPORTS = {"as it is": ("configs/maptrv2/maptrv2_r18_minicity.py", {})}

LOSSES = ("pts", ())  # field of the ground truth; losses that may be zero
