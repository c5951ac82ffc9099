"""The frame of all map heads: queries, decoder, matching, losses, detections."""
