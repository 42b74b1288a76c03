"""Facts about a scene that are found out on the host, before a kernel is recorded."""
