"""Facts about a scene, computed on the host before a kernel is recorded."""
