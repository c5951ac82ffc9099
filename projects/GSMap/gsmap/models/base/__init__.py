"""Base classes and shared parts of map heads: queries, decoder, matching, losses, detections."""
