"""nuScenes format: tables and map expansion to annotation files."""
