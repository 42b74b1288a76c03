"""The edge searches: each has its own domain of segments (see `search`)."""
