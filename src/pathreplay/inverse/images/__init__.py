"""Images of a run: files, backgrounds, metrics, and a store on disk for many of them."""
