"""One pass over an image: its rays, its film, what went wrong, and the `pathreplay` plugin that Mitsuba sees."""
