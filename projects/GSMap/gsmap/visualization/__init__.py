"""Pictures of maps over cameras and in bird's-eye view."""
