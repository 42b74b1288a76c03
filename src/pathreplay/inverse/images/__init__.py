"""Images: files, environment backgrounds, quality metrics, and a disk-backed store."""
