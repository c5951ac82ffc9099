"""All names are registered, whichever test file runs first."""

import gsmap.registered  # noqa: F401
