"""The detector that joins backbone, BEV encoder and head."""
